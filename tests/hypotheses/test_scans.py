"""Recordings of a site: searched about their beam origins, and all of one place."""

from dataclasses import replace

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.hypotheses.scans import find_scans, poses_in_clouds
from retropole.simulation.sites import SimulatedSite
from tests.adjustment.adjusting import Steps, with_lidar
from tests.numeric import numeric_jacobian


def test_scans_count_from_where_the_beams_start(simulated: SimulatedSite, steps: Steps) -> None:
    """Wherever the frame of a LiDAR's clouds lies."""
    site = simulated.as_site()
    by = np.array([0.3, -0.2, 1.1])
    away = se3.from_rt(np.eye(3), by)
    clouds = [cloud for cloud in site.lidars[1].clouds if cloud is not None]
    moved = with_lidar(site, 1, clouds=tuple(cloud.transformed(away) for cloud in clouds))
    scans = find_scans(moved)
    np.testing.assert_allclose(scans.origins, [np.zeros(3), by, np.zeros(3)])
    for placement in range(2):
        found, before = (each.poles(1, placement) for each in (scans, steps.scans))
        assert len(found) == len(before) > 1
        for one, other in zip(found, before, strict=True):
            np.testing.assert_allclose(one.point, other.point, atol=1e-6)


def test_a_recording_that_cannot_be_used_is_left_out_and_told(simulated: SimulatedSite) -> None:
    site = simulated.as_site()
    cloud = site.lidars[2].clouds[0]
    assert cloud is not None
    dim = replace(cloud, intensity=None)
    few = replace(
        site, lidars=(replace(site.lidars[2], clouds=(dim, None)),), placements=("1", "2")
    )
    scans = find_scans(few)
    assert scans.by_lidar == ((None, None),)
    ((recording, refusal),) = scans.faults
    assert recording == (0, 0)
    assert refusal.code == "no_intensity"
    assert scans.scene(0) is None
    assert scans.poles(0, 0) == ()


def test_recordings_can_be_left_out(steps: Steps) -> None:
    left = steps.scans.without({(1, 0)})
    assert left.by_lidar[1][0] is None
    assert left.by_lidar[1][1] is steps.scans.by_lidar[1][1]
    scene, whole = left.scene(1), steps.scans.scene(1)
    assert isinstance(scene, PointCloud)
    assert isinstance(whole, PointCloud)
    assert len(scene) == len(left.used(1)[0].cloud) < len(whole)


def test_poses_in_the_clouds_frames_and_their_covariance() -> None:
    rng = np.random.default_rng(0)
    T = np.stack([se3.random(rng) for _ in range(2)])
    origins = rng.normal(size=(2, 3))
    mixing = rng.normal(size=(12, 12))
    covariance = mixing @ mixing.T
    poses, moved = poses_in_clouds(T, covariance, origins)
    for pose, before, origin in zip(poses, T, origins, strict=True):
        # Where the beams start is where it was.
        np.testing.assert_allclose(se3.apply(pose, origin[None])[0], before[:3, 3], atol=1e-12)
        np.testing.assert_allclose(pose[:3, :3], before[:3, :3])

    def of_step(step: np.ndarray) -> np.ndarray:
        steps = step.reshape(2, 6)
        there = np.stack([se3.retract(a, b) for a, b in zip(T, steps, strict=True)])
        ends, _ = poses_in_clouds(there, covariance, origins)
        return np.concatenate([se3.local(a, b) for a, b in zip(poses, ends, strict=True)])

    J = numeric_jacobian(of_step, 12)
    np.testing.assert_allclose(moved, J @ covariance @ J.T, atol=1e-5)
