"""Other ways to the same transform, to compare with ours.

Each is a function ``(target, source, rng) -> PoseEstimate`` that raises `Refusal` where it has no
answer. None of them uses the poles. To add one, write it here, and name it in `FUNCTIONS` and in
`methods.RIVALS`.

All end with a registration of the whole clouds from given starts. From the identity, as if the two
frames were one, that is a rival in itself: ICP point to point (Besl and McKay 1992), a rival of
Xue et al. 2019, Table IV; and plane to plane (Segal, Haehnel and Thrun 2009). Two find a start:

- H. Lim et al., *KISS-Matcher: Fast and Robust Point Cloud Registration Revisited*, ICRA 2025:
  point features, outliers pruned by a graph, a robust solver. All its radii and noise bounds follow
  from one voxel. Which is best depends on the scene, so several are tried, and its own number of
  final inliers chooses. The answer differs a little from run to run.
- R. B. Rusu, N. Blodow and M. Beetz, *Fast point feature histograms (FPFH) for 3D registration*,
  ICRA 2009; Q.-Y. Zhou, J. Park and V. Koltun, *Open3D*, 2018. All its distances follow from one
  voxel, as in Open3D's tutorial *Global registration*. GICP refines the answer of each voxel, and
  the one that ends with the most points that correspond is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..base import se3
from ..base.datatypes import Array, PointCloud, PoseEstimate
from ..base.errors import MissingExtraError, Refusal
from ..base.quantities import counted
from ..surfaces.registration import (
    CORES,
    MIN_CLOUD_POINTS,
    Registration,
    Surface,
    prepare,
    register,
    voxel_downsample,
)

Method = Callable[[PointCloud, PointCloud, np.random.Generator], PoseEstimate]

REGISTRATION_VOXEL = 0.2
"""Clouds are downsampled to one point per cube of this side, metres."""

MAX_REGISTRATION_ITERATIONS = 300
"""At the last distance: what converges at all is not refused for want of steps
(docs/evidence/compare.md states how many were taken)."""

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
        Clouds, each in the frame of its LiDAR.
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
        ``too_few_points`` if a cloud is too small, ``no_overlap`` if too few points find each
        other, ``not_converged`` if the iterations run out, ``registration_failed`` if the result is
        not finite.
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
            f"{method} still moves after {max_iterations} iterations; it needs a better initial "
            "pose",
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
            f"{len(near)} of {len(aligned)} points end within {RESIDUAL_DISTANCE:g} m of the "
            f"other cloud, {MIN_CLOUD_POINTS} are needed; {method} needs a better initial pose, "
            "or clouds that overlap",
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
        Clouds, each in the frame of its LiDAR. Intensities are not used.
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
        Clouds, each in the frame of its LiDAR. Intensities are not used.
    rng
        Not used: nothing is drawn.

    Raises
    ------
    Refusal
        As `register_clouds`.
    """
    distances = ICP_CORRESPONDENCE_DISTANCES
    return register_clouds(target, source, [np.eye(4)], max_correspondence_distances=distances)


KISS_VOXELS = (1.0, 0.5, 0.2)
"""Tried one after the other, metres: from the quickest to the slowest. Its authors' examples take
0.2 and 0.3 for a single sweep and 2 for maps (see docs/evidence/compare.md for what set these)."""

ENOUGH_INLIERS = 15
"""With this many final inliers no further voxel is tried (see docs/evidence/compare.md)."""

MIN_INLIERS = 5
"""With fewer final inliers, its authors' examples call the answer a failure."""


class Matched(NamedTuple):
    """What one voxel ends with: a start (4, 4) of GICP, and how many or which share agrees."""

    start: Array
    support: float


def kiss_matcher(
    target: PointCloud,
    source: PointCloud,
    rng: np.random.Generator,
    voxels: Sequence[float] = KISS_VOXELS,
) -> PoseEstimate:
    """Match the clouds by KISS-Matcher with the best of several voxels, and refine by GICP.

    Its other settings are its defaults.

    Parameters
    ----------
    target, source
        Clouds, each in the frame of its LiDAR. Intensities are not used.
    rng
        Not used: KISS-Matcher draws by itself.
    voxels
        To try, metres.

    Raises
    ------
    MissingExtraError
        Without the extra ``kiss``.
    Refusal
        ``too_few_points``, ``unmatched`` where it calls its answer a failure itself, and as
        `register_clouds`.
    """
    try:
        import kiss_matcher as matching
    except ImportError as error:
        raise MissingExtraError("kiss", "the rival KISS-Matcher") from error

    if min(len(target), len(source)) < MIN_CLOUD_POINTS:
        raise Refusal(
            "too_few_points",
            f"clouds of {len(target)} and {len(source)} points, {MIN_CLOUD_POINTS} are needed each",
            {"target": len(target), "source": len(source), "needed": MIN_CLOUD_POINTS},
        )
    best = best_match(matching, target, source, voxels)
    if best.support < MIN_INLIERS:
        raise Refusal(
            "unmatched",
            f"KISS-Matcher ends with {best.support:g} correspondences that agree, {MIN_INLIERS} "
            "are needed; record a scene with more objects, or where the LiDARs see more common "
            "objects",
            {"inliers": best.support, "needed": MIN_INLIERS},
        )
    return register_clouds(target, source, [best.start])


def best_match(
    matching: Any,
    target: PointCloud,
    source: PointCloud,
    voxels: Sequence[float] = KISS_VOXELS,
) -> Matched:
    """Try the voxels until one has enough inliers; else take the one with the most.

    Parameters
    ----------
    matching
        The module ``kiss_matcher``.
    target, source
        Clouds, each in the frame of its LiDAR.
    voxels
        To try, metres.

    Returns
    -------
    Matched
        Without inliers where KISS-Matcher calls its answer at every voxel invalid.
    """
    clouds = source.xyz.astype(np.float32), target.xyz.astype(np.float32)
    best = Matched(np.eye(4), 0)
    for voxel in voxels:
        matcher = matching.KISSMatcher(matching.KISSMatcherConfig(voxel))
        found = matcher.estimate(*clouds)
        T = se3.from_rt(
            np.asarray(found.rotation, dtype=float),
            np.asarray(found.translation, dtype=float).reshape(3),
        )
        if found.valid and np.all(np.isfinite(T)):
            best = max(best, Matched(T, matcher.get_num_final_inliers()), key=attrgetter("support"))
        if best.support >= ENOUGH_INLIERS:
            break
    return best


FPFH_VOXELS = (0.7, 0.5)
"""Tried one after the other, metres: clouds are downsampled to one point per cube of this side (see
docs/evidence/compare.md for what set these)."""

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
        Clouds, each in the frame of its LiDAR. Intensities are not used.
    rng
        Seeds the generator of Open3D; with more than one thread its draws still vary.
    voxels
        To try, metres.

    Raises
    ------
    MissingExtraError
        Without the extra ``open3d``.
    Refusal
        ``too_few_points``, ``unmatched`` where too few points agree, and as
        `register_clouds`.
    """
    try:
        import open3d
    except ImportError as error:
        raise MissingExtraError("open3d", "the rival FPFH with RANSAC") from error

    open3d.utility.random.seed(int(rng.integers(2**31)))
    found = [_matched(open3d, target, source, voxel) for voxel in voxels]
    fit = max(each.support for each in found)
    starts = [each.start for each in found if each.support >= MIN_FITNESS]
    if not starts:
        raise Refusal(
            "unmatched",
            f"{100 * fit:.0f} % of the points agree with the best match of features, "
            f"{100 * MIN_FITNESS:.0f} % are needed; record where the LiDARs see more common "
            "objects",
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
            f"{MIN_CLOUD_POINTS} are needed; record a scene with more objects",
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


FUNCTIONS: dict[str, Method] = {
    "icp": icp,
    "gicp": gicp,
    "kiss": kiss_matcher,
    "fpfh": fpfh_ransac,
}
"""Every rival by its name in `methods.RIVALS`."""
