"""Surfels and how far the surfaces of two LiDARs lie apart: laws, on surfaces that are known."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.errors import UsageError
from retropole.fusion.merging import Points, fused
from retropole.fusion.surfels import (
    SurfaceDistance,
    distance_at,
    distances,
    in_words,
    moments_of,
    surface_distances,
    surfels_of,
    up_by_ground,
)
from retropole.simulation import simulate_pair

UP = np.array([0.0, 0.0, 1.0])
ORIGINS = np.array([[0.0, 0.0, 2.0], [3.0, 1.0, 2.5]])
CELL = 0.3


def points_of(xyz: Array, lidar: int, intensity: float = 7.0) -> Points:
    return fused(PointCloud(xyz, np.full(len(xyz), intensity)), np.eye(4), lidar)


def plane(rng: np.random.Generator, height: float, lidar: int, noise: float = 0.01) -> Points:
    """A piece of level ground, 6 m wide, with noise of ranges across it."""
    xy = rng.uniform(-3, 3, (12_000, 2)) + np.array([1.0, 0.0])
    return points_of(np.c_[xy, height + rng.normal(0, noise, len(xy))], lidar)


def apart_of(parts: list[Points], origins: Array = ORIGINS, cell: float = CELL) -> SurfaceDistance:
    (found,) = surface_distances(moments_of(parts, cell), origins, UP)
    return found


@pytest.mark.parametrize("height", [0.0, 0.3, 0.15, 0.29, 0.001])
def test_planes_5_mm_apart_are_so_wherever_the_cells_are(height: float) -> None:
    rng = np.random.default_rng(1)
    found = apart_of([plane(rng, height, 0), plane(rng, height + 0.005, 1)])
    assert np.median(found.distances) == pytest.approx(0.005, abs=3e-4)
    # 36 m² are seen; at the rim a cell is half empty.
    (row,) = distances([found])
    assert row.kind == "ground"
    assert row.area_m2 == pytest.approx(36, rel=0.15)
    assert row.median_m == pytest.approx(row.median_signed_m, rel=0.05)
    assert "target–source: ground 5" in in_words([row], ["target", "source"])[0]


def test_the_distance_does_not_depend_on_where_both_clouds_are() -> None:
    """Moved by whole cells to rounding; turned and moved anyhow, as far as cells cut otherwise."""
    rng = np.random.default_rng(2)
    parts = [plane(rng, 0.0, 0), plane(rng, 0.008, 1)]
    here = apart_of(parts)
    for T, within in (
        (se3.from_rt(np.eye(3), np.array([30.0, -60.0, 9.0])), 1e-9),
        (se3.from_rt(se3.rotation_from_rpy(np.array([0.1, 0.2, 1.0])), np.array([5, 6, 7])), 4e-4),
    ):
        moved = [part.copy() for part in parts]
        for part in moved:
            part["xyz"] = se3.apply(T, part["xyz"])
        (there,) = surface_distances(moments_of(moved, CELL), se3.apply(T, ORIGINS), T[:3, :3] @ UP)
        assert np.median(there.distances) == pytest.approx(np.median(here.distances), abs=within)
        assert {*there.kinds} == {0}
        assert there.areas.sum() == pytest.approx(here.areas.sum(), rel=0.1)


def test_both_see_a_curved_surface_where_it_is() -> None:
    """A cylinder of 1.5 m, of which the LiDARs see other and unequally many points."""
    rng = np.random.default_rng(3)
    parts = []
    for lidar, (low, count) in enumerate([(-1.0, 30_000), (-0.9, 6_000)]):
        angle = np.pi + rng.uniform(low, 1.0, count) * (1 + 0.1 * lidar)
        z = rng.choice(np.arange(0, 4, 0.11 + 0.06 * lidar), count) + rng.normal(0, 0.01, count)
        radius = 1.5 + rng.normal(0, 0.005, count)
        parts.append(points_of(np.c_[6 + radius * np.cos(angle), radius * np.sin(angle), z], lidar))
    found = apart_of(parts)
    assert len(found.distances) > 100
    assert abs(np.median(found.distances)) < 3e-4
    assert {*found.kinds} == {1}


def test_one_ring_and_a_bush_are_no_surface() -> None:
    rng = np.random.default_rng(4)
    along = rng.uniform(-2, 2, 4000)
    # A ring on a wall, scattered along its beams: a flat patch of its cone.
    on_wall = np.c_[np.full(len(along), 5.0), along, np.full(len(along), 2.0)] - ORIGINS[0]
    ring = ORIGINS[0] + on_wall * (1 + rng.normal(0, 0.006, len(along)))[:, None]
    bush = rng.uniform(-0.6, 0.6, (4000, 3)) + np.array([4, 4, 1])
    moments = moments_of([points_of(ring, 0), points_of(bush, 0)], CELL)
    assert len(moments.keys) > 20
    assert len(surfels_of(moments, ORIGINS).centres) == 0


def test_a_thin_wall_has_a_surfel_on_either_side_and_is_not_compared() -> None:
    rng = np.random.default_rng(5)
    yz = rng.uniform(0, 3, (2, 6000, 2))
    origins = np.array([[-4.0, 1.5, 1.5], [4.0, 1.5, 1.5]])
    parts = [points_of(np.c_[np.full(6000, 0.04 * k), yz[k]], k, 5.0 + k) for k in (0, 1)]
    moments = moments_of(parts, CELL)
    assert list(surface_distances(moments, origins, UP)) == []
    found = surfels_of(moments, origins)
    assert {*found.lidars} == {1, 2}
    for k, x in ((0, -1.0), (1, 1.0)):
        own = found.lidars == 1 << k
        np.testing.assert_allclose(found.normals[own][:, 0], x, atol=1e-6)
        np.testing.assert_allclose(found.centres[own][:, 0], 0.04 * k, atol=1e-6)
        np.testing.assert_allclose(found.intensity[own], 5.0 + k)
        assert found.thickness[own].max() < 1e-4


def test_lidars_on_one_side_have_a_surfel_together() -> None:
    rng = np.random.default_rng(6)
    parts = [plane(rng, 0.1, 0), plane(rng, 0.1, 1)]
    moments = moments_of(parts, CELL)
    found = surfels_of(moments, ORIGINS)
    middle = np.abs(found.centres[:, :2] - [1, 0]).max(axis=1) < 2.0
    assert {*found.lidars[middle]} == {3}
    assert found.count[middle].min() > 100
    # A disc with the variance of a square of three cells: 2 (0.9² / 12 · 2) under the root.
    assert np.median(found.radius) == pytest.approx(0.9 / np.sqrt(3), rel=0.05)
    assert np.median(found.thickness) == pytest.approx(0.01, rel=0.1)
    apart = list(surface_distances(moments, ORIGINS, UP))
    assert np.isfinite(distance_at(found, apart, CELL)[middle]).all()


def test_moments_do_not_depend_on_how_sweeps_come() -> None:
    rng = np.random.default_rng(7)
    every = np.concatenate([plane(rng, 0.1, 0), plane(rng, 0.1, 1)])
    first, rest = every[:1], rng.permutation(every[1:])
    whole = moments_of([every], CELL)
    parted = moments_of([first, *np.array_split(rest, 7)], CELL)
    np.testing.assert_array_equal(parted.keys, whole.keys)
    np.testing.assert_allclose(parted.sums, whole.sums, atol=1e-9)


def test_the_vertical_is_that_of_the_ground_however_a_lidar_leans() -> None:
    rng = np.random.default_rng(8)
    xyz = np.c_[rng.uniform(-9, 9, (9000, 2)), rng.normal(-2.0, 0.01, 9000)]
    T = se3.from_rt(se3.rotation_from_rpy(np.array([0.4, -0.3, 1.0])), np.array([1.0, 2.0, 3.0]))
    own = PointCloud(se3.apply(se3.inverse(T), xyz + T[:3, 3]))
    np.testing.assert_allclose(up_by_ground(own, T), UP, atol=2e-3)


def test_more_lidars_than_bits_are_refused() -> None:
    with pytest.raises(UsageError, match="up to 32 LiDARs"):
        moments_of([points_of(np.ones((3, 3)), 32)], CELL)


def test_no_points_have_no_surfels() -> None:
    moments = moments_of([], CELL)
    assert len(surfels_of(moments, ORIGINS).centres) == 0
    assert list(surface_distances(moments, ORIGINS, UP)) == []


def test_the_distance_grows_as_a_pose_is_turned() -> None:
    pair = simulate_pair("corridor", np.random.default_rng(100))
    grown = []
    for angle in (0.0, 0.05, 0.1, 0.2):
        T = pair.T_target_source.copy()
        T[:3, :3] = se3.exp_so3(np.radians(angle) * np.array([0.6, 0.0, 0.8])) @ T[:3, :3]
        parts = [fused(pair.target, np.eye(4), 0), fused(pair.source, T, 1)]
        found = apart_of(parts, np.stack([np.zeros(3), T[:3, 3]]))
        grown.append(float(np.median(np.abs(found.distances))))
    assert grown == sorted(grown)
    assert grown[-1] > 2 * grown[0]
