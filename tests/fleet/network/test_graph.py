from dataclasses import replace

import numpy as np
import pytest

from retropole.base.errors import UsageError
from retropole.fleet.network.graph import Edges, Graph, grouped
from tests.fleet.network.networks import city, ladder

pytestmark = pytest.mark.full


def with_first(values: np.ndarray, value: object) -> np.ndarray:
    out = values.copy()
    out[0] = value
    return out


WRONG = {
    "there is no pose": lambda e: replace(e, i=with_first(e.i, 1000)),
    "to itself": lambda e: replace(e, i=with_first(e.i, e.j[0])),
    "not rigid": lambda e: replace(e, T_i_j=with_first(e.T_i_j, np.diag([1, 1, -1, 1]))),
    "its transform": lambda e: replace(e, T_i_j=with_first(e.T_i_j, np.nan)),
    "expected \\(": lambda e: replace(e, T_i_j=e.T_i_j[:, :3]),
    "symmetric and positive": lambda e: replace(e, covariance=-e.covariance),
    "its covariance": lambda e: replace(e, covariance=with_first(e.covariance, np.inf)),
    "poses of each edge": lambda e: replace(e, j=e.j.astype(float)),
}


@pytest.mark.parametrize("message", WRONG)
def test_what_makes_no_sense_is_refused_in_words(message: str) -> None:
    _, graph = city(0, 20)
    edges: Edges = WRONG[message](graph.edges)
    with pytest.raises(UsageError, match=message):
        Graph(graph.nodes, edges)


def test_a_network_of_no_poses_is_refused() -> None:
    _, graph = city(0, 20)
    with pytest.raises(UsageError, match="0 poses"):
        Graph(0, graph.edges)


def test_what_is_known_is_an_edge_from_the_ground() -> None:
    _, graph = ladder(2, np.random.default_rng(0))
    observed, known = graph.observed, graph.known
    assert len(observed) == len(graph.edges) + len(known)
    last = slice(len(graph.edges), None)
    assert set(observed.i[last]) == {graph.nodes}
    np.testing.assert_array_equal(observed.j[last], known.node)
    np.testing.assert_array_equal(observed.T_i_j[last], known.T_world_node)


def test_each_number_is_in_the_group_of_its_label() -> None:
    label = np.array([2, 0, 2, 4, 0])
    groups = [group.tolist() for group in grouped(label, 6)]
    assert groups == [[1, 4], [], [0, 2], [], [3], []]
