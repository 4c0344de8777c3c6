"""Scales of values with outliers, and what they scatter by beside what is predicted."""

import numpy as np
import pytest

from retropole.surfaces.patch_pairs import GEMAN_HALF, common_scatter, robust_scale


@pytest.mark.parametrize("outliers", [0.0, 0.2])
def test_the_scale_of_normal_values_is_their_standard_deviation(outliers: float) -> None:
    rng = np.random.default_rng(1)
    values = 0.02 * rng.normal(size=4000)
    few = rng.random(4000) < outliers
    values[few] = rng.uniform(-1, 1, int(few.sum()))
    assert 0.9 < robust_scale(values, np.ones(4000)) / 0.02 < 1.0 + 2.5 * outliers + 0.1


def test_a_factor_of_the_values_is_one_of_their_scale() -> None:
    rng = np.random.default_rng(2)
    values, weights = rng.normal(size=200), rng.random(200)
    assert robust_scale(7.0 * values, weights) == pytest.approx(7.0 * robust_scale(values, weights))


@pytest.mark.parametrize("common", [0.003, 0.01, 0.03])
def test_what_values_have_in_common_is_found(common: float) -> None:
    rng = np.random.default_rng(3)
    sigma = 10 ** rng.uniform(-3, -1.3, 4000)
    values = np.hypot(sigma, common) * rng.normal(size=4000)
    values[:200] = 0.5
    found = np.sqrt(common_scatter(values, sigma**2, np.ones(4000)))
    assert 0.8 * common < found < 1.25 * common


def test_values_as_predicted_have_nothing_in_common() -> None:
    """A factor of all predictions is no common part."""
    rng = np.random.default_rng(4)
    sigma = 10 ** rng.uniform(-3, -1.3, 4000)
    for factor in (0.5, 1.0, 2.0):
        values = factor * sigma * rng.normal(size=4000)
        assert np.sqrt(common_scatter(values, sigma**2, np.ones(4000))) < 0.1 * np.median(sigma)


def test_the_order_has_no_part_and_units_scale() -> None:
    rng = np.random.default_rng(5)
    sigma = 10 ** rng.uniform(-3, -1.3, 300)
    values = np.hypot(sigma, 0.01) * rng.normal(size=300)
    weights, order = rng.random(300), rng.permutation(300)
    found = common_scatter(values, sigma**2, weights)
    assert common_scatter(values[order], sigma[order] ** 2, weights[order]) == pytest.approx(found)
    in_mm = common_scatter(1e3 * values, 1e6 * sigma**2, weights)
    assert in_mm == pytest.approx(1e6 * found)


@pytest.mark.parametrize("seed", range(20))
def test_half_of_the_values_lie_outside_of_the_scale(seed: int) -> None:
    """As its definition has it, also where tails are heavy and where values are zero."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(5, 2000))
    values = rng.standard_t(rng.uniform(0.5, 10), count) * 10.0 ** rng.uniform(-6, 3)
    values[: int(0.4 * count * rng.integers(2))] = 0.0
    weights = rng.random(count)
    square, scale = values**2, (GEMAN_HALF * robust_scale(values, weights)) ** 2
    half = 0.5 * weights.sum()
    if weights[values != 0].sum() > half:
        assert weights @ (square / (square + scale)) == pytest.approx(half, rel=1e-9)
    else:
        assert scale < 1e-29
