import numpy as np
import pytest

from retropole import se3
from retropole.uncertainty import predicted_error


def test_predicted_error_equals_sampling() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * np.array([1e-3] * 3 + [5e-3] * 3)[:, None]
    covariance = A @ A.T
    T = se3.random(rng)
    steps = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for distance, sigma in predicted_error(covariance):
        p = distance * directions
        moved = [se3.apply(se3.retract(T, s), q[None])[0] for s, q in zip(steps, p, strict=True)]
        gap = np.linalg.norm(np.array(moved) - se3.apply(T, p), axis=1)
        assert sigma == pytest.approx(np.sqrt(np.mean(gap**2)), rel=0.05)


def test_turning_the_target_frame_changes_no_prediction() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6))
    R = se3.random(rng)[:3, :3]
    turn = np.block([[R, np.zeros((3, 3))], [np.zeros((3, 3)), R]])
    one, other = predicted_error(A @ A.T), predicted_error(turn @ A @ A.T @ turn.T)
    np.testing.assert_allclose(one, other, rtol=1e-9)


def test_no_covariance_predicts_nothing() -> None:
    assert predicted_error(None) == ()
