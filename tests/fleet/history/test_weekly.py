"""The real command, run each week on recordings of simulated sites."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.fleet_weekly import Case, Outcome, Week, row_of, said, watched

pytest.importorskip("distributed", reason="needs the extra fleet")


@pytest.mark.parametrize(
    "weeks", [pytest.param(2, marks=pytest.mark.full), pytest.param(4, marks=pytest.mark.nightly)]
)
def test_a_site_that_does_not_move_ends_with_0_and_one_that_drifts_with_4(
    weeks: int, tmp_path: Path
) -> None:
    """A drift is told from the second check on, which confirms the first; by 70 mm."""
    still = watched(Case("still", "street"), 2, tmp_path / "still", weeks)
    assert [week.code for week in still.weeks] == [0] * weeks
    assert not any(week.events for week in still.weeks)
    drifting = watched(Case("5 mm a day", "street", a_day=0.005), 1, tmp_path / "drift", weeks)
    assert [week.code for week in drifting.weeks] == [0, *[4] * (weeks - 1)]
    assert drifting.alarm == 2
    assert not drifting.false
    last = drifting.weeks[-1]
    assert last.events
    for week in (*still.weeks, *drifting.weeks):
        # Whatever the time is given by, each week is a check of its own.
        assert week.said["appended"] == 1
    # As far as it had moved between the two checks that tell, and never before it had.
    (size,) = (event["size"] for event in drifting.weeks[1].events)
    assert 0.02 < np.linalg.norm(np.array(size)[3:]) < 0.085


def test_a_row_says_when_the_alarm_was_and_how_far_the_site_had_moved() -> None:
    quiet, alarm = Week(0, {}), Week(4, {"changed": [{"kind": "step"}]})
    late = Outcome(Case("step", "street", step=0.03), 1, 0.002, (quiet,) * 4 + (alarm,) * 2)
    assert late.alarm == 5
    assert late.false == 0
    assert "| 5 | 30 mm | 0 0 0 0 4 4 | 5: step | 0 |" in row_of(late)
    early = Outcome(late.case, 1, 0.002, (quiet, alarm, alarm, alarm, alarm))
    assert (early.alarm, early.false) == (2, 2)
    still = Outcome(Case("still", "street"), 1, 0.002, (quiet, alarm))
    assert still.false == 1
    assert said(Week(3, {"not_told": [{"status": "cannot_tell", "codes": ["a"]}]})) == (
        "cannot_tell (a)"
    )
