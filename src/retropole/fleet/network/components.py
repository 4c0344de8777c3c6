"""Which nodes hang together, and their datum: control, or the first node held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from ...api import Array, BoolArray, IntArray, se3
from .graph import Graph

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


def labels(graph: Graph, active: BoolArray) -> IntArray:
    """(N,) number of the component of each node; components are counted by their first node."""
    edges = active[: len(graph.edges)]
    i, j = graph.edges.i[edges], graph.edges.j[edges]
    matrix = coo_array((np.ones(len(i)), (i, j)), shape=(graph.nodes, graph.nodes))
    found = connected_components(matrix, directed=False)[1]
    _, first, inverse = np.unique(found, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[inverse])


def find_components(graph: Graph, active: BoolArray) -> tuple[Component, ...]:
    """Find the components of a network, by those of its observations that are active (M,)."""
    label = labels(graph, active)
    edges, known = len(graph.edges), len(graph.known)
    by_label = np.argsort(label, kind="stable")
    bounds = np.searchsorted(label[by_label], np.arange(label[by_label[-1]] + 2))
    posed = label[graph.known.node[active[edges : edges + known]]]
    seen = active[edges + known :]
    pointed, world = label[graph.points.node[seen]], graph.points.world[seen]
    full = np.bincount(posed, minlength=len(bounds) - 1)
    some = np.bincount(pointed, minlength=len(bounds) - 1)
    by_part = np.argsort(pointed, kind="stable")
    ends = np.cumsum(some)
    components = []
    for k in range(len(bounds) - 1):
        held = np.zeros((0, 6))
        if not full[k]:
            held = _open(world[by_part[ends[k] - some[k] : ends[k]]])
        nodes = by_label[bounds[k] : bounds[k + 1]]
        components.append(Component(nodes, int(full[k] + some[k]), held))
    return tuple(components)


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
    i, j = graph.ends
    # Between the same two ends the best one counts; a weight of zero would be none.
    weight = np.where(wanted, 1e-3, 1.0 + squares)
    order = np.argsort(weight, kind="stable")
    low, high = np.minimum(i, j)[order], np.maximum(i, j)[order]
    _, best = np.unique(low * (graph.nodes + 1) + high, return_index=True)
    one = order[best]
    size = graph.nodes + 1
    matrix = coo_array((weight[one], (low[best], high[best])), shape=(size, size)).tocsr()
    tree = minimum_spanning_tree(matrix).tocoo()
    a, b = np.minimum(tree.row, tree.col), np.maximum(tree.row, tree.col)
    keys = low[best].astype(np.int64) * size + high[best]
    # `keys` rise: they are unique and sorted.
    found = one[np.searchsorted(keys, a.astype(np.int64) * size + b)]
    kept = wanted.copy()
    kept[found] = True
    return kept
