from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.fleet.network.graph import ControlPoints, Graph, KnownPoses
from tests.fleet.network.networks import city
from tests.numeric import numeric_jacobian

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def somewhere() -> tuple[Graph, Array]:
    """A network with all kinds of observations, and poses that fit badly."""
    rng = np.random.default_rng(4)
    drawn, graph = city(4, 20)
    T = se3.retract(drawn.T_world_node, 0.3 * rng.normal(size=(graph.nodes, 6)))
    known = KnownPoses(np.array([3, 5]), drawn.T_world_node[[3, 5]], graph.edges.covariance[:2])
    points = ControlPoints(
        np.array([3, 1]),
        rng.normal(size=(2, 3)),
        graph.edges.covariance[:2, 3:, 3:],
        rng.normal(size=(2, 3)),
    )
    return Graph(graph.nodes, graph.edges, known, points), T


def test_derivatives_are_those_by_differences(somewhere: tuple[Graph, Array]) -> None:
    graph, T = somewhere
    of, found = graph.observed, graph.observed.at(T)
    # Some edges, two known poses, two control points.
    for k in (np.arange(-6, 5) % len(of)).tolist():
        for node, J in ((of.i[k], found.by_i[k]), (of.j[k], found.by_j[k])):
            if node == graph.nodes:
                continue

            def missed(step: Array, node: int = node, k: int = k) -> Array:
                steps = np.zeros((graph.nodes, 6))
                steps[node] = step
                return np.asarray(of.at(se3.retract(T, steps)).residual[k])

            expected = numeric_jacobian(missed, 6)
            np.testing.assert_allclose(J, expected, atol=1e-6 * np.abs(expected).max())


def test_a_control_point_is_seen_where_it_was_surveyed(somewhere: tuple[Graph, Array]) -> None:
    graph, T = somewhere
    points = graph.points
    found = graph.observed.at(T).residual[-len(points) :]
    missed = se3.apply(T[points.node[0]], points.at[:1])[0] - points.world[0]
    expected = missed @ np.linalg.solve(points.covariance[0], missed)
    np.testing.assert_allclose(found[0] @ found[0], expected)
    assert not found[:, :3].any()


def test_true_poses_leave_nothing(somewhere: tuple[Graph, Array]) -> None:
    graph, T = somewhere
    edges = graph.edges
    exact = np.linalg.inv(T[edges.i]) @ T[edges.j]
    at = replace(graph, edges=replace(edges, T_i_j=exact)).observed.at(T)
    assert np.abs(at.residual[: len(edges)]).max() < 1e-9


def test_residuals_are_counted_in_sigma(somewhere: tuple[Graph, Array]) -> None:
    graph, T = somewhere
    edges = graph.edges
    missed = se3.local(edges.T_i_j[0], se3.inverse(T[edges.i[0]]) @ T[edges.j[0]])
    expected = missed @ np.linalg.solve(edges.covariance[0], missed)
    np.testing.assert_allclose(graph.observed.squares(T)[0], expected)
