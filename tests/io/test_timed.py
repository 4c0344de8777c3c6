"""Sweeps get times by one clock, from whatever a recording has of them, or none."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retropole.base.datatypes import Array, PointCloud
from retropole.base.errors import Refusal
from retropole.io.recordings import Frame, Recording
from retropole.io.timed import time_in, timed_frames, times_by_azimuth

RNG = np.random.default_rng
PERIOD = 0.1


def sweep(way: float = 1.0) -> tuple[PointCloud, Array]:
    """One turn of four rings with gaps, beam by beam, and the time of each point, s."""
    turned = np.repeat(np.linspace(0, 2 * np.pi, 400, endpoint=False), 4)
    ring = np.tile(np.arange(4), 400)
    kept = RNG(0).uniform(size=1600) > 0.3
    kept[300:700] = False
    turned, ring = turned[kept], ring[kept]
    azimuth, elevation = way * turned + 1.0, 0.05 * ring - 0.1
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=1)
    return PointCloud(5.0 * rays, np.ones(len(rays)), ring), turned / (2 * np.pi) * PERIOD


def recording(clouds: Sequence[PointCloud], stamps: Sequence[float | None]) -> Recording:
    def read(numbers: range) -> Iterator[Frame]:
        return (Frame(k, clouds[k], stamps[k]) for k in numbers)

    return Recording(Path("walk"), len(clouds), read)


def times_of(clouds: Sequence[PointCloud], stamps: Sequence[float | None]) -> list[Array]:
    frames = timed_frames(recording(clouds, stamps), range(len(clouds)))
    return [frame.cloud.time for frame in frames if frame.cloud.time is not None]


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("order", ["beams", "rings", "no rings"])
def test_azimuths_tell_the_times_of_beams(way: float, order: str) -> None:
    cloud, times = sweep(way)
    if order == "rings":
        by_ring = np.argsort(cloud.ring, kind="stable")  # type: ignore[arg-type]
        cloud, times = cloud.select(by_ring), times[by_ring]
    if order == "no rings":
        cloud = replace(cloud, ring=None)
    found = times_by_azimuth(cloud, PERIOD)
    assert found is not None
    assert np.ptp(found - times) < 1e-9


def test_points_in_no_order_have_no_times_by_azimuth() -> None:
    cloud, _ = sweep()
    assert times_by_azimuth(cloud.select(RNG(1).permutation(len(cloud))), PERIOD) is None


def test_times_of_sweeps_count_from_their_stamps_and_others_stay() -> None:
    cloud, within = sweep()
    stamps = [1.7e9 + PERIOD * k for k in range(3)]
    expected = [stamp + within for stamp in stamps]
    relative = replace(cloud, time=within)
    again = replace(cloud, time=within + 0.95)
    for clouds in ([relative] * 3, [cloud] * 3, [replace(cloud, time=own) for own in expected]):
        for found, own in zip(times_of(clouds, stamps), expected, strict=True):
            assert np.ptp(found - own) < 1e-6
            assert abs(found[0] - own[0]) < 1e-2
    # Times that begin again with each second count from their first.
    assert times_of([again] * 3, stamps)[0][0] == pytest.approx(stamps[0], abs=1e-6)


def test_sweeps_without_times_of_their_own_are_refused() -> None:
    cloud, within = sweep()
    relative = replace(cloud, time=within)
    for clouds, stamps in (([relative] * 2, [None] * 2), ([relative] * 2, [5.0, 5.0])):
        with pytest.raises(Refusal) as refused:
            times_of(clouds, stamps)
        assert refused.value.reason.code == "no_times"


@pytest.mark.parametrize(
    ("name", "seconds"),
    [
        ("1698765432.5", 1698765432.5),
        ("lidar_1698765432123456789", 1698765432.123456789),
        ("1698765432_123456", 1698765432.123456),
        ("000012", None),
        ("frame_20240101", None),
    ],
)
def test_names_of_files_may_be_times(name: str, seconds: float | None) -> None:
    assert time_in(name) == seconds
