"""Shifts along the ground: found where they are, whatever the frame."""

import numpy as np
import pytest

from retropole import se3
from retropole.datatypes import Placement, Scan
from retropole.scene.consistency import consistency_of
from retropole.scene.shifts import NEAR, best_shift
from retropole.simulation import simulate_pair

POINTS = np.random.default_rng(0).uniform([-15, -15, 0.5], [15, 15, 4], (1500, 3))
"""A wood: nothing repeats."""
UP = np.array([0.0, 0.0, 1.0])


def test_a_shift_along_the_ground_is_found() -> None:
    for step in ([2.0, -1.0, 0.0], [-4.5, 3.0, 0.0], [0.0, 0.75, 0.0]):
        off = se3.from_rt(np.eye(3), np.array(step))
        found = best_shift(POINTS, POINTS, UP, off)
        assert found is not None
        np.testing.assert_allclose(found.step, -np.array(step), atol=0.26)
        assert found.gain > 3


def test_at_the_right_pose_no_shift_is_better() -> None:
    found = best_shift(POINTS, POINTS, UP, np.eye(4))
    assert found is not None
    assert found.gain < 0.5
    assert np.linalg.norm(found.step) > NEAR


def test_the_frame_does_not_matter() -> None:
    off = se3.from_rt(se3.exp_so3(np.array([0, 0, 0.4])), np.array([2.0, -1.0, 0.0]))
    source = se3.apply(se3.inverse(off), POINTS + np.array([3.0, 1.0, 0.0]))
    turn = se3.from_rt(se3.exp_so3(np.array([0.5, -1.0, 0.3])), np.array([3.0, 2.0, 1.0]))
    plain = best_shift(POINTS, source, UP, off)
    turned = best_shift(se3.apply(turn, POINTS), source, turn[:3, :3] @ UP, turn @ off)
    assert plain is not None
    assert turned is not None
    np.testing.assert_allclose(plain.step, [-3.0, -1.0, 0.0], atol=0.26)
    np.testing.assert_allclose(turned.step, turn[:3, :3] @ [-3.0, -1.0, 0.0], atol=0.5)


def test_nothing_to_compare_gives_nothing() -> None:
    assert best_shift(POINTS, np.zeros((0, 3)), UP, np.eye(4)) is None


@pytest.mark.parametrize("scene", ["corridor", "street"])
def test_walls_that_slide_along_themselves_do_not_hide_a_shift(scene: str) -> None:
    """Along the place, where a pose is denied by little, another one fits better."""
    for seed in range(2):
        pair = simulate_pair(scene, np.random.default_rng(seed))
        placement = Placement(Scan(pair.target, None, None), Scan(pair.source, None, None))
        T, rng = pair.T_target_source, np.random.default_rng(0)
        along = pair.T_world_target[:3, :3].T @ np.array([2.0, 0.0, 0.0])
        assert consistency_of([placement], T, rng).better_at is None
        found = consistency_of([placement], se3.retract(T, np.r_[0, 0, 0, along]), rng)
        assert found.better_at is not None
        assert 1.7 < found.better_at < 2.3
