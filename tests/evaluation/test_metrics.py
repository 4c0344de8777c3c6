"""e_rt of plain errors, entropy against the double sum, scores near the truth."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from retropole import se3
from retropole.datatypes import PointCloud
from retropole.errors import Refusal
from retropole.evaluation.metrics import e_rt, evaluate, rqe


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


def cloud(n: int, seed: int) -> np.ndarray:
    """Points on a floor and a wall, denser towards the sensor, as scans are."""
    rng = np.random.default_rng(seed)
    floor = rng.normal(scale=(2.0, 2.0, 0.01), size=(n // 2, 3))
    wall = rng.normal(scale=(0.01, 2.0, 1.0), size=(n - n // 2, 3)) + np.array([3.0, 0, 1])
    return np.concatenate([floor, wall])


def plain_double_sum(xyz: np.ndarray, sigma: float) -> float:
    square = cdist(xyz, xyz, "sqeuclidean")
    kernel = np.exp(-square / (4 * sigma**2)) / (4 * np.pi * sigma**2) ** 1.5
    return float(kernel.sum() / len(xyz) ** 2)


@pytest.mark.parametrize("sigma", [0.01, 0.05, 0.5])
@pytest.mark.parametrize("n", [1, 200, 5000])
def test_entropy_is_the_plain_double_sum(n: int, sigma: float) -> None:
    xyz = cloud(n, 5)
    plain = plain_double_sum(xyz, sigma)
    truncated, exact = rqe(xyz, sigma), rqe(xyz, sigma, tolerance=0.0)
    assert truncated.sum == pytest.approx(plain, rel=1e-6)
    assert exact.sum == pytest.approx(plain, rel=1e-10)
    assert exact.error == 0.0
    assert truncated.log == pytest.approx(-np.log(plain), abs=1e-6)


def test_entropy_states_the_error_of_what_it_leaves_out() -> None:
    xyz = cloud(5000, 6)
    exact = rqe(xyz, 0.05, tolerance=0.0).sum
    for tolerance in (1e-3, 1e-1, 1.0):
        rough = rqe(xyz, 0.05, tolerance=tolerance)
        assert 0.0 <= 1.0 - rough.sum / exact <= rough.error <= tolerance


def test_entropy_does_not_depend_on_frame_or_order() -> None:
    rng = np.random.default_rng(7)
    xyz = cloud(3000, 7)
    moved = se3.apply(se3.random(rng), rng.permutation(xyz))
    assert rqe(moved).sum == pytest.approx(rqe(xyz).sum, rel=1e-6)


def test_the_entropy_of_nothing_is_refused() -> None:
    with pytest.raises(Refusal, match="no points"):
        rqe(np.zeros((0, 3)))


def test_the_truth_lies_more_crisply_than_anything_beside_it() -> None:
    rng = np.random.default_rng(8)
    T = se3.random(rng)
    target = PointCloud(cloud(20_000, 8))
    source = PointCloud(se3.apply(se3.inverse(T), cloud(20_000, 9)))
    right = evaluate(target, source, T, rng=np.random.default_rng(0))
    for step in (np.array([0, 0.02, 0, 0, 0, 0]), np.array([0, 0, 0, 0, 0, 0.1])):
        wrong = evaluate(target, source, se3.retract(T, step), rng=np.random.default_rng(0))
        assert right.entropy.sum > wrong.entropy.sum
        assert right.plane_residual is not None
        assert wrong.plane_residual is not None
        assert right.plane_residual < wrong.plane_residual


def test_nothing_overlaps_far_away() -> None:
    target, source = PointCloud(cloud(2000, 10)), PointCloud(cloud(2000, 11))
    T = np.eye(4)
    T[0, 3] = 500.0
    apart = evaluate(target, source, T, rng=np.random.default_rng(0))
    assert apart.overlap == 0.0
    assert apart.plane_residual is None
    together = evaluate(target, source, np.eye(4), rng=np.random.default_rng(0))
    assert together.overlap > 0.9
