"""Steps, trends and outliers of made-up sites are told apart, and quiet sites stay quiet."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Array
from retropole.fleet.history.model import SLOPE, YEAR, together
from retropole.fleet.history.watch import MOST_WAITING, watch, watch_all
from tests.fleet.history.checks import MOVED, SIGMA, checks

pytestmark = pytest.mark.full

ROTATED = np.array([0.0, np.radians(0.3), 0, 0, 0, 0])


def test_no_check_says_nothing() -> None:
    seen = watch([])
    assert (seen.events, seen.waiting, seen.state) == ((), (), None)


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_a_quiet_site_stays_quiet(factor: float) -> None:
    seen = checks(52, seed=3)
    level = np.mean([one.step for one in seen], axis=0)
    seen = [replace(one, step=level + factor * (one.step - level)) for one in seen]
    assert not watch(seen).alarms


@pytest.mark.parametrize("moved", [MOVED, ROTATED])
def test_a_step_is_told_by_the_second_check_and_its_size_is_right(moved: np.ndarray) -> None:
    seen = watch(checks(22, lambda k: moved * (k >= 20)))
    (event,) = seen.alarms
    assert (event.kind, event.onset, event.found) == ("step", 20, 21)
    assert event.is_clear
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
    seen = watch(checks(24, lambda k: MOVED * (k >= 20) - 5 * MOVED * (k == 21)))
    assert [(e.kind, e.onset, e.found) for e in seen.alarms] == [("step", 20, 22)]


def test_a_step_before_the_first_check_is_one_against_the_stored_pose() -> None:
    seen = watch(checks(6, lambda k: 4 * MOVED))
    assert [(e.kind, e.onset) for e in seen.alarms] == [("step", 0)]


def test_checks_of_which_no_two_agree_are_said_to_be_unsettled() -> None:
    rng = np.random.default_rng(1)
    far = 100 * SIGMA * rng.normal(size=(60, 6))
    seen = watch(checks(20 + MOST_WAITING + 3, lambda k: far[k] * (k >= 20)))
    assert seen.alarms[0].kind == "unsettled"


def test_a_drift_is_told_as_a_trend() -> None:
    drift = np.array([0.0, 0, 0, 0, 0.02, 0])
    seen = watch(checks(52, lambda k: drift * 7 * max(k - 8, 0) / YEAR))
    event = seen.alarms[0]
    assert event.kind == "trend"
    assert event.size is not None
    assert event.covariance is not None
    off = event.size - drift
    assert off @ np.linalg.solve(event.covariance, off) < 30.0
    assert seen.state is not None
    assert seen.state.covariance[SLOPE, SLOPE].any()


def test_the_past_is_not_told_otherwise_later() -> None:
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
        replace(one, step=one.step + beside * (k % 3 == 0), other=k % 3 == 0 and k > 0)
        for k, one in enumerate(checks(30))
    ]
    assert not watch(seen).alarms


def test_a_drift_of_5_mm_a_day_is_told_by_the_second_check_that_says_moved() -> None:
    # 35 mm a week, from the middle of one on: neither a step nor quite a trend.
    drift = np.array([0.0, 0, 0, 0, 0.005, 0])
    for sigma in (0.5, 1.5):
        quiet = checks(16, seed=5)
        level = np.mean([one.step for one in quiet], axis=0)
        seen = [
            replace(
                one,
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
        seen = watch([replace(one, moved=k in off) for k, one in enumerate(made)])
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


def stepped(k: int) -> Array:
    return MOVED * (k >= 30)


def drifted(k: int) -> Array:
    return MOVED * max(k - 20, 0) / 20


def test_sites_beside_each_other_are_watched_as_each_alone() -> None:
    rng = np.random.default_rng(3)
    sites = []
    for seed in range(7):
        count = (90, 3, 60, 90, 1, 75, 40)[seed]
        seen = checks(count, stepped if seed % 2 else drifted, seed=seed)
        for k in np.flatnonzero(rng.random(len(seen)) < 0.04):
            seen[k] = replace(seen[k], step=seen[k].step + 20 * SIGMA * rng.normal(size=6))
        sites.append([replace(one, other=seed > 4 and k % 3 == 2) for k, one in enumerate(seen)])
    beside = watch_all([together(seen) for seen in sites])
    kinds = {event.kind for one in beside for event in one.events}
    assert {"step", "trend", "outlier"} <= kinds
    for seen, ours in zip(sites, beside, strict=True):
        alone = watch(seen)
        assert ours.waiting == alone.waiting
        assert [(one.kind, one.onset, one.found) for one in ours.events] == [
            (one.kind, one.onset, one.found) for one in alone.events
        ]
        assert ours.state is not None
        assert alone.state is not None
        np.testing.assert_allclose(ours.scale, alone.scale, rtol=1e-9)
        sigma = np.sqrt(np.maximum(np.diag(alone.state.covariance), 1e-30))
        np.testing.assert_allclose(ours.state.mean / sigma, alone.state.mean / sigma, atol=1e-6)
