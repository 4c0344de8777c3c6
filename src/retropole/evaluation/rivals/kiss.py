"""KISS-Matcher and GICP: registration of whole clouds without a start.

H. Lim et al., *KISS-Matcher: Fast and Robust Point Cloud Registration Revisited*, ICRA 2025: point
features, outliers pruned by a graph, a robust solver. GICP refines its answer. Where GICP does not
converge there is no answer: this reveals a wrong match more often than the number of inliers does.
The answer differs a little from run to run.
"""

from __future__ import annotations

import numpy as np

from ... import se3
from ...datatypes import PointCloud, PoseEstimate
from ...errors import MissingExtraError, Refusal
from ...scene.registration import MIN_CLOUD_POINTS
from .registration import register_clouds

KISS_VOXEL = 0.3
"""The authors' own default, metres."""

MIN_INLIERS = 5
"""With fewer correspondences that agree, its authors' own examples call the answer a failure."""

KISS_CORRESPONDENCE_DISTANCES = (1.0, 0.3)
"""Largest distances of GICP's corresponding points, one after the other, metres."""


def kiss_matcher(target: PointCloud, source: PointCloud, rng: np.random.Generator) -> PoseEstimate:
    """Match the clouds by KISS-Matcher with its own settings, and refine by GICP.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame. Intensities are not used.
    rng
        Not used: KISS-Matcher draws by itself.

    Raises
    ------
    MissingExtraError
        Without the extra ``kiss``.
    Refusal
        ``too_few_points``, ``unmatched`` where it finds too few correspondences that agree, and as
        `registration.register_clouds`.
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
    matcher = matching.KISSMatcher(matching.KISSMatcherConfig(KISS_VOXEL))
    found = matcher.estimate(source.xyz.astype(np.float32), target.xyz.astype(np.float32))
    inliers = int(matcher.get_num_final_inliers())
    T = se3.from_rt(
        np.asarray(found.rotation, dtype=float),
        np.asarray(found.translation, dtype=float).reshape(3),
    )
    if not found.valid or inliers < MIN_INLIERS or not np.all(np.isfinite(T)):
        raise Refusal(
            "unmatched",
            f"KISS-Matcher ends with {inliers} correspondences that agree, {MIN_INLIERS} are "
            "needed; record a scene with more in it, or where the LiDARs see more of the same",
            {"inliers": inliers, "needed": MIN_INLIERS},
        )
    return register_clouds(
        target,
        source,
        T,
        method="GICP",
        max_correspondence_distances=KISS_CORRESPONDENCE_DISTANCES,
    )
