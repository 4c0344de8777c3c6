"""What a network is made of: poses to find, relative poses between them, and what was surveyed.

Nodes that are connected are a component, whose datum is control, or the first node held.
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
from .observations import Observations

MOST_NODES = 10_000_000
"""More poses than any city has posts: a count beyond it is a mistake."""


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
class KnownPoses:
    """Poses that are known in the frame of the network, with a covariance.

    Attributes
    ----------
    node
        (K,) which.
    T_world_node
        (K, 4, 4) maps points of it into the frame of the network.
    covariance
        (K, 6, 6) over ``[φ, δ]``, rad and m, axes of the network.
    """

    node: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    T_world_node: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 6, 6)))

    def __len__(self) -> int:
        """How many there are."""
        return len(self.node)


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Surveyed points that a node sees, or that it stands on.

    Attributes
    ----------
    node
        (P,) who sees it.
    world
        (P, 3) where it was surveyed, metres, frame of the network.
    covariance
        (P, 3, 3) of survey and sight together, m², axes of the network.
    seen
        (P, 3) where the node sees it, metres, in its own frame; its own origin unless given.
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
    known, points
        What ties them to the frame of the network.

    Raises
    ------
    UsageError
        Of arrays that do not fit together, numbers that are not finite, a node that is not there,
        an edge from a node to itself, a transform that is not rigid, or a covariance that is not
        symmetric and positive.
    """

    nodes: int
    edges: Edges
    known: KnownPoses = field(default_factory=KnownPoses)
    points: ControlPoints = field(default_factory=ControlPoints)

    def __post_init__(self) -> None:
        """Check all of it."""
        if not 0 < self.nodes <= MOST_NODES:
            raise UsageError(f"a network of {self.nodes} poses: expected 1 to {MOST_NODES}")
        edges, known, points = self.edges, self.known, self.points
        _check("edge", self.nodes, (edges.i, edges.j), edges.covariance, 6, edges.T_i_j)
        _check("known pose", self.nodes, (known.node,), known.covariance, 6, known.T_world_node)
        _check("control point", self.nodes, (points.node,), points.covariance, 3)
        _refuse("edge", edges.i == edges.j, "it leads from a pose to itself")
        for what, xyz in (("world", points.world), ("seen", points.at)):
            if xyz.shape != (len(points), 3) or not (np.abs(xyz) <= se3.FARTHEST).all():
                raise UsageError(
                    f"control points: {what} is {xyz.shape}, expected finite ({len(points)}, 3)"
                )

    @cached_property
    def observed(self) -> Observations:
        """Edges first, then known poses and control points as what the ground observes."""
        edges, known, points = self.edges, self.known, self.points
        surveyed = np.tile(np.eye(4), (len(points), 1, 1))
        surveyed[:, :3, 3] = points.world
        translations = np.zeros((len(points), 6, 6))
        translations[:, 3:, 3:] = _roots(points.covariance)
        ground = np.full(len(known) + len(points), self.nodes)
        return Observations(
            np.concatenate([edges.i, ground]),
            np.concatenate([edges.j, known.node, points.node]),
            np.concatenate([edges.T_i_j, known.T_world_node, surveyed]),
            np.concatenate([np.zeros((len(edges) + len(known), 3)), points.at]),
            np.concatenate([_roots(edges.covariance), _roots(known.covariance), translations]),
            np.repeat([6, 6, 3], [len(edges), len(known), len(points)]),
        )


def _roots(covariance: Array) -> Array:
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def grouped(label: IntArray, count: int) -> list[IntArray]:
    """Give for each label from 0 on the numbers of those that have it, in rising order."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.searchsorted(label[order], np.arange(1, count)))


def _check(
    what: str,
    most: int,
    ends: tuple[IntArray, ...],
    covariance: Array,
    size: int,
    T: Array | None = None,
) -> None:
    """Check observations of one kind: the poses of each, its covariance and its transform."""
    count = len(ends[0])
    shapes: list[tuple[str, Array | IntArray | None, tuple[int, ...]]] = [
        *(("poses", end, (count,)) for end in ends),
        ("covariance", covariance, (count, size, size)),
        ("transforms", T, (count, 4, 4)),
    ]
    for name, array, shape in shapes:
        if array is None:
            continue
        if array.shape != shape or (name == "poses" and array.dtype.kind not in "iu"):
            raise UsageError(f"{name} of each {what}: {array.shape}, expected {shape}")
    for end in ends:
        _refuse(what, (end < 0) | (end >= most), f"there is no pose of that number, only {most}")
    sigma = np.sqrt(np.abs(np.diagonal(covariance, axis1=1, axis2=2)))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        correlation = covariance / sigma[:, :, None] / sigma[:, None, :]
        skew = np.abs(correlation - np.swapaxes(correlation, 1, 2)).max(axis=(1, 2), initial=0)
        fine = skew < 1e-6
    fine[fine] = np.linalg.eigvalsh(correlation[fine])[:, 0] > 1e-12
    _refuse(what, ~fine, "its covariance is not symmetric and positive")
    if T is not None:
        R = T[:, :3, :3]
        with np.errstate(invalid="ignore", over="ignore"):
            off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2), initial=0)
            fine = (np.abs(T) <= se3.FARTHEST).all(axis=(1, 2)) & (off <= se3.RIGID_TOLERANCE)
            fine &= (T[:, 3] == [0, 0, 0, 1]).all(axis=1) & (np.linalg.det(R) > 0)
        _refuse(what, ~fine, "its transform is not rigid")


def _refuse(what: str, wrong: BoolArray, words: str) -> None:
    if wrong.any():
        raise UsageError(f"{what} {np.flatnonzero(wrong)[0]}: {words}")


LEAST_LEVER = 1e-3
"""Control points that lie on one line but for so much, metres, hold no rotation about it."""


@dataclass(frozen=True, eq=False)
class Component:
    """Nodes that are connected.

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


def hanging_together(graph: Graph, kept: BoolArray, but: Sequence[int] = ()) -> IntArray:
    """(N + 1,) label of each node and, last, of the ground: equal where those kept (M,) join.

    Some of these may be left out: their numbers are `but`.
    """
    kept = kept.copy()
    kept[list(but)] = False
    ends, size = (graph.observed.i[kept], graph.observed.j[kept]), graph.nodes + 1
    matrix = coo_array((np.ones(len(ends[0])), ends), shape=(size, size))
    return np.asarray(connected_components(matrix, directed=False)[1], dtype=np.int64)


def find_components(graph: Graph, active: BoolArray | None = None) -> tuple[Component, ...]:
    """Find the components of a network, by its observations or those that are active (M,)."""
    active = np.ones(len(graph.observed), dtype=bool) if active is None else active
    is_control = graph.observed.i == graph.nodes
    label = np.unique(hanging_together(graph, active & ~is_control)[:-1], return_inverse=True)[1]
    controls, count = graph.observed.only(np.flatnonzero(active & is_control)), label.max() + 1
    components = []
    groups = grouped(label, count), grouped(label[controls.j], count)
    for nodes, own in zip(*groups, strict=True):
        is_posed = (controls.freedom[own] == 6).any()
        held = np.zeros((0, 6)) if is_posed else _open(controls.T_i_j[own, :3, 3])
        components.append(Component(nodes, len(own), held))
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
    low, high = np.sort([graph.observed.i, graph.observed.j], axis=0)[:, order]
    # Between the same two ends the best one counts.
    best = np.unique(np.ravel_multi_index((low, high), (size, size)), return_index=True)[1]
    # What the tree is the least sum of, ranks, tells which they are.
    ranks = coo_array((best + 1.0, (low[best], high[best])), shape=(size, size))
    tree = minimum_spanning_tree(ranks.tocsr())
    kept = wanted.copy()
    kept[order[tree.data.astype(np.int64) - 1]] = True
    return kept
