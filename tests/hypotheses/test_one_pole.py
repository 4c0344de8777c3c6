"""All poses about one pole: the right one is found, and a pole that was moved is on none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import fft
from scipy.spatial import cKDTree

from retropole.base import se3
from retropole.base.datatypes import (
    Array,
    Calibration,
    Match,
    Placement,
    PointCloud,
    Pole,
)
from retropole.base.errors import UsageError
from retropole.hypotheses import one_pole as about
from retropole.hypotheses.evidence import scenes_of
from retropole.hypotheses.icp_refinement import registered
from retropole.hypotheses.one_pole import (
    ANGLES,
    CELL,
    RINGS,
    SETTLES,
    SLIDE,
    matches_about,
)
from retropole.hypotheses.prior import PosePrior
from retropole.pipeline import Options, calibrate
from retropole.simulation import SimulatedPair
from retropole.surfaces.consistency import SceneObjects
from retropole.surfaces.registration import prepare, voxel_downsample
from retropole.surfaces.scans import find_poles
from retropole.surfaces.visibility import SCORING_VOXEL, range_image
from tests.hypotheses.conftest import simulated_with_one_pole
from tests.tiers import first_of

WOOD = np.random.default_rng(0).uniform([-20, -20, -3], [20, 20, 8], (3000, 3))
"""Points about a pole: nothing repeats."""

MOVED = se3.from_rt(se3.exp_so3(np.array([0.5, -2.0, 0.3])), np.array([3.0, 2.0, 1.0]))


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


@pytest.mark.parametrize("turn_deg", first_of([60.0, 0.0, 90.0, 165.0, 180.0, 270.0, 345.0]))
def test_the_highest_peak_over_the_ground_is_where_the_points_are(turn_deg: float) -> None:
    """Whichever of the four quarter turns it is in."""
    rng = np.random.default_rng(1)
    points = rng.uniform([-20, -20, 0.4], [20, 20, 6.0], (3000, 3))
    T = se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, np.radians(turn_deg)])), np.array([3.0, -4, 0]))
    origin = np.array([0.0, 0.0, 2.0])
    seen = []
    for pose in (np.eye(4), T):
        own = se3.apply(se3.inverse(pose), points)
        image = range_image(PointCloud(own, origin=origin))
        number = np.zeros(len(own), dtype=np.int64)
        up = np.array([0.0, 0.0, 1.0])
        seen.append(SceneObjects(own, number, cKDTree(own), image, np.zeros(3), up))
    best, second, *_ = about._ground_peaks(seen[0], seen[1], PosePrior())
    assert_near(best.T, T, degrees=0.01, metres=0.01)
    assert best.height > 2.0 * second.height


def test_a_registration_that_moves_too_far_ends(one_pole: SimulatedPair) -> None:
    """It comes to where it would without a limit, or, from too far away, to nothing."""
    target, source = one_pole.target.xyz, one_pole.source.xyz
    surface = prepare(target, SCORING_VOXEL)
    tree, points = cKDTree(surface.xyz), voxel_downsample(source, SCORING_VOXEL)
    T = one_pole.T_target_source
    off = se3.retract(T, np.array([0.0, 0.0, np.radians(1.5), 0.2, 0.0, 0.0]))
    free, held = (registered(surface, tree, points, off, near=n) for n in (None, SETTLES))
    assert_near(free, T)
    assert free is not None
    assert_near(held, free, degrees=0.01, metres=0.001)
    narrow = se3.PoseDifference(float(np.radians(0.5)), 1.0)
    assert registered(surface, tree, points, off, near=narrow) is None


@pytest.mark.full
def test_the_sign_of_a_pole_does_not_matter(one_pole: SimulatedPair) -> None:
    placement = found_in(one_pole)
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
        assert_near(best.T_target_source, one_pole.T_target_source, 1.0, 0.1)


def test_a_pole_that_was_moved_is_on_no_pole_where_the_scenes_lie_on_each_other(
    one_pole: SimulatedPair,
) -> None:
    placement = found_in(one_pole)
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
    T = about._screw(np.radians(turn), slide, is_flipped)
    target, source = (about._spectrum(points) for points in (WOOD, se3.apply(se3.inverse(T), WOOD)))
    other = source if is_flipped else np.conj(source)
    spectrum = np.sum(about.spread(target, (ANGLES, RINGS)) * other, axis=0)
    total = fft.irfft2(spectrum, s=(about.ANGLES, about.RINGS))
    found = list(about._highest(total[:, np.r_[-SLIDE : SLIDE + 1]]))
    assert abs((np.degrees(found[0][0]) - turn + 180) % 360 - 180) <= 1.0
    assert abs(found[0][1] - slide) <= CELL
    assert found[0][2] > 2 * found[1][2]


STEEP = se3.from_rt(se3.exp_so3(np.radians([70.0, 0.0, 0.0])), np.zeros(3))
"""Tilts a LiDAR by more than LiDARs are tilted as a rule."""


def bare(cloud: PointCloud) -> PointCloud:
    """Leave out the intensity: no pole could be found."""
    return replace(cloud, intensity=None)


def by_the_place(pair: SimulatedPair) -> Calibration:
    return calibrate(bare(pair.target), bare(pair.source), options=Options(poles=0))


@pytest.fixture(
    scope="module",
    params=[("street", 1), pytest.param(("harbor", 2), marks=pytest.mark.full)],
    ids=lambda each: each[0],
)
def pair(request: pytest.FixtureRequest) -> SimulatedPair:
    return simulated_with_one_pole(*request.param)


@pytest.fixture(scope="module")
def answer(pair: SimulatedPair) -> Calibration:
    return by_the_place(pair)


@pytest.mark.full
def test_the_place_gives_the_truth(pair: SimulatedPair, answer: Calibration) -> None:
    assert answer.status != "refused", answer.reasons
    assert_near(answer.T_target_source, pair.T_target_source)
    assert answer.T_target_source is not None
    assert answer.covariance is not None
    off = se3.local(answer.T_target_source, pair.T_target_source)
    assert off @ np.linalg.solve(answer.covariance, off) < 22.5
    # Nothing is said of poles that nobody looked for.
    assert answer.poles is None
    assert answer.radius is None
    assert answer.hypotheses[0].match.pairs == ()
    assert "without_poles" in {reason.code for reason in answer.reasons}


@pytest.mark.full
def test_frames_and_order_of_the_lidars_do_not_matter(
    pair: SimulatedPair, answer: Calibration
) -> None:
    back = calibrate(
        bare(pair.source), bare(pair.target.transformed(MOVED)), options=Options(poles=0)
    )
    assert answer.T_target_source is not None
    there = se3.inverse(MOVED @ answer.T_target_source)
    assert_near(back.T_target_source, there, 0.05, 0.02)


@pytest.mark.full
def test_the_ground_of_a_steep_lidar_is_not_taken_for_a_wall(pair: SimulatedPair) -> None:
    steep = replace(pair.source.transformed(STEEP), axis=pair.source.axis)
    answer = calibrate(bare(pair.target), bare(steep), options=Options(poles=0))
    assert_near(answer.T_target_source, pair.T_target_source @ se3.inverse(STEEP))


@pytest.mark.full
def test_what_the_place_does_not_tell_is_refused(pair: SimulatedPair) -> None:
    ground = simulated_with_one_pole("bare", 0)
    refused = by_the_place(replace(pair, source=ground.source))
    assert refused.status == "refused"
    assert refused.T_target_source is None
    assert "set up two poles" in refused.reasons[0].message


def test_one_of_poles_and_scene_must_give_the_pose(pair: SimulatedPair) -> None:
    with pytest.raises(UsageError, match="scene must determine the pose"):
        calibrate(pair.target, pair.source, options=Options(poles=0, scene=False))
