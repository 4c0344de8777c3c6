"""How large errors are found to be: errors of known size, shown with some noise."""

import numpy as np

from retropole.alignment.certainty import (
    MAX_SCALE,
    MIN_MEMBERS,
    WORKING_SHARE,
    group_scales,
    prior_precision,
    working_sigma,
)
from retropole.alignment.unknowns import Unknowns
from retropole.base.datatypes import Array
from retropole.base.systematic import ErrorModel, Groups

GROUPS = Unknowns((np.arange(32), np.arange(32)), 0, 0).groups()
SIGMA = ErrorModel().sigmas(GROUPS)


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
    alone = working_sigma(GROUPS, SIGMA, poles_alone=True)
    np.testing.assert_allclose(alone, WORKING_SHARE * SIGMA)
    with_scene = working_sigma(GROUPS, SIGMA, poles_alone=False)
    hidden = np.array([kind.field in ("tape", "radius") for kind in GROUPS.kinds])
    np.testing.assert_allclose(with_scene[hidden], WORKING_SHARE * SIGMA[hidden])
    np.testing.assert_array_equal(with_scene[~hidden], SIGMA[~hidden])
