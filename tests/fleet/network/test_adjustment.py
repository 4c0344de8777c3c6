import numpy as np
import pytest

from retropole.base import se3
from retropole.fleet.network.adjustment import (
    AdjustedNetwork,
    adjust,
    find_layout,
    normal_equations,
)
from retropole.fleet.network.graph import Graph, find_components
from tests.fleet.network.networks import city, dense, ladder

pytestmark = pytest.mark.full


def adjusted(graph: Graph, T: np.ndarray) -> AdjustedNetwork:
    active = np.ones(len(graph.observed), dtype=bool)
    return adjust(graph, find_layout(graph), T, active, find_components(graph, active))


def test_normal_equations_are_those_of_the_dense_derivatives() -> None:
    drawn, graph = city(7, 20)
    of, at = graph.observed, graph.observed.at(drawn.T_world_node)
    layout = find_layout(graph)
    weight = np.random.default_rng(0).uniform(0.1, 1, len(of))
    components = find_components(graph, weight > 0)
    normal, right = normal_equations(layout, at, weight, components)
    J = np.zeros((len(of), 6, graph.nodes + 1, 6))
    k, root = np.arange(len(of)), np.sqrt(weight)
    J[k, :, of.i] = root[:, None, None] * at.by_i
    J[k, :, of.j] += root[:, None, None] * at.by_j
    A, e = J[:, :, :-1].reshape(6 * len(of), -1), (root[:, None] * at.residual).ravel()
    found = dense(normal, layout.pattern.pairs)
    np.testing.assert_allclose(found, A.T @ A, atol=1e-9 * found.max())
    np.testing.assert_allclose(right.ravel(), -A.T @ e, atol=1e-9 * np.abs(A.T @ e).max())


def test_exact_edges_give_the_true_poses() -> None:
    T, graph = ladder(6, np.random.default_rng(8), sigma=1e-3)
    edges = graph.edges
    edges.T_i_j[:] = np.linalg.inv(T[edges.i]) @ T[edges.j]
    rng = np.random.default_rng(0)
    start = np.array([se3.retract(one, 0.2 * rng.normal(size=6)) for one in T])
    found = adjusted(graph, start)
    assert found.settled
    np.testing.assert_allclose(found.T, T, atol=1e-9)


def test_where_it_starts_does_not_matter() -> None:
    drawn, graph = city(9, 40)
    rng = np.random.default_rng(1)
    one = adjusted(graph, drawn.T_world_node)
    start = [se3.retract(T, 0.1 * rng.normal(size=6)) for T in drawn.T_world_node]
    np.testing.assert_allclose(adjusted(graph, np.array(start)).T, one.T, atol=1e-7)
