import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.se3 import joint_of, relative, relative_jacobian
from tests.numeric import numeric_jacobian

seeds = st.integers(0, 2**32 - 1)
# Angles at and around the singular places of the exponential: none, tiny, and a half turn.
angles = st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, 0.3, 1.5, np.pi - 1e-3, np.pi - 1e-7])


@given(seeds)
def test_inverse_undoes(seed: int) -> None:
    T = se3.random(np.random.default_rng(seed))
    np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(T @ se3.inverse(T), np.eye(4), atol=1e-12)


@given(seeds)
def test_apply_is_a_group_action(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B, points = se3.random(rng), se3.random(rng), rng.normal(size=(5, 3))
    np.testing.assert_allclose(
        se3.apply(A @ B, points), se3.apply(A, se3.apply(B, points)), atol=1e-11
    )


@given(seeds, angles)
def test_log_inverts_exp(seed: int, angle: float) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    phi = angle * axis / np.linalg.norm(axis)
    R = se3.exp_so3(phi)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(se3.log_so3(R), phi, atol=1e-8)
    assert se3.rotation_angle(R) == pytest.approx(angle, abs=1e-8)


@given(seeds, angles)
def test_local_inverts_retract(seed: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    T, step = se3.random(rng), rng.normal(size=6)
    step[:3] *= angle / np.linalg.norm(step[:3])
    np.testing.assert_allclose(se3.local(T, se3.retract(T, step)), step, atol=1e-7)


@given(seeds, st.sampled_from([0.0, 1e-8, 1e-4, 1e-3, 0.3, 1.5, 3.0]))
def test_local_jacobian_is_its_derivative(seed: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    T, step = se3.random(rng), rng.normal(size=6)
    step[:3] *= angle / np.linalg.norm(step[:3])
    there = se3.retract(T, step)
    by = 1e-6
    columns = [
        (se3.local(T, se3.retract(there, way)) - se3.local(T, se3.retract(there, -way))) / (2 * by)
        for way in by * np.eye(6)
    ]
    np.testing.assert_allclose(np.stack(columns, 1), se3.local_jacobian(step), atol=1e-7)


def test_many_steps_at_once_are_those_one_by_one() -> None:
    rng = np.random.default_rng(0)
    T, there = np.array([[se3.random(rng) for _ in range(4)] for _ in range(2)])
    there[0] = T[0]
    steps = se3.local(T, there)
    np.testing.assert_allclose(steps, [*map(se3.local, T, there)], atol=1e-15)
    alone = [*map(se3.local_jacobian, steps)]
    np.testing.assert_allclose(se3.local_jacobian(steps), alone, atol=1e-15)
    alone = [*map(relative_jacobian, T, there)]
    np.testing.assert_array_equal(relative_jacobian(T, there), alone)


@given(seeds)
def test_hat_is_the_cross_product(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", se3.hat(a), b), np.cross(a, b), atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1))
def test_along_principal_axes_points_spread_independently_and_ever_wider(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(20, 3)) @ rng.normal(size=(3, 3)) + rng.normal(size=3)
    centre, axes = se3.principal_axes(points)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    spread = np.cov((points - centre) @ axes, rowvar=False)
    np.testing.assert_allclose(spread, np.diag(np.diag(spread)), atol=1e-9 * np.trace(spread))
    assert np.all(np.diff(np.diag(spread)) >= 0)


def test_quaternion_order_is_xyzw() -> None:
    T = se3.from_quaternion_xyzw(np.array([0.0, 0.0, 1.0, 1.0]), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(se3.apply(T, np.array([[1.0, 0, 0]])), [[1.0, 3.0, 3.0]], atol=1e-15)


def test_random_rotations_are_proper() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        T = se3.random(rng, 2.0)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
        assert np.abs(T[:3, 3]).max() <= 2.0


@pytest.mark.parametrize(
    "angle", [0.0, 1e-200, 1e-12, 1e-6, 0.1, 1.5, 2.8, 3.1, np.pi - 1e-7, np.pi]
)
def test_rotations_are_those_of_scipy(angle: float) -> None:
    rng = np.random.default_rng(3)
    axes = rng.normal(size=(50, 3))
    phi = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    theirs = Rotation.from_rotvec(phi)
    R = theirs.as_matrix()
    np.testing.assert_allclose(se3.exp_so3(phi), R, atol=3e-15)
    np.testing.assert_allclose(se3.exp_so3(se3.log_so3(R)), R, atol=3e-15)
    np.testing.assert_allclose(np.linalg.norm(se3.log_so3(R), axis=1), angle, rtol=1e-8, atol=1e-15)
    q = se3.quaternion_xyzw(R)
    assert (q[:, 3] >= 0).all()
    # At half a turn both signs of the axis are the same.
    np.testing.assert_allclose(np.abs(np.sum(q * theirs.as_quat(), axis=1)), 1.0, atol=3e-15)
    for one, own in zip(R, q, strict=True):
        np.testing.assert_allclose(
            se3.from_quaternion_xyzw(2 * own, np.ones(3))[:3, :3], one, atol=3e-15
        )


def test_roll_pitch_and_yaw_are_those_of_scipy() -> None:
    for rpy in np.random.default_rng(4).uniform(-3, 3, (50, 3)):
        theirs = Rotation.from_euler("xyz", rpy).as_matrix()
        np.testing.assert_allclose(se3.rotation_from_rpy(rpy), theirs, atol=3e-15)


def drawn(seed: int) -> tuple[Array, Array, Array]:
    """Draw two poses, and a covariance of both that ties them to each other."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(12, 12)) * np.tile([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3], 2)[:, None]
    return se3.random(rng), se3.random(rng), mixing @ mixing.T


@pytest.mark.parametrize("seed", range(5))
def test_the_pose_maps_points_of_one_into_the_other(seed: int) -> None:
    T_i, T_j, joint = drawn(seed)
    points = np.random.default_rng(seed).normal(size=(4, 3))
    found = relative(T_i, T_j, joint)
    np.testing.assert_allclose(
        se3.apply(T_i, se3.apply(found.T_i_j, points)), se3.apply(T_j, points), atol=1e-12
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_covariance_is_that_of_finite_differences(seed: int) -> None:
    T_i, T_j, joint = drawn(seed)
    T_i_j = se3.inverse(T_i) @ T_j

    def moved(step: Array) -> Array:
        there = se3.inverse(se3.retract(T_i, step[:6])) @ se3.retract(T_j, step[6:])
        return se3.local(T_i_j, there)

    J = numeric_jacobian(moved, 12)
    np.testing.assert_allclose(relative(T_i, T_j, joint).covariance, J @ joint @ J.T, rtol=1e-5)


def test_the_covariance_is_that_of_drawn_poses() -> None:
    T_i, T_j, joint = drawn(7)
    rng = np.random.default_rng(8)
    T_i_j, covariance = relative(T_i, T_j, joint)
    steps = rng.multivariate_normal(np.zeros(12), joint, 4000)
    errors = [
        se3.local(T_i_j, se3.inverse(se3.retract(T_i, s[:6])) @ se3.retract(T_j, s[6:]))
        for s in steps
    ]
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), np.transpose(errors))
    # 1 σ of an entry of a sampled covariance is 0.016 to 0.022.
    np.testing.assert_allclose(np.cov(whitened), np.eye(6), atol=0.1)


def test_what_moves_the_whole_site_leaves_the_relative_pose_as_it_is() -> None:
    # A step of the frame itself: both poses turn about its origin, and shift, together.
    T_i, T_j, _ = drawn(3)
    turn = [np.vstack([np.eye(3), -se3.hat(T[:3, 3])]) for T in (T_i, T_j)]
    shift = np.vstack([np.zeros((3, 3)), np.eye(3)])
    common = np.hstack([np.vstack(turn), np.vstack([shift, shift])])
    found = relative(T_i, T_j, common @ common.T)
    np.testing.assert_allclose(found.covariance, 0.0, atol=1e-12)


def test_in_the_frame_of_the_first_the_pose_of_the_second_is_as_it_stands() -> None:
    _, T_j, joint = drawn(4)
    joint[:6], joint[:, :6] = 0.0, 0.0
    found = relative(np.eye(4), T_j, joint)
    np.testing.assert_allclose(found.T_i_j, T_j, atol=1e-15)
    np.testing.assert_allclose(found.covariance, joint[6:, 6:], atol=1e-18)


def test_two_of_many_are_cut_out_in_the_order_requested() -> None:
    whole = np.arange(18.0 * 18.0).reshape(18, 18)
    joint = joint_of(whole, 2, 0)
    np.testing.assert_array_equal(joint[:6, :6], whole[12:, 12:])
    np.testing.assert_array_equal(joint[:6, 6:], whole[12:, :6])
    np.testing.assert_array_equal(joint[6:, 6:], whole[:6, :6])
