import numpy as np
import pytest

from retropole.base import se3
from retropole.fleet.network.adjustment import find_layout
from retropole.fleet.network.graph import Graph
from retropole.fleet.network.snooping import Snooped, snoop, worst_around
from tests.fleet.network.networks import city, ladder, network_of, spoiled

pytestmark = pytest.mark.full


def snooped(graph: Graph, T: np.ndarray) -> Snooped:
    return snoop(graph, find_layout(graph), T)


def test_nothing_is_taken_out_of_a_sound_network() -> None:
    drawn, graph = city(12, 100)
    found = snooped(graph, drawn.T_world_node)
    assert found.active.all()
    assert found.settled


def test_a_wrong_edge_is_taken_out_and_nothing_else() -> None:
    T, graph = ladder(10, np.random.default_rng(3))
    for size in (0.02, 0.5):
        found = snooped(spoiled(graph, 8, size * np.array([0, 1.0, 0, 0, 0, 1.0])), T)
        assert np.flatnonzero(~found.active).tolist() == [8]


def test_wrong_edges_far_apart_go_together() -> None:
    T, graph = ladder(30, np.random.default_rng(4))
    for edge in (6, 30, 52):
        graph = spoiled(graph, edge, np.array([0, 0.012, 0, 0, 0, 0.01]))
    found = snooped(graph, T)
    assert np.flatnonzero(~found.active).tolist() == [6, 30, 52]
    assert found.rounds <= 3


def test_only_the_worst_of_a_neighbourhood_goes() -> None:
    _, graph = ladder(10, np.random.default_rng(5))
    chi2 = np.arange(len(graph.observed), dtype=float)
    wrong = np.zeros(len(graph.observed), dtype=bool)
    # Rails 0–2, 2–4 and 14–16.
    wrong[[0, 2, 14]] = True
    assert np.flatnonzero(worst_around(graph, chi2, wrong)).tolist() == [2, 14]


def test_wrong_edges_that_contradict_each_other_outvote_no_other() -> None:
    rng = np.random.default_rng(6)
    T, graph = ladder(8, rng)
    # One more node, by three edges, of which two have nothing to do with its pose.
    T = np.concatenate([T, se3.random(rng)[None]])
    ends = np.stack([graph.edges.i, graph.edges.j], axis=1)
    graph = network_of(T, np.concatenate([ends, [[6, 16], [8, 16], [10, 16]]]), rng)
    count = len(graph.edges)
    for edge in (count - 2, count - 1):
        graph = spoiled(graph, edge, rng.normal(size=6))
    found = snooped(graph, T)
    assert np.flatnonzero(~found.active).tolist() == [count - 2, count - 1]
    # Nothing was put back in place of the sound one.
    assert found.rounds <= 2


def test_a_wrong_control_point_is_taken_out() -> None:
    drawn, graph = city(13, 60, controls=10)
    graph.points.world[4] += [0.0, 0.5, 0.0]
    found = snooped(graph, drawn.T_world_node)
    assert np.flatnonzero(~found.active).tolist() == [len(graph.edges) + 4]
