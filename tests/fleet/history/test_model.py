"""The filter of a site's checks against least squares of all of them at once."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.special import chdtrc, chdtri

from retropole.api import floor
from retropole.base.datatypes import Array
from retropole.fleet.history.changes import IS_TREND, NONE, Changes, no_changes, passed, taken
from retropole.fleet.history.model import (
    LEVEL_FACTOR,
    SEASON,
    YEAR,
    Observed,
    State,
    first_state,
    predicted,
    together,
    updated,
    weights,
)
from retropole.fleet.history.runs import Past, Runs, adopted, as_told_by
from tests.fleet.history.checks import COMMON, RANDOM, checks

pytestmark = pytest.mark.full

SHARE = 0.5
SHARES, SLOW_TIME = np.array([SHARE, 1.0]), np.array([30.0, 90.0])


def joint_covariance(days: Array) -> Array:
    """(6n, 6n) of all steps, as the model says it, written out."""
    apart = np.abs(days[:, None] - days)
    season = np.cos(2 * np.pi * apart / YEAR)
    slow = np.exp(-apart / SLOW_TIME[0])
    n = len(days)
    return np.asarray(
        np.kron(np.ones((n, n)), LEVEL_FACTOR**2 * COMMON)
        + np.kron(season, np.diag(SEASON**2))
        + np.kron(slow, floor() + SHARE * RANDOM)
        + np.kron(np.eye(n), RANDOM)
    )


def replayed(seen: Sequence[Observed]) -> tuple[State, Changes, list[Past], float]:
    """Take checks in by two filters, of which the first tells; gives its surprises too."""
    state = first_state(together(seen[:1]), SHARES)
    changes, past, surprises = no_changes(1), [], 0.0
    for n, one in enumerate(seen):
        check = together([one])
        ahead = predicted(state, check, np.ones((1, 2)), SHARES, SLOW_TIME)
        state = updated(state, check, ahead)
        past.append(Past(n, np.ones(1, dtype=bool), passed(ahead)))
        through = passed(ahead).of(0, np.array([0]))
        changes = taken(changes, n, np.asarray(check.days), through)
        surprises += float(ahead.chi2[0, 0])
    return state, changes, past, surprises


def slot(changes: Changes, onset: int, is_trend: bool) -> int:
    (m,) = np.flatnonzero((changes.onset[0] == onset) & (is_trend == IS_TREND))
    return int(m)


def test_a_change_is_that_of_least_squares_of_all_checks_at_once() -> None:
    seen = checks(9)
    _, changes, _, surprises = replayed(seen)
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
        m = slot(changes, onset, is_trend)
        size, covariance = changes.size(0, m)
        np.testing.assert_allclose(size, expected, rtol=1e-4, atol=1e-9)
        np.testing.assert_allclose(covariance, np.linalg.inv(information), rtol=1e-3, atol=1e-12)
        statistic = float(expected @ information @ expected)
        if is_trend:
            # Or one of translation alone, which is told by fewer degrees of freedom.
            part = np.linalg.inv(information[3:, 3:])
            alone = float(chdtri(6, chdtrc(3, b[3:] @ part @ b[3:])))
            statistic = max(statistic, alone)
        np.testing.assert_allclose(changes.statistics()[0, m], statistic, rtol=1e-4)


def test_what_was_found_is_expected_from_then_on() -> None:
    moved = np.array([0.0, 0, 0, 0.03, 0, 0])
    seen = checks(12, lambda k: moved * (k >= 6))
    state, changes, past, _ = replayed(seen)
    m = slot(changes, 6, is_trend=False)
    none = np.zeros((1, 2))
    own = Runs(none, none, none[:, 0], state, changes, np.zeros(1, dtype=int))
    after = adopted(own, m, past, 0, []).state
    H = np.kron(weights(seen[-1])[:4], np.eye(6))
    np.testing.assert_allclose(H @ after.mean[0, 0], seen[-1].step, atol=0.01)
    size, covariance = changes.size(0, m)
    off = size - moved
    assert off @ np.linalg.solve(covariance, off) < 30.0
    assert np.linalg.eigvalsh(after.covariance[0] - state.covariance[0]).min() > -1e-12


def test_a_filter_that_did_not_tell_knows_the_changes_as_if_it_had() -> None:
    seen = checks(50)
    _, changes, past, _ = replayed(seen)
    _, early, _, _ = replayed(seen[:30])
    for known in (None, (29.0, early)):
        again = as_told_by(0, changes, past, 0, known)
        there = changes.onset[0] != NONE
        upper = np.triu_indices(6)
        for ours, carried in (
            (again.information[upper][:, 0], changes.information[upper][:, 0]),
            (again.vector[:, 0], changes.vector[:, 0]),
            (again.deviation[0], changes.deviation[0]),
        ):
            scale = np.abs(carried[..., there]).max()
            np.testing.assert_allclose(ours[..., there], carried[..., there], atol=1e-12 * scale)


def test_kinds_that_nothing_needs_change_nothing() -> None:
    seen = checks(30)
    state = first_state(together(seen[:1]), SHARES)
    plain, whole = (state, no_changes(1)), (state.whole(), no_changes(1).whole())
    for n, one in enumerate(seen):
        check, after = together([one]), []
        for state, changes in (plain, whole):
            ahead = predicted(state, check, np.ones((1, 2)), SHARES, SLOW_TIME)
            through = passed(ahead).of(0, np.array([0]))
            after.append(
                (updated(state, check, ahead), taken(changes, n, np.asarray(check.days), through))
            )
        plain, whole = after
    np.testing.assert_allclose(plain[0].whole().mean, whole[0].mean, atol=1e-14)
    there = plain[1].onset[0] != NONE
    for name in ("deviation", "vector"):
        ours, theirs = (vars(each[1].whole())[name][..., there] for each in (plain, whole))
        np.testing.assert_allclose(ours, theirs, atol=1e-12 * np.abs(theirs).max())


def test_a_check_adds_no_more_to_a_statistic_than_its_surprise() -> None:
    seen = checks(30)
    _, before, _, surprise = replayed(seen[:29])
    _, after, _, whole = replayed(seen)
    same = (before.onset == after.onset) & (after.onset != NONE)
    gained = (after.ratios()[0] - before.ratios()[0])[same]
    assert gained.max() <= whole - surprise


def test_a_time_and_a_way_of_being_found_have_their_own_part() -> None:
    one = checks(1)[0]
    assert weights(one)[5] == 0.0
    np.testing.assert_allclose(np.hypot(*weights(one)[1:3]), 1.0)
