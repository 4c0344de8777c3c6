"""Fused sweeps: laws of transforms, of voxels and of what moves."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import UsageError
from retropole.fusion.merging import (
    HALF,
    NO_RING,
    Grid,
    cell_keys,
    cells_at,
    fused,
    inside,
    is_static,
    one_of_each,
    usual_view,
    voxels,
)


def cloud_of(seed: int, count: int = 4000) -> PointCloud:
    rng = np.random.default_rng(seed)
    return PointCloud(
        rng.normal(0, 8, (count, 3)),
        rng.uniform(0, 255, count),
        rng.integers(-1, 32, count),
        1.7e9 + rng.uniform(0, 0.1, count),
    )


def test_merging_of_moved_is_moved_of_merged() -> None:
    rng = np.random.default_rng(1)
    T, poses = se3.random(rng), [se3.random(rng) for _ in range(3)]
    parts = [fused(cloud_of(k), pose, k) for k, pose in enumerate(poses)]
    moved = [fused(cloud_of(k), T @ pose, k) for k, pose in enumerate(poses)]
    for here, there in zip(parts, moved, strict=True):
        np.testing.assert_allclose(there["xyz"], se3.apply(T, here["xyz"]), atol=1e-12)
        for name in ("time", "intensity", "ring", "lidar"):
            np.testing.assert_array_equal(here[name], there[name])


def test_a_point_keeps_what_is_known_of_it() -> None:
    cloud = cloud_of(2)
    points = fused(cloud, np.eye(4), 5)
    assert cloud.ring is not None
    np.testing.assert_array_equal(points["ring"], np.where(cloud.ring < 0, NO_RING, cloud.ring))
    np.testing.assert_array_equal(points["time"], cloud.time)
    assert {*points["lidar"]} == {5}
    bare = fused(PointCloud(cloud.xyz), np.eye(4))
    assert np.isnan(bare["time"]).all()
    assert np.isnan(bare["intensity"]).all()
    assert {*bare["ring"]} == {NO_RING}


def test_one_point_a_voxel_whatever_the_order() -> None:
    sweeps = [fused(cloud_of(k), np.eye(4), k % 2) for k in range(6)]
    every, kept = np.concatenate(sweeps), voxels(sweeps, 0.7)
    mixed = np.random.default_rng(3).permutation(every)
    again = voxels(np.array_split(mixed, 5), 0.7)
    np.testing.assert_array_equal(np.sort(kept), np.sort(again))
    # Each occupied cube has one, and it is one of those measured.
    cells = np.unique(np.floor(every["xyz"] / 0.7), axis=0)
    np.testing.assert_array_equal(np.unique(np.floor(kept["xyz"] / 0.7), axis=0), cells)
    assert len(kept) == len(cells)
    assert np.isin(kept, every).all()


def test_a_voxel_shows_no_side_of_it_more_than_another() -> None:
    rng = np.random.default_rng(4)
    wall = np.c_[rng.normal(0.05, 0.02, 60_000), rng.uniform(0, 20, (60_000, 2))]
    kept = voxels([fused(PointCloud(wall + np.array([0, 0, 1.0])), np.eye(4))], 0.1)["xyz"][:, 0]
    inner = wall[(wall[:, 0] >= 0) & (wall[:, 0] < 0.1), 0]
    own = kept[(kept >= 0) & (kept < 0.1)]
    assert own.mean() == pytest.approx(inner.mean(), abs=4 * inner.std() / len(own) ** 0.5)
    assert own.std() == pytest.approx(inner.std(), rel=0.05)


def test_no_sweep_has_no_voxels() -> None:
    assert len(voxels([], 0.1)) == 0
    assert len(voxels([fused(cloud_of(1), np.eye(4))[:0]], 0.1)) == 0


def test_keys_of_cells_are_undone() -> None:
    rng = np.random.default_rng(5)
    anchor = np.array([4_000_000, -7, 60_000_000])
    cells = rng.integers(-HALF + 1, HALF, (1000, 3)) + anchor
    keys = cell_keys((cells + 0.5) * 0.25, 0.25, anchor, rng.integers(0, 32, 1000))
    np.testing.assert_array_equal(cells_at(keys, anchor), cells)
    with pytest.raises(UsageError, match="use larger ones, or --crop"):
        cell_keys(np.array([[6e4, 0, 0]]), 0.1, np.zeros(3, np.int64))


def test_a_grid_follows_its_cells() -> None:
    """However many points come, no more than one waits for each cell and buffer."""
    grid, points = Grid(one_of_each), fused(cloud_of(6, 20_000), np.eye(4))
    for _ in range(40):
        grid.add(cell_keys(points["xyz"], 2.0, np.zeros(3, np.int64)), points)
    assert len(grid.all().rows) < 6000


def test_what_is_inside_of_a_box() -> None:
    box = np.array([[-1.0, -np.inf, 0.0], [1.0, 2.0, np.inf]])
    xyz = np.array([[0, 0, 1], [1, 2, 0], [1.1, 0, 1], [0, 2.1, 1], [0, -99, 1], [0, 0, -0.1]])
    assert inside(xyz, box).tolist() == [True, True, False, False, True, False]


def test_what_moves_is_found_and_what_stands_stays() -> None:
    rng = np.random.default_rng(7)

    def sweep(k: int) -> PointCloud:
        azimuth, z = rng.uniform(-np.pi, np.pi, 20_000), rng.uniform(-2, 6, 20_000)
        wall = np.c_[20 * np.cos(azimuth), 20 * np.sin(azimuth), z]
        body = rng.uniform(-0.4, 0.4, (300, 3)) + np.array([6, -6 + 1.5 * k, 0.5])
        return PointCloud(np.concatenate([wall, body]) * (1 + rng.normal(0, 1e-3)))

    sweeps = [sweep(k) for k in range(9)]
    usual = usual_view(sweeps[::2])
    for cloud in sweeps:
        stays = is_static(cloud, usual)
        assert stays[:20_000].mean() > 0.999
        assert stays[20_000:].mean() < 0.05
    # Where nobody looked before, nothing is known to have moved.
    assert is_static(PointCloud(np.array([[0.0, 0.0, 9.0]])), usual).all()
