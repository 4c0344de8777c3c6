"""Which LiDARs of a site the poles link."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

Seen = tuple[tuple[tuple[bool, ...], ...], ...]
"""``seen[placement][lidar][pole]``."""

LINKING_POLES = 2
"""Poles of one placement that two LiDARs share when they are linked: fewer determine no pose."""


def groups_of(seen: Sequence[Sequence[Sequence[bool]]], lidars: int) -> list[tuple[int, ...]]:
    """LiDARs that are linked with each other, directly or through others."""
    group = list(range(lidars))
    for placement in seen:
        for a, b in combinations(range(lidars), 2):
            shared = sum(x and y for x, y in zip(placement[a], placement[b], strict=True))
            if shared >= LINKING_POLES:
                old, new = group[b], group[a]
                group = [new if own == old else own for own in group]
    return [tuple(k for k in range(lidars) if group[k] == own) for own in sorted(set(group))]


def are_linked(seen: Sequence[Sequence[Sequence[bool]]], lidars: int) -> bool:
    """Whether all LiDARs are in one group."""
    return len(groups_of(seen, lidars)) == 1
