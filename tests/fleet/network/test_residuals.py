from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.fleet.network.adjustment import Model
from retropole.fleet.network.graph import ControlPoints, Graph, KnownPoses
from tests.fleet.network.networks import city
from tests.numeric import numeric_jacobian


@pytest.fixture(scope="module")
def somewhere() -> tuple[Model, Array]:
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
    return Model(Graph(graph.nodes, graph.edges, known, points)), T


def test_derivatives_are_those_by_differences(somewhere: tuple[Model, Array]) -> None:
    model, T = somewhere
    graph = model.graph
    first, second = graph.ends
    starts = (0, len(graph.edges) + len(graph.known))
    for kind, found in enumerate(model.at(T)):
        # The first edges, and the last of each kind: known poses among them.
        for k in np.unique(np.arange(-2, 5) % len(found.residual)):
            for side, J in ((first, found.by_i), (second, found.by_j)):
                node = side[starts[kind] + k]
                if node == graph.nodes:
                    continue

                def of(step: Array, node: int = node, kind: int = kind, k: int = k) -> Array:
                    steps = np.zeros((graph.nodes, 6))
                    steps[node] = step
                    return np.asarray(model.at(se3.retract(T, steps))[kind].residual[k])

                expected = numeric_jacobian(of, 6)
                np.testing.assert_allclose(J[k], expected, atol=1e-6 * np.abs(expected).max())


def test_true_poses_leave_nothing(somewhere: tuple[Model, Array]) -> None:
    model, T = somewhere
    edges = model.graph.edges
    exact = np.linalg.inv(T[edges.i]) @ T[edges.j]
    at = Model(replace(model.graph, edges=replace(edges, T_i_j=exact))).at(T)[0]
    assert np.abs(at.residual[: len(edges)]).max() < 1e-9


def test_residuals_are_counted_in_sigma(somewhere: tuple[Model, Array]) -> None:
    model, T = somewhere
    edges = model.graph.edges
    missed = se3.local(edges.T_i_j[0], se3.inverse(T[edges.i[0]]) @ T[edges.j[0]])
    expected = missed @ np.linalg.solve(edges.covariance[0], missed)
    np.testing.assert_allclose(model.squares(T)[0], expected)
