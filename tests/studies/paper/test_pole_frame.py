"""Section IV-A: proper rotations that map what they must, at their singular cases too."""

import numpy as np
import pytest

from retropole.base import se3
from studies.paper.equations import both_casts
from studies.paper.pole_frame import in_pole_frame, turn_onto_x, turn_upright

pytestmark = pytest.mark.full

TINY = [0.0, 1e-300, 1e-160, 1e-20, 1e-16, 1e-9, 1e-8, 1e-5, 1e-2, 1.0]
"""Distances from a singular case."""


def assert_proper(R: se3.Array) -> None:
    assert pytest.approx(np.eye(3), abs=1e-14) == R @ R.T
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("off", TINY)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_stands_any_pole_upright(off: float, side: float) -> None:
    for bearing in np.linspace(0, 2 * np.pi, 9):
        n = np.array([off * np.cos(bearing), off * np.sin(bearing), side])
        n /= np.linalg.norm(n)
        A = turn_upright(n)
        assert_proper(A)
        assert A @ n == pytest.approx([0.0, 0.0, -1.0], abs=1e-14)


@pytest.mark.parametrize("off", TINY)
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("length", [1e-3, 1.0, 1e4])
def test_r_turns_any_lidar_onto_x(off: float, side: float, length: float) -> None:
    for sign in (1.0, -1.0):
        v = length * np.array([side, sign * off, 0.0])
        R = turn_onto_x(v)
        assert_proper(R)
        assert R @ v == pytest.approx([np.linalg.norm(v), 0.0, 0.0], abs=1e-14 * length)
        assert pytest.approx([0, 0, -1], abs=1e-14) == R @ [0, 0, 1], "it keeps the axis on z"


def test_r_has_a_limit_on_minus_x_and_a_has_none_at_e_z() -> None:
    at = turn_onto_x(np.array([-1.0, 0.0, 0.0]))
    for off in (1e-12, -1e-12):
        assert turn_onto_x(np.array([-1.0, off, 0.0])) == pytest.approx(at, abs=1e-11)
    along_x, along_y = (turn_upright(np.array(n)) for n in ([1e-12, 0, 1], [0, 1e-12, 1]))
    assert np.abs(along_x - along_y).max() > 1.0
    assert turn_upright(np.array([0.0, 0.0, 1.0])) == pytest.approx(along_x, abs=1e-11)


def test_general_directions_and_positions() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        n, v = rng.normal(size=3), rng.normal(size=3)
        n /= np.linalg.norm(n)
        assert_proper(turn_upright(n))
        assert turn_upright(n) @ n == pytest.approx([0, 0, -1], abs=1e-14)
        assert_proper(turn_onto_x(v))
        assert turn_onto_x(v) @ v == pytest.approx([np.linalg.norm(v), 0, 0], abs=1e-14)


def test_the_frame_is_that_of_the_model() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        pose, point, n = se3.random(rng), rng.normal(size=3), rng.normal(size=3)
        n /= np.linalg.norm(n)
        frame = in_pole_frame(pose, point, n)
        across = pose[:3, 3] - point - n * (n @ (pose[:3, 3] - point))
        distance = float(np.linalg.norm(across))
        assert frame.L_star[2, 3] == 0.0
        assert np.linalg.norm(frame.L_star[:2, 3]) == pytest.approx(distance)
        assert frame.L_hat[:3, 3] == pytest.approx([distance, 0, 0], abs=1e-12)
        assert frame.T_pole_world @ pose == pytest.approx(frame.L_hat, abs=1e-12)
        on_axis = se3.apply(frame.T_pole_world, point + np.outer([-3.0, 0.0, 5.0], n))
        assert on_axis[:, :2] == pytest.approx(0.0, abs=1e-12)
        assert on_axis[2, 2] - on_axis[0, 2] == pytest.approx(8.0), "it keeps the pole's direction"


def test_points_by_the_frame_are_those_cast_where_pole_and_lidar_stand() -> None:
    rng = np.random.default_rng(2)
    seen = 0
    for _ in range(20):
        pose = se3.random(rng, 4.0)
        point, n = pose[:3, 3] + rng.uniform(1, 3, 3), rng.normal(size=3)
        there, back = both_casts(pose, point, n / np.linalg.norm(n), 0.05)
        assert there.shape == back.shape
        seen += len(there)
        if len(there):
            assert np.abs(there - back).max() < 1e-9
    assert seen > 1000


def test_a_lidar_on_the_axis_is_refused() -> None:
    with pytest.raises(ValueError, match="on the axis"):
        in_pole_frame(np.eye(4), np.array([0.0, 0.0, 2.0]), np.array([0.0, 0.0, 1.0]))
