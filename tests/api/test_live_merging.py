"""Sweeps of LiDARs that record now, joined as they come."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import pytest

from retropole.api.live_merging import (
    CHECK_SWEEPS,
    SAME_CLOCK,
    STOPPED,
    Checked,
    LiveLidar,
    LiveMerge,
)
from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.fusion.merging import Points
from retropole.io import Frame

PERIOD = 0.05

Check = Callable[[Mapping[str, Sequence[Frame]]], Checked]


class Turning:
    """A LiDAR that sends a sweep every `PERIOD`, of which each point says when it was made."""

    def __init__(self, name: str, ahead: float = 0.0, until: float = np.inf) -> None:
        self.name, self.waits_for, self.has_ended = name, "nobody sends", False
        self._ahead, self._start, self._until = ahead, time.time(), until
        self._next = 0

    def newest(self, wait: float) -> Frame | None:
        now = time.time() - self._start
        due = self._next * PERIOD
        if due > now:
            time.sleep(min(wait, due - now))
            return None
        if now > self._until:
            time.sleep(min(wait, 0.05))
            return None
        self._next = int(now / PERIOD) + 1
        made = time.time()
        cloud = PointCloud(np.full((4, 3), 2.0), time=np.full(4, made))
        return Frame(self._next, cloud, made + self._ahead)

    def close(self) -> None:
        self.has_ended = True


@contextmanager
def merging(
    lidars: Sequence[LiveLidar], **options: object
) -> Iterator[tuple[LiveMerge, list[Points]]]:
    given: list[Points] = []
    merge = LiveMerge(lidars, lambda points, when: given.append(points), **options)  # type: ignore[arg-type]
    try:
        yield merge, given
    finally:
        merge.close()


def run(merge: LiveMerge, seconds: float) -> list[str]:
    end, words = time.time() + seconds, list[str]()
    while time.time() < end:
        merge.step(0.05)
        words += merge.new_words()
    return words


def test_a_cloud_has_one_sweep_of_each_lidar_in_the_frame_of_all() -> None:
    T = se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, 0.5])), np.array([1.0, 2.0, 3.0]))
    lidars = [LiveLidar("a", Turning("a"), np.eye(4)), LiveLidar("b", Turning("b"), T)]
    with merging(lidars) as (merge, given):
        assert run(merge, 1.0) == []
        pace = merge.pace()
    assert len(given) > 5
    for points in given[1:]:
        assert points["lidar"].tolist() == [0] * 4 + [1] * 4
        np.testing.assert_allclose(points["xyz"][:4], 2.0)
        np.testing.assert_allclose(points["xyz"][4:], se3.apply(T, np.full((4, 3), 2.0)))
        assert np.ptp(points["time"]) < 0.15
    assert len(pace.ages) == len(given)
    assert set(pace.sweeps) == {"a", "b"}
    assert max(pace.ages) < 1.0


def test_one_that_stops_is_said_and_the_others_go_on() -> None:
    lidars = [
        LiveLidar("a", Turning("a"), np.eye(4)),
        LiveLidar("b", Turning("b", until=1.0), np.eye(4)),
    ]
    with merging(lidars) as (merge, given):
        words = run(merge, 2.5 * STOPPED)
    assert words == ["b: left out, since no sweep comes: nobody sends"]
    assert given[-1]["lidar"].tolist() == [0] * 4
    assert given[-1]["time"].max() > time.time() - 1.0


def test_one_that_comes_late_is_taken_in() -> None:
    late = Turning("b")
    late._start += 2.3 * STOPPED
    lidars = [LiveLidar("a", Turning("a"), np.eye(4)), LiveLidar("b", late, np.eye(4))]
    with merging(lidars) as (merge, given):
        words = run(merge, 3.0 * STOPPED)
    assert words == ["b: left out, since no sweep comes: nobody sends", "b: its sweeps come"]
    assert given[-1]["lidar"].tolist() == [0] * 4 + [1] * 4


@pytest.mark.parametrize("ahead", [37.0, -3600.0])
def test_a_clock_that_is_ahead_is_said_and_sweeps_are_joined_all_the_same(ahead: float) -> None:
    lidars = [
        LiveLidar("a", Turning("a"), np.eye(4)),
        LiveLidar("b", Turning("b", ahead=ahead), np.eye(4)),
    ]
    with merging(lidars) as (merge, given):
        (words,) = run(merge, 2.5 * STOPPED)
    assert words.startswith(f"b: its clock is {abs(ahead):.1f} s ")
    assert ("ahead of" in words) == (ahead > 0)
    assert np.unique(given[-1]["lidar"]).tolist() == [0, 1]


def test_a_clock_that_is_given_is_not_judged() -> None:
    lidars = [LiveLidar("a", Turning("a", ahead=37.0), np.eye(4), 37.0)]
    with merging(lidars) as (merge, _):
        assert run(merge, 2.5 * STOPPED) == []
        assert max(merge.pace().ages) < SAME_CLOCK


def says_moved(frames: Mapping[str, Sequence[Frame]]) -> Checked:
    assert all(len(own) == CHECK_SWEEPS for own in frames.values())
    return Checked(("b",), "b moved")


def test_one_that_moved_is_left_out() -> None:
    lidars = [LiveLidar(name, Turning(name), np.eye(4)) for name in "abc"]
    with merging(lidars, check=says_moved, every=0.2) as (merge, given):
        words = []
        end = time.time() + 60
        while merge.moved == () and time.time() < end:
            words += run(merge, 0.2)
        words += run(merge, 0.5)
    assert words == ["b moved"]
    assert np.unique(given[-1]["lidar"]).tolist() == [0, 2]
