"""Lines are proposed through what lies in line, and fitted to what lies along them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retropole.base import se3
from retropole.base.datatypes import Array, IntArray, PointCloud
from retropole.extraction.lines import (
    LINK,
    MANY,
    MIN_POLE_POINTS,
    PATCH_RADIUS,
    RING_GAP,
    TUBE,
    clusters,
    fit_line,
    fit_lines,
    in_canonical_order,
    line_coordinates,
    on_surface,
    principal_line,
    propose_lines,
    to_nearest,
)
from tests.extraction.synthetic import FOOT, UP, offset, on_pole, upright_places

RADIUS = 0.02
Y: Array = np.array([0.0, 1.0, 0.0])
SHELL = (RADIUS + TUBE, 0.35)


def propose(xyz: Array) -> list[tuple[Array, Array]]:
    ordered = xyz[in_canonical_order(xyz, np.arange(len(xyz)))]
    return propose_lines(ordered, 0.25, 4.0, 0.06, SHELL)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_canonical_order_follows_motion_and_shuffle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xyz = rng.normal(size=(30, 3))
    order = rng.permutation(30)
    there = se3.apply(se3.random(rng), xyz)[order]
    index = np.arange(30)
    np.testing.assert_array_equal(
        in_canonical_order(xyz, index), order[in_canonical_order(there, index)]
    )


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_distance_and_place_are_those_of_the_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xyz, point, direction = rng.normal(size=(20, 3)), rng.normal(size=3), rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    distance, along = line_coordinates(xyz, point, direction)
    foot = point + along[:, None] * direction
    np.testing.assert_allclose((xyz - foot) @ direction, 0, atol=1e-9)
    np.testing.assert_allclose(distance, np.linalg.norm(xyz - foot, axis=1), atol=1e-7)


def test_principal_line_is_the_nearest() -> None:
    rng = np.random.default_rng(3)
    xyz = on_pole() + 0.01 * rng.normal(size=(32, 3))
    point, direction = principal_line(xyz)
    least = np.sum(line_coordinates(xyz, point, direction)[0] ** 2)
    for _ in range(50):
        other = direction + 0.02 * rng.normal(size=3)
        other /= np.linalg.norm(other)
        assert np.sum(line_coordinates(xyz, point, other)[0] ** 2) >= least


@given(seed=st.integers(0, 2**32 - 1))
def test_the_nearest_place_is_the_nearest_of_all(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places, candidates = rng.normal(size=int(rng.integers(2, 9))), 3 * rng.normal(size=20)
    every = np.abs(candidates[:, None] - places)
    np.testing.assert_array_equal(to_nearest(places, candidates), every.min(axis=1))


def test_the_pole_is_proposed_first_and_each_line_once() -> None:
    strays = np.random.default_rng(0).uniform(-2, 2, (20, 3)) + FOOT
    proposals = propose(np.concatenate([on_pole(), strays]))
    assert abs(proposals[0][1] @ UP) > np.cos(np.radians(3))
    upright = [d for p, d in proposals if abs(d @ UP) > 0.999 and np.hypot(*(p - FOOT)[:2]) < 0.02]
    assert len(upright) == 1


def test_two_poles_are_two_proposals() -> None:
    leaning = se3.apply(se3.from_rt(se3.exp_so3(np.array([0.6, 0, 0])), np.zeros(3)), on_pole())
    directions = [d for _, d in propose(np.concatenate([on_pole(), leaning + Y]))[:2]]
    assert {bool(abs(d @ UP) > 0.99) for d in directions} == {True, False}


def test_points_near_each_other_propose_nothing() -> None:
    assert propose(FOOT + np.random.default_rng(0).uniform(0, 0.1, (50, 3))) == []


def test_two_points_are_no_line() -> None:
    assert propose(np.array([[4.0, 0, 0], [4.0, 0, 1.0]])) == []


def test_map_coordinates_propose_the_same_lines() -> None:
    xyz = on_pole()
    shift = np.array([448_000.0, 5_410_000.0, 300.0])
    (point, direction), *_ = propose(xyz)
    (there, same), *_ = propose(xyz + shift)
    assert abs(direction @ same) == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(np.cross(there - shift - point, direction), 0, atol=1e-6)


def fitted(xyz: Array, ring: IntArray | None = None) -> tuple[int, float, int]:
    cloud = PointCloud(xyz, np.ones(len(xyz)), ring)
    line = fit_line(cloud, np.arange(len(xyz)), FOOT, UP, RADIUS)
    return len(line.index), line.length, line.rings


def test_fit_recovers_a_line_from_a_rough_guess() -> None:
    xyz = on_pole()
    cloud = PointCloud(xyz, np.ones(len(xyz)))
    guess = UP + 0.08 * Y
    line = fit_line(cloud, np.arange(len(xyz)), FOOT, guess / np.linalg.norm(guess), RADIUS)
    assert abs(line.direction @ UP) == pytest.approx(1, abs=1e-9)
    assert len(line.index) == 32
    assert line.length == pytest.approx(1.6)
    assert line.rms == pytest.approx(0.01)
    assert line.step == pytest.approx(1.6 / 15)


@pytest.mark.parametrize("tilt", [0.0, 0.1, 0.2])
def test_fit_does_not_depend_on_the_guess(tilt: float) -> None:
    """Where something touches the pole, the fit ends at one line from guesses 11° apart."""
    touching = offset(0, 0.1, np.linspace(0.2, 0.8, 10))
    xyz = np.concatenate([on_pole(), touching])
    cloud, guess = PointCloud(xyz, np.ones(len(xyz))), UP + tilt * Y
    index = np.arange(len(xyz))
    line = fit_line(cloud, index, FOOT, guess / np.linalg.norm(guess), RADIUS)
    right = fit_line(cloud, index, FOOT, UP, RADIUS)
    np.testing.assert_array_equal(line.index, right.index)
    assert abs(line.direction @ right.direction) == pytest.approx(1, abs=1e-9)


def test_each_guess_gives_what_it_gives_alone() -> None:
    """Two poles, what touches one of them, and guesses near to one, to the other and to none."""
    touching = offset(0, 0.1, np.linspace(0.2, 0.8, 10))
    other = on_pole() + 1.5 * Y + 2.5 * UP * (np.arange(32)[:, None] > 28)
    xyz = np.concatenate([on_pole(), touching, other])
    cloud, index = PointCloud(xyz, np.ones(len(xyz))), np.arange(len(xyz))
    leaning = UP + 0.15 * Y
    leaning /= np.linalg.norm(leaning)
    guesses = [
        (FOOT, UP),
        (FOOT + 1.5 * Y, UP),
        (FOOT - 3.0 * Y, UP),
        (FOOT, leaning),
        (FOOT + 0.75 * Y, Y),
    ]
    together = fit_lines(cloud, index, guesses, RADIUS)
    for guess, line in zip(guesses, together, strict=True):
        alone = fit_line(cloud, index, *guess, RADIUS)
        np.testing.assert_array_equal(line.index, alone.index)
        np.testing.assert_allclose(line.along, alone.along, atol=1e-12)
        assert line.rms == pytest.approx(alone.rms, abs=1e-12)
        distance, _ = line_coordinates(xyz[line.index], line.point, line.direction)
        assert np.all(distance <= line.tube)
    # The first has what touches it, the second ends at a gap, and by the third is nothing.
    assert [len(line.index) for line in together[:3]] == [42, 29, 0]


def test_fit_leaves_out_what_lies_next_to() -> None:
    beside = offset(0, 0.1, np.array([-0.3, -0.2, 0.1]))
    assert fitted(np.concatenate([on_pole(), beside]))[0] == 32


@pytest.mark.parametrize(("gap", "count"), [(0.99 * LINK, 35), (1.01 * LINK, 32)])
def test_a_gap_just_longer_than_the_limit_parts(gap: float, count: int) -> None:
    beyond = upright_places(0.8 + gap + np.array([0.0, 0.01, 0.02]))
    assert fitted(np.concatenate([on_pole(), beyond]))[0] == count


def test_no_points_near_the_guess_are_an_empty_line() -> None:
    assert fitted(on_pole() + Y) == (0, 0.0, 0)


def test_rings_are_counted_by_number_where_there_are_any() -> None:
    ring: IntArray = np.repeat(np.arange(16, dtype=np.int64), 2)
    assert fitted(on_pole(), ring)[2] == 16
    assert fitted(on_pole(), ring // 4)[2] == 4


@pytest.mark.parametrize(("spacing", "rings"), [(1.05 * RING_GAP, 21), (0.95 * RING_GAP, 19)])
def test_without_numbers_rings_are_gaps_along_the_line(spacing: float, rings: int) -> None:
    """Rings nearer than the gap fill a length; it counts as one ring for each gap."""
    assert fitted(on_pole(length=20 * spacing, rings=21))[2] == rings


def test_fit_follows_the_cloud() -> None:
    cloud = PointCloud(on_pole(), np.ones(32))
    T = se3.random(np.random.default_rng(5), 20.0)
    index = np.arange(32)
    here = fit_line(cloud, index, FOOT, UP, RADIUS)
    moved = replace(cloud, xyz=se3.apply(T, cloud.xyz))
    there = fit_line(moved, index, se3.apply(T, FOOT[None])[0], T[:3, :3] @ UP, RADIUS)
    np.testing.assert_allclose(there.point, se3.apply(T, here.point[None])[0])
    assert abs(there.direction @ T[:3, :3] @ here.direction) == pytest.approx(1)
    assert there.length == pytest.approx(here.length)
    assert there.rms == pytest.approx(here.rms)
    assert there.rings == here.rings


def sizes(groups: list[IntArray]) -> list[int]:
    return [len(group) for group in groups]


@pytest.mark.parametrize("count", [200, 5 * MANY])
def test_clusters_are_what_short_steps_connect(count: int) -> None:
    rng = np.random.default_rng(1)
    place = rng.integers(0, 3, count)
    xyz = rng.uniform(0, 1, (count, 3)) + place[:, None] * [5.0, 0, 0]
    groups = clusters(xyz, LINK)
    assert sizes(groups) == sorted(np.bincount(place), reverse=True)
    assert all(len(np.unique(place[group])) == 1 for group in groups)
    assert sorted(np.concatenate(groups)) == list(range(count))


def test_no_points_are_no_cluster() -> None:
    assert clusters(np.zeros((0, 3)), LINK) == []


@pytest.mark.parametrize(("step", "count"), [(0.99 * LINK, 1), (1.01 * LINK, 12)])
def test_a_step_just_longer_than_the_link_divides(step: float, count: int) -> None:
    chain = np.arange(12)[:, None] * [step, 0, 0]
    assert len(clusters(chain, LINK)) == count


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_motion_and_order_change_no_cluster(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-4, 4, (60, 3))
    order = rng.permutation(60)
    there = se3.apply(se3.random(rng, 50.0), xyz)[order]
    assert {frozenset(group) for group in clusters(xyz, LINK)} == {
        frozenset(order[group]) for group in clusters(there, LINK)
    }


def plate(width: float, step: float = 0.03, distance: float = 5.0) -> Array:
    """Points of an upright plate 1.5 m high."""
    across, up = np.meshgrid(np.arange(0, width, step), np.arange(0, 1.5, step))
    return np.stack([np.full(across.size, distance), across.ravel(), up.ravel()], axis=1)


def test_a_plate_is_a_surface_and_a_pole_is_not() -> None:
    wide, slim = plate(1.5), plate(0.12, distance=9.0)
    inside = on_surface(np.concatenate([wide, slim]))
    from_edge = np.min([wide[:, 1], 1.5 - wide[:, 1], wide[:, 2], 1.5 - wide[:, 2]], axis=0)
    assert inside[: len(wide)][from_edge > PATCH_RADIUS].all()
    assert not inside[len(wide) :].any()


@pytest.mark.parametrize(
    ("count", "is_surface"), [(MIN_POLE_POINTS, True), (MIN_POLE_POINTS - 1, False)]
)
def test_few_points_tell_no_surface(count: int, is_surface: bool) -> None:
    bearing = 2 * np.pi * np.arange(count) / count
    ring = 0.14 * np.stack([np.cos(bearing), np.sin(bearing), np.zeros(count)], axis=1)
    assert on_surface(ring).tolist() == [is_surface] * count
