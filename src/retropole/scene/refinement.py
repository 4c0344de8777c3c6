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

from .. import se3
from ..datatypes import Array, IntArray, PointCloud, PoseEstimate
from .patches import PATCH_NEIGHBOURS, Patches, surface_patches

MAX_NORMAL_ANGLE = np.radians(35.0)
"""Two patches lie on one surface only if their normals agree so far."""

MIN_CORRESPONDENCE_DISTANCE = 0.10
"""Reach of the correspondences beyond three sigma of the pose, metres."""

SPAN = 0.5
"""Patches as far from each other along their surface may be one surface, metres; how well the one's
normal foretells the other's place is counted."""

MAX_CORRESPONDENCE_DISTANCE = 1.5
"""Reach of the correspondences at most, metres."""

RANGE_BIAS, BIAS_WEIGHT, BIAS_RANGE = 0.0035, 10.0, (0.001, 0.03)
"""1 σ of the range error that all returns of one beam share, metres: what is assumed, the number of
beams it counts for beside those that show theirs, and the bounds of the outcome. Makers state an
accuracy of 10 to 30 mm; part of it is common to all beams of both LiDARs and cancels."""

CLUSTER = 2.0
"""Residuals of patches within a cube of this side, metres, are counted as correlated."""

PLACE_BIAS = 0.0008
"""1 σ of what all patches of one place have in common, metres: a wall that is not flat, and the
thinning, which leaves more of the far tail of the noise than of the middle."""

MIN_HOLD = 6.0
"""A direction of the pose counts as held by the scene with so many times the information that the
noise of the normals alone would feign."""

MIN_PATCHES = 30
MIN_SIGMA = 1e-4
MAX_REFINEMENT_ITERATIONS = 40
STEP_ROTATION, STEP_TRANSLATION = 3e-6, 3e-5
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
    cluster
        (P,) which residuals share a place.
    beams_target, beams_source
        (P, PATCH_NEIGHBOURS) the beam of each point of the target's, of the source's patch.
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
    beams_target: IntArray
    beams_source: IntArray
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

    stage: PoseEstimate
    patches: int
    pull: float
    turned: float
    moved: float


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
    bias = RANGE_BIAS
    for _ in range(MAX_REFINEMENT_ITERATIONS):
        pairs = _pairs(target_patches, source_patches, tree, T, covariance, origins_known)
        if pairs is None:
            return None
        r, J = pairs.residuals, pairs.jacobian
        spread = np.sqrt(pairs.variance)
        scale = max(1.4826 * float(np.median(np.abs(r) / spread)), MIN_SIGMA)
        spread = scale * spread
        weights = 1.0 / (spread * (1.0 + (r / (2.0 * spread)) ** 2)) ** 2
        held = _held(pairs, weights)
        offsets = _beam_offsets(pairs, J @ held, weights, bias)
        bias = offsets.sigma
        H = offsets.jacobian.T @ (offsets.jacobian * weights[:, None]) + offsets.lost + prior
        gradient = (offsets.jacobian * weights[:, None]).T @ r
        gradient = gradient + prior @ se3.local(poles.T_target_source, T)
        step = -np.asarray(np.linalg.solve(H, gradient), dtype=np.float64)
        T = se3.retract(T, step)
        covariance = _covariance(H, offsets, weights, pairs, prior)
        if np.linalg.norm(step[:3]) < STEP_ROTATION and np.linalg.norm(step[3:]) < STEP_TRANSLATION:
            break
    e = se3.local(poles.T_target_source, T)
    rms = float(np.sqrt(np.average(r**2, weights=weights)))
    return Refinement(
        PoseEstimate(T, covariance, rms),
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
    reach = np.minimum(MIN_CORRESPONDENCE_DISTANCE + 3.0 * spread, MAX_CORRESPONDENCE_DISTANCE)
    span = max(float(reach.max()), SPAN)
    distance, nearest = tree.query(moved, distance_upper_bound=span)
    s = np.flatnonzero(distance <= np.maximum(reach, SPAN))
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
    near = np.abs(np.einsum("mi,mi->m", normal, moved[s] - target.centres[t])) <= reach[s]
    if np.count_nonzero(near) < MIN_PATCHES:
        return None
    s, t, normal = s[near], t[near], normal[near]
    rays_source = source.rays[s] @ T[:3, :3].T
    return Pairs(
        residuals=np.einsum("mi,mi->m", normal, moved[s] - target.centres[t]),
        jacobian=np.einsum("mi,mij->mj", normal, lever[s]),
        levers=lever[s],
        normal=normal,
        tilt=(source.tilt[s] + target.tilt[t]) / 4,
        variance=(source.thickness[s] + target.thickness[t]) / PATCH_NEIGHBOURS
        + (source.tilt[s] + target.tilt[t]) / 4 * distance[s] ** 2,
        cluster=_labels(np.floor(moved[s] / CLUSTER)),
        beams_target=target.beams[t],
        beams_source=source.beams[s],
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


def _summed(rows: Array, label: IntArray, count: int | None = None) -> Array:
    """Sums of rows (P, D) over each label."""
    size = 0 if count is None else count
    return np.stack([np.bincount(label, column, size) for column in rows.T], axis=1)


def _share_of_beams(beams: IntArray) -> Array:
    """Share (P, B) of each patch's points (P, PATCH_NEIGHBOURS) that came from each beam."""
    found, label = np.unique(beams, return_inverse=True)
    rows = np.arange(len(beams))[:, None] * len(found) + label.reshape(beams.shape)
    counts = np.bincount(rows.reshape(-1), minlength=len(beams) * len(found))
    return np.asarray(counts.reshape(len(beams), len(found)) / beams.shape[1])


@dataclass(frozen=True, eq=False)
class BeamOffsets:
    """Range offsets of the single beams of both LiDARs, which the patches feel.

    Attributes
    ----------
    jacobian
        (P, 6) derivative of the residuals by the pose, the offsets following along.
    residuals
        (P,) without what the offsets explain.
    lost
        (6, 6) what the offsets' own prior adds to the information, since following costs.
    spread
        (6, 6) variance of the gradient that comes of the offsets.
    sigma
        1 σ of an offset, metres.
    """

    jacobian: Array
    residuals: Array
    lost: Array
    spread: Array
    sigma: float


def _beam_offsets(pairs: Pairs, J: Array, weights: Array, sigma: float) -> BeamOffsets:
    """Take the range offsets of single beams out of the problem.

    With an offset b for each beam of either LiDAR, ``b ~ N(0, σ_b²)``, the residuals are
    ``r + J x + D b``. The best b is linear in x and put in its place: ``M = DᵀWD + σ_b⁻²``,
    ``J' = J − D M⁻¹ DᵀWJ``. σ_b is what the offsets themselves show (expectation-maximisation).
    """
    D = np.concatenate(
        [
            _share_of_beams(pairs.beams_target) * pairs.range_target[:, None],
            _share_of_beams(pairs.beams_source) * pairs.range_source[:, None],
        ],
        axis=1,
    )
    count = D.shape[1]
    DW = (D * weights[:, None]).T
    M = DW @ D + np.eye(count) / sigma**2
    inverse = np.linalg.inv(M)
    by_pose, by_residual = inverse @ (DW @ J), inverse @ (DW @ pairs.residuals)
    # Beams that hardly any patch feels keep their prior, and say nothing of its width.
    told = 1.0 - np.diag(inverse) / sigma**2
    square = float(np.sum(by_residual**2) + np.sum(told * np.diag(inverse)))
    assumed = BIAS_WEIGHT * RANGE_BIAS**2
    new = np.sqrt((assumed + square) / (BIAS_WEIGHT + float(np.sum(told))))
    return BeamOffsets(
        J - D @ by_pose,
        pairs.residuals - D @ by_residual,
        by_pose.T @ by_pose / sigma**2,
        by_pose.T @ by_pose / sigma**2,
        float(np.clip(new, *BIAS_RANGE)),
    )


def _covariance(
    H: Array, offsets: BeamOffsets, weights: Array, pairs: Pairs, prior: Array
) -> Array:
    """Covariance of the minimum, of residuals that are anything but independent.

    ``Σ_c d_c d_cᵀ + H⁻¹ (V_b + V_c + Σ_poles⁻¹) H⁻¹``: ``d_c = (H − H_c)⁻¹ g_c`` is how far the
    answer goes without all residuals at one place, which may be correlated as they please (the
    jackknife over clusters, Bell and McCaffrey 2002); V_b is what the beams' offsets do to the
    gradient, V_c what an error of `PLACE_BIAS` does that all residuals of a cluster share.
    """
    J = offsets.jacobian
    JW = J * weights[:, None]
    slopes = _summed(JW * offsets.residuals[:, None], pairs.cluster)
    outer = (JW[:, :, None] * J[:, None, :]).reshape(-1, 36)
    without = H - _summed(outer, pairs.cluster).reshape(-1, 6, 6)
    moves = np.linalg.solve(without, slopes[:, :, None])[:, :, 0]
    places = _summed(JW, pairs.cluster)
    meat = prior + offsets.spread + places.T @ places * PLACE_BIAS**2
    inverse = np.linalg.inv(H)
    return np.asarray(inverse @ meat @ inverse + moves.T @ moves)
