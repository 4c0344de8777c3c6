"""The error of eq. 12 against transforms whose error is plain."""

import numpy as np
import pytest

from retropole import se3
from retropole.evaluation import e_rt


def test_zero_for_the_truth() -> None:
    T = se3.random(np.random.default_rng(0))
    assert e_rt(T, T) == 0.0


def test_a_shift_is_its_length() -> None:
    T_true = se3.random(np.random.default_rng(1))
    T = T_true.copy()
    T[:3, 3] += [0.03, 0.0, 0.04]
    assert e_rt(T, T_true) == pytest.approx(0.05)


def test_a_turn_across_y_grows_with_the_range() -> None:
    T_true = se3.random(np.random.default_rng(2))
    turn = np.eye(4)
    turn[:3, :3] = se3.exp_so3(np.array([0.0, 0.0, 0.001]))
    assert e_rt(T_true @ turn, T_true) == pytest.approx(0.001 * 30.5, rel=1e-4)


def test_a_turn_about_y_is_not_seen() -> None:
    T_true = se3.random(np.random.default_rng(3))
    turn = np.eye(4)
    turn[:3, :3] = se3.exp_so3(np.array([0.0, 0.5, 0.0]))
    assert e_rt(T_true @ turn, T_true) == pytest.approx(0.0, abs=1e-12)


def test_it_does_not_depend_on_the_target_frame() -> None:
    rng = np.random.default_rng(4)
    T, T_true, A = se3.random(rng), se3.random(rng), se3.random(rng)
    assert e_rt(A @ T, A @ T_true) == pytest.approx(e_rt(T, T_true))
    assert e_rt(T_true, T) == pytest.approx(e_rt(T, T_true))
