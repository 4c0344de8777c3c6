"""Sweeps of LiDARs that record now, joined as they come."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import retropole as rp
from retropole.api.live_merging import (
    CHECK_SWEEPS,
    SAME_CLOCK,
    STOPPED,
    Checked,
    LiveLidar,
    LiveMerge,
    LiveWish,
    check_live,
    merging_live,
)
from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import Refusal, UsageError
from retropole.fusion.merging import Points
from retropole.io import Frame, open_recording, write_pcd
from tests.api.clouds import calibrated, pair, refused

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
        words += merge.new_messages()
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


def test_one_that_stops_is_reported_and_the_others_go_on() -> None:
    lidars = [
        LiveLidar("a", Turning("a"), np.eye(4)),
        LiveLidar("b", Turning("b", until=1.0), np.eye(4)),
    ]
    with merging(lidars) as (merge, given):
        words = run(merge, 2.5 * STOPPED)
    assert words == ["b: left out, since no sweep arrives: nobody sends"]
    assert given[-1]["lidar"].tolist() == [0] * 4
    assert given[-1]["time"].max() > time.time() - 1.0


def test_one_that_comes_late_is_taken_in() -> None:
    late = Turning("b")
    late._start += 2.3 * STOPPED
    lidars = [LiveLidar("a", Turning("a"), np.eye(4)), LiveLidar("b", late, np.eye(4))]
    with merging(lidars) as (merge, given):
        words = run(merge, 3.0 * STOPPED)
    assert words == ["b: left out, since no sweep arrives: nobody sends", "b: its sweeps come"]
    assert given[-1]["lidar"].tolist() == [0] * 4 + [1] * 4


@pytest.mark.parametrize("ahead", [37.0, -3600.0])
def test_a_clock_that_is_ahead_is_reported_and_sweeps_are_joined_all_the_same(ahead: float) -> None:
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


@pytest.mark.full
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


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of a pair, and a recording of each LiDAR beside it."""
    folder = tmp_path_factory.mktemp("stored")
    calibrated().save(folder)
    write_pcd(folder / "a.pcd", pair().target)
    write_pcd(folder / "b.pcd", pair().source)
    return folder


def test_clouds_of_a_result_are_written_in_the_frame_of_the_target(stored: Path) -> None:
    sources = {"target": f"replay:{stored / 'a.pcd'}", "source": f"replay:{stored / 'b.pcd'}"}
    out = stored / "live.mcap"
    with merging_live(stored, sources, LiveWish(topic=None, out=out, every=None)) as merge:
        while 0 in merge.pace().sweeps.values():
            merge.step()
    recording = open_recording(out)
    # Where a LiDAR was late, a cloud before has the other alone.
    *_, frame = recording.read(range(recording.count))
    T = calibrated().T_target_source
    assert T is not None
    own = len(pair().target)
    np.testing.assert_allclose(frame.cloud.xyz[:own], pair().target.xyz, atol=1e-4)
    np.testing.assert_allclose(frame.cloud.xyz[own:], se3.apply(T, pair().source.xyz), atol=1e-4)
    assert frame.frame_id == "target"


def test_surfels_are_points_of_surfaces(stored: Path) -> None:
    sources = {"target": f"replay:{stored / 'a.pcd'}"}
    out = stored / "surfels.mcap"
    wish = LiveWish(topic=None, out=out, surfels=0.5, every=None)
    with merging_live(stored, sources, wish) as merge:
        while not merge.step():
            pass
    recording = open_recording(out)
    frame = next(iter(recording.read(range(1))))
    assert 10 < len(frame.cloud) < len(pair().target) / 4
    assert {"nx", "radius", "thickness"} <= frame.cloud.fields.keys()


def test_what_cannot_be_is_refused(stored: Path, tmp_path: Path) -> None:
    one = {"target": f"replay:{stored / 'a.pcd'}"}
    refused().save(tmp_path)
    for error, result, sources, wish in (
        (Refusal, tmp_path, one, LiveWish(topic=None)),
        (UsageError, stored, {"front": "replay:a.pcd"}, LiveWish(topic=None)),
        (UsageError, stored, one, LiveWish(topic=None, clocks={"rear": 1.0})),
        (UsageError, stored, one, LiveWish(topic=None, out=tmp_path / "a.ply")),
        (UsageError, stored, one, LiveWish(topic=None, frame="map")),
        (UsageError, stored, one | {"source": one["target"]}, LiveWish(topic=None)),
    ):
        with pytest.raises(error), merging_live(result, sources, wish):
            pass


@pytest.mark.full
def test_a_lidar_that_turned_since_is_found(tmp_path: Path) -> None:
    seen = rp.simulate("street", 4, sensor_target="VLP-16", sensor_source="VLP-16")
    result = rp.calibrate(seen.target, seen.source, sensor="VLP-16")
    result.save(tmp_path)
    turn = se3.from_rt(se3.exp_so3(np.radians([0.0, 0.0, 2.0])), np.zeros(3))
    for T, moved in ((np.eye(4), ()), (turn, ("source",))):
        clouds = {"target": seen.target, "source": seen.source.transformed(T)}
        frames = {name: [Frame(0, cloud, 0.0)] for name, cloud in clouds.items()}
        found = check_live(tmp_path, frames)
        assert found.moved == moved, found.text
        assert found.text.startswith("checked: source moved" if moved else "checked: no LiDAR")
