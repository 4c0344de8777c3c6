"""Recordings that are played again give their frames when they are due, and leave out others."""

import time
from contextlib import closing
from pathlib import Path
from threading import Timer

import numpy as np
import pytest

pytest.importorskip("apsw", reason="needs rosbags 0.11 to write bags")

from retropole.base.datatypes import PointCloud
from retropole.base.errors import ReadError, UsageError
from retropole.io import Frame, read_frames, write_pcd
from retropole.io.live import Source, replay
from retropole.io.live.replay import ReplaySource
from tests.bags import START, points_of, write_bag
from tests.io.clouds import assert_same, random_cloud
from tests.io.files import required
from tests.io.packets.sending import bag_of
from tests.paths import SHARED

VLP16 = SHARED / "formats" / "velodyne" / "sample_velodyne_vlp16_gps.pcap"


class Clock:
    """Time that passes only when it is told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        monkeypatch.setattr(replay, "monotonic", lambda: self.now)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def bag(folder: Path, kind: str, count: int) -> Path:
    clouds = [points_of(random_cloud(seed)) for seed in range(count)]
    return write_bag(folder, kind, {"/points": clouds})


def files(folder: Path, count: int) -> Path:
    for k in range(count):
        np.save(folder / f"sweep{k}.npy", random_cloud(k).xyz)
    return folder


def played(source: ReplaySource, clock: Clock, steps: list[float]) -> list[Frame]:
    """Frames that are given after each of several times."""
    frames = list[Frame]()
    for step in steps:
        clock.now += step
        frame = source.newest(0)
        frames += [frame] if frame else []
    return frames


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap", "mcap folder"])
def test_frames_of_a_bag_come_when_they_are_due(tmp_path: Path, clock: Clock, kind: str) -> None:
    path = bag(tmp_path, kind, 6)
    with closing(ReplaySource(path)) as source:
        clock.now += 50  # it starts with the first request
        frames = played(source, clock, [0, 0.04, 0.04, 0.04, 0.001, 0.35, 0.1])
        assert [frame.number for frame in frames] == [0, 1, 4, 5]
        for frame in frames:
            assert_same(frame.cloud, random_cloud(frame.number))
            assert frame.stamp == pytest.approx((START + frame.number * 1e8) / 1e9)
            assert frame.cloud.source == f"{path}: message {frame.number} of /points"
        assert source.has_ended
        assert source.waits_for == "the recording was played to its end"
        assert source.newest(5) is None


def test_the_rate_is_how_fast_time_passes(tmp_path: Path, clock: Clock) -> None:
    path = bag(tmp_path, "mcap", 9)
    with closing(ReplaySource(path, "/points", rate=4)) as source:
        frames = played(source, clock, [0, 0.02, 0.01, 0.05, 0.11])
        assert [frame.number for frame in frames] == [0, 1, 3, 7]
        assert not source.has_ended
        assert source.waits_for == ""
    for rate in (0, -1, float("nan"), float("inf")):
        with pytest.raises(UsageError, match="rate of"):
            ReplaySource(path, rate=rate)


def test_files_without_a_time_come_10_times_a_second(tmp_path: Path, clock: Clock) -> None:
    with closing(ReplaySource(files(tmp_path, 12))) as source:
        frames = played(source, clock, [0, 0.09, 0.02, 0.5, 9])
        assert [frame.number for frame in frames] == [0, 1, 6, 11]
        assert source.has_ended
        np.testing.assert_array_equal(frames[2].cloud.xyz, random_cloud(6).xyz)


def test_files_that_are_left_out_are_not_read(tmp_path: Path, clock: Clock) -> None:
    files(tmp_path, 5)
    (tmp_path / "sweep1.npy").write_bytes(b"none")
    (tmp_path / "sweep3.npy").write_bytes(b"none")
    with closing(ReplaySource(tmp_path)) as source:
        frames = played(source, clock, [0, 0.2])
        assert [frame.number for frame in frames] == [0, 2]
        clock.now += 0.1
        with pytest.raises(ReadError, match=r"sweep3\.npy"):
            source.newest(0)
        clock.now += 0.1
        assert required(source.newest(0)).number == 4


def test_packets_come_as_they_were_sent(clock: Clock) -> None:
    pytest.importorskip("velodyne_decoder")
    if not VLP16.exists():
        pytest.skip(f"{VLP16} is not here")
    read = list(read_frames(VLP16))
    with closing(ReplaySource(VLP16)) as source:
        frames = played(source, clock, [0, 0.05, 0.06, 0.2])
        assert [frame.number for frame in frames] == [0, 1, 3]
        for frame in frames:
            np.testing.assert_array_equal(frame.cloud.xyz, read[frame.number].cloud.xyz)
            assert frame.stamp == read[frame.number].stamp


def test_a_pause_of_the_recording_is_reported(tmp_path: Path, clock: Clock) -> None:
    path = bag(tmp_path, "mcap", 2)
    with closing(ReplaySource(path, rate=0.01)) as source:
        assert source.waits_for == ""
        assert source.newest(0) is not None
        assert source.waits_for == "for 10 s nothing was recorded"


def test_it_waits_for_the_next_frame(tmp_path: Path) -> None:
    with closing(ReplaySource(files(tmp_path, 4))) as source:
        numbers = list[int]()
        start = time.monotonic()
        while not source.has_ended:
            frame = source.newest(5)
            numbers += [frame.number] if frame else []
        assert time.monotonic() - start >= 0.29
        # On a busy computer, some may be left out.
        assert numbers[0] == 0
        assert numbers[-1] == 3


def test_closing_ends_a_wait(tmp_path: Path) -> None:
    source: Source = ReplaySource(files(tmp_path, 2), rate=0.001)
    assert source.name == f"replay:{tmp_path}"
    assert required(source.newest(0)).number == 0
    start = time.monotonic()
    timer = Timer(0.05, source.close)
    timer.start()
    assert source.newest(60) is None
    assert time.monotonic() - start < 30
    timer.join()
    source.close()
    assert source.newest(60) is None


def test_what_cannot_be_opened_is_named(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match=r"none\.pcd: there is no such file"):
        ReplaySource(tmp_path / "none.pcd")
    with pytest.raises(UsageError, match="has no topics"):
        ReplaySource(files(tmp_path, 1), "/points")


def test_one_sweep_comes_again_and_again(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    write_pcd(path, PointCloud(np.ones((5, 3)), np.ones(5)))
    source = ReplaySource(path, rate=100.0)
    numbers = []
    for _ in range(5):
        frame = source.newest(1.0)
        assert frame is not None
        assert len(frame.cloud) == 5
        numbers.append(frame.number)
    assert numbers == sorted(set(numbers))
    assert not source.has_ended
    source.close()


def test_packets_in_a_bag_are_played(tmp_path: Path) -> None:
    path = bag_of("hesai_xt32", tmp_path)
    recorded = list(read_frames(path))
    with closing(ReplaySource(path, rate=100.0)) as source:
        played = list[Frame]()
        while not source.has_ended:
            frame = source.newest(1.0)
            played += [frame] if frame else []
    assert played[-1].number == len(recorded) - 1
    for frame in played:
        assert frame.cloud.model == "XT32"
        np.testing.assert_array_equal(frame.cloud.xyz, recorded[frame.number].cloud.xyz)
