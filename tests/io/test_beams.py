"""Rings are believed where they are rings, in any frame, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.io.beams import (
    CONE_SPREAD,
    MAX_RING_SPREAD,
    fit_cones,
    ring_spread,
    rings_fault,
    with_beam_origin,
    with_trusted_rings,
)
from retropole.pipeline import Options, calibrate
from retropole.simulation import FIELD, Rectangle, simulate_pair
from tests.extraction.scenes import PAINT, X, Y, Z, pole, seen

SENSORS = ["VLP-16", "XT32", "OS1", "Pandar64"]


def recorded(sensor: str) -> PointCloud:
    walls = [
        Rectangle(6.0 * axis, other, Z, (8, 3), PAINT) for axis, other in ((X, Y), (Y, X), (-X, Y))
    ]
    return seen([*walls, pole((4, 1))], sensor)[0]


@pytest.mark.parametrize("sensor", SENSORS)
def test_rings_of_a_recording_are_rings_in_any_frame(sensor: str) -> None:
    cloud = recorded(sensor)
    assert ring_spread(cloud) < 0.1 * MAX_RING_SPREAD
    assert with_trusted_rings(cloud) is cloud
    moved = cloud.transformed(se3.random(np.random.default_rng(1), 20.0))
    assert with_trusted_rings(moved) is moved
    lost = replace(moved, origin=np.zeros(3))
    assert ring_spread(lost) > MAX_RING_SPREAD
    assert with_trusted_rings(lost) is lost


@pytest.mark.parametrize("sensor", SENSORS)
def test_what_is_no_ring_is_left_out(sensor: str) -> None:
    cloud = recorded(sensor)
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    drawn = np.random.default_rng(0).integers(0, 16, len(cloud))
    for ring, words in (
        (np.full(len(cloud), 7), "have the ring 7"),
        (drawn, "neighbours are on different rings"),
        (np.round(np.degrees(azimuth + np.pi) / 0.4).astype(np.int64), "more than any LiDAR"),
    ):
        wrong = replace(cloud, ring=ring)
        assert words in rings_fault(wrong)
        assert with_trusted_rings(wrong).ring is None


def test_a_cloud_without_rings_has_no_fault() -> None:
    cloud = replace(recorded("VLP-16"), ring=None)
    assert rings_fault(cloud) == ""
    assert ring_spread(cloud) == np.inf
    assert rings_fault(PointCloud(np.zeros((0, 3)), ring=np.zeros(0, dtype=np.int64))) == ""


def forgotten(cloud: PointCloud, T: np.ndarray) -> PointCloud:
    """Move a cloud as a program does that knows of points only."""
    return replace(cloud, xyz=se3.apply(T, cloud.xyz))


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return simulate_pair("street", np.random.default_rng(0)).target


@pytest.mark.parametrize("seed", range(3))
def test_the_rings_tell_what_the_file_forgot(cloud: PointCloud, seed: int) -> None:
    T = se3.random(np.random.default_rng(seed), 2.0)
    found = with_beam_origin(forgotten(cloud, T))
    np.testing.assert_allclose(found.origin, T[:3, 3], atol=1e-3)
    assert abs(found.axis @ T[:3, 2]) > 1 - 1e-8
    assert found.axis[2] >= 0


def test_what_the_rings_agree_with_is_kept(cloud: PointCloud) -> None:
    assert with_beam_origin(cloud) is cloud
    moved = cloud.transformed(se3.random(np.random.default_rng(0), 2.0))
    assert with_beam_origin(moved) is moved


def test_what_tells_nothing_is_kept(cloud: PointCloud) -> None:
    rng = np.random.default_rng(0)
    T = se3.random(rng, 2.0)
    bare = replace(forgotten(cloud, T), ring=None)
    assert with_beam_origin(bare) is bare
    drawn = replace(forgotten(cloud, T), ring=rng.integers(0, 16, len(cloud)))
    assert with_beam_origin(drawn) is drawn
    blurred = forgotten(cloud, T)
    blurred = replace(blurred, xyz=blurred.xyz + rng.normal(0.0, 0.3, blurred.xyz.shape))
    assert with_beam_origin(blurred) is blurred


def test_noise_of_the_angles_moves_the_apex_little() -> None:
    rng = np.random.default_rng(0)
    ring = rng.integers(0, 16, 4000)
    elevation = np.radians(-15.0 + 2.0 * ring + rng.normal(0.0, 0.03, 4000))
    azimuth, ranges = rng.uniform(-np.pi, np.pi, 4000), rng.uniform(2.0, 20.0, 4000)
    ray = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    found = fit_cones(ranges[:, None] * ray, ring, np.array([0.5, -0.3, 1.0]))
    assert 0.5 * np.radians(0.03) < found.spread < CONE_SPREAD
    assert 1e-6 < np.linalg.norm(found.apex) < 3e-3
    assert np.degrees(np.arccos(abs(found.axis[2]))) < 0.01


@pytest.mark.full
def test_poses_of_moved_clouds_follow() -> None:
    """Both clouds moved by a program that forgets the origin: the poles' pose moves along."""
    pair = simulate_pair("street", np.random.default_rng(1), noise=FIELD)
    rng = np.random.default_rng(2)
    A, B = se3.random(rng, 2.0), se3.random(rng, 2.0)
    plain = calibrate(pair.target, pair.source, options=Options(sensors=pair.sensors))
    moved = calibrate(
        forgotten(pair.target, A), forgotten(pair.source, B), options=Options(sensors=pair.sensors)
    )
    for a, b, limit in ((plain.poles, moved.poles, 0.1), (plain.refined, moved.refined, 1.5)):
        assert a is not None
        assert b is not None
        assert a.covariance is not None
        step = se3.local(a.T_target_source, se3.inverse(A) @ b.T_target_source @ B)
        assert np.sqrt(step @ np.linalg.solve(a.covariance, step)) < limit
