"""Registration of whole clouds from given starts: what every rival but the planar one ends with.

From the identity, as if the two frames were one, it is a rival of its own: ICP point to point (Besl
and McKay 1992), the other rival of Xue et al. 2019, Table IV; and plane to plane (Segal, Haehnel
and Thrun 2009).
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from ...base import se3
from ...base.datatypes import Array, PointCloud, PoseEstimate
from ...base.errors import Refusal
from ...surfaces.registration import (
    CORES,
    MIN_CLOUD_POINTS,
    Registration,
    Surface,
    prepare,
    register,
)

REGISTRATION_VOXEL = 0.2
"""Clouds are downsampled to one point per cube of this side, metres."""

MAX_REGISTRATION_ITERATIONS = 300
"""At the last distance: what converges at all is not refused for want of steps (docs/compare.md
states how many were taken)."""

MAX_APPROACH_ITERATIONS = 100
"""At each distance before it: enough after a match (the same). From the identity it may cut off an
approach, which the last distance goes on with."""

MATCHED_DISTANCES = 1.0, 0.3
"""Largest distances of corresponding points after a match, one after the other, metres."""

RESIDUAL_DISTANCE = 0.3
"""Points with a neighbour in the other cloud within this distance count in the residual, metres."""


def register_clouds(
    target: PointCloud,
    source: PointCloud,
    starts: Sequence[Array],
    *,
    method: Literal["ICP", "GICP"] = "GICP",
    max_correspondence_distances: Sequence[float] = MATCHED_DISTANCES,
    max_iterations: int = MAX_REGISTRATION_ITERATIONS,
) -> PoseEstimate:
    """Register two clouds from each of the starts, with ever closer correspondences.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame.
    starts
        (4, 4) each, target from source; at least one. The answer is from the one that ends with
        the most points that correspond, of those that converge.
    method
        ``ICP`` is point to point, ``GICP`` plane to plane.
    max_correspondence_distances
        Metres, one after the other. Only the last registration has to converge: those before it
        bring its start nearer.
    max_iterations
        At most, at the last distance; `MAX_APPROACH_ITERATIONS` before it.

    Returns
    -------
    PoseEstimate
        The pose, and the RMS distance of source points from their nearest target points, of those
        that have one within `RESIDUAL_DISTANCE`.

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
    ends = [
        _refined(surfaces, start, method, max_correspondence_distances, max_iterations)
        for start in starts
    ]
    converged = [end for end in ends if end.converged]
    if not converged:
        raise Refusal(
            "not_converged",
            f"{method} still moves after {max_iterations} iterations; it needs a better start",
            {"iterations": max_iterations},
        )
    T = max(converged, key=attrgetter("inliers")).T_target_source
    tree = cKDTree(surfaces[0].xyz)
    aligned = se3.apply(T, surfaces[1].xyz)
    distances = tree.query(aligned, distance_upper_bound=RESIDUAL_DISTANCE, workers=CORES)[0]
    near = distances[np.isfinite(distances)]
    if len(near) < MIN_CLOUD_POINTS:
        raise Refusal(
            "no_overlap",
            f"{len(near)} of {len(aligned)} points end within {RESIDUAL_DISTANCE:g} m of the other "
            f"cloud, {MIN_CLOUD_POINTS} are needed; {method} needs a better start or clouds that "
            "overlap",
            {"points": len(near), "needed": MIN_CLOUD_POINTS},
        )
    return PoseEstimate(T, None, float(np.sqrt(np.mean(near**2))))


def _refined(
    surfaces: tuple[Surface, Surface],
    T_start: Array,
    method: Literal["ICP", "GICP"],
    max_correspondence_distances: Sequence[float],
    max_iterations: int,
) -> Registration:
    """Register the source's surfaces to the target's, each distance from where the last ended."""
    end = Registration(T_start, 0, converged=False)
    *approach, last = max_correspondence_distances
    before = min(MAX_APPROACH_ITERATIONS, max_iterations)
    for distance, at_most in [*((each, before) for each in approach), (last, max_iterations)]:
        end = register(
            *surfaces,
            end.T_target_source,
            method=method,
            max_correspondence_distance=distance,
            max_iterations=at_most,
            threads=CORES,
        )
    return end


ICP_CORRESPONDENCE_DISTANCES = (3.0, 1.0, 0.3)
"""Largest distances of corresponding points, one after the other, metres (chosen: from the error
of a bad start to that of a good one)."""


def icp(target: PointCloud, source: PointCloud, rng: np.random.Generator) -> PoseEstimate:
    """Register two clouds by point-to-point ICP.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame. Intensities are not used.
    rng
        Not used: nothing is drawn.

    Raises
    ------
    Refusal
        As `register_clouds`.
    """
    distances = ICP_CORRESPONDENCE_DISTANCES
    return register_clouds(
        target, source, [np.eye(4)], method="ICP", max_correspondence_distances=distances
    )


def gicp(target: PointCloud, source: PointCloud, rng: np.random.Generator) -> PoseEstimate:
    """Register two clouds by GICP (small_gicp).

    Parameters
    ----------
    target, source
        Clouds, each in its own frame. Intensities are not used.
    rng
        Not used: nothing is drawn.

    Raises
    ------
    Refusal
        As `register_clouds`.
    """
    distances = ICP_CORRESPONDENCE_DISTANCES
    return register_clouds(target, source, [np.eye(4)], max_correspondence_distances=distances)
