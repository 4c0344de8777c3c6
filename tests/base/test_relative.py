import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.relative import joint_of, relative
from tests.numeric import numeric_jacobian


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


def test_two_of_many_are_cut_out_in_the_order_asked_for() -> None:
    whole = np.arange(18.0 * 18.0).reshape(18, 18)
    joint = joint_of(whole, 2, 0)
    np.testing.assert_array_equal(joint[:6, :6], whole[12:, 12:])
    np.testing.assert_array_equal(joint[:6, 6:], whole[12:, :6])
    np.testing.assert_array_equal(joint[6:, 6:], whole[:6, :6])
