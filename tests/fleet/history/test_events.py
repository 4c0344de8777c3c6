"""What was found says whether somebody should look, and how clear it is."""

import pytest

from retropole.fleet.history.events import CLEAR, Event, EventKind, Watched

pytestmark = pytest.mark.full


@pytest.mark.parametrize(
    ("kind", "alarm"), [("step", True), ("trend", True), ("unsettled", True), ("outlier", False)]
)
def test_all_but_a_single_check_is_an_alarm(kind: EventKind, alarm: bool) -> None:
    event = Event(kind, 3, 4)
    assert Watched((event,)).alarms == ((event,) if alarm else ())


def test_step_and_trend_are_told_apart_from_a_lead_on() -> None:
    assert Event("step", 3, 4, lead=CLEAR).is_clear
    assert not Event("step", 3, 4, lead=CLEAR - 0.1).is_clear
