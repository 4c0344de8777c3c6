import numpy as np
import pytest

from conftest import PoleMaker
from retropole.datatypes import Hypothesis, Match
from retropole.errors import Refusal
from retropole.verdict import MIN_OVERLAP, check_choice, margin_of, weaknesses


def hypothesis(
    score: float, overlap: float = 0.9, free_space: float = 0.0, exact: bool = True
) -> Hypothesis:
    match = Match(((0, 0), (1, 1)), np.eye(4), 0.01, exact, np.eye(6))
    return Hypothesis(match, 0.1, 0.1, overlap, free_space, score)


def test_margin_is_over_the_best_of_the_others() -> None:
    assert margin_of([hypothesis(0.9), hypothesis(0.2), hypothesis(0.5)]) == pytest.approx(0.4)
    assert margin_of([hypothesis(0.9)]) is None
    assert margin_of([]) is None


def test_a_scene_that_does_not_decide_is_refused() -> None:
    poor, contradicted = hypothesis(0.3, 0.3), hypothesis(0.6, 0.8, free_space=0.2)
    check_choice([hypothesis(0.9), poor, contradicted])
    with pytest.raises(Refusal) as refusal:
        check_choice([hypothesis(0.9), hypothesis(0.75, 0.75), poor, contradicted])
    assert refusal.value.code == "ambiguous"
    assert "2 hypotheses" in str(refusal.value)


def test_a_match_that_does_not_fit_is_no_rival() -> None:
    check_choice([hypothesis(0.9), hypothesis(0.9, exact=False)])


def test_scenes_that_do_not_overlap_are_refused() -> None:
    with pytest.raises(Refusal) as refusal:
        check_choice([hypothesis(0.1, MIN_OVERLAP / 2), hypothesis(-0.5)])
    assert refusal.value.code == "no_overlap"


def test_weak_poles_are_named(make_pole: PoleMaker) -> None:
    up, lean = np.array([0.0, 0, 1]), np.array([np.sin(0.5), 0, np.cos(0.5)])
    good = [make_pole([4.0, -1, 0], up), make_pole([4.0, 1, 0], lean)]
    hypotheses = [hypothesis(0.9), hypothesis(0.3)]
    assert weaknesses(good, good, hypotheses) == []
    few = [make_pole([4.0, -1, 0], up, count=7), good[1]]
    assert [r.code for r in weaknesses(good, few, hypotheses)] == ["few_points"]
    slight = make_pole([4.0, 1, 0], [np.sin(0.15), 0, np.cos(0.15)])
    codes = [r.code for r in weaknesses([good[0], slight], good, hypotheses)]
    assert codes == ["nearly_parallel_poles"]
