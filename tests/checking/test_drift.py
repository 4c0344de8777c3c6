"""A site that is recorded again: moved, unmoved, elsewhere, or with too little in it."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from msgspec import structs

import retropole as rp
from benchmarks.again import record_again
from retropole import pipeline
from retropole.adjustment.refinement import Refinement, refine
from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, Placement, PointCloud, PoseEstimate, Scan
from retropole.base.errors import UsageError
from retropole.base.sensors import SENSORS
from retropole.checking import drift
from retropole.checking.drift import NEAR_TRANSLATION, check, swapped_clouds, swapped_sensors
from retropole.hypotheses.evidence import MAX_CONFLICTING, count, scenes_of
from retropole.pipeline import Options, calibrate
from retropole.simulation import SimulatedPair, simulate_pair
from retropole.surfaces.consistency import SceneObjects
from tests.tiers import first_of

SMALL_ROTATION = np.r_[0.0, 0, np.radians(0.3), 0, 0, 0]
SMALL_TRANSLATION = np.r_[0.0, 0, 0, 0.03, 0, 0]


@pytest.fixture(scope="module")
def street() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(1))


@pytest.fixture(scope="module")
def calibration(street: SimulatedPair) -> Calibration:
    return calibrate(street.target, street.source)


@pytest.fixture(scope="module")
def stored(calibration: Calibration) -> PoseEstimate:
    assert calibration.refined is not None
    return calibration.refined


@pytest.mark.parametrize(
    ("moved", "status", "poles"),
    first_of(
        [
            (np.zeros(6), "same", True),
            (SMALL_TRANSLATION, "moved", False),
            (np.zeros(6), "same", False),
            (SMALL_ROTATION, "moved", True),
        ],
        2,
    ),
)
@pytest.mark.full
def test_small_movements_are_found(
    street: SimulatedPair, stored: PoseEstimate, moved: Array, status: str, poles: bool
) -> None:
    again = record_again(street, np.random.default_rng(11), moved=moved, poles=poles)
    answer = check(stored, again.target, again.source)
    assert answer.status == status
    assert answer.used == ("poles" if poles else "scene")
    assert answer.step is not None
    assert answer.covariance is not None
    assert answer.confirmation is not None
    assert answer.confirmation.agreeing > 20 * answer.confirmation.contradicting
    off = answer.step - moved
    assert off @ np.linalg.solve(answer.covariance, off) < 25.0


@pytest.mark.full
def test_the_recording_itself_is_the_same(street: SimulatedPair, stored: PoseEstimate) -> None:
    answer = check(stored, street.target, street.source)
    assert answer.status == "same"
    assert answer.used == "poles"
    assert answer.step is not None
    np.testing.assert_allclose(answer.step, 0.0, atol=1e-9)


@pytest.mark.full
def test_clouds_without_intensity_are_checked_by_the_scene(
    street: SimulatedPair, stored: PoseEstimate
) -> None:
    again = record_again(street, np.random.default_rng(12))
    bare = [PointCloud(cloud.xyz) for cloud in (again.target, again.source)]
    answer = check(stored, *bare)
    assert (answer.status, answer.used) == ("same", "scene")
    assert "poles_no_intensity" in [reason.code for reason in answer.reasons]


@pytest.mark.full
def test_doubtful_poles_are_left_alone_where_the_stored_pose_fits(
    street: SimulatedPair, stored: PoseEstimate, monkeypatch: pytest.MonkeyPatch
) -> None:
    class TriedError(Exception):
        pass

    def tried(*_: object, **__: object) -> None:
        raise TriedError

    monkeypatch.setattr(pipeline, "choose_with_candidates", tried)
    bare = record_again(street, np.random.default_rng(22), poles=False)
    assert check(stored, bare.target, bare.source).status == "same"
    turned = np.r_[np.radians(40.0) * street.T_world_target[2, :3], 0, 0, 0]
    astray = record_again(street, np.random.default_rng(22), moved=turned, poles=False)
    with pytest.raises(TriedError):
        check(stored, astray.target, astray.source)


@pytest.mark.full
def test_errors_of_the_same_devices_cancel(
    street: SimulatedPair, stored: PoseEstimate, calibration: Calibration
) -> None:
    again = record_again(street, np.random.default_rng(18))
    same_devices = check(stored, again.target, again.source, uncertainty=calibration.uncertainty)
    others = check(stored, again.target, again.source)
    assert same_devices.covariance is not None
    assert others.covariance is not None
    assert same_devices.step is not None
    assert others.step is not None
    np.testing.assert_allclose(same_devices.step, others.step)
    share = np.linalg.eigvals(np.linalg.solve(others.covariance, same_devices.covariance)).real
    assert share.max() < 1.1
    assert 0.02 < share.min() < 0.7
    assert same_devices.status == "same"
    assert same_devices.chi2 is not None
    assert same_devices.chi2 < 16.8


@pytest.mark.full
def test_poles_that_moved_between_the_recordings_do_not_make_a_movement(
    street: SimulatedPair, stored: PoseEstimate, calibration: Calibration
) -> None:
    again = record_again(street, np.random.default_rng(19))
    first = len(again.surfaces) - len(again.poles)
    xyz = again.source.xyz.copy()
    xyz[again.labels[1] >= first] += [0.05, 0.05, 0.0]
    bumped = replace(again.source, xyz=xyz)
    answer = check(stored, again.target, bumped, uncertainty=calibration.uncertainty)
    assert answer.status in ("same", "cannot_tell")


@pytest.mark.full
def test_several_minima_cannot_tell(
    street: SimulatedPair, stored: PoseEstimate, monkeypatch: pytest.MonkeyPatch
) -> None:
    def two_ends(*args: Any, **options: Any) -> Refinement | None:
        found = refine(*args, **options)
        return found and replace(found, other_minima=(SMALL_TRANSLATION,))

    again = record_again(street, np.random.default_rng(20), poles=False)
    monkeypatch.setattr(drift, "refine", two_ends)
    answer = check(stored, again.target, again.source)
    assert answer.status == "cannot_tell"
    assert "several_minima" in [reason.code for reason in answer.reasons]


@pytest.mark.full
def test_a_pose_that_fits_no_better_than_the_stored_one_is_no_movement(
    street: SimulatedPair, stored: PoseEstimate, monkeypatch: pytest.MonkeyPatch
) -> None:
    def elsewhere(*args: Any, **options: Any) -> Refinement | None:
        found = refine(*args, **options)
        assert found is not None
        T = se3.retract(found.pose.T_target_source, np.r_[0, 0, 0, 0, 0, 0.05])
        return replace(found, pose=structs.replace(found.pose, T_target_source=T))

    again = record_again(street, np.random.default_rng(21), poles=False)
    monkeypatch.setattr(drift, "refine", elsewhere)
    answer = check(stored, again.target, again.source)
    assert answer.p_value is not None
    assert answer.p_value < 1e-6
    assert answer.status == "cannot_tell"
    assert answer.reasons[-1].code == "stored_fits_as_well"


def with_strangers(pair: SimulatedPair, count: int) -> PointCloud:
    """The source's recording with single returns, a metre apart, from the air about it."""
    grid = np.arange(-14.5, 15.0)
    air = np.stack(np.meshgrid(grid, grid, [0.0, 1.2]), axis=-1).reshape(-1, 3)
    T = pair.T_world_target @ pair.T_target_source
    places = T[:3, 3] + np.random.default_rng(0).permutation(air)[:count]
    return PointCloud(np.concatenate([pair.source.xyz, se3.apply(se3.inverse(T), places)]))


@pytest.mark.parametrize(("count", "status"), first_of([(1800, "cannot_tell"), (40, "same")]))
@pytest.mark.full
def test_a_stored_pose_that_the_scene_denies_is_not_the_same(
    street: SimulatedPair, stored: PoseEstimate, count: int, status: str
) -> None:
    again = record_again(street, np.random.default_rng(12), poles=False)
    crowded = with_strangers(again, count)
    answer = check(stored, PointCloud(again.target.xyz), crowded)
    assert answer.confirmation is not None
    assert (answer.confirmation.contradicted > MAX_CONFLICTING) == (status != "same")
    assert answer.status == status
    # The surfaces alone find the stored pose again.
    assert answer.p_value is not None
    assert answer.p_value > 0.01
    assert ("scene_denies_stored" in [r.code for r in answer.reasons]) == (status != "same")


@pytest.mark.nightly
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


@pytest.mark.full
def test_another_place_is_never_called_same(stored: PoseEstimate) -> None:
    other = simulate_pair("harbor", np.random.default_rng(14))
    assert check(stored, other.target, other.source).status != "same"
    bare = record_again(other, np.random.default_rng(15), poles=False)
    assert check(stored, bare.target, bare.source).status != "same"


@pytest.mark.full
def test_a_mast_that_sways_has_not_moved(street: SimulatedPair, stored: PoseEstimate) -> None:
    """One sweep is taken at some phase of the sway: what is stated of it is no movement."""
    again = record_again(street, np.random.default_rng(11), moved=SMALL_ROTATION)
    swaying = check(
        stored, again.target, again.source, options=Options(mast_sway=float(np.radians(0.3)))
    )
    assert swaying.status != "moved"


@pytest.mark.full
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
        check(structs.replace(stored, covariance=None), street.target, street.source)


def test_recording_again_moves_the_source_alone(street: SimulatedPair) -> None:
    again = record_again(street, np.random.default_rng(16), moved=SMALL_TRANSLATION, poles=False)
    step = se3.local(street.T_target_source, again.T_target_source)
    np.testing.assert_allclose(step, SMALL_TRANSLATION, atol=1e-12)
    np.testing.assert_array_equal(again.T_world_target, street.T_world_target)
    assert again.poles == ()
    assert len(again.surfaces) == len(street.surfaces) - len(street.poles)


SCENES = ("street", "harbor", "corridor")

Scenes = list[tuple[SceneObjects, SceneObjects]]


@cache
def pair_of(scene: str) -> SimulatedPair:
    return rp.simulate(scene, 1, sensor_target="VLP-16", sensor_source="XT32")


@cache
def scenes(scene: str, swapped: bool) -> Scenes:
    clouds = pair_of(scene).target, pair_of(scene).source
    first, second = clouds[::-1] if swapped else clouds
    return scenes_of([Placement(Scan(first), Scan(second))], np.random.default_rng(0))


def told(scene: str, swapped: bool, stored: Array, found: Array | None = None) -> bool:
    standing = scenes(scene, swapped)
    reason = swapped_clouds(stored, found, standing, count(standing, stored))
    assert reason is None or reason.code == "swapped"
    return reason is not None


@pytest.mark.parametrize("scene", SCENES)
def test_what_stands_there_tells(scene: str) -> None:
    T = pair_of(scene).T_target_source
    assert told(scene, swapped=True, stored=T)
    assert not told(scene, swapped=False, stored=T)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("seed", range(3))
def test_a_movement_is_no_swap(scene: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = pair_of(scene).T_target_source
    step = np.r_[rng.normal(0, 0.1, 3), rng.normal(0, 0.5, 3)]
    for found in (None, T):
        assert not told(scene, swapped=False, stored=se3.retract(T, step), found=found)


def test_the_pose_of_the_poles_tells_first() -> None:
    T = pair_of("street").T_target_source
    reverse = se3.inverse(T)
    near = se3.retract(reverse, np.r_[np.zeros(3), 0.5 * NEAR_TRANSLATION, 0, 0])
    far = se3.retract(reverse, np.r_[np.zeros(3), 2.0 * NEAR_TRANSLATION, 0, 0])
    assert told("street", swapped=True, stored=T, found=near)
    assert not told("street", swapped=True, stored=T, found=far)


def test_back_to_back_either_order_is_right() -> None:
    half_turn = se3.from_rt(se3.exp_so3(np.array([0, 0, np.pi])), np.array([-3.0, 0, 0]))
    np.testing.assert_allclose(half_turn, se3.inverse(half_turn), atol=1e-12)
    assert not told("street", swapped=True, stored=half_turn, found=half_turn)


def test_sensors_tell_where_each_cloud_is_of_the_other() -> None:
    pair = pair_of("street")
    right, wrong = (SENSORS["VLP-16"], SENSORS["XT32"]), (SENSORS["XT32"], SENSORS["VLP-16"])
    placement = Placement(Scan(pair.source), Scan(pair.target))
    reason = swapped_sensors(placement, right)
    assert reason is not None
    assert "exchange them" in reason.message
    assert swapped_sensors(placement, (right[0], None)) is None
    assert swapped_sensors(Placement(Scan(pair.source), Scan(pair.source)), wrong) is None
