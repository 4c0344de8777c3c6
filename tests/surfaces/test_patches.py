"""What patches know of surfaces: by the rings that made them."""

from __future__ import annotations

import numpy as np
import pytest

from retropole.base.datatypes import Array, PointCloud
from retropole.surfaces.patches import MAX_GAP, ROUGHNESS, surface_patches

NOISE = 0.02
HEIGHT = 2.0


def fan(elevations_deg: Array, step_deg: float = 0.1) -> Array:
    """Directions of rings over a quarter of a turn."""
    azimuth = np.arange(0.0, np.pi / 2, np.radians(step_deg))
    a, e = np.meshgrid(azimuth, np.radians(elevations_deg))
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(
        -1, 3
    )


def on_ground(rays: Array, noise: float = NOISE, seed: int = 0) -> PointCloud:
    """Where beams meet the ground, with noise along them."""
    ranges = -HEIGHT / rays[:, 2] + noise * np.random.default_rng(seed).normal(size=len(rays))
    return PointCloud(rays * ranges[:, None])


@pytest.mark.parametrize("elevation", [-4.0, -10.0, -25.0])
@pytest.mark.parametrize("noise", [0.02, 0.2, 0.5])
def test_a_single_ring_is_no_surface(elevation: float, noise: float) -> None:
    """Scattered along its beams it fills a piece of its cone, and that is flat."""
    patches = surface_patches(on_ground(fan(np.array([elevation]), 0.05), noise))
    assert len(patches.centres) == 0


@pytest.mark.parametrize("noise", [0.02, 0.2, 0.5])
def test_a_single_line_of_a_lidar_that_does_not_spin_is_no_surface(noise: float) -> None:
    """It may cross the elevations at a slant."""
    azimuth = np.radians(np.arange(0.0, 20.0, 0.02))
    elevation = np.radians(-12.0) + 0.3 * azimuth
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)], axis=1
    )
    patches = surface_patches(on_ground(np.column_stack([rays, np.sin(elevation)]), noise))
    assert len(patches.centres) == 0


def test_the_ground_under_many_rings_is_where_it_is() -> None:
    patches = surface_patches(on_ground(fan(np.arange(-20.0, -10.0, 0.4), 0.2)))
    assert len(patches.centres) > 100
    # At the ends of the rings there may be less.
    some = patches.gap <= MAX_GAP
    assert np.mean(some) > 0.9
    off = patches.centres[some, 2] + HEIGHT
    assert 0.5 < np.sqrt(np.mean(off**2 / patches.variance[some])) < 1.5
    turned = np.linalg.norm(patches.normals[some, :2], axis=1)
    assert 0.3 < np.sqrt(np.mean(turned**2 / (2 * patches.tilt[some]))) < 1.5


def test_two_rings_across_a_gap_state_how_rough_surfaces_are() -> None:
    """The top of a wall and the ground behind it: a plane goes through both."""
    rays = fan(np.array([-12.0, -11.0]))
    ranges = -HEIGHT / rays[:, 2]
    upper = np.arange(len(rays)) >= len(rays) // 2
    ranges[upper] = -(HEIGHT - 0.4) / rays[upper, 2]
    cloud = PointCloud(rays * ranges[:, None])
    patches = surface_patches(cloud)
    across = (patches.gap > MAX_GAP) & (patches.extent > 0.3)
    assert across.any()
    assert np.all(patches.variance[across] > ROUGHNESS**2)
    assert np.all(patches.tilt[across] > (ROUGHNESS / patches.extent[across]) ** 2 / 2)


def test_a_third_ring_confirms_two() -> None:
    two = surface_patches(on_ground(fan(np.array([-12.0, -11.0])), 0.002))
    many = surface_patches(on_ground(fan(np.array([-13.0, -12.0, -11.0, -10.0])), 0.002))
    assert np.median(two.variance) > ROUGHNESS**2
    assert np.median(many.variance) < 1e-4


def test_no_points_make_no_patches() -> None:
    assert len(surface_patches(PointCloud(np.zeros((0, 3)))).centres) == 0
