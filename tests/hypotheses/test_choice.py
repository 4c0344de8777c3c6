"""Which hypotheses the scene leaves standing, and the choice by hand."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, Hypothesis, Match
from retropole.base.errors import Refusal, UsageError
from retropole.hypotheses.choice import (
    LEAST_OVERLAP,
    MIN_COVISIBLE_OVERLAP,
    MIN_OVERLAP,
    MIN_UNCONTRADICTED_COVISIBLE,
    MIN_UNCONTRADICTED_OVERLAP,
    UNCONTRADICTED,
    check_choice,
    hypothesis_name,
    is_hypothesis_name,
    margin_of,
    not_rejected,
)
from retropole.pipeline import Options, calibrate
from retropole.simulation import SimulatedPair, simulate_pair
from tests.tiers import first_of


def hypothesis(
    score: float, overlap: float = 0.9, violation: float = 0.0, exact: bool = True
) -> Hypothesis:
    match = Match(((0, 0), (1, 1)), np.eye(4), 0.01, exact, True, np.eye(6))
    return Hypothesis(match, 0.1, 0.1, overlap, violation, score)


def test_margin_is_over_the_best_of_the_others() -> None:
    assert margin_of([hypothesis(0.9), hypothesis(0.2), hypothesis(0.5)]) == pytest.approx(0.4)
    assert margin_of([hypothesis(0.9)]) is None
    assert margin_of([]) is None


def test_a_scene_that_does_not_decide_is_refused() -> None:
    poor, contradicted = hypothesis(0.3, 0.3), hypothesis(0.6, 0.8, violation=0.2)
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


@pytest.mark.parametrize(("of_all", "of_both", "is_refused"), [
    (1.01 * MIN_OVERLAP, 0.0, False),
    (1.01 * LEAST_OVERLAP, 1.01 * MIN_COVISIBLE_OVERLAP, False),
    (1.01 * LEAST_OVERLAP, 0.99 * MIN_COVISIBLE_OVERLAP, True),
    (0.99 * LEAST_OVERLAP, 1.0, True),
])  # fmt: skip
def test_overlap_may_be_small_where_that_of_what_both_see_is_not(
    of_all: float, of_both: float, is_refused: bool
) -> None:
    violation = 1.01 * of_all / UNCONTRADICTED
    best = replace(hypothesis(of_all, of_all, violation), covisible_overlap=of_both)
    with pytest.raises(Refusal) if is_refused else nullcontext():
        check_choice([best, hypothesis(-0.5, 0.0)])


@pytest.mark.parametrize(("of_all", "of_both", "violation", "is_refused"), [
    (1.01, 1.01, 0.99, False),
    (0.99, 1.01, 0.99, True),
    (1.01, 0.99, 0.99, True),
    (1.01, 1.01, 1.01, True),
])  # fmt: skip
def test_overlap_may_be_smaller_still_where_next_to_nothing_contradicts(
    of_all: float, of_both: float, violation: float, is_refused: bool
) -> None:
    overlap = of_all * MIN_UNCONTRADICTED_OVERLAP
    best = replace(
        hypothesis(overlap, overlap, violation * overlap / UNCONTRADICTED),
        covisible_overlap=of_both * MIN_UNCONTRADICTED_COVISIBLE,
    )
    with pytest.raises(Refusal) if is_refused else nullcontext():
        check_choice([best, hypothesis(-0.5, 0.0)])


def test_those_stand_that_the_limit_counts_and_those_that_score_nearly_as_well() -> None:
    best, rival, near = hypothesis(0.9), hypothesis(0.7, 0.7), hypothesis(0.85, violation=0.05)
    others = hypothesis(0.3, 0.3), hypothesis(0.89, exact=False)
    assert not_rejected([best, rival, near, *others]) == [True, True, True, False, False]
    with pytest.raises(Refusal) as refusal:
        check_choice([best, rival, near, *others])
    assert refusal.value.values["rivals"] == 1


def test_names_are_told_from_what_is_none() -> None:
    assert all(is_hypothesis_name(hypothesis_name(k)) for k in (0, 25, 26, 700))
    assert not any(map(is_hypothesis_name, ("", "A", "ab", "3", "h0", "a\n", 1, None)))


@pytest.fixture(scope="module", params=first_of(["corridor", "harbor"]))
def symmetric(request: pytest.FixtureRequest) -> tuple[SimulatedPair, Calibration]:
    pair = simulate_pair(request.param, np.random.default_rng(5), symmetric=True)
    return pair, calibrate(pair.target, pair.source)


def is_true(hypothesis: Hypothesis, T_true: Array) -> bool:
    turn = hypothesis.match.T_target_source[:3, :3] @ T_true[:3, :3].T
    return bool(se3.rotation_angle(turn) < np.radians(5.0))


@pytest.mark.full
def test_the_refusal_says_which_stand_and_where_the_vertical_is(
    symmetric: tuple[SimulatedPair, Calibration],
) -> None:
    pair, refused = symmetric
    assert [each.stands for each in refused.hypotheses[:3]] == [True, True, False]
    assert refused.vertical is not None
    assert refused.vertical @ pair.T_world_target[2, :3] > np.cos(np.radians(3.0))


@pytest.mark.full
def test_the_letter_of_the_true_one_gives_the_true_pose_with_a_warning(
    symmetric: tuple[SimulatedPair, Calibration],
) -> None:
    pair, refused = symmetric
    (k,) = (k for k, h in enumerate(refused.hypotheses) if is_true(h, pair.T_target_source))
    answer = calibrate(pair.target, pair.source, options=Options(by_hand=hypothesis_name(k)))
    assert answer.status == "warn"
    assert answer.reasons[0].code == "chosen_by_hand"
    assert answer.reasons[0].values["hypothesis"] == hypothesis_name(k)
    assert answer.T_target_source is not None
    off = se3.difference(answer.T_target_source, pair.T_target_source)
    assert off.rotation < np.radians(0.3)
    assert off.translation < 0.03
    # The list keeps its order, so that a letter means the same in both runs.
    assert answer.chosen == k
    for one, other in zip(answer.hypotheses, refused.hypotheses, strict=True):
        assert np.array_equal(one.match.T_target_source, other.match.T_target_source)


@pytest.mark.full
def test_a_wrong_letter_is_refused_or_warned_of(
    symmetric: tuple[SimulatedPair, Calibration],
) -> None:
    pair, refused = symmetric
    for k, each in enumerate(refused.hypotheses):
        if not is_true(each, pair.T_target_source) and each.match.exact:
            answer = calibrate(
                pair.target, pair.source, options=Options(by_hand=hypothesis_name(k))
            )
            assert answer.status in ("warn", "refused")
            if answer.status == "warn":
                assert each.stands
                assert answer.reasons[0].code == "chosen_by_hand"
            else:
                assert answer.T_target_source is None
                assert answer.reasons[0].code == "no_overlap" or each.stands


@pytest.mark.full
def test_a_letter_that_no_exact_hypothesis_has_is_an_error(
    symmetric: tuple[SimulatedPair, Calibration],
) -> None:
    pair, refused = symmetric
    inexact = next(k for k, h in enumerate(refused.hypotheses) if not h.match.exact)
    for name in (hypothesis_name(inexact), "z"):
        with pytest.raises(UsageError, match="those that fit are a, b, c, d"):
            calibrate(pair.target, pair.source, options=Options(by_hand=name))


@pytest.mark.full
def test_where_the_scene_decides_its_choice_by_hand_is_the_same_with_a_warning() -> None:
    pair = simulate_pair("street", np.random.default_rng(12))
    by_scene, by_hand = (
        calibrate(pair.target, pair.source, options=Options(by_hand=name)) for name in (None, "a")
    )
    assert by_scene.T_target_source is not None
    assert by_hand.T_target_source is not None
    assert np.array_equal(by_scene.T_target_source, by_hand.T_target_source)
    assert by_hand.status == "warn"
    contradicted = calibrate(pair.target, pair.source, options=Options(by_hand="b"))
    assert contradicted.status == "refused" or contradicted.reasons[0].code == "chosen_by_hand"


@pytest.mark.full
def test_a_letter_lifts_no_other_refusal() -> None:
    pair = simulate_pair("street", np.random.default_rng(12))
    without = replace(pair.source, intensity=np.zeros(len(pair.source)))
    plain, by_hand = (
        calibrate(pair.target, without, options=Options(by_hand=name)).reasons[0].code
        for name in (None, "a")
    )
    assert plain == by_hand
