"""Poses to start from, found without any guess and in spite of wrong edges.

Rotations first: ``R_i R_i_j = R_j`` is linear in the nine numbers of each rotation, and so has one
solution however far all are turned (chordal relaxation, Martinec and Pajdla 2007). Each is then
taken to the nearest rotation, and edges that disagree count less and less. Then translations
likewise, and where all of it lies in the frame of the network by its controls.
"""

from __future__ import annotations

import numpy as np

from ...api import Array, se3
from .adjustment import Layout, added, step
from .components import Component, find_components
from .elimination import Blocks, factorise, solve
from .graph import Graph
from .residuals import Model

REWEIGHTED = (4, 4)
"""So often edges are weighted anew by the absolute value of what they miss, which has one minimum,
and then by a function that forgets what misses by far (Geman and McClure 1985)."""

LEAST_WEIGHT = 1e-6
"""Of an edge that is forgotten: what hangs by it alone still has a place."""

LEVER = 10.0
"""How far from a known pose points are laid that stand for its rotation, metres."""

WIDE = (64.0, 16.0, 4.0, 1.0, 1.0)
"""By how much more than χ² allows edges may miss in each step of the whole network."""


def find_start(model: Model, layout: Layout) -> Array:
    """Find poses (N, 4, 4) to start from, near enough for least squares to go on."""
    graph = model.graph
    everything = np.ones(graph.observations, dtype=bool)
    components = find_components(graph, everything)
    first = np.array([component.nodes[0] for component in components])
    T = np.tile(np.eye(4), (graph.nodes, 1, 1))
    if len(graph.edges):
        T[:, :3, :3], weight = _rotations(graph, layout, first)
        T[:, :3, 3] = _translations(graph, layout, first, T[:, :3, :3], weight)
    return _onto_control(graph, components, T)


def narrowed(model: Model, layout: Layout, T: Array, critical: Array) -> Array:
    """Adjust all together while what misses by more than chance counts less and less.

    Parameters
    ----------
    model, layout
        The network.
    T
        (N, 4, 4) start.
    critical
        (M,) the square in σ² that chance allows each observation.
    """
    everything = np.ones(model.graph.observations, dtype=bool)
    components = find_components(model.graph, everything)
    edges = len(model.graph.edges)
    for wide in WIDE:
        squares = model.squares(T)
        weight = _forgetting(squares / (wide * critical))
        if wide > 1:
            # Far from control a network bends by more than its controls are uncertain: as long as
            # it does, none of them is forgotten.
            far = np.sqrt(np.maximum(squares[edges:] / critical[edges:], 1.0))
            weight[edges:] = 1 / far
        T = se3.retract(T, step(model, layout, T, weight, components)[0])
    return T


def _forgetting(ratio: Array) -> Array:
    """Weights of squares, as parts of what is allowed (Geman and McClure 1985)."""
    return np.asarray(np.maximum(1 / (1 + ratio) ** 2, LEAST_WEIGHT))


def _majority(ratio: Array, precision: Array) -> Array:
    """Weights by which the sum of absolute misses is least, each counted alike.

    Where three edges meet two good ones then outvote a wrong one, however precise it claims to be.
    """
    return np.asarray(1 / np.sqrt(np.maximum(ratio, 1e-2) * precision / np.median(precision)))


def _reweighted() -> list[bool]:
    """Which of the rounds forget what misses by far."""
    return [k >= REWEIGHTED[0] for k in range(sum(REWEIGHTED))]


def _rotations(graph: Graph, layout: Layout, first: Array) -> tuple[Array, Array]:
    """Rotations (N, 3, 3), and how much each edge counted in the end (E,)."""
    edges = graph.edges
    R_i_j = edges.T_i_j[:, :3, :3]
    precision = 3 / np.trace(edges.covariance[:, :3, :3], axis1=1, axis2=2)
    weight = np.ones(len(edges))
    R = np.zeros((0, 3, 3))
    for forgets in (None, *_reweighted()):
        if forgets is not None:
            R_i, R_j = R[edges.i], R[edges.j]
            turned = R_i @ R_i_j @ np.swapaxes(R_j, 1, 2)
            # 3 − tr R = 2 (1 − cos) is the squared angle to second order; four σ are plain.
            ratio = precision * np.maximum(3 - np.trace(turned, axis1=1, axis2=2), 0) / 16
            weight = _forgetting(ratio) if forgets else _majority(ratio, precision)
        # Rows x of a rotation: |R_i_jᵀ x_i − x_j|².
        w = (weight * precision)[:, None, None]
        R = _nearest_rotations(_solved(layout, w * np.eye(3), w * np.eye(3), -w * R_i_j, first))
    return R, weight


def _solved(layout: Layout, at_i: Array, at_j: Array, cross: Array, first: Array) -> Array:
    """Rotations that solve the linear equations (N, 3, 3), the first of each component held."""
    diagonal = added(layout.onto_nodes[0], at_i) + added(layout.onto_nodes[1], at_j)
    pairs = added(layout.onto_pairs, layout.turn(cross))
    right = np.zeros_like(diagonal)
    a, b = layout.pattern.pairs.T
    held = np.zeros(layout.pattern.size, dtype=bool)
    held[first] = True
    # Held at the identity: what it says of its neighbours is their right-hand side.
    np.subtract.at(right, b[held[a]], np.swapaxes(pairs[held[a]], 1, 2))
    np.subtract.at(right, a[held[b]], pairs[held[b]])
    pairs[held[a] | held[b]] = 0.0
    diagonal[first], right[first] = np.eye(3), np.eye(3)
    x = solve(factorise(layout.pattern, Blocks(diagonal, pairs)), right)
    # Columns of x are rows of the rotations.
    return np.swapaxes(x, 1, 2)


def _nearest_rotations(matrices: Array) -> Array:
    U, _, Vt = np.linalg.svd(matrices)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    return np.asarray(U @ Vt)


def _translations(graph: Graph, layout: Layout, first: Array, R: Array, turned: Array) -> Array:
    """Translations (N, 3) with these rotations; `turned` (E,) is how much each edge counts."""
    edges = graph.edges
    arm = np.einsum("kab,kb->ka", R[edges.i], edges.T_i_j[:, :3, 3])
    # A direction that is off by its σ moves the far end by that much more.
    variance = np.trace(edges.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3
    rotation = np.trace(edges.covariance[:, :3, :3], axis1=1, axis2=2) / 3
    precision = 1 / (variance + rotation * np.sum(arm**2, axis=1))
    weight = turned
    a, b = layout.pattern.pairs.T
    held = np.zeros(graph.nodes, dtype=bool)
    held[first] = True
    t = np.zeros((graph.nodes, 3))
    for forgets in (None, *_reweighted()):
        if forgets is not None:
            missed = t[edges.j] - t[edges.i] - arm
            ratio = precision * np.sum(missed**2, axis=1) / 16
            weight = _forgetting(ratio) if forgets else _majority(ratio, precision)
            weight = np.maximum(weight * turned, LEAST_WEIGHT)
        w = (weight * precision)[:, None, None]
        diagonal = added(layout.onto_nodes[0], w) + added(layout.onto_nodes[1], w)
        pairs = added(layout.onto_pairs, -w)
        right = added(layout.onto_nodes[1], w[:, 0] * arm) - added(
            layout.onto_nodes[0], w[:, 0] * arm
        )
        pairs[held[a] | held[b]] = 0.0
        diagonal[first], right[first] = 1.0, 0.0
        t = solve(factorise(layout.pattern, Blocks(diagonal, pairs)), right[:, None, :])[:, 0]
    return t


def _onto_control(graph: Graph, components: tuple[Component, ...], T: Array) -> Array:
    """Lay each component into the frame of the network by its controls."""
    known, points = graph.known, graph.points
    corners = np.concatenate([np.zeros((1, 3)), LEVER * np.eye(3)])
    own, world = T[known.node], known.T_world_node
    here = [own[:, :3, 3, None] + own[:, :3, :3] @ corners.T]
    there = [world[:, :3, 3, None] + world[:, :3, :3] @ corners.T]
    seen = np.einsum("kab,kb->ka", T[points.node, :3, :3], points.at) + T[points.node, :3, 3]
    source = np.concatenate([np.swapaxes(here[0], 1, 2).reshape(-1, 3), seen])
    target = np.concatenate([np.swapaxes(there[0], 1, 2).reshape(-1, 3), points.world])
    node = np.concatenate([np.repeat(known.node, 4), points.node])
    number = np.empty(graph.nodes, dtype=np.int64)
    for k, component in enumerate(components):
        number[component.nodes] = k
    T = T.copy()
    by_component = np.argsort(number[node], kind="stable")
    bounds = np.searchsorted(number[node][by_component], np.arange(len(components) + 1))
    for k, component in enumerate(components):
        some = by_component[bounds[k] : bounds[k + 1]]
        if len(some):
            T[component.nodes] = _laid(source[some], target[some]) @ T[component.nodes]
    return T


def _laid(source: Array, target: Array) -> Array:
    """Rigid transform (4, 4) with the least sum of distances: what lies far off counts little."""
    weight = np.ones(len(source))
    for _ in range(20):
        share = weight / weight.sum()
        a, b = share @ source, share @ target
        U, _, Vt = np.linalg.svd((target - b).T @ ((source - a) * share[:, None]))
        R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        T = se3.from_rt(R, b - R @ a)
        missed = np.linalg.norm(se3.apply(T, source) - target, axis=1)
        weight = 1 / np.maximum(missed, 1e-3)
    return T
