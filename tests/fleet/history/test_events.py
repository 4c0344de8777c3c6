"""What was found says whether somebody should look, and how clear it is."""

import numpy as np
import pytest

from retropole.fleet.history.events import CLEAR, Event, EventKind, Watched
from retropole.fleet.history.model import LEVEL, SIZE, SLOPE, State


@pytest.mark.parametrize(
    ("kind", "alarm"), [("step", True), ("trend", True), ("unsettled", True), ("outlier", False)]
)
def test_all_but_a_single_check_is_an_alarm(kind: EventKind, alarm: bool) -> None:
    event = Event(kind, 3, 4)
    assert event.is_alarm == alarm
    assert Watched((event,)).alarms == ((event,) if alarm else ())


def test_step_and_trend_are_told_apart_from_a_lead_on() -> None:
    assert Event("step", 3, 4, lead=CLEAR).is_clear
    assert not Event("step", 3, 4, lead=CLEAR - 0.1).is_clear


def test_level_and_slope_are_those_of_the_state() -> None:
    assert Watched().level is None
    state = State(np.arange(float(SIZE)), np.zeros((SIZE, SIZE)), 0.0)
    watched = Watched(state=state)
    assert watched.level is not None
    np.testing.assert_array_equal(watched.level[0], state.mean[LEVEL])
    # Before a trend was found there is none.
    assert watched.slope is None
    state.covariance[SLOPE, SLOPE] = np.eye(6)
    assert watched.slope is not None
    np.testing.assert_array_equal(watched.slope[0], state.mean[SLOPE])
    np.testing.assert_array_equal(watched.slope[1], np.eye(6))
