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
import small_gicp
from scipy.spatial import cKDTree

from . import se3
from .datatypes import Array, IntArray, PointCloud, Stage
from .registration import THREADS, thin

VOXEL = 0.15
"""Patches are centred on one point per cube of this side, metres."""

NEIGHBOURS = 16
"""Thinned points that a patch is fitted to."""

MAX_THICKNESS = 0.03
"""RMS distance of a patch's points from its plane, metres, above which it is no surface."""

MIN_SPREAD = 0.15
"""Least ratio of a patch's two extents: below it the points are one ring, whose plane is free."""

MAX_NORMAL_ANGLE = np.radians(35.0)
"""Two patches lie on one surface only if their normals agree so far."""

FINEST_REACH = 0.10
"""Reach of the correspondences beyond three sigma of the pose, metres."""

COARSEST_REACH = 1.5
"""Reach of the correspondences at most, metres."""

CLUSTER = 2.0
"""Residuals of patches within a cube of this side, metres, are counted as correlated."""

MAX_ITERATIONS = 40
MIN_PATCHES = 30


@dataclass(frozen=True, eq=False)
class Patches:
    """Small flat pieces of a cloud's surfaces.

    Attributes
    ----------
    centres
        (M, 3) mean of the points of each patch, metres.
    normals
        (M, 3) unit normals, turned to the sensor.
    """

    centres: Array
    normals: Array


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
    """

    stage: Stage
    patches: int
    pull: float


def surface_patches(cloud: PointCloud) -> Patches:
    """Fit planes to the neighbourhoods of a thinned cloud and keep the flat ones."""
    points = thin(cloud.xyz, VOXEL)
    if len(points) < NEIGHBOURS:
        return Patches(np.zeros((0, 3)), np.zeros((0, 3)))
    tree = small_gicp.KdTree(points, num_threads=THREADS)
    index, _ = tree.batch_knn_search(points, NEIGHBOURS, num_threads=THREADS)
    neighbours = points[np.asarray(index, dtype=np.intp)]
    centres = neighbours.mean(axis=1)
    centred = neighbours - centres[:, None]
    values, vectors = np.linalg.eigh(np.einsum("mki,mkj->mij", centred, centred) / NEIGHBOURS)
    flat = (values[:, 0] < MAX_THICKNESS**2) & (values[:, 1] > MIN_SPREAD**2 * values[:, 2])
    flat &= values[:, 0] < 0.1 * values[:, 1]
    centres, normals = centres[flat], vectors[flat, :, 0]
    facing = np.einsum("mi,mi->m", normals, cloud.origin - centres) >= 0
    return Patches(centres, np.where(facing[:, None], normals, -normals))


def refine(
    target: PointCloud, source: PointCloud, poles: Stage, *, origins_known: bool = True
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
    prior = np.linalg.inv(poles.covariance)
    T, covariance = poles.T_target_source, poles.covariance
    for _ in range(MAX_ITERATIONS):
        pairs = _pairs(target_patches, source_patches, tree, T, covariance, origins_known)
        if pairs is None:
            return None
        residuals, J, cell = pairs
        sigma = max(1.4826 * float(np.median(np.abs(residuals))), 1e-4)
        weights = 1.0 / (1.0 + (residuals / (2.0 * sigma)) ** 2) ** 2
        JW = J * (weights / sigma**2)[:, None]
        step_to_prior = se3.local(poles.T_target_source, T)
        H = JW.T @ J + prior
        gradient = JW.T @ residuals + prior @ step_to_prior
        step = -np.linalg.solve(H, gradient)
        T = se3.retract(T, step)
        covariance = _sandwich(H, JW, residuals, cell, prior)
        if np.linalg.norm(step[:3]) < 1e-6 and np.linalg.norm(step[3:]) < 1e-5:
            break
    e = se3.local(poles.T_target_source, T)
    rms = float(np.sqrt(np.average(residuals**2, weights=weights)))
    return Refinement(Stage(T, covariance, rms), len(residuals), float(e @ prior @ e))


def _pairs(
    target: Patches,
    source: Patches,
    tree: cKDTree,
    T: Array,
    covariance: Array,
    origins_known: bool,
) -> tuple[Array, Array, IntArray] | None:
    """Residuals, Jacobian and cluster of each pair of patches within reach, or None if too few."""
    rotated = source.centres @ T[:3, :3].T
    moved = rotated + T[:3, 3]
    # How far each patch may still be off, from the covariance of the pose: J Σ Jᵀ.
    lever = np.concatenate([-se3.hat(rotated), np.broadcast_to(np.eye(3), (len(moved), 3, 3))], 2)
    spread = np.sqrt(np.einsum("mij,jk,mik->m", lever, covariance, lever))
    reach = np.minimum(FINEST_REACH + 3.0 * spread, COARSEST_REACH)
    distance, nearest = tree.query(moved, distance_upper_bound=float(reach.max()), workers=THREADS)
    kept = distance <= reach
    nearest = nearest[kept]
    n_source = source.normals[kept] @ T[:3, :3].T
    n_target = target.normals[nearest]
    cosine = np.einsum("mi,mi->m", n_source, n_target)
    if not origins_known:
        n_source, cosine = n_source * np.sign(cosine)[:, None], np.abs(cosine)
    agree = cosine > np.cos(MAX_NORMAL_ANGLE)
    if np.count_nonzero(agree) < MIN_PATCHES:
        return None
    kept_rows = np.flatnonzero(kept)[agree]
    normal = n_source[agree] + n_target[agree]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    gap = moved[kept_rows] - target.centres[nearest[agree]]
    residuals = np.einsum("mi,mi->m", normal, gap)
    J = np.concatenate([np.cross(rotated[kept_rows], normal), normal], axis=1)
    cells = np.floor(moved[kept_rows] / CLUSTER).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    return residuals, J, cell.reshape(-1)


def _sandwich(H: Array, JW: Array, residuals: Array, cell: IntArray, prior: Array) -> Array:
    """Covariance that holds when the residuals of one cluster are correlated as they please.

    ``H⁻¹ (Σ_c g_c g_cᵀ + Σ_poles⁻¹) H⁻¹``, g_c the gradient of cluster c (Liang and Zeger 1986).
    """
    scores = np.zeros((int(cell.max()) + 1, 6))
    np.add.at(scores, cell, JW * residuals[:, None])
    clusters = len(scores)
    meat = scores.T @ scores * (clusters / max(clusters - 6, 1)) + prior
    inverse = np.linalg.inv(H)
    return np.asarray(inverse @ meat @ inverse)
