"""A packed cloud is the cloud: its points to the quantisation step, what matters kept first."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from retropole.base.datatypes import Array, PointCloud, Scan
from retropole.report.points import (
    COORDINATE_STEPS,
    MAX_SHOWN_RANGE,
    PackedCloud,
    PackedPoints,
    pack_cloud,
)
from tests.report.made_up import made_up
from tests.report.pages import cloud_of


def target_scan(count: int) -> Scan:
    return made_up(count=count).placements[0].target


def unpacked(packed: PackedCloud | PackedPoints) -> Array:
    steps = np.frombuffer(base64.b64decode(packed.xyz), "<u2").reshape(-1, 3)
    return np.asarray(
        np.array(packed.low) + np.array(packed.size) * steps / COORDINATE_STEPS, dtype=np.float64
    )


def test_unpacked_points_are_the_clouds_points() -> None:
    scan = target_scan(900)
    packed, cloud = pack_cloud(scan.cloud, scan.detection, max_points=10_000), scan.cloud
    points = unpacked(packed)
    assert len(points) == len(cloud) == packed.shown == packed.total
    size = np.ptp(cloud.xyz, axis=0)
    nearest = np.abs(points[:, None] - cloud.xyz).sum(axis=2).argmin(axis=1)
    assert len(set(nearest.tolist())) > 0.99 * len(points)
    assert np.all(np.abs(points - cloud.xyz[nearest]) <= size / COORDINATE_STEPS)


def test_points_on_poles_and_rejected_clusters_come_first_and_stay() -> None:
    scan = target_scan(3000)
    packed = pack_cloud(scan.cloud, scan.detection, max_points=300)
    assert (packed.on_poles, packed.shown) == (120, 300)
    on_poles = np.concatenate([pole.xyz for pole in scan.poles])
    assert np.allclose(unpacked(packed)[:120], on_poles, atol=2e-3)
    assert scan.detection is not None
    rejected = scan.cloud.xyz[scan.detection.rejected[0].index]
    assert np.allclose(unpacked(packed)[120:160], rejected, atol=2e-3)
    packed = pack_cloud(scan.cloud, scan.detection, max_points=130)
    assert (packed.on_poles, packed.shown) == (120, 130)
    assert np.allclose(unpacked(packed)[120:], rejected[:10], atol=2e-3)


def test_points_are_drawn_in_proportion_to_their_range() -> None:
    cloud = target_scan(20_000).cloud
    shown = np.linalg.norm(unpacked(pack_cloud(cloud, max_points=600)), axis=1)
    # Weighted by range, the mean of its inverse is the inverse of its mean.
    ranges = np.linalg.norm(cloud.xyz, axis=1)
    assert np.mean(1 / shown) == pytest.approx(1 / ranges.mean(), rel=0.1)


def test_stray_points_do_not_coarsen_the_others() -> None:
    xyz = np.r_[
        np.random.default_rng(0).uniform(-5, 5, (50, 3)),
        [[1e9, 0, 0], [0, -2 * MAX_SHOWN_RANGE, 0]],
    ]
    packed = pack_cloud(PointCloud(xyz), max_points=100)
    assert packed.far == 2
    assert packed.shown == 50
    assert max(packed.size) < 10.1


def test_intensity_that_says_nothing_is_left_out() -> None:
    xyz = np.random.default_rng(0).uniform(-5, 5, (50, 3))
    assert pack_cloud(PointCloud(xyz), max_points=100).intensity is None
    assert pack_cloud(PointCloud(xyz, np.full(50, 7.0)), max_points=100).intensity is None
    varied = pack_cloud(PointCloud(xyz, np.arange(50.0)), max_points=100).intensity
    assert varied is not None
    assert len(base64.b64decode(varied)) == 50


def test_intensities_are_kept_in_full_and_bright_points_before_others() -> None:
    cloud = cloud_of(2000)
    assert cloud.intensity is not None
    packed = pack_cloud(cloud, max_points=600, threshold=0.5)
    assert packed.levels is not None
    values = np.frombuffer(base64.b64decode(packed.levels.values), "<u2")
    levels = packed.levels.low + (packed.levels.high - packed.levels.low) * values / 65535
    assert np.all(levels[:200] > 0.5)
    assert np.all(levels[200:] < 0.5)
    assert (packed.levels.low, packed.levels.high) == (cloud.intensity.min(), 0.9)
    nearest = np.abs(unpacked(packed)[:, None] - cloud.xyz).sum(axis=2).argmin(axis=1)
    assert np.allclose(levels, cloud.intensity[nearest], atol=1e-5)
    assert pack_cloud(cloud, max_points=600).levels is None
    bare = PointCloud(cloud.xyz)
    assert pack_cloud(bare, max_points=600, threshold=0.5).levels is None
