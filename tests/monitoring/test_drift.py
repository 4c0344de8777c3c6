"""A site that is recorded again: moved, unmoved, elsewhere, or with too little in it."""

from dataclasses import replace

import numpy as np
import pytest

from retropole import se3
from retropole.datatypes import Array, PointCloud, PoseEstimate
from retropole.errors import UsageError
from retropole.monitoring.drift import check
from retropole.pipeline import calibrate
from retropole.simulation import SimulatedPair, record_again, simulate_pair

SMALL_ROTATION = np.r_[0.0, 0, np.radians(0.3), 0, 0, 0]
SMALL_TRANSLATION = np.r_[0.0, 0, 0, 0.03, 0, 0]


@pytest.fixture(scope="module")
def street() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(1))


@pytest.fixture(scope="module")
def stored(street: SimulatedPair) -> PoseEstimate:
    answer = calibrate(street.target, street.source)
    assert answer.refined is not None
    return answer.refined


@pytest.mark.parametrize(
    ("moved", "status", "poles"),
    [
        (np.zeros(6), "same", True),
        (np.zeros(6), "same", False),
        (SMALL_ROTATION, "moved", True),
        (SMALL_TRANSLATION, "moved", False),
    ],
)
def test_small_movements_are_found(
    street: SimulatedPair, stored: PoseEstimate, moved: Array, status: str, poles: bool
) -> None:
    again = record_again(street, np.random.default_rng(11), moved=moved, poles=poles)
    answer = check(stored, again.target, again.source)
    assert answer.status == status
    assert answer.used == ("poles" if poles else "scene")
    assert answer.step is not None
    assert answer.covariance is not None
    off = answer.step - moved
    assert off @ np.linalg.solve(answer.covariance, off) < 25.0


def test_the_recording_itself_is_the_same(street: SimulatedPair, stored: PoseEstimate) -> None:
    answer = check(stored, street.target, street.source)
    assert answer.status == "same"
    assert answer.used == "poles"
    assert answer.step is not None
    np.testing.assert_allclose(answer.step, 0.0, atol=1e-9)


def test_clouds_without_intensity_are_checked_by_the_scene(
    street: SimulatedPair, stored: PoseEstimate
) -> None:
    again = record_again(street, np.random.default_rng(12))
    bare = [PointCloud(cloud.xyz) for cloud in (again.target, again.source)]
    answer = check(stored, *bare)
    assert (answer.status, answer.used) == ("same", "scene")
    assert "poles_no_intensity" in [reason.code for reason in answer.reasons]


def test_gross_movements_are_found_with_poles_and_never_called_same_without(
    street: SimulatedPair, stored: PoseEstimate
) -> None:
    rng = np.random.default_rng(13)
    turned = np.r_[np.radians(40.0) * street.T_world_target[2, :3], 0, 0, 0]
    there = record_again(street, rng, moved=turned)
    answer = check(stored, there.target, there.source)
    assert answer.status == "moved"
    assert answer.rotation is not None
    assert np.degrees(answer.rotation.length) == pytest.approx(40.0, abs=0.1)
    gone = record_again(street, rng, moved=turned, poles=False)
    assert check(stored, gone.target, gone.source).status != "same"
    assert check(stored, gone.source, gone.target).status != "same"


def test_another_place_is_never_called_same(stored: PoseEstimate) -> None:
    other = simulate_pair("harbor", np.random.default_rng(14))
    assert check(stored, other.target, other.source).status != "same"
    bare = record_again(other, np.random.default_rng(15), poles=False)
    assert check(stored, bare.target, bare.source).status != "same"


@pytest.mark.parametrize("left", [0, 10])
def test_hardly_any_points_cannot_tell(
    street: SimulatedPair, stored: PoseEstimate, left: int
) -> None:
    answer = check(stored, street.target, street.source.select(np.arange(left)))
    assert answer.status == "cannot_tell"
    assert answer.step is None
    assert answer.rotation is None
    assert answer.reasons


def test_a_pose_without_covariance_is_refused(street: SimulatedPair, stored: PoseEstimate) -> None:
    with pytest.raises(UsageError):
        check(replace(stored, covariance=None), street.target, street.source)


def test_recording_again_moves_the_source_alone(street: SimulatedPair) -> None:
    again = record_again(street, np.random.default_rng(16), moved=SMALL_TRANSLATION, poles=False)
    step = se3.local(street.T_target_source, again.T_target_source)
    np.testing.assert_allclose(step, SMALL_TRANSLATION, atol=1e-12)
    np.testing.assert_array_equal(again.T_world_target, street.T_world_target)
    assert again.poles == ()
    assert len(again.surfaces) == len(street.surfaces) - len(street.poles)
