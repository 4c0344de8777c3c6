"""Beams at poles: what is told of those that passed beside."""

import numpy as np
import pytest

from retropole.alignment import observations
from retropole.alignment.observations import FEW_RETURNS, MOST_RETURNS, Beams, beams_of
from retropole.base.datatypes import Array, PointCloud, Pole
from retropole.base.sensors import find_sensor

RANGE, RADIUS = 5.0, 0.02


def beams_before(wall: tuple[float, float]) -> Beams:
    """Beams 0.1° apart at a vertical pole before a wall that covers these azimuths, rad."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-3.0, 3.0, 0.1)) + 1e-4, np.radians(np.arange(-6.0, 6.5, 1.0))
    )
    azimuth, elevation = azimuth.ravel(), elevation.ravel()
    level = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=1)
    on = np.abs(RANGE * np.sin(azimuth)) < RADIUS
    behind = ~on & (azimuth > wall[0]) & (azimuth < wall[1])
    xyz: Array = np.concatenate([(RANGE - RADIUS) * level[on], 1.5 * RANGE * level[behind]])
    index = np.arange(np.count_nonzero(on))
    length = float(np.ptp(xyz[index, 2]))
    pole = Pole(
        np.array([RANGE, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), xyz[index], length, 0.005, 13, index
    )
    return beams_of([(pole, PointCloud(xyz, np.ones(len(xyz))))], find_sensor("XT32"))


@pytest.mark.parametrize(
    ("wall", "passed_share"), [((-1.0, 1.0), 1.0), ((0.0, 1.0), 0.5), ((0.0, 0.0), 0.0)]
)
def test_beams_next_to_a_pole_are_known_where_something_stands_behind(
    wall: tuple[float, float], passed_share: float
) -> None:
    beams = beams_before(wall)
    np.testing.assert_array_equal(beams.passed_share, passed_share)
    assert (len(beams.passed_pole) > 0) == (passed_share > 0)


def test_of_an_unknown_sensor_nothing_is_known_next_to_a_pole() -> None:
    rng = np.random.default_rng(0)
    xyz = np.array([RANGE, 0.0, 0.0]) + rng.uniform(-1, 1, (50, 3)) * [0.005, 0.015, 0.5]
    pole = Pole(xyz.mean(axis=0), np.array([0.0, 0.0, 1.0]), xyz, 1.0, 0.01, 9, np.arange(len(xyz)))
    beams = beams_of([(pole, PointCloud(xyz, np.ones(len(xyz))))])
    assert not beams.passed_share.any()
    assert len(beams.passed_share) == len(xyz)


@pytest.fixture(scope="module")
def many() -> tuple[Array, Array]:
    """Returns on a pole, and on the wall behind it."""
    rng = np.random.default_rng(0)
    pole = np.array([RANGE, 0.0, 0.0]) + rng.uniform(-1, 1, (5 * MOST_RETURNS, 3)) * [
        0.005,
        0.015,
        1,
    ]
    wall = np.array([2 * RANGE, 0.0, 0.0]) + rng.uniform(-1, 1, (200_000, 3)) * [0.0, 1.0, 2.0]
    return pole, wall


def beams_at(pole: Array, wall: Array, left_out: int = 0) -> Beams:
    index = np.arange(len(pole))
    found = Pole(np.array([RANGE, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), pole, 2.0, 0.01, 9, index)
    cloud = np.concatenate([pole, wall])
    return beams_of([(found, PointCloud(cloud, np.ones(len(cloud)), thinned=left_out))])


def test_of_very_many_returns_a_part_is_taken_evenly_whatever_their_order(
    many: tuple[Array, Array],
) -> None:
    pole, wall = many
    plain = beams_at(pole, wall)
    shuffled = beams_at(np.random.default_rng(1).permutation(pole), wall)
    assert len(plain.ranges) == MOST_RETURNS
    np.testing.assert_array_equal(np.sort(plain.ranges), np.sort(shuffled.ranges))
    heights = np.sort(plain.ranges * plain.directions[:, 2])
    assert [heights[0], heights[-1]] == pytest.approx([pole[:, 2].min(), pole[:, 2].max()])
    np.testing.assert_allclose(heights, np.linspace(-1, 1, len(heights)), atol=0.05)


@pytest.mark.parametrize(("part", "left_out"), [(1, 0), (2, 100_000), (10, 180_000)])
def test_as_many_beams_are_left_out_on_a_pole_as_next_to_it(
    many: tuple[Array, Array], part: int, left_out: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a cloud was downsampled, which leaves the returns on poles: they are bright."""
    pole, wall = many
    found = beams_at(pole, wall[::part], left_out)
    monkeypatch.setattr(observations, "MOST_RETURNS", 10**9)
    everything = beams_at(pole, wall)
    kept_on, kept_beside = len(found.ranges), len(found.passed_pole)
    share = kept_on / len(pole)
    assert kept_on < 1.1 * MOST_RETURNS
    assert kept_beside / len(everything.passed_pole) == pytest.approx(share, rel=0.25)


def test_few_returns_on_a_pole_stay_where_the_cloud_was_thinned(many: tuple[Array, Array]) -> None:
    pole, wall = many
    assert len(beams_at(pole[:FEW_RETURNS], wall, 2_000_000).ranges) == FEW_RETURNS
