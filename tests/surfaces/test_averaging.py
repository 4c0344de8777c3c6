"""Sweeps of a LiDAR that stands become the returns of one, with less noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Array, PointCloud
from retropole.surfaces.averaging import averaged

SWEEPS, NOISE = 16, 0.02


def beams() -> Array:
    """Directions of 8 rings, 0.5° apart, over a quarter of a turn below the horizon."""
    azimuth = np.radians(0.1 + np.arange(0.0, 90.0, 0.4))
    ring = np.radians(-12.0 + 0.5 * np.arange(8))
    a, e = np.meshgrid(azimuth, ring)
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(
        -1, 3
    )


def recording(sweeps: int = SWEEPS, *, turned: float = 0.0, rings: bool = True) -> PointCloud:
    """Ground 2 m below, with noise along the beams, as a LiDAR saw it that may have been turned."""
    rng = np.random.default_rng(0)
    parts, frames = [], []
    for k in range(sweeps):
        rays = beams() + turned * rng.normal(size=3)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        ranges = -2.0 / rays[:, 2] + NOISE * rng.normal(size=len(rays))
        parts.append(rays * ranges[:, None])
        frames.append(np.full(len(rays), k))
    ring = np.tile(np.repeat(np.arange(8), len(beams()) // 8), sweeps)
    return PointCloud(
        np.concatenate(parts), ring=ring if rings else None, frame=np.concatenate(frames)
    )


def noise_of(points: Array) -> float:
    """RMS along the beam."""
    ranges = np.linalg.norm(points, axis=1)
    return float(np.sqrt(np.mean(((points[:, 2] + 2.0) * ranges / points[:, 2]) ** 2)))


@pytest.mark.parametrize("turned", [0.0, 0.001])
@pytest.mark.parametrize("rings", [True, False])
def test_sweeps_become_one_with_less_noise(turned: float, rings: bool) -> None:
    cloud = recording(turned=turned, rings=rings)
    average = averaged(cloud)
    found = average.xyz
    assert (average.ring is not None) is rings
    one = len(cloud) // SWEEPS
    # A LiDAR that moved meets the cells beside, too, and some of them once or twice.
    assert 0.9 * one <= len(found) <= (1.3 if turned == 0.0 else 4.0) * one
    most = 1.2 if turned == 0.0 else 4.0
    assert 0.8 * NOISE / np.sqrt(SWEEPS) < noise_of(found) < most * NOISE / np.sqrt(SWEEPS)


def test_the_ground_stays_where_it_is() -> None:
    found = averaged(recording()).xyz
    assert abs(np.mean(found[:, 2] + 2.0)) < 3 * NOISE * 0.2 / np.sqrt(len(found) * SWEEPS)


def test_a_single_sweep_is_left_as_it_is() -> None:
    cloud = recording(1)
    assert averaged(cloud) is cloud
    without = replace(cloud, frame=None)
    assert averaged(without) is without
    nothing = cloud.select(np.zeros(len(cloud), dtype=bool))
    assert len(averaged(nothing)) == 0


def test_the_order_of_the_points_does_not_matter() -> None:
    cloud = recording()
    shuffled = cloud.select(np.random.default_rng(1).permutation(len(cloud)))
    np.testing.assert_allclose(averaged(shuffled).xyz, averaged(cloud).xyz, atol=1e-9)


def test_what_stands_at_two_ranges_stays_apart() -> None:
    """The edge of a post: every other sweep meets it, the others the wall behind."""
    ray = np.array([np.cos(0.3), np.sin(0.3), 0.0])
    ranges = np.array([5.0, 8.0, 5.01, 8.01, 4.99, 7.99])
    cloud = PointCloud(ranges[:, None] * ray, frame=np.arange(6))
    np.testing.assert_allclose(np.linalg.norm(averaged(cloud).xyz, axis=1), [5.0, 8.0], atol=1e-9)


def test_an_upright_axis_is_not_needed() -> None:
    """Of a LiDAR that lies on its side the beams are the same."""
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, [1.0, 2.0, 3.0]
    cloud = recording()
    back = np.linalg.inv(T)
    found = averaged(cloud.transformed(T)).xyz @ back[:3, :3].T + back[:3, 3]
    assert 0.9 < len(found) / len(averaged(cloud)) < 1.1
    assert noise_of(found) < 1.5 * NOISE / np.sqrt(SWEEPS)


def test_each_average_keeps_the_ring_of_its_returns() -> None:
    cloud = recording()
    found = averaged(cloud)
    assert found.ring is not None
    elevation = np.degrees(np.arcsin(found.xyz[:, 2] / np.linalg.norm(found.xyz, axis=1)))
    np.testing.assert_allclose(elevation, -12.0 + 0.5 * found.ring, atol=1e-6)


def test_a_cloud_is_averaged_once() -> None:
    cloud = recording()
    assert averaged(cloud) is averaged(cloud)
