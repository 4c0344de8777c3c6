"""Beams at poles: what is told of those that passed beside."""

import numpy as np
import pytest

from retropole.alignment.observations import MOST_BEAMS, Beams, beams_of
from retropole.datatypes import Array, IntArray, PointCloud, Pole
from retropole.sensors import find_sensor

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
    ("wall", "beside"), [((-1.0, 1.0), 1.0), ((0.0, 1.0), 0.5), ((0.0, 0.0), 0.0)]
)
def test_beams_beside_a_pole_are_known_where_something_stands_behind(
    wall: tuple[float, float], beside: float
) -> None:
    beams = beams_before(wall)
    np.testing.assert_array_equal(beams.beside, beside)
    assert (len(beams.passed_pole) > 0) == (beside > 0)


def test_of_an_unknown_sensor_nothing_is_known_beside_a_pole() -> None:
    rng = np.random.default_rng(0)
    xyz = np.array([RANGE, 0.0, 0.0]) + rng.uniform(-1, 1, (50, 3)) * [0.005, 0.015, 0.5]
    pole = Pole(xyz.mean(axis=0), np.array([0.0, 0.0, 1.0]), xyz, 1.0, 0.01, 9, np.arange(len(xyz)))
    beams = beams_of([(pole, PointCloud(xyz, np.ones(len(xyz))))])
    assert not beams.beside.any()
    assert len(beams.beside) == len(xyz)


def test_of_very_many_returns_a_part_is_taken_evenly_whatever_their_order() -> None:
    rng = np.random.default_rng(0)
    xyz = np.array([RANGE, 0.0, 0.0]) + rng.uniform(-1, 1, (5 * MOST_BEAMS, 3)) * [0.005, 0.015, 1]
    wall = np.array([2 * RANGE, 0.0, 0.0]) + rng.uniform(-1, 1, (60_000, 3)) * [0.0, 0.2, 2.0]

    def beams(order: IntArray) -> Beams:
        index = np.arange(len(xyz))
        pole = Pole(xyz.mean(axis=0), np.array([0.0, 0.0, 1.0]), xyz[order], 2.0, 0.01, 9, index)
        cloud = np.concatenate([xyz[order], wall])
        return beams_of([(pole, PointCloud(cloud, np.ones(len(cloud))))])

    plain, shuffled = beams(np.arange(len(xyz))), beams(rng.permutation(len(xyz)))
    assert len(plain.ranges) == len(plain.passed_pole) == MOST_BEAMS
    np.testing.assert_array_equal(np.sort(plain.ranges), np.sort(shuffled.ranges))
    # Evenly along the pole, from end to end.
    heights = np.sort(plain.ranges * plain.directions[:, 2])
    assert [heights[0], heights[-1]] == pytest.approx([xyz[:, 2].min(), xyz[:, 2].max()])
    np.testing.assert_allclose(heights, np.linspace(-1, 1, MOST_BEAMS), atol=0.05)
