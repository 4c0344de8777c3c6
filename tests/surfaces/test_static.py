"""Many frames of a static scene: what moved goes, what stands stays."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.again import record_again
from retropole.base import se3
from retropole.base.datatypes import BoolArray, PointCloud
from retropole.base.errors import Refusal
from retropole.evaluation.metrics import e_rt
from retropole.extraction.poles import extract_poles
from retropole.pipeline import calibrate
from retropole.simulation import SimulatedPair, simulate_pair
from retropole.surfaces.static import (
    check_static,
    check_still,
    pole_drift,
    remove_dynamic_points,
    turned_by,
)

FRAMES = 6


@pytest.fixture(scope="module")
def street() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(3), frames=FRAMES)


def with_walker(cloud: PointCloud) -> tuple[PointCloud, BoolArray]:
    """Add a person who walks by, 1 m a frame; tell which points are theirs."""
    rng = np.random.default_rng(0)
    people, frames = [], []
    for k in range(FRAMES):
        body = rng.uniform(-1, 1, (150, 3)) * [0.15, 0.15, 0.6]
        people.append(body + np.array([2.5, -2.5 + k, -0.4]))
        frames.append(np.full(150, k))
    assert cloud.frame is not None
    assert cloud.intensity is not None
    walker = np.concatenate(people)
    joined = PointCloud(
        np.concatenate([cloud.xyz, walker]),
        intensity=np.concatenate([cloud.intensity, np.full(len(walker), 20.0)]),
        frame=np.concatenate([cloud.frame, *frames]),
    )
    return joined, np.arange(len(joined)) >= len(cloud)


@pytest.mark.full
def test_a_walker_goes_and_the_scene_stays(street: SimulatedPair) -> None:
    cloud, walks = with_walker(street.target)
    left = remove_dynamic_points(cloud)
    kept = np.isin(cloud.xyz[:, 0], left.xyz[:, 0])
    # Where no other frame has a return there is no telling.
    assert np.mean(kept[walks]) < 0.35
    assert np.mean(kept[~walks]) > 0.97


@pytest.mark.full
def test_poles_stay_whole(street: SimulatedPair) -> None:
    first = len(street.surfaces) - len(street.poles)
    on_poles = street.target.xyz[street.labels[0] >= first]
    left = remove_dynamic_points(street.target)
    assert np.mean(np.isin(on_poles[:, 0], left.xyz[:, 0])) > 0.98


@pytest.mark.full
def test_few_frames_are_left_alone(street: SimulatedPair) -> None:
    single = replace(street.target, frame=None)
    assert remove_dynamic_points(single) is single
    two = street.target.select(np.asarray(street.target.frame) < 2)
    assert remove_dynamic_points(two) is two


@pytest.mark.full
def test_a_pole_that_moves_is_refused(street: SimulatedPair) -> None:
    cloud = street.target
    poles = extract_poles(cloud).poles
    check_static("target", cloud, poles)
    assert cloud.frame is not None
    pole = poles[0]
    frame = cloud.frame[pole.index]
    distance, sigma = pole_drift(pole, frame)
    assert distance < 5 * sigma
    sideways = np.cross(pole.direction, [1.0, 0.0, 0.0])
    moved = replace(pole, xyz=pole.xyz + 0.1 * (frame >= 3)[:, None] * sideways)
    with pytest.raises(Refusal) as refusal:
        check_static("target", cloud, [moved])
    assert refusal.value.code == "moving_pole"


@pytest.mark.nightly
def test_frames_average_the_noise_away() -> None:
    """Compared scene by scene: which scenes are refused differs between one sweep and ten."""
    ratios: list[float] = []
    for seed in range(8):
        pair = simulate_pair("bare", np.random.default_rng(seed), frames=10)
        single = [
            replace(cloud.select(np.asarray(cloud.frame) == 0), frame=None)
            for cloud in (pair.target, pair.source)
        ]
        poses = [
            calibrate(*clouds, scene=False).T_target_source
            for clouds in ((pair.target, pair.source), single)
        ]
        errors = [e_rt(T, pair.T_target_source) for T in poses if T is not None]
        if len(errors) == 2:
            ratios.append(errors[0] / errors[1])
    assert len(ratios) >= 6
    # Returns on the tape average, the sensors' systematic errors do not.
    assert 0.3 < np.exp(np.mean(np.log(ratios))) < 0.8


def bumped(cloud: PointCloud, angle: float, frames: int = FRAMES) -> PointCloud:
    """Turn a LiDAR before the second half of its frames."""
    assert cloud.frame is not None
    R = se3.exp_so3(angle * np.array([0.0, 0.6, 0.8]))
    late = (cloud.frame >= frames // 2)[:, None]
    return replace(cloud, xyz=np.where(late, cloud.xyz @ R.T, cloud.xyz))


@pytest.mark.parametrize("degrees", [0.6, 2.0, 5.0])
@pytest.mark.full
def test_a_lidar_that_turned_while_it_recorded_is_refused(
    street: SimulatedPair, degrees: float
) -> None:
    moved = remove_dynamic_points(bumped(street.target, np.radians(degrees)))
    assert turned_by(moved) == pytest.approx(np.radians(degrees), rel=0.05)
    with pytest.raises(Refusal) as refusal:
        check_still("target", moved)
    assert refusal.value.code == "moving_lidar"
    assert "target" in str(refusal.value)


@pytest.mark.full
def test_a_lidar_that_stood_did_not_turn(street: SimulatedPair) -> None:
    for cloud in (street.target, street.source, replace(street.target, frame=None)):
        assert turned_by(cloud) < np.radians(0.1)
        check_still("target", cloud)


@pytest.fixture(scope="module", params=[1000, 1001])
def sparse(request: pytest.FixtureRequest) -> SimulatedPair:
    """Two LiDARs whose sweeps are sparse and never meet the same points, where little holds."""
    seed: int = request.param
    rng = np.random.default_rng(seed)
    return simulate_pair("corridor", rng, sensor_target="Mid-360", sensor_source="Mid-360")


@pytest.mark.parametrize("frames", [2, 3, 5, 6])
def test_single_sparse_sweeps_are_no_turn(sparse: SimulatedPair, frames: int) -> None:
    """Of the 32 recordings, GICP turns two by more than is allowed."""
    for seed in range(2):
        again = record_again(sparse, np.random.default_rng(seed), frames=frames)
        for cloud in (again.target, again.source):
            check_still("target", remove_dynamic_points(cloud))


@pytest.mark.parametrize("degrees", [0.5, 2.0])
@pytest.mark.full
def test_a_sparse_lidar_that_turned_is_refused(sparse: SimulatedPair, degrees: float) -> None:
    again = record_again(sparse, np.random.default_rng(0), frames=8)
    for cloud in (again.target, again.source):
        moved = remove_dynamic_points(bumped(cloud, np.radians(degrees), 8))
        with pytest.raises(Refusal, match="turned by"):
            check_still("target", moved)


@pytest.mark.full
def test_a_bumped_lidar_gives_no_answer(street: SimulatedPair) -> None:
    answer = calibrate(bumped(street.target, np.radians(1.0)), street.source)
    assert answer.status == "refused"
    assert answer.reasons[0].code == "moving_lidar"
