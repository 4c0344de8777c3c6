"""The solver: it finds minima, in any units, and says when it did not."""

from dataclasses import dataclass

import numpy as np
import pytest

from retropole.alignment.solver import (
    Quadratics,
    Solution,
    Step,
    levenberg_marquardt,
    levenberg_marquardt_each,
)
from retropole.base.datatypes import Array, IntArray


@dataclass(frozen=True, eq=False)
class Point:
    """Squared residuals at a point, in units that ``scale`` gives each parameter."""

    x: Array
    cost: float
    gradient: Array
    curvature: Array


def rosenbrock(x: Array, scale: Array) -> Point:
    """(1 − a)² + 100 (b − a²)² with its Gauss–Newton matrix, a and b in units of ``scale``."""
    a, b = x * scale
    r = np.array([1 - a, 10 * (b - a * a)])
    J = np.array([[-1.0, 0.0], [-20 * a, 10.0]]) * scale
    return Point(x, float(r @ r) / 2, J.T @ r, J.T @ J)


def small(step: Step) -> bool:
    return bool(np.abs(step.scaled).max() < 1e-9)


def solve(scale: Array, max_iterations: int = 100) -> Solution[Point]:
    return levenberg_marquardt(
        rosenbrock(np.array([-1.2, 1.0]) / scale, scale),
        lambda now, step, damping: rosenbrock(now.x + step, scale),
        small,
        tolerance=1e-9,
        max_iterations=max_iterations,
    )


@pytest.mark.parametrize("scale", [np.ones(2), np.array([1e-4, 1e3])])
def test_finds_the_minimum_in_any_units(scale: Array) -> None:
    found = solve(scale)
    assert found.converged
    np.testing.assert_allclose(found.point.x * scale, 1.0, atol=1e-8)


def test_units_change_no_step() -> None:
    assert solve(np.ones(2)).iterations == solve(np.array([1e-3, 1e2])).iterations


def test_says_when_the_iterations_run_out() -> None:
    found = solve(np.ones(2), 3)
    assert not found.converged
    assert found.iterations == 3


def test_the_cost_never_rises() -> None:
    costs = [solve(np.ones(2), n).point.cost for n in range(1, 30)]
    assert costs == sorted(costs, reverse=True)


def test_a_start_at_the_minimum_stays() -> None:
    at = rosenbrock(np.ones(2), np.ones(2))
    found = levenberg_marquardt(
        at,
        lambda now, step, damping: rosenbrock(now.x + step, np.ones(2)),
        small,
        tolerance=1e-9,
        max_iterations=5,
    )
    assert found.converged
    np.testing.assert_array_equal(found.point.x, at.x)


def test_a_derivative_that_leads_uphill_is_no_convergence() -> None:
    def wrong(x: Array) -> Point:
        return Point(x, float(x @ x), -2 * x, 2 * np.eye(2))

    found = levenberg_marquardt(
        wrong(np.ones(2)),
        lambda now, step, damping: wrong(now.x + step),
        small,
        tolerance=1e-9,
        max_iterations=50,
    )
    assert not found.converged


@pytest.mark.parametrize("max_iterations", [1, 4, 12, 100])
def test_many_problems_at_once_end_where_each_ends_alone(max_iterations: int) -> None:
    """Also those that run out of steps, beside others that came to rest long before."""
    starts = np.array([[-1.2, 1.0], [1.0, 1.0], [3.0, -4.0], [0.9, 0.8], [-50.0, 20.0]])
    one = np.ones(2)

    def models(x: Array, which: IntArray) -> Quadratics:
        points = [rosenbrock(each, one) for each in x]
        return Quadratics(
            np.array([p.cost for p in points]),
            np.array([p.gradient for p in points]),
            np.array([p.curvature for p in points]),
        )

    tolerance = 1e-9
    found = levenberg_marquardt_each(
        starts, models, np.add, tolerance=tolerance, max_iterations=max_iterations
    )
    for k, start in enumerate(starts):
        alone = levenberg_marquardt(
            rosenbrock(start, one),
            lambda now, step, damping: rosenbrock(now.x + step, one),
            lambda step: float(np.linalg.norm(step.step)) < tolerance,
            tolerance=tolerance,
            max_iterations=max_iterations,
        )
        assert alone.converged == found.came_to_rest[k]
        np.testing.assert_allclose(found.ends[k], alone.point.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.models.costs[k], alone.point.cost, rtol=1e-6, atol=1e-18)
