from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Array
from retropole.fleet.network.graph import (
    ControlPoints,
    Graph,
    KnownPoses,
    connected,
    find_components,
)
from tests.fleet.network.networks import ladder

pytestmark = pytest.mark.full


def everything(graph: Graph) -> np.ndarray:
    return np.ones(len(graph.observed), dtype=bool)


def with_points(graph: Graph, world: Array) -> Graph:
    node = np.arange(len(world))
    covariance = np.tile(np.eye(3), (len(world), 1, 1))
    return replace(graph, known=KnownPoses(), points=ControlPoints(node, world, covariance))


def test_a_part_without_control_holds_its_first_node() -> None:
    _, graph = ladder(4, np.random.default_rng(0))
    active = everything(graph)
    edges = graph.edges
    # Nodes 4 to 7 are cut off.
    active[: len(edges)] = (edges.i < 4) == (edges.j < 4)
    first, second = find_components(graph, active)
    assert first.nodes.tolist() == [0, 1, 2, 3]
    assert first.controls == 1
    assert not len(first.held)
    assert second.nodes.tolist() == [4, 5, 6, 7]
    np.testing.assert_array_equal(second.held, np.eye(6))
    assert second.datum == "no control: pose 4 is held"


def test_points_hold_what_they_can() -> None:
    _, graph = ladder(3, np.random.default_rng(0))
    places = np.array([[0.0, 0, 0], [4, 0, 0], [9, 0, 0], [0, 5, 0]])
    open_rotations = {1: 3, 2: 1, 3: 1, 4: 0}
    for count, left in open_rotations.items():
        (component,) = find_components(
            with_points(graph, places[:count]), np.ones(len(graph.edges) + count, dtype=bool)
        )
        assert len(component.held) == left
        assert not component.held[:, 3:].any()
        if left == 1:
            np.testing.assert_allclose(np.abs(component.held[0]), [1, 0, 0, 0, 0, 0], atol=1e-12)
            assert "open" in component.datum


def test_what_holds_the_network_together_stays() -> None:
    _, graph = ladder(3, np.random.default_rng(0))
    squares = np.arange(len(graph.observed), dtype=float)
    kept = connected(graph, np.zeros(len(graph.observed), dtype=bool), squares)
    assert len(find_components(graph, kept)) == 1
    # No more than a tree that hangs by the ground, and that of the least squares.
    assert kept.sum() == graph.nodes
    assert kept[0]
    assert (connected(graph, everything(graph), squares) == everything(graph)).all()
