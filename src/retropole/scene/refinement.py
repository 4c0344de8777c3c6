"""Poles and scene in one problem: the pose that both agree on.

The poles give a pose and its covariance; the scene adds the distances between surface patches that
both LiDARs see. Minimised together:

    Σ_i ρ( n_i · (R c_i + t − d_i) / σ )  +  e(T)ᵀ Σ_poles⁻¹ e(T)

with c_i the centre of a patch of the source, d_i of its nearest patch of the target, n_i the mean
of their normals, σ the scale of these residuals estimated from themselves, and e(T) the step from
the poles' pose to T. A direction that the scene does not hold (along a corridor, over open ground)
has no part in the first sum and stays where the poles put it; one that it holds becomes as certain
as the surfaces are. Coarse to fine: a patch looks for its partner as far as the pose is still
uncertain there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .. import se3
from ..alignment.solver import Step, gauss_newton
from ..datatypes import Array, IntArray, PointCloud, PoseEstimate
from ..uncertainty import MAD_TO_SIGMA
from .patch_pairs import MIN_PATCHES, PatchPairs, held_directions, pair_patches
from .patches import surface_patches
from .ring_offsets import RANGE_BIAS, RingOffsets, ring_offsets

PLACE_BIAS = 0.0008
"""1 σ of what all patches of one place have in common, metres: a wall that is not flat, and the
downsampling, which keeps more of the far tail of the noise than of the middle. Set so that the 95 %
regions of benchmarks/accuracy.py hold the truth in 95 % of its simulated scenes."""

MIN_SIGMA = 1e-4
"""Least scale of the residuals, in units of their own predicted standard deviation."""

ROBUST_WIDTH = 2.0
"""Residuals of so many σ have a quarter of the weight (Geman and McClure 1987)."""

MAX_REFINEMENT_ITERATIONS = 40
STEP_ROTATION, STEP_TRANSLATION = 3e-6, 3e-5
"""Stop where a step is below these, rad and m: about the least 1 σ that any of 50 simulated scenes
states, 2.5e-6 rad and 7e-5 m."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """The pose that poles and scene agree on.

    Attributes
    ----------
    pose
        Pose, covariance, and RMS residual of the patches.
    patches
        How many pairs of patches took part.
    mahalanobis_sq
        Squared Mahalanobis distance of the pose from the poles' own: χ² with 6 degrees of freedom
        where the stated uncertainties are right.
    from_poles
        The same step as rotation, rad, and translation, metres at the source's own origin.
    converged, iterations
        Whether the last step was below its tolerance, and how many were taken.
    """

    pose: PoseEstimate
    patches: int
    mahalanobis_sq: float
    from_poles: se3.PoseDifference
    converged: bool
    iterations: int


@dataclass(frozen=True, eq=False)
class _Problem:
    """Patches and poles at a pose: the linear system, and what its parts were made of."""

    pairs: PatchPairs
    weights: Array
    offsets: RingOffsets
    gradient: Array
    curvature: Array


@dataclass(frozen=True, eq=False)
class _Estimate:
    """A pose on the way, its covariance and the ring offsets' σ, and the problem that gave it."""

    T: Array
    covariance: Array
    range_bias: float
    problem: _Problem | None = None


def refine(
    target: PointCloud, source: PointCloud, poles: PoseEstimate, *, origins_known: bool = False
) -> Refinement | None:
    """Let the scene sharpen the pose that the poles give.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame.
    poles
        Pose and covariance of the poles.
    origins_known
        Whether the beams of both clouds start where `PointCloud.origin` says; without, the front of
        an object and its back cannot be told apart by their normals.

    Returns
    -------
    Refinement or None
        None where the scene has fewer than `MIN_PATCHES` common patches: it has nothing to say.
    """
    assert poles.covariance is not None
    target_patches, source_patches = surface_patches(target), surface_patches(source)
    if min(len(target_patches.centres), len(source_patches.centres)) < MIN_PATCHES:
        return None
    tree = cKDTree(target_patches.centres)
    prior: Array = np.asarray(np.linalg.inv(poles.covariance))

    def linearise(now: _Estimate) -> _Problem | None:
        pairs = pair_patches(
            target_patches, source_patches, tree, now.T, now.covariance, origins_known
        )
        if pairs is None:
            return None
        from_poles = se3.local(poles.T_target_source, now.T)
        return _linear_system(pairs, prior, from_poles, now.range_bias)

    def move(now: _Estimate, problem: _Problem, step: Array) -> _Estimate:
        covariance = _covariance(problem, prior)
        T = se3.retract(now.T, step)
        return _Estimate(T, covariance, problem.offsets.sigma, problem)

    start = _Estimate(poles.T_target_source, poles.covariance, RANGE_BIAS)
    found = gauss_newton(
        start, linearise, move, _is_small, max_iterations=MAX_REFINEMENT_ITERATIONS
    )
    if found is None:
        return None
    end = found.point
    assert end.problem is not None
    residuals = end.problem.pairs.residuals
    rms = float(np.sqrt(np.average(residuals**2, weights=end.problem.weights)))
    e = se3.local(poles.T_target_source, end.T)
    return Refinement(
        PoseEstimate(end.T, end.covariance, rms),
        len(residuals),
        float(e @ prior @ e),
        se3.difference(poles.T_target_source, end.T),
        found.converged,
        found.iterations,
    )


def _is_small(step: Step) -> bool:
    rotation, translation = np.linalg.norm(step.step[:3]), np.linalg.norm(step.step[3:])
    return bool(rotation < STEP_ROTATION and translation < STEP_TRANSLATION)


def _linear_system(
    pairs: PatchPairs, prior: Array, from_poles: Array, range_bias: float
) -> _Problem:
    """Weigh the residuals, keep to what the surfaces hold, and add the poles."""
    r = pairs.residuals
    spread = np.sqrt(pairs.variance)
    spread = spread * max(MAD_TO_SIGMA * float(np.median(np.abs(r) / spread)), MIN_SIGMA)
    weights = 1.0 / (spread * (1.0 + (r / (ROBUST_WIDTH * spread)) ** 2)) ** 2
    held = held_directions(pairs, weights)
    offsets = ring_offsets(pairs, pairs.jacobian @ held, weights, range_bias)
    weighted = offsets.jacobian * weights[:, None]
    information = offsets.jacobian.T @ weighted + offsets.prior_information
    return _Problem(
        pairs,
        weights,
        offsets,
        gradient=weighted.T @ r + prior @ from_poles,
        curvature=information + prior,
    )


def _covariance(problem: _Problem, prior: Array) -> Array:
    """Covariance of the minimum, of residuals that are far from independent.

    ``Σ_c d_c d_cᵀ + H⁻¹ (V_b + V_c + Σ_poles⁻¹) H⁻¹``: ``d_c = (H − H_c)⁻¹ g_c`` is how far the
    answer goes without all residuals at one place, which may be correlated in any way (the
    jackknife over clusters, Bell and McCaffrey 2002); V_b is what the rings' offsets do to the
    gradient, V_c what an error of `PLACE_BIAS` does that all residuals of a cluster share.
    """
    H, offsets, cluster = problem.curvature, problem.offsets, problem.pairs.cluster
    J = offsets.jacobian
    JW = J * problem.weights[:, None]
    gradients = _summed(JW * offsets.residuals[:, None], cluster)
    outer = (JW[:, :, None] * J[:, None, :]).reshape(-1, 36)
    without = H - _summed(outer, cluster).reshape(-1, 6, 6)
    moves = np.linalg.solve(without, gradients[:, :, None])[:, :, 0]
    places = _summed(JW, cluster)
    inner = prior + offsets.prior_information + places.T @ places * PLACE_BIAS**2
    inverse = np.linalg.inv(H)
    return np.asarray(inverse @ inner @ inverse + moves.T @ moves)


def _summed(rows: Array, label: IntArray) -> Array:
    """Sums of rows (P, D) over each label."""
    return np.stack([np.bincount(label, column) for column in rows.T], axis=1)
