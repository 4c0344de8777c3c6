"""How large errors are found to be: errors of known size, drawn and shown with some noise."""

import numpy as np
import pytest

from retropole.alignment.error_sizes import (
    LEAST_DRAWN,
    MAX_SCALE,
    MIN_MEMBERS,
    WORKING_SHARE,
    drawn_sigma,
    group_scales,
    prior_precision,
    working_sigma,
)
from retropole.alignment.unknowns import Unknowns
from retropole.base.datatypes import Array
from retropole.base.systematic import ErrorModel, Groups

GROUPS = Unknowns((np.arange(32), np.arange(32)), 0, 0).groups()
SIGMA = ErrorModel().sigmas(GROUPS)
HIDDEN = np.array([kind.field in ("tape", "radius", "width") for kind in GROUPS.kinds])
RINGS = np.bincount(GROUPS.label) >= MIN_MEMBERS


def drawn(true: Array, noise: Array, seed: int) -> tuple[Array, float]:
    """Sizes that `drawn_sigma` ends at, and the mean squared error of the errors, in units of the
    known, over that of an estimate drawn by the known sizes.
    """
    rng = np.random.default_rng(seed)
    b = true[GROUPS.label] * rng.normal(size=len(GROUPS.label))
    seen = b + noise * rng.normal(size=len(b))
    found, squares = SIGMA, []
    for _ in range(12):
        precision = prior_precision(GROUPS, found)
        variance = 1.0 / (precision + 1.0 / noise**2)
        estimated = variance / noise**2 * seen
        squares.append(np.mean(((estimated - b) / SIGMA[GROUPS.label])[~HIDDEN[GROUPS.label]] ** 2))
        found = drawn_sigma(GROUPS, SIGMA, precision, estimated, variance)
    return found, float(squares[-1] / squares[0])


def test_where_errors_are_small_the_estimate_is_drawn_by_less() -> None:
    """And errs less for it; where they are as large as they are known to be, hardly more."""
    noise = 0.5 * SIGMA[GROUPS.label]
    for share, most in ((0.0, 0.2), (0.3, 0.8), (1.0, 1.05)):
        ratios = [drawn(share * SIGMA, noise, seed)[1] for seed in range(10)]
        assert np.mean(ratios) < most
    sizes = np.mean([drawn(1.0 * SIGMA, noise, seed)[0] for seed in range(10)], axis=0)
    np.testing.assert_allclose(sizes[RINGS] / SIGMA[RINGS], 1.0, atol=0.15)


def test_one_large_error_among_small_ones_is_found() -> None:
    noise = 0.2 * SIGMA[GROUPS.label]
    for kind in np.flatnonzero(RINGS):
        true = 0.05 * SIGMA
        true[kind] = 2.0 * SIGMA[kind]
        sizes, _ = drawn(true, noise, int(kind))
        assert sizes[kind] == pytest.approx(2.0 * SIGMA[kind], rel=0.4)
        others = ~HIDDEN & (np.arange(len(SIGMA)) != kind)
        assert np.median(sizes[others] / SIGMA[others]) < 0.85


def test_sizes_that_it_is_drawn_by_have_bounds_and_units() -> None:
    noise = 0.1 * SIGMA[GROUPS.label]
    for share in (0.0, 1.0, 50.0):
        sizes, _ = drawn(share * SIGMA, noise, 0)
        np.testing.assert_array_equal(sizes[HIDDEN], SIGMA[HIDDEN])
        assert np.all(sizes >= 0.99 * LEAST_DRAWN * SIGMA)
        assert np.all(sizes <= 1.01 * MAX_SCALE * SIGMA)
    # Errors that the data do not show change nothing.
    unseen, _ = drawn(2.0 * SIGMA, 1e3 * SIGMA[GROUPS.label], 0)
    np.testing.assert_allclose(unseen, SIGMA, rtol=1e-3)


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


def test_sizes_are_never_less_than_known_nor_boundless() -> None:
    groups = Unknowns((np.arange(100), np.arange(100)), 0, 0).groups()
    sigma = ErrorModel().sigmas(groups)
    noise = 0.5 * sigma[groups.label]
    np.testing.assert_array_equal(estimates(groups, sigma, 0.1 * sigma, noise, 0), sigma)
    large = estimates(groups, sigma, 50 * sigma, noise, 0)
    many = np.bincount(groups.label) >= MIN_MEMBERS
    np.testing.assert_allclose(large[many], MAX_SCALE * sigma[many])
    # Errors that the data do not show change nothing.
    unseen = estimates(groups, sigma, 2 * sigma, 1e3 * sigma[groups.label], 0)
    np.testing.assert_allclose(unseen, sigma, rtol=1e-3)


def test_the_estimate_is_drawn_by_less_of_errors_that_only_poles_show() -> None:
    alone = working_sigma(GROUPS, SIGMA, poles_alone=True)
    np.testing.assert_allclose(alone, WORKING_SHARE * SIGMA)
    with_scene = working_sigma(GROUPS, SIGMA, poles_alone=False)
    hidden = np.array([kind.field in ("tape", "radius") for kind in GROUPS.kinds])
    np.testing.assert_allclose(with_scene[hidden], WORKING_SHARE * SIGMA[hidden])
    np.testing.assert_array_equal(with_scene[~hidden], SIGMA[~hidden])
