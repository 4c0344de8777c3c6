"""Poles and scene in one problem: the pose that both agree on, with the LiDARs' errors in it.

The poles give a quadratic form of the pose and of the errors of both LiDARs (`alignment.factor`);
the scene adds the distances between surface patches that both LiDARs see, which the same errors
move. Minimised together over the step x and the errors b:

    Σ_i w_i ρ( n_i · (R c_i + t − d_i) + D_i b )  +  ½ zᵀΛz − ηᵀz  +  ½ bᵀB⁻¹b,    z = [x, b]

with c_i the centre of a patch of the source, d_i of the target's surface near it, n_i the mean of
their normals. A direction that the scene does not hold (along a corridor, over open ground) has no
part in the first sum and stays where the poles put it. The sizes of the errors are estimated too,
never below what the manufacturer states. Coarse to fine: a patch looks for its partner as far as
the pose is still uncertain there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import se3
from ..alignment.certainty import (
    Scatter,
    group_scales,
    prior_precision,
    stated,
    working_sigma,
)
from ..alignment.factor import POSE, PoleFactor, gaussian_factor
from ..datatypes import Array, IntArray, PointCloud, PoseEstimate
from ..systematic import ErrorModel, Groups, Layout, groups_of, joined
from ..uncertainty import Uncertainty
from .patch_pairs import (
    MIN_PATCHES,
    PatchPairs,
    PatchSets,
    held_directions,
    pair_patches,
    prepare_patches,
    thinned,
)
from .patches import surface_patches

PLACE_BIAS = 0.0008
"""1 σ of what all patches of one place have in common, metres: a wall that is not flat, and the
downsampling, which keeps more of the far tail of the noise than of the middle."""

MIN_SIGMA = 1e-4
"""Least scale of the residuals, in units of their own predicted standard deviation."""

ROBUST_WIDTH = 2.0
"""Residuals of so many σ have a quarter of the weight (Geman and McClure 1987)."""

GEMAN_HALF, SCALE_BISECTIONS = 0.6120, 60
"""The c for which ``x²/(x² + c²)`` of standard normal x has a mean of one half, and halvings that
find a scale to rounding."""

MAX_REFINEMENT_ITERATIONS = 60
STEP = 2e-7
"""Stop where a step is below this, rad and m: steps shrink by half or more each time, so that ends
from other starts agree within 1e-6."""

FEW, FEW_STEP = 4, 3e-4
"""The first steps take every n-th patch of the source, until one is below this, rad and m."""

NARROWING, INFORMATION_SHARE = 0.25, 4.0
"""Patches look for their partners as far as so many times the variance that independent residuals
would leave, and as this part, from step to step, of the variance that the poles left: narrowed at
once, the search clings to whatever the first step found."""

WIDE, START_SIGMAS = 0.1, 2.0
"""From which 1 σ of the poles at the middle of the cloud, metres, the search is also started from
so many σ to either side."""

SEVERAL = 16.8
"""Squared Mahalanobis distance from which two ends are two minima: χ² with 6 degrees of freedom
exceeds it once in a hundred times."""

DISAGREE = 16.8
"""Squared Mahalanobis distance of the poles' pose from which it is not taken for chance that the
scene has another: the covariance then covers both."""

SUPPORT_WIDTH = 0.01
"""Residual that halves the support of a pair when minima are compared, metres."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """The pose that poles and scene agree on.

    Attributes
    ----------
    pose
        Pose, covariance, and RMS residual of the patches.
    uncertainty
        The covariance in its two kinds, and the budget.
    patches
        How many pairs of patches took part.
    mahalanobis_sq
        Squared Mahalanobis distance of the pose from the poles' own: χ² with 6 degrees of freedom
        where the stated uncertainties are right.
    from_poles
        The same step as rotation, rad, and translation, metres at the source's own origin.
    other_minima
        Steps (6,) to where the search ended from other starts within the poles' uncertainty, where
        that is another pose; empty mostly.
    converged, iterations
        Whether the last step was below its tolerance, and how many were taken.
    """

    pose: PoseEstimate
    uncertainty: Uncertainty
    patches: int
    mahalanobis_sq: float
    from_poles: se3.PoseDifference
    other_minima: tuple[Array, ...]
    converged: bool
    iterations: int


@dataclass(frozen=True, eq=False)
class _Linear:
    """The problem about a pose, solved.

    Attributes
    ----------
    pairs, weights
        Patches that correspond, and the weights (P,) of their residuals, 1/m².
    rows
        (P, 6 + B) derivative of the residuals by the pose, held directions only, and the errors.
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
    precision: Array
    step: Array
    errors: Array
    inverse: Array


@dataclass(frozen=True, eq=False)
class _Problem:
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
class _End:
    """Where a descent ended: pose, 1 σ of each group of errors, and the last linear problem."""

    T: Array
    sigma: Array
    linear: _Linear
    converged: bool
    iterations: int


def refine(
    target: PointCloud,
    source: PointCloud,
    poles: PoseEstimate,
    *,
    factor: PoleFactor | None = None,
    model: ErrorModel | None = None,
    origins_known: bool = False,
) -> Refinement | None:
    """Let the scene sharpen the pose that the poles give.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame.
    poles
        Pose and covariance of the poles, from which the search starts.
    factor
        What the poles say of the pose and the errors; None takes `poles` for a normal distribution
        of the pose that says nothing of the errors.
    model
        Sizes of the errors; None takes those of unknown LiDARs.
    origins_known
        Whether the beams of both clouds start where `PointCloud.origin` says; without, the front of
        an object and its back cannot be told apart by their normals.

    Returns
    -------
    Refinement or None
        None where the scene has fewer than `MIN_PATCHES` common patches: it has nothing to say.
    """
    assert poles.covariance is not None
    patches = surface_patches(target), surface_patches(source)
    if min(len(one.centres) for one in patches) < MIN_PATCHES:
        return None
    seen = Layout((np.unique(patches[0].bands), np.unique(patches[1].bands)))
    given = gaussian_factor(poles) if factor is None else factor
    layout = joined(given.layout, seen)
    groups = groups_of(layout)
    known = (ErrorModel() if model is None else model).sigmas(groups)
    sets = prepare_patches(patches[0], patches[1], layout)
    problem = _Problem(sets, thinned(sets, FEW), given.within(layout), groups, known, origins_known)
    end = _descend(problem, poles.T_target_source, poles.covariance)
    if end is None:
        return None
    others = [_descend(problem, T, poles.covariance) for T in _other_starts(poles, source)]
    ends = [end, *(other for other in others if other is not None)]
    best = max(ends, key=_support)
    e = se3.local(poles.T_target_source, best.T)
    mahalanobis_sq = float(e @ np.linalg.solve(poles.covariance, e))
    apart = (("poles and scene disagree", np.outer(e, e)),) if mahalanobis_sq > DISAGREE else ()
    uncertainty = _uncertainty(best, problem, apart)
    pairs, weights = best.linear.pairs, best.linear.weights
    rms = float(np.sqrt(np.average(pairs.residuals**2, weights=weights)))
    minima = [
        se3.local(best.T, one.T)
        for one in ends
        if _distance_sq(uncertainty.covariance, best.T, one.T) > SEVERAL
    ]
    return Refinement(
        PoseEstimate(best.T, uncertainty.covariance, rms),
        uncertainty,
        len(weights),
        mahalanobis_sq,
        se3.difference(poles.T_target_source, best.T),
        tuple(minima),
        best.converged,
        best.iterations,
    )


def _distance_sq(covariance: Array, T: Array, T_other: Array) -> float:
    step = se3.local(T, T_other)
    return float(step @ np.linalg.solve(covariance, step))


def _other_starts(poles: PoseEstimate, source: PointCloud) -> list[Array]:
    """Give the ends of the poles' uncertainty where surfaces may be mistaken for their neighbours.

    Under a wide uncertainty patches correspond over decimetres, and what the search ends at may
    depend on where it started.
    """
    assert poles.covariance is not None
    lever = float(np.median(np.linalg.norm(source.xyz - source.origin, axis=1)))
    scale = np.r_[np.full(3, 1.0 / max(lever, 1.0)), np.ones(3)]
    values, vectors = np.linalg.eigh(poles.covariance / np.outer(scale, scale))
    widest = float(np.sqrt(max(values[-1], 0.0)))
    if widest < WIDE:
        return []
    step = START_SIGMAS * widest * vectors[:, -1] * scale
    return [se3.retract(poles.T_target_source, sign * step) for sign in (1.0, -1.0)]


def _support(end: _End) -> float:
    """How much of the scene agrees at an end: the sum of robust weights, each at most 1."""
    pairs = end.linear.pairs
    square = pairs.residuals**2 / (pairs.variance + SUPPORT_WIDTH**2)
    return float(np.sum(pairs.agreement / (1.0 + square)))


def _descend(problem: _Problem, T: Array, covariance: Array) -> _End | None:
    """Gauss–Newton steps of the pose, the errors and their sizes, to a standstill."""
    groups, sigma, start = problem.groups, problem.known, covariance
    sets = problem.few
    for iteration in range(1, MAX_REFINEMENT_ITERATIONS + 1):
        pairs = pair_patches(sets, T, covariance, problem.origins_known)
        if pairs is None and sets is problem.few:
            # A scene with little in it needs all of it.
            sets = problem.sets
            pairs = pair_patches(sets, T, covariance, problem.origins_known)
        if pairs is None:
            return None
        precision = prior_precision(groups, working_sigma(groups, sigma, poles_alone=False))
        linear = _solve(pairs, problem.factor, T, covariance, precision)
        T = se3.retract(T, linear.step)
        narrowed = NARROWING**iteration * start
        covariance = INFORMATION_SHARE * linear.inverse[:POSE, :POSE] + narrowed
        variance = np.diag(linear.inverse)[POSE:]
        sigma = group_scales(groups, problem.known, precision, linear.errors, variance)
        if sets is problem.few:
            sets = problem.few if np.abs(linear.step).max() > FEW_STEP else problem.sets
        elif np.abs(linear.step).max() < STEP:
            return _End(T, sigma, linear, True, iteration)
    return _End(T, sigma, linear, False, MAX_REFINEMENT_ITERATIONS)


def _solve(
    pairs: PatchPairs, factor: PoleFactor, T: Array, covariance: Array, precision: Array
) -> _Linear:
    """Weigh the residuals, keep to what the surfaces hold, add the poles and the errors' prior.

    What the pose may still be off by, `covariance`, is no reason to take a residual for an outlier:
    a distant wall would be given up before the ground has let the pose turn towards it.
    """
    r = pairs.residuals
    spread = np.sqrt(pairs.variance)
    spread = spread * max(robust_scale(r / spread, pairs.agreement), MIN_SIGMA)
    still_off = np.sum(pairs.jacobian * (pairs.jacobian @ covariance), axis=1)
    outlying = r**2 / (ROBUST_WIDTH**2 * (spread**2 + still_off))
    weights = pairs.agreement / (spread * (1.0 + outlying)) ** 2
    held = held_directions(pairs, weights)
    rows = np.concatenate([pairs.jacobian @ held, pairs.by_error], axis=1)
    weighted = rows * weights[:, None]
    information = weighted.T @ rows + factor.information
    index = np.arange(POSE, len(information))
    information[index, index] += precision
    here = np.r_[se3.local(factor.T_target_source, T), np.zeros(len(precision))]
    gradient = weighted.T @ r + factor.information @ here - factor.vector
    inverse = np.linalg.inv(information)
    step = -inverse @ gradient
    return _Linear(pairs, weights, rows, precision, step[:POSE], step[POSE:], inverse)


def robust_scale(values: Array, weights: Array) -> float:
    """Estimate the standard deviation of values (N,) about 0, half of which may be outliers.

    The s with ``Σ w x²/(x² + (cs)²) = ½ Σ w`` (an M-estimate of scale, Huber 1981, with the loss of
    Geman and McClure); c makes it 1 for standard normal values. Unlike a median it has a derivative
    everywhere: where it jumped, so would the pose.
    """
    square = values**2
    low, high = 1e-30, float(square.max()) + 1e-30
    half = 0.5 * float(weights.sum())
    for _ in range(SCALE_BISECTIONS):
        middle = np.sqrt(low * high)
        if float(weights @ (square / (square + middle))) > half:
            low = middle
        else:
            high = middle
    return float((low * high) ** 0.25) / GEMAN_HALF


def _uncertainty(end: _End, problem: _Problem, other: tuple[tuple[str, Array], ...]) -> Uncertainty:
    """State the uncertainty of the minimum, of residuals that are far from independent.

    ``Σ_c d_c d_cᵀ``: ``d_c = (S − S_c)⁻¹ g_c`` is how far the answer goes without all residuals at
    one place, which may be correlated in any way (the jackknife over clusters, Bell and McCaffrey
    2002), with the errors b eliminated from S and g.
    """
    linear = end.linear
    inverse, weights, cluster = linear.inverse, linear.weights, linear.pairs.cluster
    marginal = np.linalg.inv(inverse[:POSE, :POSE])
    J = linear.rows @ inverse[:, :POSE] @ marginal
    residuals = linear.pairs.residuals + linear.rows[:, POSE:] @ linear.errors
    JW = J * weights[:, None]
    gradients = _summed(JW * residuals[:, None], cluster)
    outer = (JW[:, :, None] * J[:, None, :]).reshape(-1, POSE**2)
    without = marginal - _summed(outer, cluster).reshape(-1, POSE, POSE)
    moves = np.linalg.solve(without, gradients[:, :, None])[:, :, 0]
    size = np.sum(moves * (moves @ marginal), axis=1)
    freedom = float(size.sum() ** 2 / max(float(np.sum(size**2)), 1e-300))
    places = _summed(JW, cluster) @ inverse[:POSE, :POSE]
    information = problem.factor.information
    from_poles = inverse[:POSE] @ information @ inverse[:POSE].T
    return stated(
        problem.groups,
        end.sigma,
        linear.precision,
        inverse,
        linear.errors,
        (
            Scatter("scatter of the surfaces", moves.T @ moves, freedom),
            Scatter("scatter of the poles' returns", from_poles, problem.factor.redundancy),
        ),
        (("surfaces that are not flat", places.T @ places * PLACE_BIAS**2), *other),
    )


def _summed(rows: Array, label: IntArray) -> Array:
    """Sums of rows (P, D) over each label."""
    return np.stack([np.bincount(label, column) for column in rows.T], axis=1)
