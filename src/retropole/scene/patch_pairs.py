"""Patches of both clouds that lie on one surface, and which directions of the pose they hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.spatial import cKDTree

from .. import se3
from ..datatypes import Array, IntArray
from .patches import PATCH_NEIGHBOURS, Patches

MAX_NORMAL_ANGLE = np.radians(35.0)
"""Two patches lie on one surface only if their normals agree so far, rad."""

MIN_CORRESPONDENCE_DISTANCE, MAX_CORRESPONDENCE_DISTANCE = 0.10, 1.5
"""Distance across the surface within which patches correspond: the first, metres, beyond
`POSE_SIGMAS` of the pose, and the second at most."""

POSE_SIGMAS = 3.0
"""So many σ of the pose at a patch are added to the correspondence distance."""

SPAN = 0.5
"""Patches as far from each other along their surface may be one surface, metres; how well the one's
normal predicts where the other lies is counted."""

CLUSTER_SIDE = 2.0
"""Residuals of patches within a cube of this side, metres, are counted as correlated."""

MIN_HOLD = 6.0
"""A direction of the pose counts as held by the scene with so many times the information that the
noise of the normals alone would imitate."""

MIN_PATCHES = 30
"""With fewer pairs of patches the scene has nothing to say: five for each parameter of the pose."""


@dataclass(frozen=True, eq=False)
class PatchPairs:
    """Patches of both clouds that lie on one surface under a pose, and how far they are apart.

    Attributes
    ----------
    residuals
        (P,) signed distance along the normal, metres.
    jacobian
        (P, 6) derivative with respect to ``[φ, δ]``.
    levers
        (P, 3, 6) derivative of where the source's patch lies.
    normal, tilt
        (P, 3) the mean normal, (P,) its variance, rad².
    variance
        (P,) of the residual as the patches' own scatter has it, m²: of their centres, and of their
        normals over the distance between the centres.
    cluster
        (P,) which residuals lie at one place.
    rings_target, rings_source
        (P, PATCH_NEIGHBOURS) the ring of each point of the target's, of the source's patch.
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
    rings_target: IntArray
    rings_source: IntArray
    range_target: Array
    range_source: Array


def pair_patches(
    target: Patches,
    source: Patches,
    tree: cKDTree,
    T: Array,
    covariance: Array,
    origins_known: bool,
) -> PatchPairs | None:
    """Pair each source patch with the target patch on its surface.

    Parameters
    ----------
    target, source
        Patches, each in its own frame.
    tree
        Of the target's centres.
    T, covariance
        (4, 4) and (6, 6) the pose and how far it may still be off: both steer how far a patch looks
        for its partner.
    origins_known
        As `refinement.refine` has it.

    Returns
    -------
    PatchPairs or None
        None where fewer than `MIN_PATCHES` pairs are found.
    """
    rotated = source.centres @ T[:3, :3].T
    moved = rotated + T[:3, 3]
    # How far each patch may still be off, from the covariance of the pose: tr(J Σ Jᵀ).
    lever = np.concatenate([-se3.hat(rotated), np.broadcast_to(np.eye(3), (len(moved), 3, 3))], 2)
    spread = np.sqrt(np.einsum("mik,mik->m", lever @ covariance, lever))
    distance_limit = np.minimum(
        MIN_CORRESPONDENCE_DISTANCE + 3.0 * spread, MAX_CORRESPONDENCE_DISTANCE
    )
    span = max(float(distance_limit.max()), SPAN)
    distance, nearest = tree.query(moved, distance_upper_bound=span)
    s = np.flatnonzero(distance <= np.maximum(distance_limit, SPAN))
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
    near = np.abs(np.einsum("mi,mi->m", normal, moved[s] - target.centres[t])) <= distance_limit[s]
    if np.count_nonzero(near) < MIN_PATCHES:
        return None
    s, t, normal = s[near], t[near], normal[near]
    rays_source = source.rays[s] @ T[:3, :3].T
    return PatchPairs(
        residuals=np.einsum("mi,mi->m", normal, moved[s] - target.centres[t]),
        jacobian=np.einsum("mi,mij->mj", normal, lever[s]),
        levers=lever[s],
        normal=normal,
        tilt=(source.tilt[s] + target.tilt[t]) / 4,
        variance=(source.thickness[s] + target.thickness[t]) / PATCH_NEIGHBOURS
        + (source.tilt[s] + target.tilt[t]) / 4 * distance[s] ** 2,
        cluster=labels_of(np.floor(moved[s] / CLUSTER_SIDE)),
        rings_target=target.rings[t],
        rings_source=source.rings[s],
        range_target=-np.einsum("mi,mi->m", normal, target.rays[t]),
        range_source=np.einsum("mi,mi->m", normal, rays_source),
    )


def held_directions(pairs: PatchPairs, weights: Array) -> Array:
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


def labels_of(cells: Array) -> IntArray:
    """Number the rows of (P, D) cell coordinates: equal rows, equal numbers."""
    whole = cells.astype(np.int64) - cells.min(axis=0).astype(np.int64)
    flat = np.ravel_multi_index(tuple(whole.T), tuple(whole.max(axis=0) + 1))
    return np.unique(flat, return_inverse=True)[1].astype(np.int64)
