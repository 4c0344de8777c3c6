from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.fleet.network.graph import ControlPoints, Graph, KnownPoses, find_components
from retropole.fleet.network.snooping import against_consensus, agrees, hanging, inseparable, relaid
from tests.fleet.network.networks import network_of, spoiled

pytestmark = pytest.mark.full

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
    def always(*_: int) -> bool:
        return True

    assert against_consensus({4: (1,), 5: (1, 2)}, set(), always) == {1: [4, 5]}
    assert against_consensus({4: (1,), 5: (1, 2)}, {1}, always) == {}
    assert against_consensus({4: (1,), 5: (2,)}, set(), always) == {}


def test_those_that_contradict_each_other_outvote_none() -> None:
    alone: dict[int, tuple[int, ...]] = {4: (1,), 5: (1,), 6: (1,)}
    assert against_consensus(alone, set(), lambda *_: False) == {}
    assert against_consensus(alone, set(), lambda _, one, other: {one, other} == {4, 6}) == {
        1: [4, 6]
    }


STAR = np.array([[0, 1], [1, 2], [2, 3], [4, 1], [2, 4], [3, 4]])
"""Node 4 hangs by edges 3, 4 and 5 on a line of nodes; 6 and 7 are known poses of nodes 0 and 4,
and 8 is a control point that node 4 sees."""


@pytest.mark.parametrize(("one", "other"), [(4, 5), (3, 4), (4, 3), (5, 7), (4, 8), (8, 4)])
def test_sound_ones_agree_and_a_wrong_one_agrees_with_none(one: int, other: int) -> None:
    rng = np.random.default_rng(2)
    T = np.array([se3.random(rng) for _ in range(5)])
    known = KnownPoses(np.array([0, 4]), T[[0, 4]], np.tile(np.eye(6) * 1e-8, (2, 1, 1)))
    seen = np.array([[1.0, 2.0, 3.0]])
    points = ControlPoints(known.node[1:], se3.apply(T[4], seen), np.eye(3)[None] * 1e-6, seen)
    network = replace(network_of(T, STAR, rng), known=known, points=points)
    rival = 5 if 5 not in (one, other) else 3
    active = np.isin(np.arange(len(network.observed)), [0, 1, 2, 6, rival])
    # The rival is wrong, and has led node 4 astray.
    T[4] = se3.random(rng)
    assert agrees(network, active, T, rival, one, other)
    for step in 0.2 * np.eye(6):
        bad = spoiled(network, min(one, other), step)
        assert not agrees(bad, active, T, rival, one, other)


def test_what_hangs_by_a_wrong_edge_is_laid_where_another_puts_it() -> None:
    T, network = graph()
    moved = T.copy()
    moved[2] = se3.random(np.random.default_rng(1))
    active = np.ones(7, dtype=bool)
    active[2] = False
    # Node 2 hangs by edge 1; edge 2 puts it right.
    found = relaid(network, active, moved, 1, 2)
    np.testing.assert_allclose(found, T, atol=0.02)
