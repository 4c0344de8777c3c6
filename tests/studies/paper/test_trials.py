"""Sec. IV-A, trial by trial: the trials are what the table says, and poles as long as asked."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.checking.metrics import errors_of
from studies.paper.estimator import poles_of, solve
from studies.paper.trials import (
    MIN_RINGS,
    TRIAL_LENGTH,
    TRIALS,
    pole_lengths,
    sees_both,
    set_up,
    ten_trials,
    trial_errors,
)
from tests.studies.paper.exhibits import number

pytestmark = pytest.mark.full


@pytest.mark.parametrize("length", [1.0, 2.0])
def test_poles_are_as_long_as_requested(length: float) -> None:
    short, tall = set_up(3, length), set_up(3, 6.0)
    np.testing.assert_array_equal(short.T_target_source, tall.T_target_source)
    for k, pole in enumerate(short.poles):
        np.testing.assert_array_equal(pole.axis, tall.poles[k].axis)
        xyz = se3.apply(short.T_world_target, short.target.xyz[short.labels[0] == k])
        extent = np.ptp((xyz - pole.centre) @ pole.axis)
        assert 0.4 * length < extent < length


def test_a_pole_without_returns_is_not_seen() -> None:
    assert sees_both(set_up(0, 6.0))
    assert not sees_both(set_up(0, 0.05)), f"of 5 cm there are no {MIN_RINGS} rings"


def test_the_first_trials_are_those_of_fewer() -> None:
    pair = set_up(0, TRIAL_LENGTH)
    two = trial_errors(pair, 0, 2)
    np.testing.assert_array_equal(trial_errors(pair, 0, 1), two[:1])
    assert np.all(two[0] != two[1])
    paper = solve(pair, poles_of(pair, "isotropic", np.random.default_rng([0, 1, 0]))).paper
    errors = errors_of(paper.T_target_source, pair.T_target_source)
    np.testing.assert_array_equal(two[0, 0], [errors.rotation, errors.translation, errors.e_rt])


def test_mean_and_standard_deviation_are_over_ten_trials() -> None:
    errors = trial_errors(set_up(0, TRIAL_LENGTH), 0, TRIALS)
    rows = {row[:2]: row[2:] for row in ten_trials(1).rows}
    for k, name in enumerate(("the paper's estimator", "beam model")):
        mean, sd = errors[:, k].mean(axis=0), errors[:, k].std(axis=0, ddof=1)
        expected = np.stack([mean, sd], axis=1) * np.array([[np.degrees(1.0)], [1.0], [1.0]])
        np.testing.assert_allclose([number(c) for c in rows[0, name][:6]], expected.ravel())


@pytest.mark.nightly
def test_short_poles_are_worse() -> None:
    rows = {row[:2]: number(row[2]) for row in pole_lengths(60).rows}
    for name in ("the paper's estimator", "beam model"):
        assert 1.2 < rows[name, 1.0] / rows[name, 6.0] < 3.0
