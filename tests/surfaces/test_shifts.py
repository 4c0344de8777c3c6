"""Shifts along the ground and off it: found where they are, whatever the frame."""

from itertools import combinations

import numpy as np
from scipy.ndimage import maximum_filter

from retropole.base import se3
from retropole.surfaces.consistency import (
    PEAKS,
    SAME_SHIFT,
    _with_neighbours,
    best_lifts,
    best_shifts,
)

POINTS = np.random.default_rng(0).uniform([-15, -15, 0.5], [15, 15, 4], (1500, 3))
"""A wood: nothing repeats."""
UP = np.array([0.0, 0.0, 1.0])


def test_a_shift_along_the_ground_is_found() -> None:
    for step in ([2.0, -1.0, 0.0], [-4.5, 3.0, 0.0], [0.0, 0.75, 0.0]):
        off = se3.from_rt(np.eye(3), np.array(step))
        found = best_shifts(POINTS, POINTS, UP, off)[0]
        np.testing.assert_allclose(found.step, -np.array(step), atol=0.26)
        assert found.gain > 3


def test_at_the_right_pose_no_shift_is_better() -> None:
    found = best_shifts(POINTS, POINTS, UP, np.eye(4))
    assert len(found) == PEAKS
    gains = [shift.gain for shift in found]
    assert gains == sorted(gains, reverse=True)
    assert gains[0] < 0.5
    steps = [np.zeros(3), *(shift.step for shift in found)]
    assert all(np.abs(a - b).max() > SAME_SHIFT for a, b in combinations(steps, 2))


def test_a_lift_off_the_ground_is_found_in_any_frame() -> None:
    turn = se3.from_rt(se3.exp_so3(np.array([0.5, -1.0, 0.3])), np.array([3.0, 2.0, 1.0]))
    for lift in (-2.1, 0.8, 5.5):
        off = se3.from_rt(np.eye(3), np.array([0.0, 0.0, lift]))
        for T in (np.eye(4), turn):
            up = T[:3, :3] @ UP
            found = best_lifts(se3.apply(T, POINTS), POINTS, up, T @ off)[0]
            np.testing.assert_allclose(found.step, -lift * up, atol=0.26)
            assert found.gain > 2
    assert max(shift.gain for shift in best_lifts(POINTS, POINTS, UP, np.eye(4))) < 0.5


def test_the_frame_does_not_matter() -> None:
    off = se3.from_rt(se3.exp_so3(np.array([0, 0, 0.4])), np.array([2.0, -1.0, 0.0]))
    source = se3.apply(se3.inverse(off), POINTS + np.array([3.0, 1.0, 0.0]))
    turn = se3.from_rt(se3.exp_so3(np.array([0.5, -1.0, 0.3])), np.array([3.0, 2.0, 1.0]))
    plain = best_shifts(POINTS, source, UP, off)[0]
    turned = best_shifts(se3.apply(turn, POINTS), source, turn[:3, :3] @ UP, turn @ off)[0]
    np.testing.assert_allclose(plain.step, [-3.0, -1.0, 0.0], atol=0.26)
    np.testing.assert_allclose(turned.step, turn[:3, :3] @ [-3.0, -1.0, 0.0], atol=0.5)


def test_nothing_to_compare_gives_nothing() -> None:
    for find in (best_shifts, best_lifts):
        assert find(POINTS, np.zeros((0, 3)), UP, np.eye(4)) == []


def test_a_cell_and_its_neighbours_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    for shape in ((1, 1), (1, 9), (7, 2), (30, 40)):
        grid = (rng.random(shape) < 0.1).astype(np.float32)
        np.testing.assert_array_equal(_with_neighbours(grid.copy()), maximum_filter(grid, 3))
