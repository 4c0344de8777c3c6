"""What a need is answered: by sampling, in words, and on both sides of its limits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.uncertainty import predicted_error
from retropole.base.uncertainty.purpose import (
    CONFIDENCE,
    Need,
    displacement,
    displacement_bound,
    fitness,
    is_certainly_met,
)

pytestmark = pytest.mark.full


def a_covariance(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6)) * np.array([3e-4] * 3 + [5e-3] * 3)[:, None]
    return np.asarray(A @ A.T)


def directions(rng: np.random.Generator, count: int) -> Array:
    drawn = rng.normal(size=(count, 3))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


@pytest.mark.parametrize("distance", [1.0, 30.0])
def test_no_point_moves_further_and_one_moves_as_far(distance: float) -> None:
    rng = np.random.default_rng(0)
    T, points = se3.random(rng), distance * directions(rng, 5000)
    for step in rng.normal(size=(20, 6)) * np.array([1e-4] * 3 + [2e-3] * 3):
        moved = se3.apply(se3.retract(T, step), points) - se3.apply(T, points)
        furthest = np.linalg.norm(moved, axis=1).max()
        most = float(displacement(step, distance))
        assert furthest <= 1.001 * most
        assert furthest >= 0.99 * most


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("distance", [10.0, 60.0])
def test_the_bound_holds_as_often_as_it_says(seed: int, distance: float) -> None:
    covariance, rng = a_covariance(seed), np.random.default_rng(seed + 10)
    T, points = se3.random(rng), distance * directions(rng, 400)
    bound = displacement_bound(covariance, distance)
    steps = rng.multivariate_normal(np.zeros(6), covariance, 2000)
    off = [
        np.linalg.norm(se3.apply(se3.retract(T, s), points) - se3.apply(T, points), axis=1).max()
        for s in steps
    ]
    # Three times what chance makes of 2,000 draws; 400 directions miss the worst by little.
    assert np.mean(np.array(off) <= bound) == pytest.approx(CONFIDENCE, abs=0.018)


def test_the_bound_of_one_direction_is_that_of_a_normal_distribution() -> None:
    covariance = np.diag([0, 0, 0, 1e-4, 0, 0])
    assert displacement_bound(covariance, 30.0) == pytest.approx(1.96 * 0.01, rel=0.01)
    about = np.diag([1e-6, 0, 0, 0, 0, 0])
    assert displacement_bound(about, 30.0) == pytest.approx(1.96 * 0.03, rel=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_the_bound_grows_with_distance_and_turns_with_the_frame(seed: int) -> None:
    covariance = a_covariance(seed)
    bounds = [displacement_bound(covariance, distance) for distance in (1.0, 10.0, 30.0, 60.0)]
    assert bounds == sorted(bounds)
    for bound, each in zip(bounds, predicted_error(covariance), strict=True):
        assert 1.3 * each.sigma_m < bound < 4 * each.sigma_m
    R = se3.random(np.random.default_rng(seed))[:3, :3]
    turn = np.block([[R, np.zeros((3, 3))], [np.zeros((3, 3)), R]])
    turned = displacement_bound(turn @ covariance @ turn.T, 30.0)
    assert turned == pytest.approx(bounds[2], rel=0.02)
    assert displacement_bound(4 * covariance, 30.0) == pytest.approx(2 * bounds[2])


def test_a_need_is_answered_yes_no_or_not_shown() -> None:
    covariance = a_covariance(0)
    bound = displacement_bound(covariance, 30.0)
    answers = [
        fitness(covariance, Need(share * bound, 30.0)).answer for share in (0.01, 0.99, 1.01)
    ]
    assert answers == ["no", "not shown", "yes"]
    fit = fitness(covariance, Need(0.5 * bound, 30.0))
    assert fit.bound_m == pytest.approx(bound)


@given(st.floats(0.001, 1.0), st.floats(0.5, 100.0), st.sampled_from(range(3)), st.floats(0.0, 0.2))
def test_an_answer_is_never_surer_than_its_probability(
    within: float, at: float, seed: int, wrong: float
) -> None:
    fit = fitness(a_covariance(seed), Need(within, at), wrong=wrong)
    assert fit.probability <= 1 - wrong
    assert (fit.answer == "yes") == (fit.probability >= CONFIDENCE)
    assert (fit.bound_m is None) == (1 - wrong <= CONFIDENCE)
    if fit.bound_m is not None:
        assert (fit.bound_m < 0.999 * within) <= (fit.answer == "yes")
    said = fit.words
    assert "100 %" not in said
    assert ("yes" in said) == (fit.answer == "yes")


def test_another_pose_or_a_doubt_takes_the_yes_away() -> None:
    covariance, need = a_covariance(0), Need(1.0, 30.0)
    assert fitness(covariance, need).words == "within 100 cm at 30 m: yes, 99 % sure"
    assert fitness(covariance, need, wrong=0.04).answer == "yes"
    assert fitness(covariance, need, wrong=0.06).answer == "not shown"
    doubted = fitness(covariance, need, doubts=("small_margin",))
    assert doubted.answer == "not shown"
    assert doubted.words.endswith("not shown, 99 % sure if it were not for small_margin")


def test_what_is_hardly_not_enough_is_not_reported_to_be_95_percent_sure() -> None:
    covariance = a_covariance(0)
    hardly = Need(displacement_bound(covariance, 30.0, 0.949), 30.0)
    assert fitness(covariance, hardly).words.endswith("not shown, 94 % sure")


def test_what_is_surely_met_is_met_and_not_only_what_could_hardly_be_missed() -> None:
    sure = 0
    for seed in range(20):
        covariance = a_covariance(seed)
        bound = displacement_bound(covariance, 30.0)
        for times in (0.9, 1.0, 1.5, 3.0, 6.0):
            need = Need(times * bound, 30.0)
            if is_certainly_met(covariance, need):
                sure += 1
                assert fitness(covariance, need).answer == "yes"
        assert not is_certainly_met(covariance, Need(bound, 30.0))
        assert is_certainly_met(covariance, Need(6.0 * bound, 30.0))
    assert sure < 60
