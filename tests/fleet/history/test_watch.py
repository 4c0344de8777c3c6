"""Steps, trends and outliers of made-up sites are told apart, and quiet sites stay quiet."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import chdtrc, chdtri

from retropole.api import floor
from retropole.base.datatypes import Array
from retropole.fleet.history import watch as watching
from retropole.fleet.history.watch import (
    CLEAR,
    LEVEL_FACTOR,
    MOST_WAITING,
    SEASON,
    SHARES,
    TIMES,
    YEAR,
    Event,
    EventKind,
    Watched,
    watch,
)
from tests.fleet.history.checks import COMMON, MOVED, RANDOM, SIGMA, checks

pytestmark = pytest.mark.full

ROTATED = np.array([0.0, np.radians(0.3), 0, 0, 0, 0])


def test_no_check_says_nothing() -> None:
    seen = watch([])
    assert (seen.events, seen.waiting) == ((), ())


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_a_quiet_site_stays_quiet(factor: float) -> None:
    seen = checks(52, seed=3)
    level = np.mean([one.step for one in seen], axis=0)
    seen = [one._replace(step=level + factor * (one.step - level)) for one in seen]
    assert not watch(seen).alarms


@pytest.mark.parametrize("moved", [MOVED, ROTATED])
def test_a_step_is_reported_by_the_second_check_and_its_size_is_right(moved: np.ndarray) -> None:
    seen = watch(checks(22, lambda k: moved * (k >= 20)))
    (event,) = seen.alarms
    assert (event.kind, event.onset, event.found) == ("step", 20, 21)
    assert event.lead > 0.0
    assert event.size is not None
    assert event.covariance is not None
    off = event.size - moved
    assert off @ np.linalg.solve(event.covariance, off) < 30.0
    assert watch(checks(21, lambda k: moved * (k >= 20))).waiting == (20,)


def test_one_check_that_is_off_is_an_outlier() -> None:
    seen = watch(checks(24, lambda k: 10 * MOVED * (k == 20)))
    (event,) = seen.events
    assert (event.kind, event.onset, event.found) == ("outlier", 20, 21)
    assert not seen.alarms


def test_two_that_are_off_and_do_not_agree_are_outliers() -> None:
    seen = watch(checks(24, lambda k: MOVED * (k == 20) - MOVED * (k == 21)))
    assert [(e.kind, e.onset) for e in seen.events] == [("outlier", 20), ("outlier", 21)]


def test_an_outlier_within_a_step_does_not_hide_it() -> None:
    (event,) = watch(checks(24, lambda k: MOVED * (k >= 20) - 5 * MOVED * (k == 21))).alarms
    assert (event.kind, event.onset) == ("step", 20)
    assert event.found <= 23


def test_a_step_before_the_first_check_is_one_against_the_stored_pose() -> None:
    seen = watch(checks(6, lambda k: 4 * MOVED))
    assert [(e.kind, e.onset) for e in seen.alarms] == [("step", 0)]


def test_checks_of_which_no_two_agree_are_reported_to_be_unsettled() -> None:
    rng = np.random.default_rng(1)
    far = 100 * SIGMA * rng.normal(size=(60, 6))
    seen = watch(checks(20 + MOST_WAITING + 3, lambda k: far[k] * (k >= 20)))
    assert seen.alarms[0].kind == "unsettled"


def test_a_drift_is_reported_as_a_trend() -> None:
    drift = np.array([0.0, 0, 0, 0, 0.02, 0])
    seen = watch(checks(52, lambda k: drift * 7 * max(k - 8, 0) / YEAR))
    event = seen.alarms[0]
    assert event.kind == "trend"
    assert event.size is not None
    assert event.covariance is not None
    off = event.size - drift
    assert off @ np.linalg.solve(event.covariance, off) < 30.0


def test_the_past_is_not_changed_later() -> None:
    whole = checks(26, lambda k: MOVED * (k >= 12))
    early, late = watch(whole[:18]).events, watch(whole).events
    assert [(e.kind, e.onset, e.found) for e in early] == [
        (e.kind, e.onset, e.found) for e in late if e.found < 18
    ]


def test_weeks_without_a_check_do_no_harm() -> None:
    seen = [one for k, one in enumerate(checks(40, lambda k: MOVED * (k >= 36))) if k % 4]
    (event,) = watch(seen).alarms
    assert (event.kind, event.found - event.onset) == ("step", 1)


def test_what_the_scene_alone_finds_may_lie_elsewhere() -> None:
    beside = 2.0 * SIGMA
    seen = [
        one._replace(step=one.step + beside * (k % 3 == 0), other=k % 3 == 0 and k > 0)
        for k, one in enumerate(checks(30))
    ]
    assert not watch(seen).alarms


def test_a_drift_of_5_mm_a_day_is_reported_by_the_second_check_that_says_moved() -> None:
    # 35 mm a week, from the middle of one on: neither a step nor quite a trend.
    drift = np.array([0.0, 0, 0, 0, 0.005, 0])
    for sigma in (0.5, 1.5):
        quiet = checks(16, seed=5)
        level = np.mean([one.step for one in quiet], axis=0)
        seen = [
            one._replace(
                step=level + sigma * (one.step - level) + drift * max(7 * k - 66.5, 0),
                random=sigma**2 * one.random,
                moved=k >= 11,
            )
            for k, one in enumerate(quiet)
        ]
        assert not watch(seen[:10]).alarms
        # By 52 and 87 mm: after two weeks and a half.
        assert watch(seen[:13]).alarms


def test_two_that_say_moved_on_the_same_side_are_an_alarm_and_lorries_are_none() -> None:
    def told(*sides: float) -> list[str]:
        off = {20 + k: side for k, side in enumerate(sides)}
        made = checks(21 + len(sides), lambda k: 3 * MOVED * off.get(k, 0.0))
        seen = watch([one._replace(moved=k in off) for k, one in enumerate(made)])
        return [event.kind for event in seen.alarms]

    # That grows by as much again fits neither a step nor a single one that is off.
    assert told(1.0, 2.0)
    assert told(1.0, -1.0) == []
    assert told(1.0) == []


def test_a_first_check_that_is_off_is_an_outlier_and_what_follows_no_step() -> None:
    seen = watch(checks(12, lambda k: 2 * MOVED * (k == 0)))
    assert not seen.alarms
    assert [(e.kind, e.onset) for e in seen.events] == [("outlier", 0)]


def test_a_lorry_after_a_check_that_chance_put_aside_is_no_trend() -> None:
    seen = watch(checks(24, lambda k: MOVED * (0.3 * (k == 20) + 2.0 * (k == 21))))
    assert not seen.alarms


@pytest.mark.parametrize(
    ("kind", "alarm"), [("step", True), ("trend", True), ("unsettled", True), ("outlier", False)]
)
def test_all_but_a_single_check_is_an_alarm(kind: EventKind, alarm: bool) -> None:
    event = Event(kind, 3, 4)
    assert Watched((event,)).alarms == ((event,) if alarm else ())


def test_step_and_trend_are_distinguished_from_a_lead_on() -> None:
    assert Event("step", 3, 4, lead=CLEAR).is_clear
    assert not Event("step", 3, 4, lead=CLEAR - 0.1).is_clear


def test_turning_the_axes_turns_what_is_found() -> None:
    turn = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0]
    T = np.kron(np.eye(2), turn)
    seen = checks(40, lambda k: MOVED * (0.5 * (k >= 12) + 0.02 * max(k - 25, 0)))
    turned = [
        one._replace(step=T @ one.step, random=T @ one.random @ T.T, common=T @ one.common @ T.T)
        for one in seen
    ]
    ours, theirs = watch(seen).events, watch(turned).events
    assert [(e.kind, e.onset, e.found) for e in ours] == [
        (e.kind, e.onset, e.found) for e in theirs
    ]
    assert ours
    for one, other in zip(ours, theirs, strict=True):
        assert one.size is not None
        assert other.size is not None
        np.testing.assert_allclose(T @ one.size, other.size, rtol=1e-6, atol=1e-9)


def joint_covariance(days: Array, law: int) -> Array:
    """(6n, 6n) of all steps, as the model says it, written out."""
    apart = np.abs(days[:, None] - days)
    season = np.cos(2 * np.pi * apart / YEAR)
    slow = np.exp(-apart / TIMES[law])
    n = len(days)
    return np.asarray(
        np.kron(np.ones((n, n)), LEVEL_FACTOR**2 * COMMON)
        + np.kron(season, np.diag(SEASON**2))
        + np.kron(slow, floor() + SHARES[law] * RANDOM)
        + np.kron(np.eye(n), RANDOM)
    )


@pytest.mark.parametrize("law", range(len(SHARES)))
def test_a_change_is_that_of_least_squares_of_all_checks_at_once(
    law: int,
) -> None:
    # The scatter is as stated, and one law tells.
    seen, onset = checks(9), 4
    now = watching._begin(seen[0])
    now = replace(
        now,
        total=np.full(len(SHARES), now.weight),
        likelihood=1.0 * (np.arange(len(SHARES)) == law),
    )
    surprises = 0.0
    for n, one in enumerate(seen):
        now, chi2 = watching._include(now, one, n)
        now = replace(now, total=np.full(len(SHARES), now.weight))
        now = replace(now, likelihood=1.0 * (np.arange(len(SHARES)) == law))
        surprises += chi2
    days = np.array([one.days for one in seen])
    y = np.concatenate([one.step for one in seen])
    V = joint_covariance(days, law)
    np.testing.assert_allclose(surprises, y @ np.linalg.solve(V, y), rtol=0.01)
    for is_trend, shape in (
        (False, (np.arange(9) >= onset).astype(float)),
        (True, np.maximum(days - days[onset], 0.0) / YEAR),
    ):
        X = np.kron(shape[:, None], np.eye(6))
        information = X.T @ np.linalg.solve(V, X)
        b = X.T @ np.linalg.solve(V, y)
        expected = np.linalg.solve(information, b)
        (m,) = np.flatnonzero((now.onset == onset) & (now.is_trend == is_trend))
        back = np.linalg.inv(now.axes)
        size = back @ (now.vector[law, :, m] / now.information[law, :, m])
        np.testing.assert_allclose(size, expected, rtol=1e-3, atol=1e-9)
        statistic = float(expected @ information @ expected)
        # Or one of translation alone, which is told by fewer degrees of freedom.
        part = np.linalg.inv(information[3:, 3:])
        alone = float(chdtri(6, chdtrc(3, b[3:] @ part @ b[3:])))
        statistic = max(statistic, alone)
        np.testing.assert_allclose(watching._statistics(now)[m], statistic, rtol=1e-3)
