"""A carrier that creeps between two recordings is no movement of the LiDARs on it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.again import record_again
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud, PoseEstimate
from retropole.checking.carrier import CarrierMotion, carrier_motion
from retropole.checking.drift import check
from retropole.checking.movement import CheckResult
from retropole.pipeline import calibrate
from retropole.simulation import SimulatedPair, simulate_pair
from tests.surfaces import swaying

pytestmark = pytest.mark.full

NOON, SWEEP = 1.7e9, 0.1
T = se3.from_rt(se3.exp_so3(np.array([0.1, -0.2, 0.9])), np.array([1.0, -0.5, 0.3]))
"""Of the source in the frame of the target, which is that of the hall."""


def in_hall(velocity: Array, start: float, T_lidar: Array, sweeps: int, seed: int) -> PointCloud:
    """Record in a hall from a carrier whose turn and shift per second are given in the hall."""
    rng = np.random.default_rng(seed)
    clouds = []
    for k in range(sweeps):
        moved = velocity * (start + k * SWEEP)
        pose = se3.from_rt(se3.exp_so3(moved[:3]), moved[3:]) @ T_lidar
        # Recorded with the axes of the hall from where the LiDAR is, and turned into its own.
        cloud = swaying.recorded(np.zeros((8, 6)), rng, at=pose[:3, 3])
        clouds.append(cloud.xyz @ pose[:3, :3])
    frame = np.repeat(np.arange(sweeps), [len(xyz) for xyz in clouds])
    when = NOON + start, NOON + start + (sweeps - 1) * SWEEP
    return PointCloud(np.concatenate(clouds), frame=frame if sweeps > 1 else None, recorded=when)


def motion_in_hall(velocity: Array, apart: float, sweeps: tuple[int, int]) -> CarrierMotion | None:
    target = in_hall(velocity, 0.0, np.eye(4), sweeps[0], 1)
    source = in_hall(velocity, apart, T, sweeps[1], 2)
    return carrier_motion(T, target, source)


@pytest.mark.parametrize("sweeps", [(4, 4), (4, 1), (1, 4)])
@pytest.mark.parametrize("apart", [0.08, -0.05])
def test_either_lidar_shows_how_the_carrier_moved(sweeps: tuple[int, int], apart: float) -> None:
    velocity = np.array([0.0, 0.005, 0.01, 0.15, -0.1, 0.02])
    # The middles of recordings of other lengths lie apart by more.
    middle = apart + (sweeps[1] - sweeps[0]) / 2 * SWEEP
    found = motion_in_hall(velocity, apart, sweeps)
    assert found is not None
    assert found.is_seen
    assert found.apart == pytest.approx(middle, abs=1e-6)
    moved = se3.from_rt(se3.exp_so3(velocity[:3] * middle), velocity[3:] * middle) @ T
    off = found.step - se3.local(T, moved)
    assert off @ np.linalg.solve(found.covariance, off) < 25.0
    assert np.linalg.norm(off[3:]) < 0.002


def test_the_clouds_are_brought_to_one_moment() -> None:
    velocity = np.array([0.0, 0.0, 0.01, 0.2, 0.0, 0.0])
    target = in_hall(velocity, 0.0, np.eye(4), 4, 1)
    source = in_hall(velocity, 0.08, T, 4, 2)
    found = carrier_motion(T, target, source)
    assert found is not None
    clouds = found.without_motion(T, target, source)
    middle = velocity * 1.5 * SWEEP
    at = se3.from_rt(se3.exp_so3(middle[:3]), middle[3:])
    for cloud, pose in zip(clouds, (np.eye(4), T), strict=True):
        in_frame = se3.apply(at @ pose, cloud.xyz)
        # Every return lies on a wall of the hall.
        outside = np.abs(np.abs(in_frame) - swaying.HALF).min(axis=1)
        assert np.sqrt(np.mean(outside**2)) < 0.012


def test_a_carrier_that_stands_is_not_seen_to_move() -> None:
    found = motion_in_hall(np.zeros(6), 0.08, (4, 4))
    assert found is not None
    assert not found.is_seen
    assert np.linalg.norm(found.step[3:]) < 0.002


def test_of_single_sweeps_what_carriers_do_bounds_the_motion() -> None:
    found = motion_in_hall(np.zeros(6), 0.1, (1, 1))
    assert found is not None
    assert not found.is_seen
    np.testing.assert_array_equal(found.step, 0.0)
    fastest = np.sqrt(np.diag(found.covariance)[3:]) / 0.1 * np.sqrt(16.8)
    np.testing.assert_allclose(fastest, 0.29, atol=0.01)


def test_what_is_not_of_one_moment_says_nothing() -> None:
    stands = np.zeros(6)
    assert motion_in_hall(stands, 0.0, (1, 1)) is None
    assert motion_in_hall(stands, 0.3, (1, 1)) is None
    driving = motion_in_hall(np.array([0.0, 0, 0, 0.7, 0.7, 0]), 0.08, (4, 4))
    assert driving is None or not driving.is_seen
    dated = in_hall(stands, 0.0, np.eye(4), 1, 1)
    undated = replace(in_hall(stands, 0.1, T, 1, 2), recorded=None)
    assert carrier_motion(T, dated, undated) is None


@pytest.fixture(scope="module")
def street() -> SimulatedPair:
    rng = np.random.default_rng(2)
    return simulate_pair("street", rng, sensor_target="VLP-16", sensor_source="VLP-16")


@pytest.fixture(scope="module")
def creeps(street: SimulatedPair) -> Callable[[float, int, float], CheckResult]:
    """Check recordings of a carrier at a speed, m/s, of some sweeps, whose source moved, m."""
    answer = calibrate(street.target, street.source)
    stored = answer.refined
    assert isinstance(stored, PoseEstimate)

    def checked(speed: float, sweeps: int, moved: float) -> CheckResult:
        step = np.array([0.0, 0, 0, moved, 0, 0])
        rng = np.random.default_rng(5)
        again = record_again(street, rng, moved=step, poles=False, frames=sweeps)
        T_source = se3.retract(street.T_target_source, step)
        clouds = []
        for cloud, pose, start in ((again.target, np.eye(4), 0.0), (again.source, T_source, 0.1)):
            frame = np.zeros(len(cloud)) if cloud.frame is None else cloud.frame
            after = (start + SWEEP * frame)[:, None] * np.array([0.6, -0.8, 0.0]) * speed
            when = NOON + start, NOON + start + (sweeps - 1) * SWEEP
            xyz = cloud.xyz - after @ pose[:3, :3]
            clouds.append(replace(cloud, xyz=xyz, time=None, recorded=when))
        return check(stored, *clouds, uncertainty=answer.uncertainty)

    return checked


@pytest.mark.parametrize(
    ("speed", "sweeps", "moved", "statuses"),
    [
        (0.24, 3, 0.0, {"same"}),
        pytest.param(0.24, 3, 0.04, {"moved"}, marks=pytest.mark.full),
        (0.24, 1, 0.0, {"same", "cannot_tell"}),
        pytest.param(0.0, 1, 0.06, {"moved"}, marks=pytest.mark.full),
        pytest.param(0.0, 3, 0.03, {"moved"}, marks=pytest.mark.full),
    ],
)
def test_a_creep_is_no_movement_and_hides_none(
    creeps: Callable[[float, int, float], CheckResult],
    speed: float,
    sweeps: int,
    moved: float,
    statuses: set[str],
) -> None:
    answer = creeps(speed, sweeps, moved)
    assert answer.status in statuses
    said = [reason for reason in answer.reasons if reason.code == "carrier_moved"]
    assert bool(said) == (speed > 0)
    if said:
        assert said[0].values["apart_s"] == pytest.approx(0.1, abs=1e-6)
        assert said[0].values["speed_m_s"] == pytest.approx(0.24, abs=0.03)
    if answer.status == "moved":
        assert answer.translation is not None
        assert answer.translation.length == pytest.approx(moved, abs=0.01)
