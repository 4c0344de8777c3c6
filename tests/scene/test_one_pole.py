"""One pole that both LiDARs see: the place gives the rest of the pose, or there is no answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import fft

from retropole.alignment.adjustment import PLACE_SIGMA
from retropole.base import se3
from retropole.base.datatypes import Array, Match, Placement, Pole, PoseEstimate
from retropole.base.errors import Refusal
from retropole.matching.placements import PairedPlacement
from retropole.pipeline import calibrate
from retropole.scene import one_pole
from retropole.scene.by_place import check_held
from retropole.scene.confirmation import scenes_of
from retropole.scene.disambiguation import score_hypotheses
from retropole.scene.one_pole import CELL, SLIDE, matches_about
from retropole.scene.refinement import refine
from retropole.scene.scans import find_poles
from retropole.simulation import SimulatedPair, simulate_pair

WOOD = np.random.default_rng(0).uniform([-20, -20, -3], [20, 20, 8], (3000, 3))
"""Points about a pole: nothing repeats."""

SCENES = {"corridor": 3, "street": 1, "harbor": 2}
MOVED = se3.from_rt(se3.exp_so3(np.array([0.5, -2.0, 0.3])), np.array([3.0, 2.0, 1.0]))


@pytest.fixture(scope="module", params=sorted(SCENES))
def pair(request: pytest.FixtureRequest) -> SimulatedPair:
    return simulate_pair(request.param, np.random.default_rng(SCENES[request.param]), poles=1)


@pytest.fixture(scope="module")
def street() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(1), poles=1)


def found_in(pair: SimulatedPair) -> Placement:
    return Placement(
        find_poles(pair.target, sensor=None, threshold=None, radius=0.02),
        find_poles(pair.source, sensor=None, threshold=None, radius=0.02),
    )


def poses_in(placement: Placement) -> list[Match]:
    (standing,) = scenes_of([placement], np.random.default_rng(0))
    return matches_about(placement, standing, 0.02)


def assert_near(T: Array | None, T_true: Array, degrees: float = 0.3, metres: float = 0.05) -> None:
    assert T is not None
    off = se3.difference(T, T_true)
    assert np.degrees(off.rotation) < degrees
    assert off.translation < metres


def test_one_pole_gives_the_truth_where_the_place_tells(pair: SimulatedPair) -> None:
    answer = calibrate(pair.target, pair.source)
    assert answer.status == "ok", answer.reasons
    assert_near(answer.T_target_source, pair.T_target_source)
    assert answer.covariance is not None
    off = se3.local(answer.T_target_source, pair.T_target_source)
    assert off @ np.linalg.solve(answer.covariance, off) < 22.5
    assert [len(h.match.pairs) for h in answer.hypotheses[:1]] == [1]
    (note,) = [note for note in answer.notes if note.code == "by_place"]
    assert note.values["poles"] == 1
    assert "nearly_parallel_poles" not in {each.code for each in answer.notes}


def test_swapping_the_clouds_inverts_the_answer(pair: SimulatedPair) -> None:
    there, back = calibrate(pair.target, pair.source), calibrate(pair.source, pair.target)
    assert there.T_target_source is not None
    assert_near(back.T_target_source, se3.inverse(there.T_target_source), 0.05, 0.02)


def test_moving_both_clouds_moves_the_answer(street: SimulatedPair) -> None:
    moved = calibrate(street.target.transformed(MOVED), street.source)
    assert_near(moved.T_target_source, MOVED @ street.T_target_source)
    moved = calibrate(street.target, street.source.transformed(MOVED))
    assert_near(moved.T_target_source, street.T_target_source @ se3.inverse(MOVED))


def test_bare_ground_gives_no_answer() -> None:
    bare = simulate_pair("bare", np.random.default_rng(0), poles=1)
    answer = calibrate(bare.target, bare.source)
    assert answer.status == "refused"
    assert answer.T_target_source is None


def test_a_place_that_a_half_turn_about_the_pole_changes_nothing_of_gives_no_answer(
    street: SimulatedPair,
) -> None:
    """The place and its like, turned by half a turn about the pole, in both clouds."""
    (pole,) = street.poles
    about = se3.from_rt(
        se3.exp_so3(np.pi * pole.axis), pole.centre - se3.exp_so3(np.pi * pole.axis) @ pole.centre
    )
    clouds = []
    for cloud, pose in (
        (street.target, street.T_world_target),
        (street.source, street.T_world_source),
    ):
        turn = se3.inverse(pose) @ about @ pose
        number = np.tile(np.arange(len(cloud)), 2)
        xyz = np.concatenate([cloud.xyz, se3.apply(turn, cloud.xyz)])
        clouds.append(replace(cloud.select(number), xyz=xyz))
    answer = calibrate(clouds[0], clouds[1])
    assert answer.status == "refused"


def test_files_of_two_places_give_no_answer(street: SimulatedPair) -> None:
    other = simulate_pair("harbor", np.random.default_rng(2), poles=1)
    assert calibrate(street.target, other.source).status == "refused"


def test_the_number_of_poles_that_was_asked_for_counts(street: SimulatedPair) -> None:
    assert calibrate(street.target, street.source, poles=1).status == "ok"
    refused = calibrate(street.target, street.source, poles=2)
    assert refused.status == "refused"
    assert refused.reasons[0].code == "too_few_poles"


def test_without_the_scene_two_poles_are_needed(street: SimulatedPair) -> None:
    refused = calibrate(street.target, street.source, scene=False)
    assert refused.reasons[0].code == "too_few_poles"


def test_the_sign_of_a_pole_does_not_matter(street: SimulatedPair) -> None:
    placement = found_in(street)
    for scan in placement.scans:
        assert scan.detection is not None
        poles = tuple(replace(pole, direction=-pole.direction) for pole in scan.poles)
        turned = replace(scan, detection=replace(scan.detection, poles=poles))
        each = (
            Placement(turned, placement.source)
            if scan is placement.target
            else Placement(placement.target, turned)
        )
        best = poses_in(each)[0]
        assert best.exact
        assert_near(best.T_target_source, street.T_target_source, 1.0, 0.1)


def test_a_pole_that_was_moved_is_on_no_pole_where_the_scenes_lie_on_each_other(
    street: SimulatedPair,
) -> None:
    placement = found_in(street)
    (pole,) = placement.source.poles
    moved = _carried(pole, np.array([0.8, 0.5, 0.0]))
    assert placement.source.detection is not None
    source = replace(
        placement.source, detection=replace(placement.source.detection, poles=(moved,))
    )
    matches = poses_in(Placement(placement.target, source))
    assert matches
    assert not any(match.exact for match in matches)
    # All are poses that lay the pole on the pole: what the place is compared at.
    for match in matches:
        away = se3.apply(match.T_target_source, moved.xyz) - placement.target.poles[0].point
        across = np.cross(away, placement.target.poles[0].direction)
        assert np.sqrt(np.mean(np.sum(across**2, axis=1))) < 0.05


def _carried(pole: Pole, step: Array) -> Pole:
    return replace(pole, point=pole.point + step, xyz=pole.xyz + step)


@pytest.mark.parametrize("is_flipped", [False, True])
@pytest.mark.parametrize(("turn", "slide"), [(0.0, 0.0), (40.0, 1.5), (200.0, -3.5)])
def test_the_highest_peak_is_where_the_points_are(
    turn: float, slide: float, is_flipped: bool
) -> None:
    T = one_pole._screw(np.radians(turn), slide, is_flipped)
    target, source = (
        one_pole._spectrum(points) for points in (WOOD, se3.apply(se3.inverse(T), WOOD))
    )
    other = source if is_flipped else np.conj(source)
    spectrum = np.sum(one_pole._spread(target) * other, axis=0)
    total = fft.irfft2(spectrum, s=(one_pole.ANGLES, one_pole.LAYERS))
    found = list(one_pole._highest(total[:, np.r_[-SLIDE : SLIDE + 1]]))
    assert abs((np.degrees(found[0][0]) - turn + 180) % 360 - 180) <= 1.0
    assert abs(found[0][1] - slide) <= CELL
    assert found[0][2] > 2 * found[1][2]


def test_a_pose_that_the_scene_holds_no_better_than_was_assumed_is_refused(
    street: SimulatedPair,
) -> None:
    placement = found_in(street)
    scans = placement.target.cloud, placement.source.cloud
    (hypothesis, *_) = score_hypotheses(*scans, poses_in(placement))
    paired = [PairedPlacement(placement, hypothesis)]
    with pytest.raises(Refusal, match="too few surfaces") as refused:
        check_held(paired, None)
    assert refused.value.code == "degenerate_poles"
    T = hypothesis.match.T_target_source
    refined = refine(*scans, PoseEstimate(T, np.diag(PLACE_SIGMA**2), 0.01))
    check_held(paired, refined)
    assert refined is not None
    for k in range(6):
        variance = np.diag(refined.pose.covariance).copy()
        variance[k] = (0.6 * PLACE_SIGMA[k]) ** 2
        loose = PoseEstimate(T, np.diag(variance), 0.01)
        with pytest.raises(Refusal, match="hold the pose to"):
            check_held(paired, replace(refined, pose=loose))
    two = replace(hypothesis, match=replace(hypothesis.match, by_place=False))
    check_held([PairedPlacement(placement, two)], None)
