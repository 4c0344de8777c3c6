"""Which nodes hang together, and their datum: control, or the first node held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from ...api import Array, BoolArray, IntArray, se3
from .graph import Graph, grouped

LEAST_LEVER = 1e-3
"""Control points that lie on one line but for so much, metres, hold no rotation about it."""


@dataclass(frozen=True, eq=False)
class Component:
    """Nodes that hang together.

    Attributes
    ----------
    nodes
        (K,) in rising order.
    controls
        How many known poses and control points tie it to the frame of the network.
    held
        (H, 6) directions in which its first node is held, since no control says anything of
        them: rows over ``[φ, δ]``, orthonormal; all six without control.
    """

    nodes: IntArray
    controls: int
    held: Array

    @property
    def datum(self) -> str:
        """In words."""
        return self.datum_of(None)

    def datum_of(self, names: Sequence[str] | None) -> str:
        """In words, with the first node by its name (N,) rather than by its number."""
        first = int(self.nodes[0])
        pose = f"pose {first if names is None else names[first]}"
        if not self.controls:
            return f"no control: {pose} is held"
        if len(self.held):
            return (
                f"{self.controls} controls leave {len(self.held)} of its rotations open: "
                f"{pose} is held in them"
            )
        return f"{self.controls} controls"


def hanging_together(graph: Graph, kept: BoolArray) -> IntArray:
    """(N + 1,) label of each node and, last, of the ground: equal where those kept (M,) join."""
    ends = tuple(end[kept] for end in graph.ends)
    size = graph.nodes + 1
    matrix = coo_array((np.ones(len(ends[0])), ends), shape=(size, size))
    return np.asarray(connected_components(matrix, directed=False)[1], dtype=np.int64)


def find_components(graph: Graph, active: BoolArray) -> tuple[Component, ...]:
    """Find the components of a network, by those of its observations that are active (M,)."""
    is_edge = np.arange(graph.observations) < len(graph.edges)
    label = np.unique(hanging_together(graph, active & is_edge)[:-1], return_inverse=True)[1]
    _, known, points = np.split(active, np.cumsum([len(graph.edges), len(graph.known)]))
    world, count = graph.points.world[points], int(label.max()) + 1
    groups = (
        grouped(label[nodes], count)
        for nodes in (slice(None), graph.known.node[known], graph.points.node[points])
    )
    components = [
        Component(
            nodes, len(posed) + len(seen), np.zeros((0, 6)) if len(posed) else _open(world[seen])
        )
        for nodes, posed, seen in zip(*groups, strict=True)
    ]
    return tuple(sorted(components, key=lambda component: int(component.nodes[0])))


def _open(points: Array) -> Array:
    """(H, 6) directions that points (K, 3) do not hold."""
    if not len(points):
        return np.eye(6)
    away = points - points.mean(axis=0)
    arms = se3.hat(away)
    size, way = np.linalg.eigh(np.einsum("kba,kbc->ac", arms, arms))
    free = way[:, size <= LEAST_LEVER**2].T
    return np.hstack([free, np.zeros_like(free)])


def connected(graph: Graph, wanted: BoolArray, squares: Array) -> BoolArray:
    """Add to the wanted observations (M,) those of the least squares that hold all together.

    Two contradicting edges that a node alone hangs by both look wrong; without either it would
    have no place at all.
    """
    size = graph.nodes + 1
    order = np.lexsort((squares, ~wanted))
    low, high = np.sort(np.stack(graph.ends), axis=0)[:, order]
    # Between the same two ends the best one counts.
    best = np.unique(np.ravel_multi_index((low, high), (size, size)), return_index=True)[1]
    # What the tree is the least sum of, ranks, tells which they are.
    ranks = coo_array((best + 1.0, (low[best], high[best])), shape=(size, size))
    tree = minimum_spanning_tree(ranks.tocsr())
    kept = wanted.copy()
    kept[order[tree.data.astype(np.int64) - 1]] = True
    return kept
