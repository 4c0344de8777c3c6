"""Least squares, once for all: damped steps for one problem, or for many small ones at once.

Of many, each takes the steps that it takes alone, and
what a call costs is paid once for all.

All say whether they converged and after how many iterations; a caller that ignores `converged`
is in error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.linalg import lapack

from ..base.datatypes import Array, BoolArray, IntArray

MAX_ITERATIONS = 60
"""Largest number of steps. From lines on lines most starts need 5 to 15, the beam model 5 to 30;
what has not converged by then oscillates."""

DAMPING = 1e-3
"""Damping at the start, as a part of the curvature of each parameter: starts are near a minimum."""

ROUNDING = 1e-9
"""Part of a sum over hundreds of returns that is rounding: a cost may rise by it, less damping is
none, damped by its inverse a step is none, and eigenvalues so small compared with the largest
are zero."""


class Model(Protocol):
    """A cost near a point: its gradient (P,) and positive definite curvature (P, P)."""

    @property
    def gradient(self) -> Array:
        """(P,) derivative by the step."""

    @property
    def curvature(self) -> Array:
        """(P, P) second derivative by the step, or a positive definite substitute."""


class Quadratic(Model, Protocol):
    """A model with the value of the cost, which can be compared from step to step."""

    @property
    def cost(self) -> float:
        """Value at the point."""


Q = TypeVar("Q", bound=Quadratic)
S = TypeVar("S")


@dataclass(frozen=True)
class Step:
    """One step of a solver.

    Attributes
    ----------
    step
        (P,) in the units of the parameters.
    scaled
        (P,) in units of ``1/√curvature`` of each: where the cost is a negative log-likelihood, of
        the 1 σ that each parameter would have were all others known.
    gain
        By how much the cost fell; 0 if it cannot be compared.
    """

    step: Array
    scaled: Array
    gain: float


@dataclass(frozen=True, eq=False)
class Solution(Generic[S]):
    """Where a solver ended.

    Attributes
    ----------
    point
        The last point, whatever the problem makes of one.
    converged
        Whether the last step was small, or no further one lowers the cost.
    iterations
        How many steps were tried.
    damping
        Of the next step.
    """

    point: S
    converged: bool
    iterations: int
    damping: float = 0.0


def levenberg_marquardt(
    start: Q,
    advance: Callable[[Q, Array, float], Q],
    small: Callable[[Step], bool],
    *,
    tolerance: float,
    damping: float = DAMPING,
    min_damping: float = ROUNDING,
    slack: float = ROUNDING,
    max_iterations: int = MAX_ITERATIONS,
) -> Solution[Q]:
    """Minimise a cost by damped Newton steps (Marquardt 1963).

    Damping is relative to the curvature of each parameter, which keeps radians and metres from
    being weighed against each other.

    Parameters
    ----------
    start
        The cost at the start.
    advance
        From the cost at a point, a step (P,) and the damping to the cost after the step.
    small
        Whether a step that was taken is small enough to stop.
    tolerance
        Largest entry of a scaled step that is small where no step lowers the cost: the
        minimum is reached.
    damping, min_damping
        At the start, and at least.
    slack
        A cost may rise by this part of itself: rounding.
    max_iterations
        Largest number of steps.
    """
    now = start
    for iteration in range(1, max_iterations + 1):
        scale = np.sqrt(np.diag(now.curvature)) + 1e-12
        damped = now.curvature / np.outer(scale, scale) + damping * np.eye(len(scale))
        scaled = -np.linalg.solve(damped, now.gradient / scale)
        new = advance(now, scaled / scale, damping)
        gain = now.cost - new.cost
        if gain >= -slack * abs(now.cost):
            now, damping = new, max(damping / 10.0, min_damping)
            if small(Step(np.asarray(scaled / scale), np.asarray(scaled), gain)):
                return Solution(now, True, iteration, damping)
        elif np.abs(scaled).max() < tolerance:
            return Solution(now, True, iteration, damping)
        else:
            damping *= 10.0
            if damping > 1.0 / ROUNDING:
                return Solution(now, False, iteration, damping)
    return Solution(now, False, max_iterations, damping)


class Quadratics(NamedTuple):
    """Costs (B,) of B problems, their gradients (B, P), and positive curvatures (B, P, P)."""

    costs: Array
    gradients: Array
    curvatures: Array


class Solutions(NamedTuple):
    """Where B problems ended: (B, …) points, the models there, and which came to rest (B,)."""

    ends: Array
    models: Quadratics
    came_to_rest: BoolArray


def levenberg_marquardt_each(
    starts: Array,
    model_at: Callable[[Array, IntArray], Quadratics],
    move: Callable[[Array, Array], Array],
    *,
    tolerance: float,
    max_iterations: int = MAX_ITERATIONS,
) -> Solutions:
    """Minimise the costs of many small problems, each as `levenberg_marquardt` does it alone.

    Parameters
    ----------
    starts
        (B, …) a point for each problem.
    model_at
        From points (M, …) and the numbers (M,) of their problems to the models there.
    move
        From points (M, …) and steps (M, P) to the next points.
    tolerance
        A problem ends where its step, in the units of the parameters, is shorter.
    max_iterations
        Largest number of steps, for each.
    """
    points, left = starts.copy(), np.arange(len(starts))
    models = Quadratics(*(each.copy() for each in model_at(points, left)))
    converged = np.zeros(len(starts), dtype=bool)
    dampings = np.full(len(starts), DAMPING)
    for _ in range(max_iterations):
        if len(left) == 0:
            break
        now = Quadratics(*(each[left] for each in models))
        scale = np.sqrt(np.einsum("bii->bi", now.curvatures)) + 1e-12
        damped = now.curvatures / (scale[:, :, None] * scale[:, None, :])
        damped += dampings[left, None, None] * np.eye(scale.shape[1])
        scaled = -np.linalg.solve(damped, (now.gradients / scale)[:, :, None])[:, :, 0]
        moved = move(points[left], scaled / scale)
        new = model_at(moved, left)
        better = now.costs - new.costs >= -ROUNDING * now.costs
        done = left[better]
        points[done] = moved[better]
        for kept, found in zip(models, new, strict=True):
            kept[done] = found[better]
        dampings[done] = np.maximum(dampings[done] / 10.0, ROUNDING)
        rests = np.linalg.norm(scaled / scale, axis=1) < tolerance
        rests = np.where(better, rests, np.abs(scaled).max(axis=1) < tolerance)
        converged[left[rests]] = True
        dampings[left[~better & ~rests]] *= 10.0
        left = left[~rests & (dampings[left] <= 1.0 / ROUNDING)]
    return Solutions(points, models, converged)


def inverse_of(information: Array) -> Array:
    """Invert a positive definite matrix, in a third of the time that a general one takes."""
    root, failed = lapack.dpotrf(information)
    half, _ = lapack.dpotri(root, overwrite_c=True)
    if failed or not np.isfinite(half).all():
        return np.asarray(np.linalg.inv(information))
    # Below the diagonal are zeros.
    return np.asarray(half + np.triu(half, 1).T)
