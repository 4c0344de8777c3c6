"""Table III: one hypothesis is right, and every rule has a figure for it."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Hypothesis
from studies.paper import reproduce
from studies.paper.choosing import (
    PAPER_RULES,
    RULES,
    ScoredCorridor,
    is_right,
    score_corridor,
    unlimited_icp,
)
from tests.studies.paper.exhibits import number

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def corridor() -> ScoredCorridor:
    return score_corridor(1)


def test_the_right_hypothesis_comes_first_and_there_is_one(corridor: ScoredCorridor) -> None:
    assert corridor.right == [True, False, False, False]


def test_right_is_what_lies_near_the_truth(corridor: ScoredCorridor) -> None:
    poles = np.array([pole.point for pole in corridor.poles[1]])
    right: Hypothesis = corridor.hypotheses[0]
    T = right.match.T_target_source
    assert is_right(right, T, poles)
    for step in np.diag([0.2, 0.2, 0.2, 1.1, 1.1, 1.1]):
        assert not is_right(right, se3.retract(T, step), poles)
        assert is_right(right, se3.retract(T, step / 100), poles)


def test_every_rule_is_counted() -> None:
    four, often = reproduce(1, None, only=["table3_four_result", "table3_how_often"])
    assert [row[0] for row in four.rows] == ["a", "b", "c", "d"]
    counts = often.rows
    assert [row[0] for row in counts] == [*PAPER_RULES, *RULES]
    assert all(0 <= number(right) <= number(of) == 1 for _, right, of in counts)


def test_rules_without_a_figure_choose_last(corridor: ScoredCorridor) -> None:
    first = corridor.hypotheses[0]
    silent = Hypothesis(
        first.match, None, None, first.overlap, first.free_space_violation, first.score
    )
    for name in ("paper: least e_r", "paper: least e_t"):
        assert RULES[name](silent) == np.inf


def test_icp_of_any_reach_has_a_figure_for_every_hypothesis(corridor: ScoredCorridor) -> None:
    right, *others = unlimited_icp(corridor.pair, corridor.hypotheses)
    assert len(others) == 3
    assert any(h.icp_rotation is None for h in corridor.hypotheses[1:]), "a reach of 1 m has not"
    assert 1e-4 < right.e_r < 0.2 < min(moved.e_r for moved in others)
    assert 1e-3 < right.e_t < 0.5 < min(moved.e_t for moved in others)
    assert all(moved.converged for moved in (right, *others))
