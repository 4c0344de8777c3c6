import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.uncertainty import covariance_fault, predicted_error


def test_predicted_error_equals_sampling() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * np.array([1e-3] * 3 + [5e-3] * 3)[:, None]
    covariance = A @ A.T
    T = se3.random(rng)
    steps = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for each in predicted_error(covariance):
        p = each.range_m * directions
        moved = [se3.apply(se3.retract(T, s), q[None])[0] for s, q in zip(steps, p, strict=True)]
        gap = np.linalg.norm(np.array(moved) - se3.apply(T, p), axis=1)
        assert each.sigma_m == pytest.approx(np.sqrt(np.mean(gap**2)), rel=0.05)


def test_turning_the_target_frame_changes_no_prediction() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 6))
    R = se3.random(rng)[:3, :3]
    turn = np.block([[R, np.zeros((3, 3))], [np.zeros((3, 3)), R]])
    one, other = predicted_error(A @ A.T), predicted_error(turn @ A @ A.T @ turn.T)
    assert [e.sigma_m for e in one] == pytest.approx([e.sigma_m for e in other], rel=1e-9)


def test_no_covariance_predicts_nothing() -> None:
    assert predicted_error(None) == ()


def test_every_sampled_covariance_is_one_in_any_units() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        A = rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-6, 3, 6)[:, None]
        assert covariance_fault(A @ A.T) is None
        # Printed with seven digits and read again.
        assert covariance_fault(np.vectorize(lambda v: float(f"{v:.9g}"))(A @ A.T)) is None


@pytest.mark.parametrize(
    ("C", "fault"),
    [
        (np.diag([1.0, -1e-9]), "negative"),
        (np.array([[1.0, 0.5], [0.4, 1.0]]), "symmetric"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "eigenvalue"),
        (np.diag([1.0, np.nan]), "finite"),
        (np.diag([1.0, 0.0]), "zero"),
    ],
)
def test_what_is_no_covariance_is_reported(C: Array, fault: str) -> None:
    said = covariance_fault(C)
    assert said is not None
    assert fault in said


def test_a_part_may_have_no_variance_but_then_no_correlation() -> None:
    assert covariance_fault(np.diag([1.0, 0.0]), is_part=True) is None
    assert covariance_fault(np.array([[1.0, 0.1], [0.1, 0.0]]), is_part=True) is not None
