"""Poses to start from, found without any guess and in spite of wrong edges.

Rotations first: ``R_i R_i_j = R_j`` is linear in the nine numbers of each rotation, and so has one
solution however far all are turned (chordal relaxation, Martinec and Pajdla 2007). Each is then
taken to the nearest rotation, and edges that disagree count less and less. Then translations
likewise, and where all of it lies in the frame of the network by its controls.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...api import Array, se3
from .adjustment import FIRM, Layout, added, step
from .elimination import Blocks, factorise, solve
from .graph import Component, Graph, find_components, grouped

REWEIGHTED = (4, 4)
"""So often edges are weighted anew by the absolute value of what they miss, which has one minimum,
and then by a function that forgets what misses by far (Geman and McClure 1985)."""

LEAST_WEIGHT = 1e-6
"""Of an edge that is forgotten: what hangs by it alone still has a place."""

LEVER = 10.0
"""How far from a known pose points are laid that stand for its rotation, metres."""

WIDE = (64.0, 16.0, 4.0, 1.0, 1.0)
"""By how much more than χ² allows edges may miss in each step of the whole network."""


def find_start(graph: Graph, layout: Layout) -> Array:
    """Find poses (N, 4, 4) to start from, near enough for least squares to go on."""
    components = find_components(graph)
    first = np.array([component.nodes[0] for component in components])
    T = np.tile(np.eye(4), (graph.nodes, 1, 1))
    if len(graph.edges):
        T[:, :3, :3], weight = _rotations(graph, layout, first)
        T[:, :3, 3] = _translations(graph, layout, first, T[:, :3, :3], weight)
    return _onto_control(graph, components, T)


def narrowed(graph: Graph, layout: Layout, T: Array, critical: Array) -> Array:
    """Adjust all together while what misses by more than chance counts less and less.

    Parameters
    ----------
    graph, layout
        The network.
    T
        (N, 4, 4) start.
    critical
        (M,) the square in σ² that chance allows each observation.
    """
    components = find_components(graph)
    edges = len(graph.edges)
    for wide in WIDE:
        squares = graph.observed.squares(T)
        weight = _forgetting(squares / (wide * critical))
        if wide > 1:
            # Far from control a network bends by more than its controls are uncertain: as long as
            # it does, none of them is forgotten.
            far = np.sqrt(np.maximum(squares[edges:] / critical[edges:], 1.0))
            weight[edges:] = 1 / far
        T = se3.retract(T, step(graph, layout, T, weight, components)[0])
    return T


def _forgetting(ratio: Array) -> Array:
    """Weights of squares, as parts of what is allowed (Geman and McClure 1985)."""
    return np.asarray(np.maximum(1 / (1 + ratio) ** 2, LEAST_WEIGHT))


def _majority(ratio: Array, precision: Array) -> Array:
    """Weights by which the sum of absolute misses is least, each counted alike.

    Where three edges meet two good ones then outvote a wrong one, however precise it claims to be.
    """
    return np.asarray(1 / np.sqrt(np.maximum(ratio, 1e-2) * precision / np.median(precision)))


def _reweighted(
    precision: Array, solved: Callable[[Array], Array], squares: Callable[[Array], Array]
) -> tuple[Array, Array]:
    """Solve again and again, with edges weighted by what they miss; gives the weights (E,) too.

    Parameters
    ----------
    precision
        (E,) of each edge.
    solved
        Poses by the weights of the edges.
    squares
        (E,) squares of what edges miss by poses.
    """
    weight = np.ones(len(precision))
    found = solved(weight)
    for k in range(sum(REWEIGHTED)):
        # Four σ are plain.
        ratio = precision * squares(found) / 16
        weight = _forgetting(ratio) if k >= REWEIGHTED[0] else _majority(ratio, precision)
        found = solved(weight)
    return found, weight


def _rotations(graph: Graph, layout: Layout, first: Array) -> tuple[Array, Array]:
    """Rotations (N, 3, 3), and how much each edge counted in the end (E,)."""
    edges = graph.edges
    R_i_j = edges.T_i_j[:, :3, :3]
    precision = 3 / np.trace(edges.covariance[:, :3, :3], axis1=1, axis2=2)

    def solved(weight: Array) -> Array:
        # Rows x of a rotation: |R_i_jᵀ x_i − x_j|².
        w = weight * precision
        right = np.zeros((graph.nodes, 3, 3))
        x = _solved(layout, w, -w[:, None, None] * R_i_j, right, first, np.eye(3))
        # Columns of x are rows of the rotations.
        return _nearest_rotations(np.swapaxes(x, 1, 2))

    def squares(R: Array) -> Array:
        turned = R[edges.i] @ R_i_j @ np.swapaxes(R[edges.j], 1, 2)
        # 3 − tr R = 2 (1 − cos) is the squared angle to second order.
        return np.asarray(np.maximum(3 - np.trace(turned, axis1=1, axis2=2), 0))

    return _reweighted(precision, solved, squares)


def _solved(
    layout: Layout, weight: Array, cross: Array, right: Array, first: Array, held: Array
) -> Array:
    """Solve linear equations (N, B, K), the first node of each component held at (B, K).

    `weight` (E,) is what each edge adds at its own ends, `cross` (E, B, B) between them.
    """
    eye = np.eye(cross.shape[-1])
    by_i, by_j = (sums[:, : len(weight)] for sums in layout.onto_nodes)
    degree = by_i @ weight + by_j @ weight
    # Nothing else says where a component lies: what is held firmly is met.
    firm = FIRM * np.maximum(degree[first], 1.0)[:, None, None]
    diagonal = degree[:, None, None] * eye
    diagonal[first] += firm * eye
    right[first] += firm * held
    pairs = added(layout.onto_pairs, layout.turn(cross))
    return solve(factorise(layout.pattern, Blocks(diagonal, pairs)), right)


def _nearest_rotations(matrices: Array) -> Array:
    """Rotations (..., 3, 3) nearest to matrices."""
    U, _, Vt = np.linalg.svd(matrices)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt)


def _translations(graph: Graph, layout: Layout, first: Array, R: Array, turned: Array) -> Array:
    """Translations (N, 3) with these rotations; `turned` (E,) is how much each edge counts."""
    edges = graph.edges
    arm = np.einsum("kab,kb->ka", R[edges.i], edges.T_i_j[:, :3, 3])
    # A direction that is off by its σ moves the far end by that much more.
    variance = np.trace(edges.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3
    rotation = np.trace(edges.covariance[:, :3, :3], axis1=1, axis2=2) / 3
    precision = 1 / (variance + rotation * np.sum(arm**2, axis=1))
    by_i, by_j = (sums[:, : len(edges)] for sums in layout.onto_nodes)

    def solved(weight: Array) -> Array:
        w = np.maximum(weight * turned, LEAST_WEIGHT) * precision
        right = ((by_j - by_i) @ (w[:, None] * arm))[:, None, :]
        t = _solved(layout, w, -w[:, None, None], right, first, np.zeros((1, 3)))
        return np.asarray(t[:, 0])

    def squares(t: Array) -> Array:
        return np.asarray(np.sum((t[edges.j] - t[edges.i] - arm) ** 2, axis=1))

    return _reweighted(precision, solved, squares)[0]


def _onto_control(graph: Graph, components: tuple[Component, ...], T: Array) -> Array:
    """Lay each component into the frame of the network by its controls."""
    known, points = graph.known, graph.points
    node = np.concatenate([np.repeat(known.node, 4), points.node])
    corners = np.tile(np.concatenate([np.zeros((1, 3)), LEVER * np.eye(3)]), (len(known), 1))
    at = np.concatenate([corners, points.at])
    source = np.einsum("kab,kb->ka", T[node, :3, :3], at) + T[node, :3, 3]
    world = np.repeat(known.T_world_node, 4, axis=0)
    corners = np.einsum("kab,kb->ka", world[:, :3, :3], corners) + world[:, :3, 3]
    target = np.concatenate([corners, points.world])
    number = np.empty(graph.nodes, dtype=np.int64)
    for k, component in enumerate(components):
        number[component.nodes] = k
    T = T.copy()
    for some, component in zip(grouped(number[node], len(components)), components, strict=True):
        if len(some):
            T[component.nodes] = laid(source[some], target[some]) @ T[component.nodes]
    return T


def laid(source: Array, target: Array) -> Array:
    """Rigid transform (4, 4) with the least sum of distances: what lies far off counts little."""
    weight = np.ones(len(source))
    for _ in range(20):
        share = weight / weight.sum()
        a, b = share @ source, share @ target
        R = _nearest_rotations((target - b).T @ ((source - a) * share[:, None]))
        T = se3.from_rt(R, b - R @ a)
        missed = np.linalg.norm(se3.apply(T, source) - target, axis=1)
        weight = 1 / np.maximum(missed, 1e-3)
    return T
