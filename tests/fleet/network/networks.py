"""Small networks whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.city import SURVEY, City, simulate_city
from retropole.base import se3
from retropole.base.datatypes import Array, IntArray
from retropole.fleet.network.graph import ControlPoints, Edges, Graph


def city(
    seed: int = 0, nodes: int = 60, wrong: float = 0.0, controls: int = 8
) -> tuple[City, Graph]:
    """A city and the network of what was measured in it."""
    drawn = simulate_city(nodes, np.random.default_rng(seed), wrong, controls)
    covariance = np.tile(np.eye(3) * SURVEY**2, (len(drawn.control), 1, 1))
    graph = Graph(
        len(drawn.T_world_node),
        Edges(drawn.i, drawn.j, drawn.T_i_j, drawn.covariance),
        points=ControlPoints(drawn.control, drawn.surveyed, covariance),
    )
    return drawn, graph


def ladder(length: int, rng: np.random.Generator, sigma: float = 1e-3) -> tuple[Array, Graph]:
    """True poses, and a network of two rows of nodes with rungs; the first sees four known points.

    Edges are the rails first, then the rungs, then a brace across each field: without it the rails
    of a field could not be told apart.
    """
    count = 2 * length
    T = np.array([se3.random(rng) for _ in range(count)])
    T[:, :2, 3] += 10.0 * np.stack([np.arange(count) // 2, np.arange(count) % 2], axis=1)
    k = np.arange(count - 2)
    braces = np.stack([k[::2], k[::2] + 3], axis=1)
    ends = np.concatenate([np.stack([k, k + 2], 1), np.arange(count).reshape(-1, 2), braces])
    return T, network_of(T, ends, rng, sigma)


def network_of(T: Array, ends: IntArray, rng: np.random.Generator, sigma: float = 1e-3) -> Graph:
    """Edges between true poses with isotropic noise; the first pose sees four known points."""
    i, j = ends.T
    measured = np.linalg.inv(T[i]) @ T[j]
    noise = sigma * rng.normal(size=(len(i), 6))
    measured = np.array([se3.retract(a, step) for a, step in zip(measured, noise, strict=True)])
    covariance = np.tile(np.eye(6) * sigma**2, (len(i), 1, 1))
    seen = np.concatenate([np.zeros((1, 3)), 10 * np.eye(3)])
    survey = np.tile(np.eye(3) * 1e-8, (4, 1, 1))
    points = ControlPoints(np.zeros(4, dtype=np.int64), se3.apply(T[0], seen), survey, seen)
    return Graph(len(T), Edges(i, j, measured, covariance), points)


def spoiled(graph: Graph, edge: int, step: Array) -> Graph:
    """The same network with a gross error in one edge."""
    measured = graph.edges.T_i_j.copy()
    measured[edge] = se3.retract(measured[edge], step)
    return replace(graph, edges=replace(graph.edges, T_i_j=measured))


def in_sigma(T: Array, other: Array, covariance: Array) -> float:
    """Largest distance of poses from others in their stated σ."""
    worst = 0.0
    for a, b, C in zip(T, other, covariance, strict=True):
        step = se3.local(a, b)
        worst = max(worst, float(np.abs(step / np.sqrt(np.diag(C))).max()))
    return worst
