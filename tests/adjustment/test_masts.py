"""LiDARs on one mast rest as one, and those on separate masts are not mistaken for it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from retropole.adjustment.masts import common_motion, on_one_mast, with_masts
from retropole.base import se3
from retropole.base.datatypes import Array, Placement, Scan
from retropole.hypotheses.scans import SiteScans
from tests.surfaces.swaying import HALF, scan_on_mast, swaying
from tests.tiers import first_of

pytestmark = pytest.mark.full

SIGMA = float(np.radians(0.1))


def test_those_that_hang_on_one_mast_rest_as_one_and_others_stay() -> None:
    rng = np.random.default_rng(0)
    masts = swaying(10, SIGMA, 0.3, rng), swaying(10, SIGMA, 0.3, rng)
    poses = {k: se3.random(rng, 1.0) for k in range(4)}
    hang = (0, 1, 0, 0)
    scans = [scan_on_mast(masts[hang[k]], T, rng) for k, T in poses.items()]
    # Of the second placement only one is there.
    rows = tuple((scan, scan if k == 1 else None) for k, scan in enumerate(scans))
    found = with_masts(SiteScans(rows, np.zeros((4, 3))), poses).by_lidar
    for k, (first, second) in enumerate(found):
        assert first is not None
        assert first.sway is not None
        assert first.sway.is_shared == (hang[k] == 0)
        assert (first is scans[k]) == (hang[k] == 1)
        assert second is rows[k][1]
    again = with_masts(SiteScans(rows, np.zeros((4, 3))), {1: poses[1]}).by_lidar
    assert again == rows


SIGMA_ONE_MAST = float(np.radians(0.1))
AT = np.array([1.5, -2.0, 0.4])
"""Of the source in the hall; the target is in its middle."""


@cache
def on_masts(
    seed: int, *, one: bool, frequency: float = 0.3, sweeps: int = 10
) -> tuple[Placement, Array]:
    """Record with two LiDARs; the pose between them, too."""
    rng = np.random.default_rng(seed)
    T = se3.random(rng, 3.0)
    T[:3, 3] = AT
    motion = swaying(sweeps, SIGMA_ONE_MAST, frequency, rng)
    other = motion if one else swaying(sweeps, SIGMA_ONE_MAST, frequency, rng)
    return Placement(scan_on_mast(motion, np.eye(4), rng), scan_on_mast(other, T, rng)), T


def error_of(placement: Placement, T: Array) -> Array:
    """(6,) by how much what lies at rest by the one LiDAR does not by the other, `T` being true."""
    both = zip(placement.scans, (np.eye(4), T), strict=True)
    target, source = (_from_walls(scan.cloud.transformed(pose).xyz) for scan, pose in both)
    return target - source


def _from_walls(xyz: Array) -> Array:
    """(6,) turn and shift that lay returns on the walls of the hall."""
    axis = np.argmin(np.abs(HALF - np.abs(xyz)), axis=1)
    normal = np.eye(3)[axis]
    side = np.sign(np.take_along_axis(xyz, axis[:, None], 1)[:, 0])
    residual = side * HALF[axis] - np.einsum("ni,ni->n", xyz, normal)
    lever = np.concatenate([np.cross(xyz, normal), normal], axis=1)
    kept = np.abs(residual) < 0.05
    return np.asarray(np.linalg.lstsq(lever[kept], residual[kept], rcond=None)[0])


@pytest.mark.parametrize("seed", first_of(range(2)))
def test_lidars_on_one_mast_rest_as_one(seed: int) -> None:
    """A third of a period: alone, each rests where it may."""
    alone, T = on_masts(seed, one=True)
    (shared,) = on_one_mast([alone], T)
    assert shared is not alone
    assert all(scan.sway is not None and scan.sway.is_shared for scan in shared.scans)
    before, after = (np.linalg.norm(error_of(each, T)[:3]) for each in (alone, shared))
    assert after < SIGMA_ONE_MAST / 20
    assert after < before
    sways = [scan.sway for scan in shared.scans if scan.sway is not None]
    assert all(np.linalg.eigvalsh(np.asarray(each.covariance)).min() > -1e-15 for each in sways)
    # They are told and drawn as one; to which side an angle counts is of each.
    target, source = sways
    assert source.angle_rad == pytest.approx(target.angle_rad, rel=0.05)
    first, other = (np.array(each.angles_rad) for each in sways)
    assert np.abs(other) == pytest.approx(np.abs(first), abs=SIGMA_ONE_MAST / 10)


@pytest.mark.parametrize(
    ("seed", "frequency"), first_of([(seed, hz) for hz in (1.0, 0.3) for seed in range(2)])
)
def test_lidars_on_masts_of_their_own_are_left_alone(seed: int, frequency: float) -> None:
    alone, T = on_masts(seed, one=False, frequency=frequency)
    placements = [alone]
    assert on_one_mast(placements, T) is placements


def test_it_does_not_matter_which_is_the_target_and_what_was_done_before() -> None:
    alone, T = on_masts(0, one=True)
    (once,) = on_one_mast([alone], T)
    (twice,) = on_one_mast([once], T)
    (swapped,) = on_one_mast([Placement(alone.source, alone.target)], se3.inverse(T))
    for again, close in ((twice, 1e-5), (Placement(swapped.source, swapped.target), 1e-4)):
        step = error_of(again, T) - error_of(once, T)
        assert np.abs(step[:3]).max() < close
    back = common_motion((alone.source, alone.target), (np.eye(4), se3.inverse(T)))
    assert back.odds == pytest.approx(common_motion(alone.scans, (np.eye(4), T)).odds, abs=3.0)


def test_recordings_of_other_times_do_not_sway_as_one() -> None:
    """By the clock of the recorder; a third of a period later the mast goes another way."""
    alone, T = on_masts(0, one=True, frequency=1.0)
    later = replace(alone.source.cloud, recorded=(101.0, 102.0))
    target = replace(alone.target, cloud=replace(alone.target.cloud, recorded=(100.7, 101.7)))
    placements = [Placement(target, replace(alone.source, cloud=later))]
    assert on_one_mast(placements, T) is placements


def test_one_that_stands_is_on_no_mast() -> None:
    alone, T = on_masts(0, one=True)
    still = Scan(alone.source.cloud)
    placements = [Placement(alone.target, still)]
    assert on_one_mast(placements, T) is placements
