import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from retropole.alignment.point_to_line import (
    Lines,
    align_each,
    equivalent_points,
    point_line_residuals,
)
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import Refusal
from studies.paper.estimator import align_poles

Line = tuple[Array, Array]


def skew_lines(rng: np.random.Generator, count: int = 2) -> list[Line]:
    lines = []
    for k in range(count):
        direction = np.array([0.0, 0, 1]) + 0.4 * rng.normal(size=3)
        point = np.array([4.0, 2.0 * k - 1, 0]) + 0.3 * rng.normal(size=3)
        lines.append((point, direction / np.linalg.norm(direction)))
    return lines


def points_on(lines: list[Line], T_source_target: Array) -> list[Array]:
    along = np.linspace(-1, 1, 15)[:, None]
    return [se3.apply(T_source_target, p + along * n) for p, n in lines]


def test_jacobian_equals_finite_differences() -> None:
    rng = np.random.default_rng(1)
    T, points = se3.random(rng), rng.normal(size=(7, 3))
    q, n = rng.normal(size=(7, 3)), rng.normal(size=(7, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    _, jacobian = point_line_residuals(T, points, q, n)
    eps = 1e-6
    for k in range(6):
        step = np.zeros(6)
        step[k] = eps
        up, _ = point_line_residuals(se3.retract(T, step), points, q, n)
        down, _ = point_line_residuals(se3.retract(T, -step), points, q, n)
        np.testing.assert_allclose(jacobian[:, :, k], (up - down) / (2 * eps), atol=1e-8)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_exact_on_exact_data(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_true = se3.random(rng, 3.0)
    lines = skew_lines(rng)
    points = points_on(lines, se3.inverse(T_true))
    start = se3.retract(T_true, np.r_[0.1 * rng.normal(size=3), 0.2 * rng.normal(size=3)])
    fit = align_poles(lines, points, start)
    np.testing.assert_allclose(fit.T_target_source, T_true, atol=1e-9)
    assert fit.rms < 1e-9


def test_the_order_of_points_and_poles_does_not_matter() -> None:
    rng = np.random.default_rng(2)
    T_true, lines = se3.random(rng), skew_lines(rng, 3)
    points = [p + 0.01 * rng.normal(size=p.shape) for p in points_on(lines, se3.inverse(T_true))]
    one = align_poles(lines, points, T_true)
    other = align_poles(lines[::-1], [rng.permutation(p) for p in points[::-1]], T_true)
    np.testing.assert_allclose(one.T_target_source, other.T_target_source, atol=1e-9)


def test_many_sets_of_poles_at_once_are_aligned_as_each_alone() -> None:
    """Of unlike numbers of poles: what a set has fewer than another stands for no return."""
    rng = np.random.default_rng(12)
    lines = [skew_lines(rng, count) for count in (2, 4, 3)]
    poses = [se3.random(rng) for _ in lines]
    points = [
        [p + 0.01 * rng.normal(size=p.shape) for p in points_on(own, se3.inverse(T))]
        for own, T in zip(lines, poses, strict=True)
    ]
    ones = np.ones((3, 24, 3))
    filled = Lines(ones, ones.copy(), ones.copy(), np.zeros((3, 24)))
    for k, (own, xyz) in enumerate(zip(lines, points, strict=True)):
        n = 6 * len(own)
        filled.on_poles[k, :n] = np.concatenate([equivalent_points(each) for each in xyz])
        filled.line_points[k, :n] = np.repeat([q for q, _ in own], 6, axis=0)
        filled.line_directions[k, :n] = np.repeat([n for _, n in own], 6, axis=0)
        filled.counts[k, :n] = np.repeat([len(each) / 6 for each in xyz], 6)
    found = align_each(filled, np.stack(poses))
    for fit, own, xyz, T in zip(found, lines, points, poses, strict=True):
        alone = align_poles(own, xyz, T)
        assert fit.converged == alone.converged
        np.testing.assert_allclose(fit.T_target_source, alone.T_target_source, atol=1e-9)
        np.testing.assert_allclose(fit.information, alone.information, rtol=1e-6, atol=1e-6)
        assert fit.rms == pytest.approx(alone.rms, rel=1e-9)


def test_moving_either_side_moves_the_answer_along() -> None:
    rng = np.random.default_rng(3)
    T_true, lines = se3.random(rng), skew_lines(rng)
    points = [p + 0.01 * rng.normal(size=p.shape) for p in points_on(lines, se3.inverse(T_true))]
    fit = align_poles(lines, points, T_true)
    A, B = se3.random(rng), se3.random(rng)
    moved = align_poles(
        [(se3.apply(A, p[None])[0], A[:3, :3] @ n) for p, n in lines],
        [se3.apply(B, p) for p in points],
        A @ T_true @ se3.inverse(B),
    )
    expected = A @ fit.T_target_source @ se3.inverse(B)
    np.testing.assert_allclose(moved.T_target_source, expected, atol=1e-8)
    assert moved.rms == pytest.approx(fit.rms, rel=1e-6)


def test_parallel_lines_are_refused() -> None:
    up = np.array([0.0, 0, 1])
    lines = [(np.array([4.0, -1, 0]), up), (np.array([4.0, 1, 0]), up)]
    with pytest.raises(Refusal) as refusal:
        align_poles(lines, points_on(lines, np.eye(4)), np.eye(4))
    assert refusal.value.code == "degenerate_poles"


@pytest.mark.parametrize("radius", [1e-2, 1e-5, 1e-11])
def test_the_error_vanishes_with_the_radius(radius: float) -> None:
    """Points on the side of a pole that faces the sensor bias the pose in proportion to it."""
    rng = np.random.default_rng(8)
    T_true, lines = se3.random(rng, 2.0), skew_lines(rng)
    along = np.linspace(-1, 1, 15)[:, None]

    def facing(origin: Array, p: Array, n: Array) -> Array:
        toward = origin - p - ((origin - p) @ n) * n
        return p + along * n + radius * toward / np.linalg.norm(toward)

    seen = [facing(np.zeros(3), p, n) for p, n in lines]
    fitted = [(xyz.mean(axis=0), n) for xyz, (_, n) in zip(seen, lines, strict=True)]
    there = [facing(T_true[:3, 3], p, n) for p, n in lines]
    points = [se3.apply(se3.inverse(T_true), xyz) for xyz in there]
    fit = align_poles(fitted, points, T_true)
    error = np.abs(se3.local(fit.T_target_source, T_true)).max()
    assert error < 50 * radius + 1e-12
    if radius <= 1e-11:
        assert error < 1e-9


def test_six_points_stand_for_many() -> None:
    rng = np.random.default_rng(9)
    xyz = rng.normal(size=(40, 3)) * [0.01, 0.02, 1.0] + rng.normal(size=3)
    six = equivalent_points(xyz)
    for _ in range(5):
        T, q, n = se3.random(rng), rng.normal(size=3), rng.normal(size=3)
        n /= np.linalg.norm(n)
        sums = []
        for points in (xyz, six):
            lines = np.broadcast_to(q, points.shape), np.broadcast_to(n, points.shape)
            residuals, jacobian = point_line_residuals(T, points, *lines)
            H = np.einsum("nij,nik->jk", jacobian, jacobian)
            sums.append([np.mean(np.sum(residuals**2, axis=1)), *(H / len(points)).ravel()])
        np.testing.assert_allclose(sums[1], sums[0], rtol=1e-9, atol=1e-9)
