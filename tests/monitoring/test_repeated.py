"""What of two poses' systematic errors cancels where the same devices made both recordings."""

import numpy as np
import pytest

from retropole.base.datatypes import Array
from retropole.base.uncertainty import Uncertainty
from retropole.monitoring.repeated import REPEATED, kept, step_covariance

SCALE = np.repeat([3e-4, 2e-3], 3)


def covariance(rng: np.random.Generator) -> Array:
    A = rng.normal(size=(6, 6)) * SCALE[:, None] / np.sqrt(6)
    return np.asarray(A @ A.T + np.diag(SCALE**2) / 10)


def floor_free(stored: Array, new: Array) -> Array:
    """Give what is kept, less what is kept of nothing but the floor."""
    tiny = 1e-12 * np.diag(SCALE**2)
    return kept(stored, new) - kept(tiny, tiny)


def test_of_equal_errors_the_part_is_kept_that_does_not_repeat() -> None:
    S = covariance(np.random.default_rng(0))
    np.testing.assert_allclose(floor_free(S, S), 2 * (1 - REPEATED) * S, atol=1e-12, rtol=1e-6)


def test_a_pose_from_elsewhere_shares_nothing() -> None:
    S, none = covariance(np.random.default_rng(1)), np.zeros((6, 6))
    np.testing.assert_allclose(kept(S, none), S)
    np.testing.assert_allclose(kept(none, S), S)
    np.testing.assert_allclose(kept(none, none), none)


def test_errors_of_other_directions_do_not_cancel() -> None:
    rng = np.random.default_rng(2)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0] * 1e-2
    one, other = np.diag([1.0, 1, 1, 1e-8, 1e-8, 1e-8]), np.diag([1e-8, 1e-8, 1e-8, 1.0, 1, 1])
    one, other = (axes @ each @ axes.T for each in (one, other))
    np.testing.assert_allclose(floor_free(one, other), one + other, atol=1e-7)


def test_units_axes_and_which_is_stored_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    one, other = covariance(rng), covariance(rng)
    J = rng.normal(size=(6, 6))
    plain = floor_free(one, other)
    np.testing.assert_allclose(floor_free(other, one), plain, atol=1e-12)
    np.testing.assert_allclose(
        floor_free(J @ one @ J.T, J @ other @ J.T), J @ plain @ J.T, atol=1e-9, rtol=1e-4
    )


@pytest.mark.parametrize("alike", [True, False])
def test_it_holds_the_scatter_of_errors_that_repeat(alike: bool) -> None:
    """Errors b of the devices move the poses by A b and A' b, or alike, and repeat to ρ."""
    rng = np.random.default_rng(4)
    A = rng.normal(size=(6, 20)) * SCALE[:, None]
    B = A if alike else A + 0.5 * rng.normal(size=(6, 20)) * SCALE[:, None]
    covered = kept(A @ A.T, B @ B.T)
    b = rng.normal(size=(2000, 20))
    again = REPEATED * b + np.sqrt(1 - REPEATED**2) * rng.normal(size=b.shape)
    steps = again @ B.T - b @ A.T
    square = np.einsum("ni,ij,nj->n", steps, np.linalg.inv(covered), steps)
    # χ² with 6 degrees of freedom has a mean of 6; the floor makes it less.
    assert (3.0 if alike else 4.0) < square.mean() < (6.0 if alike else 12.0)


def test_random_errors_add_up() -> None:
    rng = np.random.default_rng(5)
    R, Q, S = (covariance(rng) for _ in range(3))
    both = step_covariance(Uncertainty(R, S), Uncertainty(Q, S))
    np.testing.assert_allclose(both - kept(S, S), R + Q)
    assert np.linalg.eigvalsh(R + Q + 2 * S - both).min() > -1e-5
