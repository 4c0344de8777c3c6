"""Fig. 4 and Table III: four exact hypotheses, 180° apart, of which one is right."""

import numpy as np
import pytest

from retropole import se3
from retropole.datatypes import Hypothesis
from retropole.evaluation.paper.choosing import RULES, ScoredCorridor, is_right, score_corridor
from tests.evaluation.paper.exhibits import all_exhibits, number


@pytest.fixture(scope="module")
def corridor() -> ScoredCorridor:
    return score_corridor(1)


def test_the_four_hypotheses_are_180_degrees_apart() -> None:
    rows = all_exhibits()["fig4_hypotheses"].rows
    assert [number(row[3]) for row in rows] == pytest.approx([0, 180, 180, 180], abs=1.0)
    rms = [number(row[2]) for row in rows]
    assert rms == pytest.approx([rms[0]] * 4, rel=1e-3)


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
    assert [row[0] for row in all_exhibits()["table3_four_result"].rows] == ["a", "b", "c", "d"]
    counts = all_exhibits()["table3_how_often"].rows
    assert [row[0] for row in counts] == list(RULES)
    assert all(0 <= number(right) <= number(of) == 1 for _, right, of in counts)


def test_rules_without_a_figure_choose_last(corridor: ScoredCorridor) -> None:
    first = corridor.hypotheses[0]
    silent = Hypothesis(
        first.match, None, None, first.overlap, first.free_space_violation, first.score
    )
    for name in ("paper: least e_r", "paper: least e_t"):
        assert RULES[name](silent) == np.inf
