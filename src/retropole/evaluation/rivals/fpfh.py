"""FPFH, RANSAC and GICP: registration of whole clouds without a start, by Open3D.

R. B. Rusu, N. Blodow and M. Beetz, *Fast point feature histograms (FPFH) for 3D registration*, ICRA
2009; Q.-Y. Zhou, J. Park and V. Koltun, *Open3D*, 2018. All its distances follow from one voxel, as
in Open3D's tutorial *Global registration*. Which voxel is best depends on the scene, so several are
tried. GICP refines the answer of each, and the one that ends with the most points that correspond
is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...base.datatypes import Array, PointCloud, PoseEstimate
from ...base.errors import MissingExtraError, Refusal
from ...base.quantities import counted
from ...surfaces.registration import MIN_CLOUD_POINTS, voxel_downsample
from .registration import register_clouds

FPFH_VOXELS = (0.7, 0.5)
"""Tried one after the other, metres: clouds are downsampled to one point per cube of this side (see
docs/compare.md for what set these)."""

NORMAL_RADIUS, FEATURE_RADIUS = 2.0, 5.0
"""Of normals and features, in voxels (the tutorial)."""

RANSAC_DISTANCE = 1.5
"""Points correspond under a pose that brings them so near, in voxels (the same)."""

EDGE_RATIO = 0.9
"""Least ratio of the sides of corresponding triangles (the same)."""

FPFH_NORMAL_NEIGHBOURS, FEATURE_NEIGHBOURS = 30, 100
"""At most, within the radius (the same)."""

RANSAC_POINTS = 3
"""Points of a hypothesis (the same)."""

RANSAC_ITERATIONS, RANSAC_CONFIDENCE = 100_000, 0.999
"""RANSAC ends at either (the same)."""

MIN_FITNESS = 0.1
"""Least share of the source's points that correspond under a pose (chosen: of right answers it is
0.36 and more). Open3D names none. Wrong answers often have more than right ones, so that a larger
least share would refuse right answers before wrong ones."""


class Matched(NamedTuple):
    """What one voxel ends with: a start (4, 4) of GICP, and its share of points."""

    start: Array
    fitness: float


def fpfh_ransac(
    target: PointCloud,
    source: PointCloud,
    rng: np.random.Generator,
    voxels: Sequence[float] = FPFH_VOXELS,
) -> PoseEstimate:
    """Match FPFH features by RANSAC at several voxels, and refine by GICP.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame. Intensities are not used.
    rng
        Seeds Open3D's own generator; with more than one thread its draws still vary.
    voxels
        To try, metres.

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

    open3d.utility.random.seed(int(rng.integers(2**31)))
    found = [_matched(open3d, target, source, voxel) for voxel in voxels]
    fit = max(each.fitness for each in found)
    starts = [each.start for each in found if each.fitness >= MIN_FITNESS]
    if not starts:
        raise Refusal(
            "unmatched",
            f"{100 * fit:.0f} % of the points agree with the best match of features, "
            f"{100 * MIN_FITNESS:.0f} % are needed; record where the LiDARs see more of the same",
            {"fitness": fit, "needed": MIN_FITNESS},
        )
    return register_clouds(target, source, starts)


def _matched(open3d: Any, target: PointCloud, source: PointCloud, voxel: float) -> Matched:
    """Match the features of both clouds at one voxel."""
    clouds = [_featured(open3d, cloud, voxel) for cloud in (target, source)]
    pipeline = open3d.pipelines.registration
    distance = RANSAC_DISTANCE * voxel
    found = pipeline.registration_ransac_based_on_feature_matching(
        clouds[1][0],
        clouds[0][0],
        clouds[1][1],
        clouds[0][1],
        True,
        distance,
        pipeline.TransformationEstimationPointToPoint(False),
        RANSAC_POINTS,
        [
            pipeline.CorrespondenceCheckerBasedOnEdgeLength(EDGE_RATIO),
            pipeline.CorrespondenceCheckerBasedOnDistance(distance),
        ],
        pipeline.RANSACConvergenceCriteria(RANSAC_ITERATIONS, RANSAC_CONFIDENCE),
    )
    T: Array = np.array(found.transformation, dtype=float)
    return Matched(T, float(found.fitness) if np.all(np.isfinite(T)) else 0.0)


def _featured(open3d: Any, cloud: PointCloud, voxel: float) -> tuple[Any, Any]:
    """Downsample a cloud, and describe each point by the normals around it (FPFH)."""
    points = voxel_downsample(cloud.xyz, voxel)
    if len(points) < MIN_CLOUD_POINTS:
        raise Refusal(
            "too_few_points",
            f"{counted(len(points), 'point is', 'points are')} left of a cloud downsampled to "
            f"{voxel:g} m, "
            f"{MIN_CLOUD_POINTS} are needed; record a scene with more in it",
            {"points": len(points), "needed": MIN_CLOUD_POINTS},
        )
    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    near = open3d.geometry.KDTreeSearchParamHybrid
    made.estimate_normals(near(radius=NORMAL_RADIUS * voxel, max_nn=FPFH_NORMAL_NEIGHBOURS))
    made.orient_normals_towards_camera_location(cloud.origin)
    features = open3d.pipelines.registration.compute_fpfh_feature(
        made, near(radius=FEATURE_RADIUS * voxel, max_nn=FEATURE_NEIGHBOURS)
    )
    return made, features
