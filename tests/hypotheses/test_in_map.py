"""A LiDAR in a map: cars do not draw it, and what a registration rests on is found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from retropole.adjustment.refinement import refine
from retropole.alignment.adjustment import SURROUNDINGS_SIGMA
from retropole.base import se3
from retropole.base.datatypes import Array, Placement, PointCloud, PoseEstimate, Scan
from retropole.hypotheses.by_place import DETERMINED, REGISTRATION_SIGMA, is_constrained
from retropole.hypotheses.in_map import registered_in_map, scatter_without_parts
from tests.tiers import first_of

ALONG = np.eye(6)[:, 3:4]
"""The direction along the street, which its fronts and the ground leave open."""


def trunk(rng: np.random.Generator, at: Sequence[float], count: int = 1500) -> Array:
    """Points (N, 3) all around a trunk."""
    angle = rng.uniform(0, 2 * np.pi, count)
    around = at + 0.2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(np.c_[around, rng.uniform(-2, 4, count)])


def street(
    rng: np.random.Generator,
    trunks: Sequence[Sequence[float]],
    moved: float = 0.0,
    shorter: float = 15.0,
) -> PointCloud:
    """Ground, two fronts along x and trunks, with 1 cm of noise; one front moved, one shorter."""
    ground = np.c_[rng.uniform(-15, 15, (12_000, 2)), np.full(12_000, -2.0)]
    fronts = [
        np.c_[rng.uniform(-half, half, n), np.full(n, y), rng.uniform(-2, 3, n)]
        for y, half, n in ((-6.0, shorter, int(400 * shorter)), (6.0 + moved, 15.0, 6000))
    ]
    xyz = np.concatenate([ground, *fronts, *(trunk(rng, at) for at in trunks)])
    return PointCloud(xyz + rng.normal(0, 0.01, xyz.shape), is_map=True)


TRUNKS = (-9.0, 4.0), (7.0, 4.5), (2.0, -5.0), (-8.0, -4.5)


def along(now: Sequence[Sequence[float]]) -> tuple[float, float | None]:
    """Register along a street whose trunks may have moved: how far it is off, and 1 σ, metres."""
    rng = np.random.default_rng(4)
    given, seen = street(rng, TRUNKS[: len(now)]), street(rng, now)
    T = registered_in_map(Placement(Scan(given), Scan(seen)), np.eye(4))
    found = scatter_without_parts(given, seen, T, ALONG, SURROUNDINGS_SIGMA, DETERMINED)
    sigma = None if found is None else SURROUNDINGS_SIGMA[3] * float(np.sqrt(found[0, 0]))
    return float(se3.local(T, np.eye(4))[3]), sigma


@pytest.mark.full
def test_trunks_on_all_sides_give_the_position_along_a_street() -> None:
    off, sigma = along(TRUNKS)
    assert sigma is not None
    assert abs(off) < 3 * sigma < 0.05


@pytest.mark.full
def test_one_trunk_alone_does_not() -> None:
    assert along(TRUNKS[:1])[1] is None


@pytest.mark.full
@pytest.mark.parametrize("moved", first_of([0.2, -0.1, 0.05]))
def test_a_trunk_that_moved_is_covered_or_not_relied_on(moved: float) -> None:
    (x, y), *others = TRUNKS
    off, sigma = along([(x + moved, y), *others])
    assert sigma is None or abs(off) < 2 * sigma


def test_in_a_map_cars_that_parked_elsewhere_do_not_draw_a_registration() -> None:
    rng = np.random.default_rng(6)
    ground = np.c_[rng.uniform(-15, 15, (40_000, 2)), np.full(40_000, -2.0)]
    trunks = np.concatenate([trunk(rng, at) for at in ((-9.0, 4.0), (7.0, 5.0), (2.0, -8.0))])
    cars = rng.uniform([4, -5, -1.9], [8, -3, -0.4], (6000, 3))
    cars[:, 0] = np.where(rng.random(6000) < 0.5, 4.0, 8.0)
    now = np.concatenate([ground, trunks, cars + np.array([0.2, 0.0, 0.0])])
    scans = [
        Scan(PointCloud(np.concatenate([ground, trunks, cars]), is_map=True)),
        Scan(PointCloud(now)),
    ]
    found = registered_in_map(Placement(scans[0], scans[1]), np.eye(4))
    assert np.linalg.norm(found[:3, 3]) < 0.03


@pytest.mark.full
@pytest.mark.parametrize(("moved", "shorter"), first_of([(0.2, 15.0), (-0.2, 7.0)]))
def test_a_front_that_moved_by_20_cm_does_not_draw_a_pose_that_counts(
    moved: float, shorter: float
) -> None:
    """The pose is right, or nothing says where across the street it is, which is refused."""
    rng = np.random.default_rng(1)
    given, seen = street(rng, TRUNKS, 0.0, shorter), street(rng, TRUNKS, moved, shorter)
    T = registered_in_map(Placement(Scan(given), Scan(seen)), np.eye(4))
    found = refine(given, seen, PoseEstimate(T, np.diag(REGISTRATION_SIGMA**2), 0.01))
    assert found is not None
    off = np.linalg.norm(found.pose.T_target_source[:3, 3])
    assert off < 0.03 or not is_constrained(found.held)
