"""What is stated of a pose's errors: against the linear problem, solved over and over."""

import numpy as np
import pytest

from retropole.alignment.certainty import (
    MAX_SCALE,
    MIN_MEMBERS,
    WORKING_SHARE,
    few_freedom,
    floors,
    group_scales,
    parts_of_errors,
    parts_of_poles,
    prior_precision,
    solve_factor,
    sways,
    uncertainty_of_pair,
    working_sigma,
)
from retropole.alignment.network import OF_SOURCE, PoleFactor, poses_of_pair
from retropole.alignment.unknowns import POSE, Unknowns
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.systematic import ErrorModel, Groups
from retropole.base.uncertainty import (
    FLOOR_ROTATION,
    FLOOR_TRANSLATION,
    Uncertainty,
    predicted_error,
)
from tests.numeric import CHI2_6_95

UNKNOWNS = Unknowns((np.arange(6), np.arange(5)), 0, 0)
GROUPS = UNKNOWNS.groups()
POSES, RADIUS = UNKNOWNS.poses, UNKNOWNS.radius - UNKNOWNS.poses
SIGMA = ErrorModel().sigmas(GROUPS)
NOISE = 0.004
FLOOR = np.diag(np.repeat([FLOOR_ROTATION, FLOOR_TRANSLATION], 3) ** 2)


def linear_problem(seed: int, rows: int = 200) -> tuple[Array, Array]:
    """Derivatives of residuals by the pose and by the errors."""
    rng = np.random.default_rng(seed)
    by_pose = rng.normal(size=(rows, POSE)) * np.r_[np.full(3, 5.0), np.full(3, 1.0)]
    # Errors that look much like motions, as real ones do, and matter about alike.
    by_errors = by_pose @ rng.normal(size=(POSE, UNKNOWNS.errors)) / 5
    by_errors = by_errors + 0.02 * rng.normal(size=by_errors.shape)
    return by_pose, by_errors * 0.01 / SIGMA[GROUPS.label]


def factor_of(A: Array, y: Array) -> PoleFactor:
    """Of residuals that know the source's pose and all errors: the target is the frame."""
    J = np.hstack([np.zeros((len(A), POSE)), A])
    weighted = J.T / NOISE**2
    T = poses_of_pair(np.eye(4))
    return PoleFactor(
        T, UNKNOWNS, OF_SOURCE, weighted @ J, weighted @ y, np.inf, np.zeros((len(J.T), 0))
    )


def stated_of(A: Array, y: Array, sigma: Array, precision: Array) -> Uncertainty:
    factor = factor_of(A, y)
    estimate = solve_factor(factor, precision)
    parts = parts_of_errors(GROUPS, sigma, precision, estimate.inverse, estimate.errors)
    parts += parts_of_poles("noise", factor, estimate.inverse)
    return uncertainty_of_pair([*parts, *floors(factor.T, factor.free)])


def test_an_error_moves_the_estimate_as_the_module_says() -> None:
    by_pose, by_errors = linear_problem(0)
    A = np.hstack([by_pose, by_errors])
    precision = prior_precision(GROUPS, SIGMA)
    rng = np.random.default_rng(1)
    b = SIGMA[GROUPS.label] * rng.normal(size=UNKNOWNS.errors)
    x = rng.normal(size=POSE) * 0.01
    found = solve_factor(factor_of(A, A @ np.r_[x, b]), precision)
    moved = -found.inverse[POSE:POSES, POSES:] @ (precision * b)
    np.testing.assert_allclose(found.steps[POSE:] - x, moved, atol=1e-12)
    assert not found.steps[:POSE].any()
    assert np.abs(moved).max() > 1e-4


@pytest.mark.parametrize("share", [1.0, 0.25])
def test_the_stated_covariance_is_that_of_the_errors(share: float) -> None:
    """Also where the estimate is drawn to smaller errors than those that are stated."""
    by_pose, by_errors = linear_problem(2)
    A = np.hstack([by_pose, by_errors])
    precision = prior_precision(GROUPS, share * SIGMA)
    inverse = solve_factor(factor_of(A, np.zeros(len(A))), precision).inverse
    gain = inverse[POSE:POSES, POSE:] @ A.T / NOISE**2
    rng = np.random.default_rng(3)
    b = SIGMA[GROUPS.label] * rng.normal(size=(20000, UNKNOWNS.errors))
    y = b @ by_errors.T + NOISE * rng.normal(size=(20000, len(A)))
    errors = y @ gain.T
    # These errors have no part that are not modelled.
    covariance = stated_of(A, y[0], SIGMA, precision).covariance - FLOOR
    squares = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors)
    assert 0.945 < np.mean(squares < CHI2_6_95) < 0.955
    whitened = np.linalg.cholesky(np.linalg.inv(covariance))
    np.testing.assert_allclose(np.cov((errors @ whitened).T), np.eye(POSE), atol=0.05)


def test_shares_make_the_whole() -> None:
    by_pose, by_errors = linear_problem(4)
    A = np.hstack([by_pose, by_errors])
    said = stated_of(A, np.zeros(len(A)), SIGMA, prior_precision(GROUPS, SIGMA))
    shares = np.array([entry.share_at_30m for entry in said.budget])
    assert shares.sum() == pytest.approx(1.0)
    assert shares.min() >= 0.0
    np.testing.assert_array_equal(shares, np.sort(shares)[::-1])
    np.testing.assert_allclose(said.covariance, said.random + said.systematic)
    for part in (said.random, said.systematic):
        assert np.linalg.eigvalsh(part).min() > 0
    scatter = next(entry for entry in said.budget if entry.name == "noise")
    random, whole = (predicted_error(c, (30.0,))[0].sigma_m for c in (said.random, said.covariance))
    assert scatter.share_at_30m == pytest.approx((random / whole) ** 2)
    assert scatter.sigma == pytest.approx(random)


def test_the_budget_names_sizes_and_what_the_data_have() -> None:
    by_pose, by_errors = linear_problem(5)
    A = np.hstack([by_pose, by_errors])
    b = 0.5 * SIGMA[GROUPS.label]
    precision = prior_precision(GROUPS, SIGMA)
    estimate = solve_factor(factor_of(A, by_errors @ b), precision)
    said = stated_of(A, by_errors @ b, SIGMA, precision)
    radius = next(entry for entry in said.budget if entry.name == "radius of the poles")
    assert (radius.sensor, radius.unit) == (None, "m")
    assert radius.sigma == SIGMA[GROUPS.label[RADIUS]]
    assert radius.estimated == estimate.errors[RADIUS]
    # Many numbers are no single one.
    rings = [entry for entry in said.budget if entry.name == "range of single rings"]
    assert {entry.sensor for entry in rings} == {"target", "source"}
    assert all(entry.estimated is None for entry in rings)


def test_less_is_never_stated_with_more_errors() -> None:
    by_pose, by_errors = linear_problem(6)
    A = np.hstack([by_pose, by_errors])
    precision = prior_precision(GROUPS, SIGMA)
    small = stated_of(A, np.zeros(len(A)), SIGMA, precision).covariance
    large = stated_of(A, np.zeros(len(A)), 1.5 * SIGMA, precision).covariance
    assert np.linalg.eigvalsh(large - small).min() > -1e-15


def test_data_that_say_nothing_leave_the_prior() -> None:
    """An error that the pose absorbs entirely passes into it whole, however many the data."""
    rng = np.random.default_rng(7)
    by_pose = rng.normal(size=(50000, POSE))
    by_errors = np.zeros((50000, UNKNOWNS.errors))
    by_errors[:, 0] = by_pose[:, 5]
    A = np.hstack([by_pose, by_errors])
    said = stated_of(A, np.zeros(len(A)), SIGMA, prior_precision(GROUPS, SIGMA))
    assert np.sqrt(said.systematic[5, 5]) == pytest.approx(
        np.hypot(SIGMA[0], FLOOR_TRANSLATION), rel=1e-3
    )
    assert np.sqrt(said.systematic[4, 4]) == pytest.approx(FLOOR_TRANSLATION, rel=1e-3)


def test_few_degrees_of_freedom_keep_what_is_stated() -> None:
    """With a scale estimated from ν residuals, the region that is widened still holds 95 %."""
    rng = np.random.default_rng(8)
    for freedom in (3, 5, 20):
        x = np.sum(rng.normal(size=(100_000, POSE)) ** 2, axis=1)
        scale = rng.chisquare(freedom, 100_000) / freedom
        inside = np.mean(x < CHI2_6_95 * scale * few_freedom(freedom))
        assert 0.945 < inside < 0.955
    widths = [few_freedom(freedom) for freedom in (3.0, 4.0, 8.0, 30.0, 1e3, 1e7)]
    assert np.all(np.diff(widths) < 0)
    assert widths[-1] == pytest.approx(1.0, abs=1e-4)
    assert few_freedom(0.5) == few_freedom(3.0)


@pytest.mark.full
def test_sway_moves_the_frame_of_the_lidar_that_swayed() -> None:
    """By sampling: each LiDAR turned and shifted about its own origin, the pose between both."""
    rng = np.random.default_rng(0)
    T = se3.from_rt(se3.exp_so3(np.array([0.1, -0.2, 1.4])), np.array([4.0, -2.0, 0.5]))
    roots = 1e-4 * rng.normal(size=(2, 6, 6))
    left = np.einsum("lij,lkj->lik", roots, roots)
    parts = sways(poses_of_pair(T), OF_SOURCE, left)
    assert [part.lidar for part in parts] == [0, 1]
    stated = sum(part.root[POSE:] @ part.root[POSE:].T for part in parts)
    steps = []
    for _ in range(4000):
        first, second = (
            se3.from_rt(se3.exp_so3(own[:3]), own[3:])
            for own in (root @ rng.normal(size=6) for root in roots)
        )
        steps.append(se3.local(T, se3.inverse(first) @ T @ second))
    drawn = np.cov(np.array(steps).T)
    way = np.linalg.inv(np.linalg.cholesky(stated))
    sizes = np.linalg.eigvalsh(way @ drawn @ way.T)
    assert sizes[0] > 0.85
    assert sizes[-1] < 1.15
    assert not sways(poses_of_pair(T), OF_SOURCE, np.zeros((2, 6, 6)))


GROUPS_ERROR_SIZES = Unknowns((np.arange(32), np.arange(32)), 0, 0).groups()
SIGMA_ERROR_SIZES = ErrorModel().sigmas(GROUPS_ERROR_SIZES)


def estimates(groups: Groups, sigma: Array, true: Array, noise: Array, seed: int) -> Array:
    """Sizes that `group_scales` ends at, of errors that data with some noise show one by one."""
    rng = np.random.default_rng(seed)
    b = true[groups.label] * rng.normal(size=len(groups.label))
    seen = b + noise * rng.normal(size=len(b))
    found = sigma
    for _ in range(5):
        precision = prior_precision(groups, found)
        variance = 1.0 / (precision + 1.0 / noise**2)
        found = group_scales(groups, sigma, precision, variance / noise**2 * seen, variance)
    return found


def test_sizes_are_found_where_many_errors_show_them() -> None:
    groups = Unknowns((np.arange(100), np.arange(100)), 0, 0).groups()
    sigma = ErrorModel().sigmas(groups)
    many = np.bincount(groups.label) >= MIN_MEMBERS
    noise = 0.5 * sigma[groups.label]
    found = np.mean([estimates(groups, sigma, 2 * sigma, noise, k) for k in range(10)], axis=0)
    np.testing.assert_allclose(found[many] / sigma[many], 2.0, atol=0.2)
    # Few errors do not tell their own size.
    np.testing.assert_allclose(found[~many], sigma[~many], rtol=1e-12)


def test_sizes_fall_as_far_as_many_errors_show_and_no_size_is_boundless() -> None:
    groups = Unknowns((np.arange(100), np.arange(100)), 0, 0).groups()
    sigma = ErrorModel().sigmas(groups)
    many = np.bincount(groups.label) >= MIN_MEMBERS
    noise = 0.1 * sigma[groups.label]
    small = np.mean([estimates(groups, sigma, 0.5 * sigma, noise, k) for k in range(10)], axis=0)
    # The known size counts as five of a hundred errors, so 0.55 of it is found and not 0.5.
    expected = np.sqrt((MIN_MEMBERS + 100 * 0.5**2) / (MIN_MEMBERS + 100))
    np.testing.assert_allclose(small[many] / sigma[many], expected, atol=0.04)
    np.testing.assert_allclose(small[~many], sigma[~many], rtol=1e-12)
    large = estimates(groups, sigma, 50 * sigma, noise, 0)
    np.testing.assert_allclose(large[many], MAX_SCALE * sigma[many])
    # Errors that the data do not show change nothing.
    unseen = estimates(groups, sigma, 2 * sigma, 1e3 * sigma[groups.label], 0)
    np.testing.assert_allclose(unseen, sigma, rtol=1e-3)


def test_the_estimate_is_drawn_by_less_of_errors_that_only_poles_show() -> None:
    alone = working_sigma(GROUPS_ERROR_SIZES, SIGMA_ERROR_SIZES, poles_alone=True)
    np.testing.assert_allclose(alone, WORKING_SHARE * SIGMA_ERROR_SIZES)
    with_scene = working_sigma(GROUPS_ERROR_SIZES, SIGMA_ERROR_SIZES, poles_alone=False)
    hidden = np.array([kind.field in ("tape", "radius") for kind in GROUPS_ERROR_SIZES.kinds])
    np.testing.assert_allclose(with_scene[hidden], WORKING_SHARE * SIGMA_ERROR_SIZES[hidden])
    np.testing.assert_array_equal(with_scene[~hidden], SIGMA_ERROR_SIZES[~hidden])
