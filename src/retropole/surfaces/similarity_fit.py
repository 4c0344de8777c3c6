"""Registration of surfaces by a rigid motion, and if wanted by a common scale as well.

Point to plane (Chen and Medioni 1992) with robust weights (Geman and McClure 1987). A factor is one
column more of the normal equations, about the middle of the points that correspond (Umeyama 1991).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import small_gicp
from scipy.spatial import cKDTree

from ..alignment.solver import ROUNDING
from ..base import se3
from ..base.datatypes import Array
from .registration import MIN_CLOUD_POINTS, NORMAL_NEIGHBOURS, as_surface

DISTANCES = 1.5, 1.0, 0.6, 0.35, 0.35, 0.25, 0.25, 0.15, 0.15, 0.15
"""Largest distance of corresponding points, step by step, metres."""

RESIDUAL_WIDTH = 0.25
"""Residuals of this part of that distance have a quarter weight."""

MAX_CHANGE = 0.15
"""The factor changes by no larger part in one fit: where less and less corresponds, clouds would
shrink to a point."""

ON_SURFACE = 0.05
"""Distance from the surface that halves the support of a point, metres."""


@dataclass(frozen=True, eq=False)
class Planes:
    """A downsampled cloud, (N, 3), with the unit normal of its surface at each point."""

    points: Array
    normals: Array
    tree: cKDTree


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """Pose (4, 4) from the source once that is scaled by a factor about its own frame's origin."""

    T: Array
    factor: float


def planes_of(tree: cKDTree) -> Planes | None:
    """Estimate the normals of the points of a tree; None where they are too few."""
    points = np.asarray(tree.data)
    if len(points) < MIN_CLOUD_POINTS:
        return None
    surface = as_surface(points)
    small_gicp.estimate_normals_covariances(
        surface.cloud, surface.tree, num_neighbors=NORMAL_NEIGHBOURS, num_threads=1
    )
    return Planes(points, np.array(surface.cloud.normals())[:, :3], tree)


def fit_similarity(
    target: Planes, source: Array, T_start: Array, *, free_factor: bool
) -> SimilarityFit | None:
    """Lay points (N, 3) on surfaces, from a pose (4, 4) on.

    Returns
    -------
    SimilarityFit or None
        None where too little corresponds, or the factor leaves `MAX_CHANGE`. The factor is 1 unless
        it is free.
    """
    moved, T, factor = se3.apply(T_start, source), T_start, 1.0
    for limit in DISTANCES:
        distance, index = target.tree.query(moved, distance_upper_bound=limit)
        near = np.isfinite(distance)
        if np.count_nonzero(near) < MIN_CLOUD_POINTS:
            return None
        points, normals = moved[near], target.normals[index[near]]
        residuals = np.einsum("ij,ij->i", normals, points - target.points[index[near]])
        middle = points.mean(axis=0)
        arms = points - middle
        J = np.column_stack([np.cross(arms, normals), normals, np.sum(arms * normals, axis=1)])
        J = J if free_factor else J[:, :6]
        weights = 1.0 / (1.0 + (residuals / (RESIDUAL_WIDTH * limit)) ** 2) ** 2
        information = (J * weights[:, None]).T @ J
        # A little, where surfaces leave a direction free.
        information += ROUNDING * np.trace(information) / len(information) * np.eye(J.shape[1])
        step = -np.linalg.solve(information, J.T @ (weights * residuals))
        by = 1.0 + float(step[6]) if free_factor else 1.0
        turn = by * se3.exp_so3(step[:3])
        moved = (moved - middle) @ turn.T + middle + step[3:6]
        factor *= by
        if abs(np.log(max(factor, 1e-9))) > MAX_CHANGE:
            return None
        # A point p becomes  by·E(q − m) + m + δ  with  q = T(factor·p).
        T = se3.from_rt((turn / by) @ T[:3, :3], turn @ (T[:3, 3] - middle) + middle + step[3:6])
    return SimilarityFit(T, factor)


def support(target: Planes, moved: Array) -> float:
    """How many of some points (N, 3) lie on the target's surfaces, those beside them in part."""
    distance, index = target.tree.query(moved, distance_upper_bound=DISTANCES[0])
    near = np.isfinite(distance)
    apart = moved[near] - target.points[index[near]]
    off = np.einsum("ij,ij->i", target.normals[index[near]], apart)
    return float(np.sum(1.0 / (1.0 + (off / ON_SURFACE) ** 2)))
