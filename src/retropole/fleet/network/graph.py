"""What a network is made of: poses to find, relative poses between them, and surveyed points.

Observations are numbered: edges first, then control points, which join a pose and the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from ...api import Array, BoolArray, IntArray, se3
from ...base.errors import UsageError

LEAST_INDEPENDENT = 1e-5
"""Part of the variance of each number that is added to it: GTSAM gives up where one is known
2¹² times better given another."""

LEAST_LEVER = 1e-3
"""Control points that lie on one line but for this much, metres, hold no rotation about it."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Relative poses, each taken as independent of the others.

    Attributes
    ----------
    i, j
        (E,) the two poses of each.
    T_i_j
        (E, 4, 4) maps points of j into the frame of i.
    covariance
        (E, 6, 6) over ``[φ, δ]``, rad and m, axes of i: ``R_true = Exp(φ) R``, ``t_true = t + δ``.
    """

    i: IntArray
    j: IntArray
    T_i_j: Array
    covariance: Array

    def __len__(self) -> int:
        """How many there are."""
        return len(self.i)


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Surveyed points that a node sees, or that it is on.

    Attributes
    ----------
    node
        (P,) who sees it.
    world
        (P, 3) where it was surveyed, metres, frame of the network.
    covariance
        (P, 3, 3) of survey and sight together, m², axes of the network.
    seen
        (P, 3) where the node sees it, metres, in the frame of the node; its origin unless given.
    """

    node: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    world: Array = field(default_factory=lambda: np.zeros((0, 3)))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    seen: Array | None = None

    def __len__(self) -> int:
        """How many there are."""
        return len(self.node)

    @property
    def at(self) -> Array:
        """(P, 3) where each is in the frame of its node, metres."""
        return np.zeros((len(self), 3)) if self.seen is None else self.seen


@dataclass(frozen=True, eq=False)
class Graph:
    """A network to adjust.

    Attributes
    ----------
    nodes
        How many poses are to be found.
    edges
        Relative poses between them.
    points
        What ties them to the frame of the network.
    """

    nodes: int
    edges: Edges
    points: ControlPoints = field(default_factory=ControlPoints)

    @cached_property
    def ends(self) -> IntArray:
        """(M, 2) the two ends of each observation; the number behind the last pose is the ground.

        The ground is the second end.
        """
        points = np.stack([self.points.node, np.full(len(self.points), self.nodes)], axis=1)
        return np.concatenate([np.stack([self.edges.i, self.edges.j], axis=1), points])

    @cached_property
    def numbers(self) -> IntArray:
        """(M,) how many numbers each observation is: 6, or the 3 of a point."""
        return np.repeat([6, 3], [len(self.edges), len(self.points)])

    @cached_property
    def roots(self) -> Array:
        """(M, 6, 6) that make residuals of GTSAM multiples of σ, ``WᵀW = C⁻¹``.

        A point has its three numbers first.

        Raises
        ------
        UsageError
            Of a covariance that is not positive.
        """
        C = np.tile(np.eye(6), (len(self.ends), 1, 1))
        # GTSAM has the axes of the second pose, at its end.
        turn = twice(np.swapaxes(self.edges.T_i_j[:, :3, :3], 1, 2))
        C[self.numbers == 6] = turn @ self.edges.covariance @ np.swapaxes(turn, 1, 2)
        C[self.numbers == 3, :3, :3] = self.points.covariance
        C[:, range(6), range(6)] *= 1 + LEAST_INDEPENDENT
        try:
            # GTSAM takes a matrix without upper entries for a diagonal one.
            return np.swapaxes(np.linalg.cholesky(np.linalg.inv(C)), 1, 2)
        except np.linalg.LinAlgError:
            raise UsageError("a covariance of the network is not positive") from None


def twice(R: Array) -> Array:
    """(K, 6, 6) rotations (K, 3, 3) of a rotation and of a translation."""
    found = np.zeros((len(R), 6, 6))
    found[:, :3, :3] = found[:, 3:, 3:] = R
    return found


@dataclass(frozen=True, eq=False)
class Component:
    """Nodes that are connected.

    Attributes
    ----------
    nodes
        (K,) in rising order.
    points
        (C,) control points that tie it to the frame of the network.
    held
        (H, 3) axes about which its first node is fixed, since control gives no information about
        these rotations; without control all of its pose is fixed.
    """

    nodes: IntArray
    points: IntArray
    held: Array

    def datum(self, names: Sequence[object]) -> str:
        """In words, with the first node by its name (N,)."""
        pose = f"pose {names[int(self.nodes[0])]}"
        if not len(self.points):
            return f"no control points: {pose} is fixed"
        open_ = f" leave {len(self.held)} of its rotations undetermined: {pose} is fixed in them"
        return f"{len(self.points)} controls" + (open_ if len(self.held) else "")


def labels(graph: Graph, kept: BoolArray) -> IntArray:
    """(N + 1,) of each node and, last, of the ground: equal where observations kept (M,) join."""
    a, b = graph.ends[kept].T
    size = graph.nodes + 1
    matrix = coo_array((np.ones(len(a)), (a, b)), shape=(size, size))
    return np.asarray(connected_components(matrix, directed=False)[1], dtype=np.int64)


def find_components(graph: Graph, active: BoolArray) -> tuple[Component, ...]:
    """Find the components of a network by its active observations (M,)."""
    edges = len(graph.edges)
    label = labels(graph, active & (np.arange(len(active)) < edges))[:-1]
    some = np.flatnonzero(active[edges:])
    _, first, label = np.unique(label, return_index=True, return_inverse=True)
    groups = _grouped(label, len(first)), _grouped(label[graph.points.node[some]], len(first))
    found = [
        Component(nodes, some[own], _open(graph.points.world[some[own]]))
        for nodes, own in zip(*groups, strict=True)
    ]
    return tuple(sorted(found, key=lambda component: int(component.nodes[0])))


def _grouped(label: IntArray, count: int) -> list[IntArray]:
    order = np.argsort(label, kind="stable")
    return np.split(order, np.searchsorted(label[order], np.arange(1, count)))


def _open(points: Array) -> Array:
    """(H, 3) axes about which points (K, 3) hold no rotation."""
    arms = se3.hat(points - points.mean(axis=0)) if len(points) else np.zeros((0, 3, 3))
    size, way = np.linalg.eigh(np.einsum("kba,kbc->ac", arms, arms))
    return np.asarray(way[:, size <= LEAST_LEVER**2].T)


def connected(graph: Graph, wanted: BoolArray, squares: Array) -> BoolArray:
    """Add to the wanted observations (M,) those of the least squares that hold all together.

    Two contradicting edges that alone connect a node both look wrong; without either it would
    have no place at all.
    """
    size = graph.nodes + 1
    order = np.lexsort((squares, ~wanted))
    low, high = np.sort(graph.ends[order], axis=1).T
    # Between the same two ends the best one counts.
    best = np.unique(np.ravel_multi_index((low, high), (size, size)), return_index=True)[1]
    # The tree is the least sum of ranks; these show which edges they are.
    ranks = coo_array((best + 1.0, (low[best], high[best])), shape=(size, size))
    tree = minimum_spanning_tree(ranks.tocsr())
    kept = wanted.copy()
    kept[order[tree.data.astype(np.int64) - 1]] = True
    return kept


def worst_around(graph: Graph, chi2: Array, wrong: BoolArray) -> BoolArray:
    """Which of the wrong observations (M,) have the largest χ² of all around.

    Around an edge are all that share one of its poses, or are one edge away from it.
    """
    i, j = graph.ends.T
    score = np.where(wrong, chi2, 0.0)
    near = np.zeros(graph.nodes + 1)
    for _ in range(2):
        reach = np.maximum(score, np.maximum(near[i], near[j]))
        # The ground is not a neighbourhood: it does not connect controls at two ends of a city.
        for end in (i, j):
            np.maximum.at(near, end, reach)
        near[-1] = 0.0
    return np.asarray(wrong & (score >= np.maximum(near[i], near[j])))
