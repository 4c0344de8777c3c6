"""What the others check of a contradiction, by the truth alone."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2, ncx2, norm

from benchmarks.contradiction_checks import (
    LEVEL,
    PER_FREEDOM,
    POWER,
    SEEN,
    Design,
    coordinates_are_checkable,
    least_found,
    lidar_is_checkable,
    pole_is_checkable,
    radius_is_checkable,
    survey_is_checkable,
)
from retropole.base import se3
from retropole.simulation import EXACT, SimulatedSite, Survey, simulate_site

pytestmark = pytest.mark.full


@cache
def made(points: int = 0, placements: tuple[int, ...] = (0, 1)) -> SimulatedSite:
    return simulate_site(
        "posts",
        np.random.default_rng(1),
        lidars=3,
        placements=2,
        sensors=("VLP-16",),
        noise=EXACT,
        survey=Survey(placements, points),
    )


def shift(x: float, y: float, z: float = 0.0) -> np.ndarray:
    return np.array([[x, y, z]] * 2)


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 6])
def test_the_least_that_is_found_is_found_with_the_power_requested(freedom: int) -> None:
    limit = max(PER_FREEDOM * freedom, float(chi2.isf(2.0 * norm.sf(LEVEL), freedom)))
    size = least_found(freedom)
    if freedom == 1:
        assert size == pytest.approx((LEVEL + 0.8416) ** 2, rel=1e-3)
    assert ncx2.sf(limit, freedom, size) == pytest.approx(POWER, abs=1e-6)
    assert least_found(freedom + 1) > size


def test_what_lies_beyond_the_least_error_is_checked_and_what_lies_below_is_not() -> None:
    site = made()
    name = site.surveyed[0].name
    found = [survey_is_checkable(site, name, shift(size, 0.0)) for size in (0.0, 0.02, 0.3, 3.0)]
    assert found == [False, False, True, True]


def test_along_a_pole_nobody_sees_where_its_end_is() -> None:
    site = made()
    pole = site.surveyed[0]
    assert pole.foot is not None
    assert pole.top is not None
    along = pole.top - pole.foot
    assert not survey_is_checkable(site, pole.name, np.array([along, along]))


def test_three_points_do_not_tell_that_one_is_off_their_plane() -> None:
    """They fix a frame; in their plane the distance of the other two tells which is off."""
    site = made(3, ())
    a, b, c = (point.at for point in site.true_points)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    aside = (b - a) / np.linalg.norm(b - a)
    assert not survey_is_checkable(site, "C1", 5.0 * normal[None])
    assert survey_is_checkable(site, "C1", 5.0 * aside[None])
    (normal,) = np.linalg.svd(np.array([a, b, c]) - (a + b + c) / 3)[2][2:]
    assert survey_is_checkable(made(6, ()), "C1", 5.0 * normal[None])


def test_a_pole_is_checked_where_others_see_it_where_it_was() -> None:
    """And where its LiDAR sees enough others: of three, each may be the one that moved."""
    site = made()
    push = se3.from_rt(np.eye(3), np.array([0.12, 0.0, 0.0]))
    # The second LiDAR sees all poles of both placements, the third those of one.
    assert pole_is_checkable(site, (1, 0), [1], push)
    assert not any(any(own) for own in site.seen[0][2:])
    assert not pole_is_checkable(site, (1, 0), [2], push)
    # Nobody else sees it, and it was not surveyed: where it stood is no question.
    alone = ((False, True, True), (True, True, True), (False, True, True))
    bare = replace(site, seen=(site.seen[0], alone), surveyed=(), true_surveyed=())
    assert not pole_is_checkable(bare, (1, 0), [1], push)


def test_a_common_movement_of_all_that_is_seen_is_taken_up() -> None:
    """Whoever moves all values as a rigid body says nothing."""
    design = Design(made(4))
    T = se3.from_rt(se3.exp_so3(np.array([1e-3, -2e-3, 1e-3])), np.array([0.02, 0.01, -0.03]))
    moved = {
        k: (se3.apply(T, one.at[None])[0] - one.at)[:, None]
        for k, one in enumerate(design.values)
        if one.lidar == 0
    }
    left = design.left(design.whitened(moved))
    # Second order of the turn, some micrometres.
    assert float(np.sum(left**2)) < 1e-3 * (0.01 / SEEN) ** 2


def test_coordinates_as_a_rigid_body() -> None:
    rng = np.random.default_rng(0)
    true = rng.normal(scale=[8.0, 8.0, 1.0], size=(5, 3))
    R = se3.exp_so3(rng.normal(size=3))
    assert not coordinates_are_checkable(list(true), list(true @ R.T + 3.0))
    assert coordinates_are_checkable(list(true), list(true[:, [1, 0, 2]]))
    assert coordinates_are_checkable(list(true), list(true * 1000.0))
    # A plane is the mirror image of itself.
    flat = true * [1.0, 1.0, 0.0]
    assert not coordinates_are_checkable(list(flat), list(flat[:, [1, 0, 2]]))


def test_a_lidar_that_recorded_once_cannot_have_moved_between() -> None:
    site = made()
    assert lidar_is_checkable(site, 1)
    clouds = (site.clouds[0], (site.clouds[1][0], None), site.clouds[2])
    assert not lidar_is_checkable(replace(site, clouds=clouds), 1)


def test_far_poles_do_not_tell_their_width() -> None:
    site = made()
    assert radius_is_checkable(site)
    far = tuple(T @ se3.from_rt(np.eye(3), np.array([0, 0, 400.0])) for T in site.T_world_lidar)
    assert not radius_is_checkable(replace(site, T_world_lidar=far))
