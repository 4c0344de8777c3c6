"""Whether two LiDARs repeat distances equally well."""

import numpy as np
import pytest
from scipy.stats import f

from retropole.certify.repetition import Spread, compare_spread


def spread(variance: float, freedom: float = 10.0) -> Spread:
    return Spread(5, 0.002, variance, freedom)


def test_equal_variances_pass_and_unequal_ones_do_not() -> None:
    equal = compare_spread(spread(1.0), spread(1.2), 0.05)
    assert equal is not None
    assert equal.passed
    assert equal.probability > 0.05
    for target, source in ((8.0, 1.0), (1.0, 8.0)):
        unequal = compare_spread(spread(target), spread(source), 0.05)
        assert unequal is not None
        assert not unequal.passed
        assert unequal.probability < 0.05


def test_the_bounds_are_those_of_f() -> None:
    test = compare_spread(spread(1.0, 7.5), spread(1.0, 12.0), 0.05)
    assert test is not None
    assert (test.low, test.high) == pytest.approx(f.ppf([0.025, 0.975], 7.5, 12.0))
    probability = 2 * min(f.cdf(1.0, 7.5, 12.0), f.sf(1.0, 7.5, 12.0))
    assert test.probability == pytest.approx(probability)


def test_nothing_repeated_is_nothing_compared() -> None:
    assert compare_spread(None, spread(1.0), 0.05) is None


def test_as_many_as_meant_fail_where_variances_are_equal() -> None:
    rng = np.random.default_rng(0)
    variances = rng.chisquare(10, size=(2000, 2)) / 10
    tests = [compare_spread(spread(a), spread(b), 0.05) for a, b in variances]
    failed = np.mean([test is not None and not test.passed for test in tests])
    assert 0.03 < failed < 0.07
