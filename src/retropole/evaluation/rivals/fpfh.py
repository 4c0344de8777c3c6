"""FPFH, RANSAC and GICP: registration of whole clouds without a start, by Open3D.

R. B. Rusu, N. Blodow and M. Beetz, *Fast point feature histograms (FPFH) for 3D registration*, ICRA
2009; Q.-Y. Zhou, J. Park and V. Koltun, *Open3D*, 2018. GICP refines its answer.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...datatypes import Array, PointCloud, PoseEstimate
from ...errors import MissingExtraError, Refusal
from ...scene.registration import MIN_CLOUD_POINTS, voxel_downsample
from .registration import register_clouds

FPFH_VOXEL = 0.3
"""Clouds are downsampled to one point per cube of this side, metres (as for KISS-Matcher)."""

NORMAL_RADIUS, FEATURE_RADIUS = 2 * FPFH_VOXEL, 5 * FPFH_VOXEL
"""Of normals and features, metres, in the proportion of Open3D's tutorial *Global registration*."""

RANSAC_DISTANCE = 1.5 * FPFH_VOXEL
"""Points correspond under a pose that brings them so near, metres (the same tutorial)."""

EDGE_RATIO = 0.9
"""Least ratio of the sides of corresponding triangles (the same)."""

FPFH_NORMAL_NEIGHBOURS, FEATURE_NEIGHBOURS = 30, 100
"""At most, within the radius (the same)."""

RANSAC_POINTS = 3
"""Points of a hypothesis (the same)."""

RANSAC_ITERATIONS, RANSAC_CONFIDENCE = 100_000, 0.999
"""RANSAC ends at either (the same). Where the iterations run out first, `MIN_FITNESS` and GICP
decide whether its answer is good."""

MIN_FITNESS = 0.1
"""Least share of the source's points that correspond under the best pose (chosen)."""

FPFH_CORRESPONDENCE_DISTANCES = (1.0, 0.3)
"""Largest distances of GICP's corresponding points, one after the other, metres."""


def fpfh_ransac(target: PointCloud, source: PointCloud, rng: np.random.Generator) -> PoseEstimate:
    """Match FPFH features by RANSAC, and refine by GICP.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame. Intensities are not used.
    rng
        Seeds Open3D's own generator; with more than one thread its draws still vary.

    Raises
    ------
    MissingExtraError
        Without the extra ``open3d``.
    Refusal
        ``too_few_points``, ``unmatched`` where too few points agree, and as
        `registration.register_clouds`.
    """
    try:
        import open3d
    except ImportError as error:
        raise MissingExtraError("open3d", "the rival FPFH with RANSAC") from error

    clouds = [_featured(open3d, cloud) for cloud in (target, source)]
    open3d.utility.random.seed(int(rng.integers(2**31)))
    pipeline = open3d.pipelines.registration
    found = pipeline.registration_ransac_based_on_feature_matching(
        clouds[1][0],
        clouds[0][0],
        clouds[1][1],
        clouds[0][1],
        True,
        RANSAC_DISTANCE,
        pipeline.TransformationEstimationPointToPoint(False),
        RANSAC_POINTS,
        [
            pipeline.CorrespondenceCheckerBasedOnEdgeLength(EDGE_RATIO),
            pipeline.CorrespondenceCheckerBasedOnDistance(RANSAC_DISTANCE),
        ],
        pipeline.RANSACConvergenceCriteria(RANSAC_ITERATIONS, RANSAC_CONFIDENCE),
    )
    T: Array = np.array(found.transformation, dtype=float)
    if found.fitness < MIN_FITNESS or not np.all(np.isfinite(T)):
        raise Refusal(
            "unmatched",
            f"{100 * found.fitness:.0f} % of the points agree with the best match of features, "
            f"{100 * MIN_FITNESS:.0f} % are needed; record where the LiDARs see more of the same",
            {"fitness": float(found.fitness), "needed": MIN_FITNESS},
        )
    return register_clouds(
        target,
        source,
        T,
        method="GICP",
        max_correspondence_distances=FPFH_CORRESPONDENCE_DISTANCES,
    )


def _featured(open3d: Any, cloud: PointCloud) -> tuple[Any, Any]:
    """Downsample a cloud, and describe each point by the normals around it (FPFH)."""
    points = voxel_downsample(cloud.xyz, FPFH_VOXEL)
    if len(points) < MIN_CLOUD_POINTS:
        raise Refusal(
            "too_few_points",
            f"{len(points)} points are left of a cloud downsampled to {FPFH_VOXEL:g} m, "
            f"{MIN_CLOUD_POINTS} are needed; record a scene with more in it",
            {"points": len(points), "needed": MIN_CLOUD_POINTS},
        )
    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    near = open3d.geometry.KDTreeSearchParamHybrid
    made.estimate_normals(near(radius=NORMAL_RADIUS, max_nn=FPFH_NORMAL_NEIGHBOURS))
    made.orient_normals_towards_camera_location(cloud.origin)
    features = open3d.pipelines.registration.compute_fpfh_feature(
        made, near(radius=FEATURE_RADIUS, max_nn=FEATURE_NEIGHBOURS)
    )
    return made, features
