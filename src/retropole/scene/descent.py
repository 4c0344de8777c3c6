"""Down to the pose that poles and scene agree on: one linear problem after the other.

See `refinement` for what is minimised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from ..alignment.certainty import group_scales, prior_precision, working_sigma
from ..alignment.factor import POSE, PoleFactor
from ..base import se3
from ..base.datatypes import Array
from ..base.systematic import Groups
from .patch_pairs import PatchPairs, PatchSets, pair_patches
from .weights import weigh

MAX_REFINEMENT_ITERATIONS = 60
STEP = 2e-7
"""Stop where a step is below this, rad and m: steps shrink by half or more each time, so that ends
from other starts agree within 1e-6."""

MIN_RATIO, MAX_RATIO = -4.0, 0.75
"""Least and most that a step may be of the one before it, to be taken for part of a geometric
series: steps three times too long walk to and fro with −2."""

FEW, FEW_STEP = 4, 3e-4
"""The approach takes every n-th patch of the source, until a step is below this, rad and m."""

NARROWING, INFORMATION_SHARE = 0.06, 4.0
"""Patches look for their partners as far as so many times the variance that independent residuals
would leave, and as this part, from step to step, of the variance that the poles left: narrowed at
once, the search clings to whatever the first step found."""

SUPPORT_WIDTH = 0.01
"""Residual that halves the support of a pair when minima are compared, metres."""


@dataclass(frozen=True, eq=False)
class LinearProblem:
    """The problem about a pose, solved.

    Attributes
    ----------
    pairs, weights
        Patches that correspond, and the weights (P,) of their residuals, 1/m².
    rows, residuals
        (P, 6 + B) derivative of the residuals by the pose and the errors, and (P,) the residuals,
        without what the surfaces do not hold.
    precision
        (B,) of the prior of the errors.
    step, errors
        (6,) and (B,) the minimum.
    inverse
        (6 + B, 6 + B) of the information of both.
    """

    pairs: PatchPairs
    weights: Array
    rows: Array
    residuals: Array
    precision: Array
    step: Array
    errors: Array
    inverse: Array


@dataclass(frozen=True, eq=False)
class RefinementProblem:
    """What stays the same from step to step: patches, poles, groups of errors, their sizes.

    `few` has a part of the source's patches, for the first steps.
    """

    sets: PatchSets
    few: PatchSets
    factor: PoleFactor
    groups: Groups
    known: Array
    origins_known: bool


@dataclass(frozen=True, eq=False)
class End:
    """Where a descent ended.

    Attributes
    ----------
    T
        (4, 4) the pose.
    search
        (6, 6) covariance as far as which patches look for their partners.
    sigma
        (G,) 1 σ of each group of errors.
    linear
        The last linear problem.
    converged, iterations
        Whether the last step was small enough, and how many were taken.
    """

    T: Array
    search: Array
    sigma: Array
    linear: LinearProblem
    converged: bool
    iterations: int


def support_of(end: End) -> float:
    """How much of the scene agrees at an end: the sum of robust weights, each at most 1."""
    pairs = end.linear.pairs
    square = pairs.residuals**2 / (pairs.variance + SUPPORT_WIDTH**2)
    return float(np.sum(pairs.agreement / (1.0 + square)))


def approach(problem: RefinementProblem, T: Array, covariance: Array) -> End | None:
    """Descend with a part of the patches from a pose (4, 4), which may be off by a covariance."""
    sigma = problem.known
    return _descend(problem, problem.few, T, covariance, covariance, sigma, 0, FEW_STEP) or (
        # A scene with little in it needs all of it.
        _descend(problem, problem.sets, T, covariance, covariance, sigma, 0, FEW_STEP)
    )


def settle(problem: RefinementProblem, near: End, covariance: Array) -> End | None:
    """Descend with all patches from where an approach ended, to a standstill."""
    begun = near.iterations
    return _descend(problem, problem.sets, near.T, near.search, covariance, near.sigma, begun, STEP)


def _descend(
    problem: RefinementProblem,
    sets: PatchSets,
    T: Array,
    search: Array,
    covariance: Array,
    sigma: Array,
    begun: int,
    tolerance: float,
) -> End | None:
    """Gauss–Newton steps of the pose, the errors and their sizes, until one is small."""
    end: End | None = None
    before: Array | None = None
    for iteration in range(begun + 1, begun + MAX_REFINEMENT_ITERATIONS + 1):
        pairs = pair_patches(sets, T, search, problem.origins_known)
        if pairs is None:
            return None
        working = working_sigma(problem.groups, sigma, poles_alone=False)
        precision = prior_precision(problem.groups, working)
        linear = _solve(pairs, problem.factor, T, search, precision)
        stride, before = stride_of(linear.step, np.diag(linear.inverse)[:POSE], before)
        T = se3.retract(T, stride * linear.step)
        narrowed = NARROWING**iteration * covariance
        search = INFORMATION_SHARE * linear.inverse[:POSE, :POSE] + narrowed
        variance = np.diag(linear.inverse)[POSE:]
        sigma = group_scales(problem.groups, problem.known, precision, linear.errors, variance)
        small = bool(np.abs(linear.step).max() < tolerance)
        end = End(T, search, sigma, linear, small, iteration)
        if small:
            break
    return end


def stride_of(step: Array, variance: Array, before: Array | None) -> tuple[float, Array | None]:
    """How much of a step to go, and what of it to remember for the next (Aitken 1926).

    Weights and partners change with the pose, so that each step is followed by a smaller one in the
    same direction, or back where it was too long. Of two steps the second tells the ratio, and
    thereby the sum of all to come.
    """
    free = variance > 0
    scaled = step[free] / np.sqrt(variance[free])
    if before is None:
        return 1.0, scaled
    ratio = float(scaled @ before / max(float(before @ before), 1e-300))
    return 1.0 / (1.0 - min(max(ratio, MIN_RATIO), MAX_RATIO)), None


def _solve(
    pairs: PatchPairs,
    factor: PoleFactor,
    T: Array,
    search: Array,
    precision: Array,
) -> LinearProblem:
    """Weigh the residuals, keep to what the surfaces hold, add the poles and the errors' prior."""
    weighed = weigh(pairs, search)
    weights, rows = weighed.weights, weighed.rows
    # As the square of one array: BLAS then computes one half of it.
    root = np.sqrt(weights)
    weighted = rows * root[:, None]
    information = weighted.T @ weighted + factor.information
    index = np.arange(POSE, len(information))
    information[index, index] += precision
    here = np.r_[se3.local(factor.T_target_source, T), np.zeros(len(precision))]
    gradient = weighted.T @ (root * weighed.residuals) + factor.information @ here - factor.vector
    inverse = inverse_of(information)
    step = -inverse @ gradient
    return LinearProblem(
        pairs, weights, rows, weighed.residuals, precision, step[:POSE], step[POSE:], inverse
    )


def inverse_of(information: Array) -> Array:
    """Invert a positive definite matrix, in a third of the time that a general one takes."""
    root, failed = lapack.dpotrf(information)
    half, _ = lapack.dpotri(root)
    upper = np.triu(half)
    if failed or not np.isfinite(upper).all():
        return np.asarray(np.linalg.inv(information))
    return np.asarray(upper + np.triu(upper, 1).T)
