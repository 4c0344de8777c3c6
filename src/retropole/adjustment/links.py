"""What holds a site together: pairs that link all LiDARs, and the poles that both sides see."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from .site import Adjusted


@dataclass(frozen=True)
class Link:
    """A pair of LiDARs without which some LiDARs would hang by fewer poles and patches.

    Attributes
    ----------
    lidars
        The pair.
    near
        LiDARs on the side of the first; all others are on the other side.
    poles
        Indices of the poles that both sides see: one LiDAR or many on each.
    """

    lidars: tuple[int, int]
    near: frozenset[int]
    poles: tuple[int, ...]

    @property
    def is_checked(self) -> bool:
        """Whether its poles check each other: two fit by themselves."""
        return len(self.poles) > 2


def find_links(adjusted: Adjusted) -> Iterator[Link]:
    """Find the pairs that link all LiDARs by most poles, and of those by most patches of the scene.

    They are a spanning tree, so that each parts the LiDARs into two sides.
    """
    count = len(adjusted.end.T)
    seen = [pole.seen.keys() for pole in adjusted.datum.poles]
    patches = {term.lidars: len(term.weighed.weights) for term in adjusted.end.scene}
    weights = {
        pair: (sum(set(pair) <= own for own in seen), patches.get(pair, 0))
        for pair in combinations(range(count), 2)
    }
    linked = [pair for pair in weights if weights[pair][0]]
    linked.sort(key=lambda pair: weights[pair], reverse=True)
    ranks = np.zeros((count, count))
    for rank, pair in enumerate(linked, start=1):
        ranks[pair] = rank
    tree = minimum_spanning_tree(ranks).toarray()
    for pair in linked:
        if not tree[pair]:
            continue
        rest = tree.copy()
        rest[pair] = 0.0
        _, label = connected_components(rest, directed=False)
        near = frozenset(np.flatnonzero(label == label[pair[0]]).tolist())
        across = [k for k, own in enumerate(seen) if own & near and own - near]
        yield Link(pair, near, tuple(across))
