"""All poses about one pole: the right one is found, and a pole that was moved is on none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import fft

from retropole.base import se3
from retropole.base.datatypes import Array, Match, Placement, Pole
from retropole.hypotheses import one_pole as about
from retropole.hypotheses.evidence import scenes_of
from retropole.hypotheses.one_pole import ANGLES, CELL_ABOUT_POLE, LAYERS, SLIDE, matches_about
from retropole.simulation import SimulatedPair
from retropole.surfaces.scans import find_poles

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
    spectrum = np.sum(about.spread(target, (ANGLES, LAYERS)) * other, axis=0)
    total = fft.irfft2(spectrum, s=(about.ANGLES, about.LAYERS))
    found = list(about._highest(total[:, np.r_[-SLIDE : SLIDE + 1]]))
    assert abs((np.degrees(found[0][0]) - turn + 180) % 360 - 180) <= 1.0
    assert abs(found[0][1] - slide) <= CELL_ABOUT_POLE
    assert found[0][2] > 2 * found[1][2]
