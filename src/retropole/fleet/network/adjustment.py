"""Least squares of a network: normal equations of blocks, solved again until nothing moves.

What each observation says, residuals and derivatives, counts in its own σ. Poses move by steps
``[φ, δ]`` in the axes of the network: ``Exp(φ) R`` and ``t + δ``. The translation does not turn
with the rotation, so that coordinates as large as a city's do no harm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from ...api import Array, BoolArray, IntArray, se3
from ...base.relative import relative_jacobian
from .elimination import Blocks, Factor, Pattern, factorise, find_pattern, solve
from .graph import Component, Edges, Graph


@dataclass(frozen=True, eq=False)
class Whitened:
    """Observations of one kind at some poses, each number in σ.

    Attributes
    ----------
    residual
        (K, D) what was measured against what the poses say.
    by_i, by_j
        (K, D, 6) derivatives by a step of the first pose, and of the second.
    """

    residual: Array
    by_i: Array
    by_j: Array


@dataclass(frozen=True, eq=False)
class Model:
    """A network with the whitening of its observations, which is the same at all poses."""

    graph: Graph

    @cached_property
    def relative(self) -> Edges:
        """Edges, then known poses as edges from the ground."""
        return self.graph.relative

    @cached_property
    def roots(self) -> tuple[Array, Array]:
        """(K, D, D) by which the residuals of each kind are counted in σ: ``WᵀW = C⁻¹``."""
        first, second = (
            np.linalg.inv(np.linalg.cholesky(C))
            for C in (self.relative.covariance, self.graph.points.covariance)
        )
        return first, second

    def at(self, T: Array) -> tuple[Whitened, Whitened]:
        """Relative poses, known ones last, and control points at poses (N, 4, 4)."""
        return self._relative_poses(T), self._points(T)

    def _relative_poses(self, T: Array) -> Whitened:
        """How far relative poses are from the measured ones."""
        of, W = self.relative, self.roots[0]
        T = with_ground(T)
        T_i, T_j = T[of.i], T[of.j]
        step = se3.local(of.T_i_j, se3.inverse(T_i) @ T_j) if len(of) else np.zeros((0, 6))
        J = W @ se3.local_jacobian(step) @ relative_jacobian(T_i, T_j)
        return Whitened(np.einsum("kab,kb->ka", W, step), J[:, :, :6], J[:, :, 6:])

    def _points(self, T: Array) -> Whitened:
        """How far seen points are from where they were surveyed."""
        points, W = self.graph.points, self.roots[1]
        own = T[points.node]
        arm = np.einsum("kab,kb->ka", own[:, :3, :3], points.at)
        by_j = W @ np.concatenate([-se3.hat(arm), np.tile(np.eye(3), (len(points), 1, 1))], axis=2)
        residual = own[:, :3, 3] + arm - points.world
        return Whitened(np.einsum("kab,kb->ka", W, residual), np.zeros_like(by_j), by_j)

    def squares(self, T: Array) -> Array:
        """(M,) squared residuals of all observations, in σ²."""
        return np.concatenate([np.sum(one.residual**2, axis=1) for one in self.at(T)])


def with_ground(T: Array) -> Array:
    """Poses (N + 1, 4, 4) with the ground as the last: the frame of the network itself."""
    return np.concatenate([T, np.eye(4)[None]])


SETTLED = 1e-8
"""Steps end where the next would change the sum of squares by less than this, σ²: no pose then
moves by more than 1e-4 of its σ."""

MOST_STEPS = 20
"""Of one adjustment; from a robust start three or four are usual."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the observations stand in the normal equations.

    Attributes
    ----------
    pattern
        Of the normal equations: every edge has its block, whether it is active or not.
    pair
        (E,) the block of each edge.
    turned
        (E,) whether its first pose is the second of the pair.
    onto_nodes
        (N, K) sums over observations, by the first and the second end of relative poses, known
        ones last, and by who sees the points.
    onto_pairs
        (P, E) sums over edges.
    """

    pattern: Pattern
    pair: IntArray
    turned: BoolArray
    onto_nodes: tuple[csr_array, ...]
    onto_pairs: csr_array

    def turn(self, blocks: Array) -> Array:
        """Turn blocks (E, B, B) by the ends of each edge into those by its pair's, or back."""
        turned = blocks.copy()
        turned[self.turned] = np.swapaxes(blocks[self.turned], 1, 2)
        return turned


@dataclass(frozen=True, eq=False)
class AdjustedNetwork:
    """Poses at the least sum of squares, and the factor of the normal equations there.

    `settled` says whether the steps ended by themselves.
    """

    T: Array
    factor: Factor
    settled: bool


def find_layout(model: Model) -> Layout:
    """Order the unknowns of a network."""
    graph = model.graph
    i, j = graph.edges.i, graph.edges.j
    ends = np.sort(np.stack([i, j], axis=1), axis=1)
    pairs, pair = np.unique(ends, axis=0, return_inverse=True)
    pair = pair.reshape(-1)
    relative = model.relative
    onto_nodes = tuple(
        # No unknowns are of the ground.
        _sums(node, graph.nodes + 1)[:-1]
        for node in (relative.i, relative.j, graph.points.node)
    )
    pattern = find_pattern(graph.nodes, pairs)
    return Layout(pattern, pair, i > j, onto_nodes, _sums(pair, len(pairs)))


def _sums(target: IntArray, size: int) -> csr_array:
    """(size, K) matrix that adds up K values by where they belong."""
    count = len(target)
    return csr_array((np.ones(count), (target, np.arange(count))), shape=(size, count))


def added(sums: csr_array, values: Array) -> Array:
    """Add up values (K, ...) by where they belong."""
    shape = values.shape[1:]
    flat = values.reshape(len(values), int(np.prod(shape)))
    return np.asarray(sums @ flat).reshape(-1, *shape)


def normal_equations(
    layout: Layout,
    observed: tuple[Whitened, Whitened],
    weight: Array,
    components: tuple[Component, ...],
) -> tuple[Blocks, Array]:
    """Normal equations (N, 6, 6) with their pairs, and their right-hand side (N, 6).

    Parameters
    ----------
    layout
        Where they stand.
    observed
        Relative poses and control points, as `residuals.Model.at` gives them.
    weight
        (M,) of each observation.
    components
        With what holds the datum of each.
    """
    relative, points = observed
    of_relative, of_points = np.split(weight, [len(relative.residual)])
    sides = (
        (relative.by_i, relative.residual, of_relative),
        (relative.by_j, relative.residual, of_relative),
        (points.by_j, points.residual, of_points),
    )
    size = layout.pattern.size
    diagonal, right = np.zeros((size, 6, 6)), np.zeros((size, 6))
    for sums, (J, residual, w) in zip(layout.onto_nodes, sides, strict=True):
        heavy = np.swapaxes(J, 1, 2) * w[:, None, None]
        diagonal += added(sums, heavy @ J)
        right -= added(sums, np.einsum("kab,kb->ka", heavy, residual))
    edges = slice(0, len(layout.pair))
    heavy = relative.by_j[edges] * of_relative[edges, None, None]
    cross = np.swapaxes(relative.by_i[edges], 1, 2) @ heavy
    pairs = added(layout.onto_pairs, layout.turn(cross))
    _hold(diagonal, pairs, right, layout.pattern.pairs, components)
    return Blocks(diagonal, pairs), right


def held_nodes(components: tuple[Component, ...]) -> tuple[IntArray, Array]:
    """Nodes (H,) that hold a datum, and the projectors (H, 6, 6) on what is held of each."""
    some = [component for component in components if len(component.held)]
    nodes = np.array([component.nodes[0] for component in some], dtype=np.int64)
    held = np.array([component.held.T @ component.held for component in some]).reshape(-1, 6, 6)
    return nodes, held


def _hold(
    diagonal: Array, pairs: Array, right: Array, ends: IntArray, components: tuple[Component, ...]
) -> None:
    """Take what is held out of the unknowns, and let it stand by itself instead."""
    nodes, held = held_nodes(components)
    free = np.tile(np.eye(6), (len(diagonal), 1, 1))
    free[nodes] -= held
    # Of the size of the rest, so that it does no harm to what is solved.
    scale = np.maximum(np.trace(diagonal[nodes], axis1=1, axis2=2) / 6, 1.0)
    diagonal[nodes] = free[nodes] @ diagonal[nodes] @ free[nodes] + scale[:, None, None] * held
    right[nodes] = np.einsum("kab,kb->ka", free[nodes], right[nodes])
    some = np.isin(ends, nodes).any(axis=1)
    a, b = ends[some].T
    pairs[some] = free[a] @ pairs[some] @ free[b]


def step(
    model: Model, layout: Layout, T: Array, weight: Array, components: tuple[Component, ...]
) -> tuple[Array, Factor, float]:
    """One step of Gauss and Newton: steps (N, 6), factor, and by how much it lowers the squares."""
    normal, right = normal_equations(layout, model.at(T), weight, components)
    factor = factorise(layout.pattern, normal)
    steps = solve(factor, right[:, :, None])[:, :, 0]
    return steps, factor, float(np.sum(steps * right))


def adjust(
    model: Model,
    layout: Layout,
    T: Array,
    active: BoolArray,
    components: tuple[Component, ...],
    until: float = SETTLED,
) -> AdjustedNetwork:
    """Find the poses with the least sum of squares of the active observations.

    Parameters
    ----------
    model, layout
        The network.
    T
        (N, 4, 4) start.
    active
        (M,) which observations count.
    components
        What they leave together, with what is held of each.
    until
        Steps end where the next would change the sum of squares by less than this, σ².
    """
    weight = active.astype(float)
    for _ in range(MOST_STEPS):
        steps, factor, gain = step(model, layout, T, weight, components)
        T = se3.retract(T, steps)
        if gain < until:
            return AdjustedNetwork(T, factor, True)
    return AdjustedNetwork(T, factor, False)
