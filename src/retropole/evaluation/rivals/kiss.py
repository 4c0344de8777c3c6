"""KISS-Matcher and GICP: registration of whole clouds without a start.

H. Lim et al., *KISS-Matcher: Fast and Robust Point Cloud Registration Revisited*, ICRA 2025: point
features, outliers pruned by a graph, a robust solver. All its radii and noise bounds follow from
one voxel. Which is best depends on the scene, so several are tried, and its own number of final
inliers chooses. GICP refines its answer. The answer differs a little from run to run.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from ...base import se3
from ...base.datatypes import Array, PointCloud, PoseEstimate
from ...base.errors import MissingExtraError, Refusal
from ...surfaces.registration import MIN_CLOUD_POINTS
from .registration import register_clouds

KISS_VOXELS = (1.0, 0.5, 0.2)
"""Tried one after the other, metres: from the quickest to the slowest. Its authors' examples take
0.2 and 0.3 for a single sweep and 2 for maps (see docs/compare.md for what set these)."""

ENOUGH_INLIERS = 15
"""With so many final inliers no further voxel is tried (see docs/compare.md)."""

MIN_INLIERS = 5
"""With fewer final inliers, its authors' own examples call the answer a failure."""


class Matched(NamedTuple):
    """What one voxel ends with: a start (4, 4) of GICP, and its final inliers."""

    start: Array
    inliers: int


def kiss_matcher(
    target: PointCloud,
    source: PointCloud,
    rng: np.random.Generator,
    voxels: Sequence[float] = KISS_VOXELS,
) -> PoseEstimate:
    """Match the clouds by KISS-Matcher with the best of several voxels, and refine by GICP.

    Its other settings are its own defaults.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame. Intensities are not used.
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
    best = best_match(matching, target, source, voxels)
    if best.inliers < MIN_INLIERS:
        raise Refusal(
            "unmatched",
            f"KISS-Matcher ends with {best.inliers} correspondences that agree, {MIN_INLIERS} are "
            "needed; record a scene with more in it, or where the LiDARs see more of the same",
            {"inliers": best.inliers, "needed": MIN_INLIERS},
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
        Clouds, each in its own frame.
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
            best = max(
                best, Matched(T, int(matcher.get_num_final_inliers())), key=attrgetter("inliers")
            )
        if best.inliers >= ENOUGH_INLIERS:
            break
    return best
