"""Recordings of other times are told by their timestamps, where these are dates."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Placement, PointCloud, Scan
from retropole.base.errors import Reason
from retropole.io.recordings import time_of_recording
from retropole.surfaces.static import MAX_APART, other_times, recorded_together

HOUR = 3600.0
NOON = 1_700_000_000.0


def recorded_at(first: float, last: float, as_points: bool = False) -> PointCloud:
    xyz = np.array([[5.0, 0.0, 0.0], [6.0, 0.0, 0.0]])
    if as_points:
        return PointCloud(xyz, time=np.array([first, last]))
    return PointCloud(xyz, recorded=(first, last))


def said_of(target: PointCloud, source: PointCloud) -> list[Reason]:
    return list(other_times([Placement(Scan(target), Scan(source))]))


@pytest.mark.parametrize("as_points", [False, True])
def test_recordings_of_other_times_are_told_apart(as_points: bool) -> None:
    target = recorded_at(NOON, NOON + 10, as_points)
    for apart, is_other in ((0.9 * MAX_APART, False), (1.1 * MAX_APART, True), (-5.0, False)):
        for start in (NOON + 10 + apart, NOON - apart - 10):
            said = said_of(target, recorded_at(start, start + 10, as_points))
            assert [reason.code for reason in said] == ["other_times"] * is_other
            if is_other:
                assert said[0].values["apart_s"] == pytest.approx(apart)
    (later,) = said_of(target, recorded_at(NOON + 3 * HOUR + 10, NOON + 3 * HOUR + 20))
    assert "lie 3.0 h apart" in later.message
    assert "stood still in between" in later.message


def test_clocks_that_show_no_date_say_nothing() -> None:
    dated = recorded_at(NOON, NOON + 1)
    unknown = PointCloud(np.ones((2, 3)))
    assert said_of(dated, unknown) == said_of(unknown, dated) == said_of(unknown, unknown) == []
    # Seconds since the sensor was switched on, of the week, or of the sweep.
    for start in (0.0, 245_370.0, 4e8):
        assert said_of(dated, recorded_at(start, start + 0.1, as_points=True)) == []


def test_of_several_placements_the_one_is_named() -> None:
    good, bad = recorded_at(NOON, NOON + 1), recorded_at(NOON + HOUR, NOON + HOUR + 1)
    pairs = [Placement(Scan(good), Scan(good)), Placement(Scan(good), Scan(bad))]
    (reason,) = other_times(pairs)
    assert reason.values["placement"] == 2
    assert "of placement 2" in reason.message


def test_recordings_that_overlap_were_made_together() -> None:
    """Only where both clocks show dates, and of every placement; whichever is the target."""
    target, unknown = recorded_at(NOON, NOON + 10), PointCloud(np.ones((2, 3)))
    for start, overlaps in ((-20.0, False), (-10.5, False), (-9.0, True), (9.0, True), (11, False)):
        source = recorded_at(NOON + start, NOON + start + 10)
        both = Placement(Scan(target), Scan(source)), Placement(Scan(source), Scan(target))
        assert [recorded_together([each]) for each in both] == [overlaps] * 2
        with_itself = Placement(Scan(target), Scan(target))
        assert recorded_together([with_itself, both[0]]) == overlaps
    assert not recorded_together([Placement(Scan(target), Scan(unknown))])


def test_points_times_go_before_those_of_the_recorder() -> None:
    both = replace(recorded_at(NOON, NOON + 1, as_points=True), recorded=(NOON + HOUR, NOON + HOUR))
    assert time_of_recording(both) == (NOON, NOON + 1)
    assert time_of_recording(replace(both, time=np.zeros(2))) == (NOON + HOUR, NOON + HOUR)
