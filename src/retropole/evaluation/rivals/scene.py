"""Registration of whole clouds from a start: what every rival but the planar one ends with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from ... import se3
from ...datatypes import Array, PointCloud, PoseEstimate
from ...errors import Refusal
from ...scene.registration import CORES, MIN_CLOUD_POINTS, prepare, register

REGISTRATION_VOXEL = 0.2
"""Clouds are thinned to one point per cube of this side, metres."""

MAX_REGISTRATION_ITERATIONS = 30
"""From a start that is nearly right; a third of them is what it takes."""

RESIDUAL_WITHIN = 0.3
"""Points with a neighbour of the other cloud within this distance count in the residual, metres."""


def register_scene(
    target: PointCloud,
    source: PointCloud,
    T_start: Array,
    *,
    method: Literal["ICP", "GICP"],
    reaches: Sequence[float],
    max_iterations: int = MAX_REGISTRATION_ITERATIONS,
) -> PoseEstimate:
    """Register two clouds from a start, with ever closer correspondences.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame.
    T_start
        (4, 4) start, target from source.
    method
        ``ICP`` is point to point, ``GICP`` plane to plane.
    reaches
        Largest distances of corresponding points, metres, one after the other.
    max_iterations
        Steps at most, for each reach.

    Returns
    -------
    PoseEstimate
        The pose, and the RMS distance of source points from their nearest target points, of those
        that have one within `RESIDUAL_WITHIN`.

    Raises
    ------
    Refusal
        ``too_few_points`` where a cloud is too small, ``no_overlap`` where too few points find
        each other, ``not_converged`` where the iterations run out, ``registration_failed`` where
        the result is not finite.
    """
    surfaces = (
        prepare(target.xyz, REGISTRATION_VOXEL, threads=CORES),
        prepare(source.xyz, REGISTRATION_VOXEL, threads=CORES),
    )
    T = T_start
    for reach in reaches:
        result = register(
            *surfaces, T, method=method, reach=reach, max_iterations=max_iterations, threads=CORES
        )
        T = result.T_target_source
    if not result.converged:
        raise Refusal(
            "not_converged",
            f"{method} still moves after {max_iterations} iterations; it needs a better start",
            {"iterations": max_iterations},
        )
    tree = cKDTree(surfaces[0].xyz)
    moved = se3.apply(T, surfaces[1].xyz)
    distance = tree.query(moved, distance_upper_bound=RESIDUAL_WITHIN, workers=CORES)[0]
    near = distance[np.isfinite(distance)]
    if len(near) < MIN_CLOUD_POINTS:
        raise Refusal(
            "no_overlap",
            f"{len(near)} of {len(moved)} points end within {RESIDUAL_WITHIN:g} m of the other cloud, "
            f"{MIN_CLOUD_POINTS} are needed; {method} needs a better start or clouds that overlap",
            {"points": len(near), "needed": MIN_CLOUD_POINTS},
        )
    return PoseEstimate(T, None, float(np.sqrt(np.mean(near**2))))
