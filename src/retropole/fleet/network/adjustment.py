"""Least squares of a network: normal equations of blocks, solved again until nothing moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from ...api import Array, BoolArray, IntArray, se3
from .elimination import Blocks, Factor, Pattern, factorise, find_pattern, selected_inverse, solve
from .graph import Component, Graph
from .observations import Whitened

SETTLED = 1e-8
"""Steps end where the next would change the sum of squares by less than this, σ²: no pose then
moves by more than 1e-4 of its σ."""

FIRM = 1e10
"""By how much more than its observations say the first pose of a component is held where no control
says anything: all of it moves along, so that nothing else feels that."""

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
        (N, M) sums over observations, by the first and by the second pose of each.
    onto_pairs
        (P, E) sums over edges.
    """

    pattern: Pattern
    pair: IntArray
    turned: BoolArray
    onto_nodes: tuple[csr_array, csr_array]
    onto_pairs: csr_array

    def turn(self, blocks: Array) -> Array:
        """Turn blocks (E, B, B) by the ends of each edge into those by its pair's, or back."""
        turned = blocks.copy()
        turned[self.turned] = np.swapaxes(blocks[self.turned], 1, 2)
        return turned


@dataclass(frozen=True, eq=False)
class AdjustedNetwork:
    """Poses at the least sum of squares.

    Attributes
    ----------
    T
        (N, 4, 4) poses.
    covariance
        Of each pose (N, 6, 6), and of each two that share an edge (P, 6, 6).
    settled
        Whether the steps ended by themselves.
    """

    T: Array
    covariance: Blocks
    settled: bool


def find_layout(graph: Graph) -> Layout:
    """Order the unknowns of a network."""
    i, j = graph.edges.i, graph.edges.j
    ends = np.sort(np.stack([i, j], axis=1), axis=1)
    pairs, pair = np.unique(ends, axis=0, return_inverse=True)
    pair = pair.reshape(-1)
    # No unknowns are of the ground.
    by_i, by_j = (
        _sums(node, graph.nodes + 1)[:-1] for node in (graph.observed.i, graph.observed.j)
    )
    pattern = find_pattern(graph.nodes, pairs)
    return Layout(pattern, pair, i > j, (by_i, by_j), _sums(pair, len(pairs)))


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
    observed: Whitened,
    weight: Array,
    components: tuple[Component, ...],
) -> tuple[Blocks, Array]:
    """Normal equations (N, 6, 6) with their pairs, and their right-hand side (N, 6).

    Parameters
    ----------
    layout
        Where they stand.
    observed
        Of all observations.
    weight
        (M,) of each observation.
    components
        With what holds the datum of each.
    """
    size = layout.pattern.size
    diagonal, right = np.zeros((size, 6, 6)), np.zeros((size, 6))
    for sums, J in zip(layout.onto_nodes, (observed.by_i, observed.by_j), strict=True):
        heavy = np.swapaxes(J, 1, 2) * weight[:, None, None]
        diagonal += added(sums, heavy @ J)
        right -= added(sums, np.einsum("kab,kb->ka", heavy, observed.residual))
    edges = slice(0, len(layout.pair))
    heavy = observed.by_j[edges] * weight[edges, None, None]
    cross = np.swapaxes(observed.by_i[edges], 1, 2) @ heavy
    pairs = added(layout.onto_pairs, layout.turn(cross))
    nodes, held = held_nodes(components)
    firm = FIRM * np.maximum(np.trace(diagonal[nodes], axis1=1, axis2=2) / 6, 1.0)
    diagonal[nodes] += firm[:, None, None] * held
    return Blocks(diagonal, pairs), right


def held_nodes(components: tuple[Component, ...]) -> tuple[IntArray, Array]:
    """Nodes (H,) that hold a datum, and the projectors (H, 6, 6) on what is held of each."""
    some = [component for component in components if len(component.held)]
    nodes = np.array([component.nodes[0] for component in some], dtype=np.int64)
    held = np.array([component.held.T @ component.held for component in some]).reshape(-1, 6, 6)
    return nodes, held


def step(
    graph: Graph, layout: Layout, T: Array, weight: Array, components: tuple[Component, ...]
) -> tuple[Array, Factor, float]:
    """One step of Gauss and Newton: steps (N, 6), factor, and by how much it lowers the squares."""
    normal, right = normal_equations(layout, graph.observed.at(T), weight, components)
    factor = factorise(layout.pattern, normal)
    steps = solve(factor, right[:, :, None])[:, :, 0]
    return steps, factor, float(np.sum(steps * right))


def adjust(
    graph: Graph,
    layout: Layout,
    T: Array,
    active: BoolArray,
    components: tuple[Component, ...],
    until: float = SETTLED,
) -> AdjustedNetwork:
    """Find the poses with the least sum of squares of the active observations.

    Parameters
    ----------
    graph, layout
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
        steps, factor, gain = step(graph, layout, T, weight, components)
        T = se3.retract(T, steps)
        if gain < until:
            break
    covariance = selected_inverse(factor)
    nodes, held = held_nodes(components)
    free = np.eye(6) - held
    covariance.diagonal[nodes] = free @ covariance.diagonal[nodes] @ free
    return AdjustedNetwork(T, covariance, gain < until)
