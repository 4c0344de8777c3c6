"""Which LiDARs of a site the poles link."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components

Seen = tuple[tuple[tuple[bool, ...], ...], ...]
"""``seen[placement][lidar][pole]``."""

LINKING_POLES = 2
"""Poles of one placement that two LiDARs share when they are linked: fewer determine no pose."""


def groups_of(seen: Sequence[Sequence[Sequence[bool]]], lidars: int) -> list[tuple[int, ...]]:
    """LiDARs that are linked with each other, directly or through others."""
    linked = np.zeros((lidars, lidars), dtype=bool)
    for placement in np.array(seen, dtype=np.int64) if len(seen) else ():
        linked |= placement @ placement.T >= LINKING_POLES
    count, group = connected_components(linked, directed=False)
    return [tuple(np.flatnonzero(group == k).tolist()) for k in range(count)]


def are_linked(seen: Sequence[Sequence[Sequence[bool]]], lidars: int) -> bool:
    """Whether all LiDARs are in one group."""
    return len(groups_of(seen, lidars)) == 1
