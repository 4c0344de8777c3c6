"""What a network is made of."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Array
from retropole.base.errors import UsageError
from retropole.fleet.network.graph import (
    ControlPoints,
    Graph,
    connected,
    find_components,
    worst_around,
)
from tests.fleet.network.networks import city, ladder

pytestmark = pytest.mark.full


def everything(graph: Graph) -> np.ndarray:
    return np.ones(len(graph.ends), dtype=bool)


def with_points(graph: Graph, world: Array) -> Graph:
    node = np.arange(len(world))
    covariance = np.tile(np.eye(3), (len(world), 1, 1))
    return replace(graph, points=ControlPoints(node, world, covariance))


def test_a_part_without_control_holds_its_first_node() -> None:
    _, graph = ladder(4, np.random.default_rng(0))
    active = everything(graph)
    edges = graph.edges
    # Nodes 4 to 7 are cut off.
    active[: len(edges)] = (edges.i < 4) == (edges.j < 4)
    first, second = find_components(graph, active)
    assert first.nodes.tolist() == [0, 1, 2, 3]
    assert len(first.points) == 4
    assert not len(first.held)
    assert second.nodes.tolist() == [4, 5, 6, 7]
    assert second.datum(range(8)) == "no control points: pose 4 is fixed"


def test_points_hold_what_they_can() -> None:
    _, graph = ladder(3, np.random.default_rng(0))
    places = np.array([[0.0, 0, 0], [4, 0, 0], [9, 0, 0], [0, 5, 0]])
    open_rotations = {1: 3, 2: 1, 3: 1, 4: 0}
    for count, left in open_rotations.items():
        other = with_points(graph, places[:count])
        (component,) = find_components(other, everything(other))
        assert len(component.held) == left
        if left == 1:
            np.testing.assert_allclose(np.abs(component.held[0]), [1, 0, 0], atol=1e-12)
            assert "undetermined" in component.datum("abcdef")


def test_what_holds_the_network_together_stays() -> None:
    _, graph = ladder(3, np.random.default_rng(0))
    squares = np.arange(len(graph.ends), dtype=float)
    kept = connected(graph, ~everything(graph), squares)
    assert len(find_components(graph, kept)) == 1
    # No more than a tree that hangs by the ground, and that of the least squares.
    assert kept.sum() == graph.nodes
    assert kept[0]
    assert (connected(graph, everything(graph), squares) == everything(graph)).all()


def test_only_the_worst_of_a_neighbourhood_goes() -> None:
    _, graph = ladder(10, np.random.default_rng(5))
    chi2 = np.arange(len(graph.ends), dtype=float)
    # Rails 0–2, 2–4 and 14–16.
    wrong = np.isin(np.arange(len(chi2)), [0, 2, 14])
    assert np.flatnonzero(worst_around(graph, chi2, wrong)).tolist() == [2, 14]


def test_a_covariance_that_is_none_is_refused() -> None:
    _, graph = city(0, 20)
    edges = replace(graph.edges, covariance=-graph.edges.covariance)
    with pytest.raises(UsageError, match="not positive"):
        _ = replace(graph, edges=edges).roots
