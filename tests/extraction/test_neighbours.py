"""A crossing pole, a wall behind and rings along a line are told from what only looks alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import DEFAULT_RADIUS, Array
from retropole.extraction import surroundings
from retropole.extraction.lines import MOST, SEARCH_ROOM
from retropole.extraction.surroundings import is_wall_behind, on_crossing_line, runs_along_sweep
from tests.extraction.synthetic import FOOT, UP, line_with, offset, on_pole

CROSSING_TUBE = DEFAULT_RADIUS + SEARCH_ROOM


def crossing(angle: float, count: int = 30) -> Array:
    """Points of a line that crosses the upright one, some away from it."""
    along = np.linspace(0.3, 1.0, count)
    return offset(0.05, along * np.sin(angle), along * np.cos(angle))


@pytest.mark.parametrize(
    ("factor", "is_crossing"), [(0.98, False), (1.02, True), (3.0, True), (8.0, True)]
)
def test_another_line_is_one_at_an_angle(factor: float, is_crossing: bool) -> None:
    beside = crossing(factor * surroundings.MIN_CROSSING_ANGLE)
    assert on_crossing_line(beside, line_with()).tolist() == [is_crossing] * len(beside)


def test_what_lies_off_the_other_line_is_not_on_it() -> None:
    other = crossing(0.5)
    off = other[::5] + np.array([0, 2 * CROSSING_TUBE / np.cos(0.5), 0])
    on_it = on_crossing_line(np.concatenate([other, off]), line_with())
    assert on_it[: len(other)].all()
    assert not on_it[len(other) :].any()


def test_the_other_line_is_fitted_to_all_its_points() -> None:
    """Through the two points that propose it, some of the others would be missed."""
    for seed in range(10):
        noise = np.random.default_rng(seed).normal(0, CROSSING_TUBE / 4, (60, 3))
        assert on_crossing_line(crossing(0.5, 60) + noise, line_with()).all()


def test_points_near_each_other_are_no_other_line() -> None:
    near = offset(0, 0.2, 0) + np.random.default_rng(0).uniform(0, 0.1, (20, 3))
    assert not on_crossing_line(near, line_with()).any()


def wall(distance: float, width: float = 0.35) -> Array:
    """Points on both sides of the pole, on a plane that passes it at some distance."""
    across, up = np.meshgrid(np.linspace(-width, width, 12), np.linspace(-0.8, 0.8, 20))
    return offset(distance, across.ravel(), up.ravel())


@pytest.mark.parametrize(("factor", "is_behind"), [(0.99, False), (1.01, True)])
def test_a_wall_is_behind_from_some_distance(factor: float, is_behind: bool) -> None:
    assert is_wall_behind(wall(factor * surroundings.MIN_WALL_GAP), on_pole(width=0)) is is_behind


@pytest.mark.parametrize("share", [0.95, 1.05])
def test_a_pole_that_leans_on_a_wall_leaves_it_in_part(share: float) -> None:
    """The wall is behind as far as the quantile of its distances says."""
    far = int(share * (1 - MOST) * 100)
    away = np.repeat([-1.1 * surroundings.MIN_WALL_GAP, 0.0], [far, 100 - far])
    assert is_wall_behind(wall(0.0), offset(away, 0.0, 0.0)) is (share > 1)


@pytest.mark.parametrize(("extra", "is_wall"), [(0.95, True), (1.05, False)])
def test_a_wall_is_most_of_what_lies_beside(extra: float, is_wall: bool) -> None:
    plane = wall(0.2)
    count = int(extra / 2 * len(plane) * (1 / MOST - 1))
    # In pairs, as far before the plane as behind it, so that they do not draw it away.
    off = np.array([1.5 * surroundings.PLANE_DISTANCE, 0, 0])
    pairs = [plane[:count] + off, plane[:count] - off]
    assert is_wall_behind(np.concatenate([plane, *pairs]), on_pole(width=0)) is is_wall


@pytest.mark.parametrize("before", [0.15, 0.2, 0.3])
def test_a_quarter_of_clutter_before_a_wall_does_not_hide_it(before: float) -> None:
    plane = wall(0.2)
    clutter = offset(0.2 - before, 0.35, np.linspace(-0.8, 0.8, len(plane) // 4))
    assert is_wall_behind(np.concatenate([plane, clutter]), on_pole(width=0))


def test_a_corner_is_no_wall() -> None:
    _, aside, up = (wall(0.0) - FOOT).T
    assert not is_wall_behind(offset(0.1 + 2 * np.abs(aside), aside, up), on_pole(width=0))


def scan_rows(ring_step: float, point_step: float = 0.01) -> Array:
    """Returns of a wall: rings one above the other, points next to each other on each."""
    across, up = np.meshgrid(np.arange(-0.4, 0.4, point_step), ring_step * np.arange(-3, 4))
    return offset(0.0, across.ravel(), up.ravel())


@pytest.mark.parametrize(("angle", "runs"), [(0.0, True), (np.pi / 2, False)])
def test_a_line_along_the_rings_runs_along_a_sweep(angle: float, runs: bool) -> None:
    """Level along the rings, or across them; nothing asks which way is up."""
    rotation = se3.exp_so3(np.array([np.pi / 2 - angle, 0, 0]))
    own = FOOT + (on_pole(0.6, 10, 1) - FOOT) @ rotation.T
    xyz = np.concatenate([own, scan_rows(0.1)])
    line = replace(line_with(10), direction=rotation @ UP)
    assert runs_along_sweep(xyz, np.arange(len(xyz)), line) is runs


def test_rings_as_close_as_their_returns_tell_nothing() -> None:
    rows = scan_rows(0.01)
    xyz = np.concatenate([on_pole(0.6, 10, 1), rows])
    assert not runs_along_sweep(xyz, np.arange(len(xyz)), line_with(10))


def test_few_returns_tell_nothing() -> None:
    least = surroundings.SWEEP_NEIGHBOURS**2
    column = offset(0.0, 0.2, np.linspace(0, 0.02 * (least - 1), least))
    xyz = np.concatenate([on_pole(0.6, 10, 1), column])
    assert runs_along_sweep(xyz, np.arange(len(xyz)), line_with(10))
    assert not runs_along_sweep(xyz, np.arange(len(xyz) - 1), line_with(10))
