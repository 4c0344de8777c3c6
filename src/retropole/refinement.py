"""Poles and scene in one problem: the pose that both agree on.

The poles give a pose and its covariance; the scene adds the distances between surface patches that
both LiDARs see. Minimised together:

    Σ_i ρ( n_i · (R c_i + t − d_i) / σ )  +  e(T)ᵀ Σ_poles⁻¹ e(T)

with c_i the centre of a patch of the source, d_i of its nearest patch of the target, n_i the mean
of their normals, σ the scale of these residuals taken from themselves, and e(T) the step from the
poles' pose to T. A direction that the scene does not hold (along a corridor, over open ground) has
no part in the first sum and stays where the poles put it; one that it holds becomes as sharp as the
surfaces are. Coarse to fine: a patch may reach as far as the pose is still uncertain at its place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.spatial import cKDTree

from . import se3
from .datatypes import Array, IntArray, PointCloud, Stage
from .patches import NEIGHBOURS, Patches, surface_patches
from .registration import THREADS

MAX_NORMAL_ANGLE = np.radians(35.0)
"""Two patches lie on one surface only if their normals agree so far."""

FINEST_REACH = 0.10
"""Reach of the correspondences beyond three sigma of the pose, metres."""

COARSEST_REACH = 1.5
"""Reach of the correspondences at most, metres."""

RANGE_BIAS = 0.0035
"""1 σ of the range error that all returns of one beam share, metres. Makers state an accuracy of
10 to 30 mm; part of it is common to all beams of both LiDARs and cancels."""

BEAM = np.radians(0.5)
"""Returns within a band of elevation of this width are taken as one beam's."""

CLUSTER = 2.0
"""Residuals of patches within a cube of this side, metres, are counted as correlated."""

MIN_HOLD = 6.0
"""A direction of the pose counts as held by the scene with so many times the information that the
noise of the normals alone would feign."""

MIN_PATCHES = 30
MIN_SIGMA = 1e-4
MAX_ITERATIONS = 40
STEP_ROTATION, STEP_TRANSLATION = 1e-6, 1e-5
"""Stop where a step is below these, rad and m."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Patches of both clouds that lie on one surface under a pose, and how far they are apart.

    Attributes
    ----------
    residuals
        (P,) signed distance along the normal, metres.
    jacobian
        (P, 6) derivative with respect to ``[φ, δ]``.
    levers
        (P, 3, 6) derivative of the place of the source's patch.
    normal, tilt
        (P, 3) the mean normal, (P,) its variance, rad².
    variance
        (P,) of the residual as the patches' own scatter has it, m²: of their centres, and of their
        normals over the distance between the centres.
    cluster, beam_target, beam_source
        (P,) which residuals share a place, a beam of the target, a beam of the source.
    range_target, range_source
        (P,) derivative of the residual with respect to the range that the LiDAR measured.
    """

    residuals: Array
    jacobian: Array
    levers: Array
    normal: Array
    tilt: Array
    variance: Array
    cluster: IntArray
    beam_target: IntArray
    beam_source: IntArray
    range_target: Array
    range_source: Array


@dataclass(frozen=True, eq=False)
class Refinement:
    """The pose that poles and scene agree on.

    Attributes
    ----------
    stage
        Pose, covariance, and RMS residual of the patches.
    patches
        How many pairs of patches took part.
    pull
        Squared Mahalanobis distance of the pose from the poles' own: χ² with 6 degrees of freedom
        where both tell the truth.
    turned, moved
        The same step in rad, and in metres at the source's own origin.
    """

    stage: Stage
    patches: int
    pull: float
    turned: float
    moved: float


def refine(
    target: PointCloud, source: PointCloud, poles: Stage, *, origins_known: bool = False
) -> Refinement | None:
    """Let the scene sharpen the pose that the poles give.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame.
    poles
        Pose and covariance of the poles.
    origins_known
        Whether the beams of both clouds start where `PointCloud.origin` says; without, a thing's
        front and its back cannot be told apart by their normals.

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
    T: Array = poles.T_target_source
    covariance: Array = poles.covariance
    for _ in range(MAX_ITERATIONS):
        pairs = _pairs(target_patches, source_patches, tree, T, covariance, origins_known)
        if pairs is None:
            return None
        r, J = pairs.residuals, pairs.jacobian
        spread = np.sqrt(pairs.variance)
        scale = max(1.4826 * float(np.median(np.abs(r) / spread)), MIN_SIGMA)
        spread = scale * spread
        weights = 1.0 / (spread * (1.0 + (r / (2.0 * spread)) ** 2)) ** 2
        held = _held(pairs, weights)
        J = J @ held
        JW = J * weights[:, None]
        H = JW.T @ J + prior
        gradient = JW.T @ r + prior @ se3.local(poles.T_target_source, T)
        step = -np.asarray(np.linalg.solve(H, gradient), dtype=np.float64)
        T = se3.retract(T, step)
        covariance = _covariance(H, J, JW, pairs, prior)
        if np.linalg.norm(step[:3]) < STEP_ROTATION and np.linalg.norm(step[3:]) < STEP_TRANSLATION:
            break
    e = se3.local(poles.T_target_source, T)
    rms = float(np.sqrt(np.average(r**2, weights=weights)))
    return Refinement(
        Stage(T, covariance, rms),
        len(r),
        float(e @ prior @ e),
        float(np.linalg.norm(e[:3])),
        float(np.linalg.norm(e[3:])),
    )


def _pairs(
    target: Patches,
    source: Patches,
    tree: cKDTree,
    T: Array,
    covariance: Array,
    origins_known: bool,
) -> Pairs | None:
    """Pair each source patch with the target patch on its surface; None where too few do."""
    rotated = source.centres @ T[:3, :3].T
    moved = rotated + T[:3, 3]
    # How far each patch may still be off, from the covariance of the pose: tr(J Σ Jᵀ).
    lever = np.concatenate([-se3.hat(rotated), np.broadcast_to(np.eye(3), (len(moved), 3, 3))], 2)
    spread = np.sqrt(np.einsum("mik,mik->m", lever @ covariance, lever))
    reach = np.minimum(FINEST_REACH + 3.0 * spread, COARSEST_REACH)
    distance, nearest = tree.query(moved, distance_upper_bound=float(reach.max()), workers=THREADS)
    s = np.flatnonzero(distance <= reach)
    t = nearest[s]
    normal_source = source.normals[s] @ T[:3, :3].T
    cosine = np.einsum("mi,mi->m", normal_source, target.normals[t])
    if not origins_known:
        normal_source, cosine = normal_source * np.sign(cosine)[:, None], np.abs(cosine)
    agree = cosine > np.cos(MAX_NORMAL_ANGLE)
    if np.count_nonzero(agree) < MIN_PATCHES:
        return None
    s, t = s[agree], t[agree]
    normal = normal_source[agree] + target.normals[t]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rays_source = source.rays[s] @ T[:3, :3].T
    return Pairs(
        residuals=np.einsum("mi,mi->m", normal, moved[s] - target.centres[t]),
        jacobian=np.einsum("mi,mij->mj", normal, lever[s]),
        levers=lever[s],
        normal=normal,
        tilt=(source.tilt[s] + target.tilt[t]) / 4,
        variance=(source.thickness[s] + target.thickness[t]) / NEIGHBOURS
        + (source.tilt[s] + target.tilt[t]) / 4 * distance[s] ** 2,
        cluster=_labels(np.floor(moved[s] / CLUSTER)),
        beam_target=_labels(np.floor(np.arcsin(target.rays[t, 2:]) / BEAM)),
        beam_source=_labels(np.floor(np.arcsin(source.rays[s, 2:]) / BEAM)),
        range_target=-np.einsum("mi,mi->m", normal, target.rays[t]),
        range_source=np.einsum("mi,mi->m", normal, rays_source),
    )


def _held(pairs: Pairs, weights: Array) -> Array:
    """Projection (6, 6) onto the steps that the surfaces hold, and not the noise of their normals.

    The normal of flat ground errs by a degree here and there, and thousands of such errors seem to
    hold a pose along the ground: information of that kind is what ``H_n``, the sum over the two
    tangents of each patch by the variance of its normal, says. Of the generalised eigenvectors of
    ``H_s v = λ H_n v``, those with λ below `MIN_HOLD` are left to the poles.
    """
    across = np.eye(3) - pairs.normal[:, :, None] * pairs.normal[:, None, :]
    tangents = across @ pairs.levers
    noise = np.einsum("m,mij,mik->jk", weights * pairs.tilt, tangents, tangents)
    scene = (pairs.jacobian.T * weights) @ pairs.jacobian
    scale = 1.0 / np.sqrt(np.diag(noise) + 1e-300)
    noise = noise * np.outer(scale, scale) + 1e-9 * np.eye(6)
    values, vectors = eigh(scene * np.outer(scale, scale), noise)
    kept = vectors[:, values >= MIN_HOLD]
    # The vectors are orthonormal under H_n: v vᵀ H_n projects onto them.
    projection = kept @ kept.T @ noise
    return np.asarray(scale[:, None] * projection / scale[None, :])


def _labels(cells: Array) -> IntArray:
    """Number the rows of (P, D) cell coordinates: equal rows, equal numbers."""
    whole = cells.astype(np.int64) - cells.min(axis=0).astype(np.int64)
    flat = np.ravel_multi_index(tuple(whole.T), tuple(whole.max(axis=0) + 1))
    return np.unique(flat, return_inverse=True)[1].astype(np.int64)


def _grouped(rows: Array, label: IntArray) -> Array:
    """Outer products of the sums of rows (P, 6) over each label, added up: (6, 6)."""
    sums = _summed(rows, label)
    return np.asarray(sums.T @ sums)


def _summed(rows: Array, label: IntArray) -> Array:
    """Sums of rows (P, D) over each label."""
    return np.stack([np.bincount(label, weights=column) for column in rows.T], axis=1)


def _covariance(H: Array, J: Array, JW: Array, pairs: Pairs, prior: Array) -> Array:
    """Covariance of the minimum, of residuals that are anything but independent.

    ``Σ_c d_c d_cᵀ + H⁻¹ (Σ_b s_b s_bᵀ σ_b² + Σ_poles⁻¹) H⁻¹``: ``d_c = (H − H_c)⁻¹ g_c`` is how far
    the answer goes without all residuals at one place, which may be correlated as they please (the
    jackknife over clusters, Bell and McCaffrey 2002); s_b is what a range error shared by all
    returns of beam b does to the gradient. The first is seen in the residuals; the second moves the
    answer and leaves few traces there, so its size is an assumption, `RANGE_BIAS`.
    """
    slopes = _summed(JW * pairs.residuals[:, None], pairs.cluster)
    outer = (JW[:, :, None] * J[:, None, :]).reshape(-1, 36)
    without = H - _summed(outer, pairs.cluster).reshape(-1, 6, 6)
    moves = np.linalg.solve(without, slopes[:, :, None])[:, :, 0]
    meat = prior
    for beam, derivative in (
        (pairs.beam_target, pairs.range_target),
        (pairs.beam_source, pairs.range_source),
    ):
        meat = meat + _grouped(JW * derivative[:, None], beam) * RANGE_BIAS**2
    inverse = np.linalg.inv(H)
    return np.asarray(inverse @ meat @ inverse + moves.T @ moves)
