"""The filter of a site's checks against least squares of all of them at once."""

import numpy as np
from scipy.special import chdtrc, chdtri

from retropole.api import floor
from retropole.base.datatypes import Array
from retropole.fleet.history.model import (
    LEVEL_FACTOR,
    SEASON,
    SLOW_TIME,
    YEAR,
    adopted,
    begin,
    first_state,
    no_changes,
    predicted,
    updated,
    weights,
)
from tests.fleet.history.checks import COMMON, RANDOM, checks

SHARE = 0.5


def joint_covariance(days: Array) -> Array:
    """(6n, 6n) of all steps, as the model says it, written out."""
    apart = np.abs(days[:, None] - days)
    season = np.cos(2 * np.pi * apart / YEAR)
    slow = np.exp(-apart / SLOW_TIME)
    n = len(days)
    return np.asarray(
        np.kron(np.ones((n, n)), LEVEL_FACTOR**2 * COMMON)
        + np.kron(season, np.diag(SEASON**2))
        + np.kron(slow, floor() + SHARE * RANDOM)
        + np.kron(np.eye(n), RANDOM)
    )


def test_a_change_is_that_of_least_squares_of_all_checks_at_once() -> None:
    seen = checks(9)
    state, changes = first_state(seen[0], SHARE), no_changes()
    surprises = 0.0
    for k, one in enumerate(seen):
        state, changes = predicted(state, changes, one, 1.0, SHARE)
        changes = begin(changes, k, one.days, kinds=("step", "trend"))
        state, changes, told = updated(state, changes, one, 1.0)
        surprises += float(told.chi2)
    days = np.array([one.days for one in seen])
    y = np.concatenate([one.step for one in seen])
    V = joint_covariance(days)
    np.testing.assert_allclose(surprises, y @ np.linalg.solve(V, y), rtol=1e-6)
    onset = 4
    for is_trend, shape in (
        (False, (np.arange(9) >= onset).astype(float)),
        (True, np.maximum(days - days[onset], 0.0) / YEAR),
    ):
        X = np.kron(shape[:, None], np.eye(6))
        information = X.T @ np.linalg.solve(V, X)
        b = X.T @ np.linalg.solve(V, y)
        expected = np.linalg.solve(information, b)
        m = int(np.flatnonzero((changes.onset == onset) & (changes.is_trend == is_trend))[0])
        size, covariance = changes.size(m)
        np.testing.assert_allclose(size, expected, rtol=1e-4, atol=1e-9)
        np.testing.assert_allclose(covariance, np.linalg.inv(information), rtol=1e-3, atol=1e-12)
        statistic = float(expected @ information @ expected)
        if is_trend:
            # Or one of translation alone, which is told by fewer degrees of freedom.
            part = np.linalg.inv(information[3:, 3:])
            alone = float(chdtri(6, chdtrc(3, b[3:] @ part @ b[3:])))
            statistic = max(statistic, alone)
        np.testing.assert_allclose(changes.statistics()[m], statistic, rtol=1e-4)


def test_what_was_found_is_expected_from_then_on() -> None:
    moved = np.array([0.0, 0, 0, 0.03, 0, 0])
    seen = checks(12, lambda k: moved * (k >= 6))
    state, changes = first_state(seen[0], SHARE), no_changes()
    for k, one in enumerate(seen):
        state, changes = predicted(state, changes, one, 1.0, SHARE)
        if k == 6:
            changes = begin(changes, k, one.days, kinds=("step",))
        state, changes, _ = updated(state, changes, one, 1.0)
    after = adopted(state, changes, 0)
    H = np.kron(weights(seen[-1]), np.eye(6))
    np.testing.assert_allclose(H @ after.mean, seen[-1].step, atol=0.01)
    size, covariance = changes.size(0)
    off = size - moved
    assert off @ np.linalg.solve(covariance, off) < 30.0
    assert np.linalg.eigvalsh(after.covariance - state.covariance).min() > -1e-12


def test_a_time_and_a_way_of_being_found_have_their_own_part() -> None:
    one = checks(1)[0]
    assert weights(one)[5] == 0.0
    np.testing.assert_allclose(np.hypot(*weights(one)[2:4]), 1.0)
