"""Clouds above a number of points: which are kept, and how much memory it takes to find out."""

import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from retropole.base.datatypes import PER_POINT, PointCloud
from retropole.io import downsample, joined, read_cloud, read_recording, write_pcd
from retropole.io.recordings import BRIGHT_SHARE, FEWEST_FRAMES, Frame, Recording, read_within
from tests.io.files import required

RINGS = 16


def cloud_of(count: int, seed: int = 0) -> PointCloud:
    """Make a cloud whose rings follow each other, as sensors give them."""
    rng = np.random.default_rng(seed)
    return PointCloud(
        rng.uniform(1, 9, (count, 3)),
        intensity=rng.integers(0, 256, count).astype(float),
        ring=np.arange(count) % RINGS,
        time=np.arange(count) / count,
    )


def recording_of(sizes: list[int]) -> Recording:
    def read(numbers: range) -> Iterator[Frame]:
        return (Frame(k, cloud_of(sizes[k], k)) for k in numbers)

    return Recording(Path("made"), len(sizes), read)


def test_below_the_limit_a_cloud_is_itself() -> None:
    cloud = cloud_of(1000)
    assert downsample(cloud, 1000) is cloud
    assert downsample(cloud, 10**9) is cloud


@pytest.mark.parametrize("part", [0.999, 0.5, 0.1, 0.003])
def test_as_many_points_are_kept_as_requested(part: float) -> None:
    cloud = cloud_of(100_003)
    most = int(part * len(cloud))
    kept = downsample(cloud, most)
    assert len(kept) == most
    assert kept.thinned == len(cloud) - most
    again = downsample(cloud, most)
    for name in ("xyz", *PER_POINT):
        np.testing.assert_array_equal(getattr(kept, name), getattr(again, name))
    # Every value stays with its point, and the points in their order.
    index = np.round(required(kept.time) * len(cloud)).astype(int)
    assert (np.diff(index) > 0).all()
    np.testing.assert_array_equal(kept.xyz, cloud.xyz[index])
    np.testing.assert_array_equal(kept.intensity, required(cloud.intensity)[index])


def test_the_points_on_poles_are_kept_and_the_others_evenly() -> None:
    cloud = cloud_of(160_000)
    dim = np.minimum(required(cloud.intensity), 100.0)
    poles = np.random.default_rng(1).choice(len(cloud), 300, replace=False)
    dim[poles] = 255.0
    cloud = PointCloud(cloud.xyz, intensity=dim, ring=cloud.ring, time=cloud.time)
    kept = downsample(cloud, 40_000)
    assert np.count_nonzero(required(kept.intensity) == 255.0) == 300
    # A step of 4 over 16 rings must not leave a quarter of them.
    counts = np.bincount(required(kept.ring), minlength=RINGS)
    assert counts.min() > 0.9 * 2500
    assert counts.max() < 1.1 * 2500
    index = np.round(required(kept.time) * len(cloud)).astype(int)
    assert np.diff(index).max() <= 2 * 4 + 1
    assert np.median(np.diff(index)) in (3, 4, 5)


def test_where_all_is_bright_all_is_thinned() -> None:
    cloud = PointCloud(np.ones((50_000, 3)), intensity=np.full(50_000, 255.0))
    assert len(downsample(cloud, 1000)) == 1000
    assert len(downsample(PointCloud(np.ones((50_000, 3))), 1000)) == 1000
    bright = int(BRIGHT_SHARE * 1000)
    rising = PointCloud(np.ones((50_000, 3)), intensity=np.arange(50_000.0))
    assert (
        np.count_nonzero(required(downsample(rising, 1000).intensity) >= 50_000 - bright) == bright
    )


def test_frames_that_fit_are_read_as_ever() -> None:
    recording = recording_of([100, 50, 100])
    numbers, frames = read_within(recording, range(3), 250)
    assert numbers == range(3)
    whole = list(recording.read(range(3)))
    for name in ("xyz", *PER_POINT):
        np.testing.assert_array_equal(
            getattr(joined(recording, frames), name), getattr(joined(recording, whole), name)
        )


@pytest.mark.parametrize(("count", "step"), [(100, 2), (101, 4), (400, 8)])
def test_of_many_frames_every_second_is_left_out_until_they_fit(count: int, step: int) -> None:
    recording = recording_of([100] * count)
    numbers, frames = read_within(recording, range(count), 5000)
    assert numbers == range(0, count, step)
    assert [frame.number for frame in frames] == list(numbers)
    assert all(len(frame.cloud) == 100 for frame in frames)


def test_few_large_frames_are_thinned_to_their_share() -> None:
    recording = recording_of([100_000] * 5 + [7])
    numbers, frames = read_within(recording, range(6), 60_000)
    assert numbers == range(6)
    assert [len(frame.cloud) for frame in frames] == [10_000] * 5 + [7]
    assert joined(recording, frames).thinned == 5 * 90_000


@pytest.mark.parametrize("sizes", [[10] * 3 + [200_000] * 31, [200_000] * 31 + [10] * 3])
def test_memory_follows_the_limit_whatever_the_first_frames_are(sizes: list[int]) -> None:
    most = 400_000
    tracemalloc.start()
    _, frames = read_within(recording_of(sizes), range(len(sizes)), most)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    of_a_point = 6 * 8
    assert sum(len(frame.cloud) for frame in frames) <= most
    assert len(frames) >= FEWEST_FRAMES // 2
    # What is kept, the frame that was one too many, and the thinned ones beside those they are of.
    assert peak < 2.5 * (most + max(sizes)) * of_a_point


Written = Callable[[list[int]], Path]


@pytest.fixture
def folder(tmp_path: Path) -> Written:
    def write(sizes: list[int]) -> Path:
        for k, size in enumerate(sizes):
            write_pcd(tmp_path / "frames" / f"{k}.pcd", cloud_of(size, k))
        return tmp_path / "frames"

    return write


def test_a_folder_says_what_was_left_out(folder: Written) -> None:
    path = folder([10, 10, 10, *[400] * 31])
    read = read_recording(path, max_points=4000)
    assert read.numbers == range(0, 34, 2)
    assert read.left_out == 17
    assert not read.is_whole
    share = 4000 // 17
    assert len(read.cloud) == 2 * 10 + 15 * share
    assert read.cloud.thinned == 15 * (400 - share)
    whole = read_recording(path)
    assert whole.left_out == whole.cloud.thinned == 0
    assert len(whole.cloud) == 30 + 31 * 400
    same = read_recording(path, max_points=30 + 31 * 400)
    np.testing.assert_array_equal(same.cloud.xyz, whole.cloud.xyz)


def test_a_file_is_thinned(folder: Written) -> None:
    path = folder([5000]) / "0.pcd"
    read = read_cloud(path, max_points=2000)
    assert (len(read), read.thinned) == (2000, 3000)
    assert len(read_cloud(path)) == 5000


def test_each_of_several_frames_is_named_as_it_is_read(tmp_path: Path) -> None:
    for k in range(3):
        np.savetxt(tmp_path / f"frame{k}.xyz", np.ones((4, 4)) + k)
    steps: list[str] = []
    read_recording(tmp_path, progress=steps.append)
    assert [step.partition("frame, ")[2] for step in steps] == ["1 of 3", "2 of 3", "3 of 3"]
    steps.clear()
    read_recording(tmp_path / "frame0.xyz", progress=steps.append)
    assert steps == [], "one frame is no share of anything"
