"""Distances between poles depend on nothing but the poles."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import f

from retropole.alignment.posterior import State
from retropole.base.datatypes import Array
from retropole.checking.distances import (
    Spread,
    Targets,
    compare_spread,
    distances,
    distances_of,
    places,
)


def lines(count: int, seed: int = 0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    n = rng.normal(size=(count, 3))
    return 3 * rng.normal(size=(count, 3)), n / np.linalg.norm(n, axis=1, keepdims=True)


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.full
def test_no_rigid_motion_changes_a_distance(count: int) -> None:
    points, directions = lines(count)
    rng = np.random.default_rng(1)
    R, t = Rotation.random(rng=rng).as_matrix(), 10 * rng.normal(size=3)
    # Another point of each line is as good.
    others = (points + rng.normal(size=(count, 1)) * directions) @ R.T + t
    offsets = rng.normal(size=count)
    there = distances(others, directions @ R.T, offsets)
    assert there == pytest.approx(distances(points, directions, offsets), abs=1e-9)


@pytest.mark.full
def test_the_order_of_two_poles_makes_no_difference_with_two() -> None:
    # Two lines have four half turns: whichever pole is which, their distance is the same.
    points, directions = lines(2)
    one = distances(points, directions, np.array([0.4, -1.2]))
    other = distances(points[::-1], directions[::-1], np.array([0.4, -1.2]))
    assert one == pytest.approx(other)


@pytest.mark.full
def test_a_place_is_the_nearest_to_all_other_lines() -> None:
    points, directions = lines(4)
    at = places(points, directions)

    def far(k: int, along: float) -> float:
        from_others = at[k] + along * directions[k] - points
        across = np.linalg.norm(np.cross(from_others, directions), axis=1)
        return float((np.delete(across, k) ** 2).sum())

    assert all(far(k, 0) < min(far(k, 0.01), far(k, -0.01)) for k in range(4))


@pytest.mark.full
def test_a_scale_shows_in_every_distance() -> None:
    points, directions = lines(4)
    offsets = np.ones(4)
    longer = distances(1.01 * points, directions, 1.01 * offsets)
    assert longer == pytest.approx(1.01 * distances(points, directions, offsets))


@pytest.mark.full
def test_derivatives_are_those_of_the_steps() -> None:
    points, directions = lines(4)
    state = State(np.eye(4), np.zeros(2), 0.02, points, directions)
    targets = [
        Targets(np.array([0, 2]), np.array([1.0, -1.0]), np.array([0.3, -0.2])),
        Targets(np.array([1, 3]), np.array([1.0, 1.0]), np.zeros(2)),
    ]
    lengths, by_axes = distances_of(state, targets)
    step = 1e-4 * np.random.default_rng(2).normal(size=16)
    moved, _ = distances_of(state.moved(np.r_[np.zeros(9), step]), targets)
    assert moved - lengths == pytest.approx(by_axes @ step, abs=1e-6)
    # The second placement does not depend on the axes of the first.
    assert not by_axes[1, [0, 1, 2, 3, 8, 9, 10, 11]].any()


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
