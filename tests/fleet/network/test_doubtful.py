import numpy as np

from retropole import se3
from retropole.datatypes import Array
from retropole.fleet.network.components import find_components
from retropole.fleet.network.doubtful import hanging, inseparable, outvoted, relaid
from retropole.fleet.network.graph import Graph
from tests.fleet.network.networks import network_of

ENDS = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 1], [4, 5]])
"""A loop 1–2–3–4, with a tail on either side; node 0 is known."""


def graph() -> tuple[Array, Graph]:
    rng = np.random.default_rng(0)
    T = np.array([se3.random(rng) for _ in range(6)])
    return T, network_of(T, ENDS, rng)


def test_all_edges_of_the_only_loop_may_be_wrong_in_each_others_stead() -> None:
    _, network = graph()
    active = np.ones(7, dtype=bool)
    active[2] = False
    checked = np.zeros(7, dtype=np.int64)
    alone = inseparable(network, active, checked)
    assert set(alone) == {2}
    assert set(alone[2]) == {1, 3, 4}
    components = find_components(network, active)
    doubtful = hanging(network, active, components, {1, 3, 4})
    # Nodes 2 to 5 hang by one of them.
    assert doubtful.tolist() == [False, False, True, True, True, True]
    assert not hanging(network, active, components, set()).any()


def test_what_others_check_is_no_rival() -> None:
    _, network = graph()
    active = np.ones(7, dtype=bool)
    active[2] = False
    assert inseparable(network, active, np.full(7, 6)) == {}


def test_two_that_agree_outvote_one() -> None:
    assert outvoted({4: (1,), 5: (1, 2)}, set()) == {1: [4, 5]}
    assert outvoted({4: (1,), 5: (1, 2)}, {1}) == {}
    assert outvoted({4: (1,), 5: (2,)}, set()) == {}


def test_what_hangs_by_a_wrong_edge_is_laid_where_another_puts_it() -> None:
    T, network = graph()
    moved = T.copy()
    moved[2] = se3.random(np.random.default_rng(1))
    active = np.ones(7, dtype=bool)
    active[2] = False
    # Node 2 hangs by edge 1; edge 2 puts it right.
    found = relaid(network, active, moved, 1, 2)
    np.testing.assert_allclose(found, T, atol=0.02)
