"""Refinement of hypotheses by ICP of the scene, as far as their poles allow.

Poles with few returns determine the pose only to some degrees, and a scene that is rotated by
three degrees overlaps little. Registered from the right hypothesis, the scenes then coincide
where the poles still fit; from a wrong one they end at another pose, or fit no better. See
docs/evidence/detection.md, Candidate poles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from ..base import se3
from ..base.datatypes import Array, Hypothesis, Match, PointCloud, Pole, kept
from ..surfaces.registration import (
    MIN_CLOUD_POINTS,
    Surface,
    prepare,
    register,
    surface_of,
    voxel_downsample,
)
from ..surfaces.visibility import SCORING_VOXEL, tree_of
from .correspondence import exact_rms, same_pose

ICP_DISTANCES = 1.0, 0.5, 0.25
"""Largest distances of corresponding points, one registration after the other, metres. The first is
3° at 20 m, what poles of few returns do not determine. With it alone sparse scans drift: from 12
right hypotheses of hard scenes (benchmarks/hard_scenes.py, seeds below 1000) three ended more than
3° off and one 0.3 m, with all three no more than 1.5° and 0.09 m."""

ICP_REACH = 3.0
"""Source points farther from the target at the start are left out, metres. Points farther than
the first of these distances plus 2 m could only be used if the pose moved by more than
the poles allow, and the search for their neighbours dominates the time of a registration."""

ICP_STEPS, STEPS_AT_ONCE = 30, 5
"""Steps of one registration, and after how many of them the motion is checked: most
that move too far have done so by the tenth."""

MOST_REFINED = 4
"""Number of hypotheses that are refined, the best first: each takes three registrations. In those
12 scenes the right one was the first."""


def refine_by_icp(
    target: PointCloud,
    source: PointCloud,
    hypotheses: Sequence[Hypothesis],
    target_poles: Sequence[Pole],
    source_poles: Sequence[Pole],
) -> list[Match]:
    """Register the scenes from every exact hypothesis, and keep the result if the poles allow it.

    Parameters
    ----------
    target, source
        The whole clouds, each in the frame of its LiDAR.
    hypotheses
        The best first.
    target_poles, source_poles
        Those that the hypotheses pair.

    Returns
    -------
    list of Match
        With `icp_refined` and the pose of the registration's end if the lines are still an exact
        match there, within `exact_rms`; otherwise unchanged. Of those that end in the same pose
        only the first.

    Raises
    ------
    Refusal
        ``too_few_points`` if the target is too small to register.
    """
    surface, tree = prepared(target)
    points = voxel_downsample(source.xyz, SCORING_VOXEL)
    at = np.array([pole.point for pole in source_poles])
    found: list[Match] = []
    for k, match in enumerate(hypothesis.match for hypothesis in hypotheses):
        if match.exact and k < MOST_REFINED:
            T = registered(surface, tree, points, match.T_target_source)
            limit = exact_rms(target_poles, source_poles, match.pairs)
            count = sum(len(source_poles[j].xyz) for _, j in match.pairs)
            if T is not None and rms_after(match, T, count) <= limit:
                match = replace(match, T_target_source=T, icp_refined=True)
        if not any(match.exact and other.exact and same_pose(match, other, at) for other in found):
            found.append(match)
    return found


@kept
def prepared(cloud: PointCloud) -> tuple[Surface, cKDTree]:
    """Prepare a cloud as the target of registrations, with the tree of its points.

    Raises
    ------
    Refusal
        ``too_few_points`` if it is too small to register.
    """
    surface = prepare(cloud.xyz, SCORING_VOXEL)
    return surface, tree_of(surface.xyz)


def registered(
    target: Surface,
    tree: cKDTree,
    source: Array,
    T: Array,
    *,
    near: se3.PoseDifference | None = None,
    at: Array | None = None,
) -> Array | None:
    """Register the scenes from a pose (4, 4), by the points within `ICP_REACH` of each other.

    Parameters
    ----------
    target, tree
        The target, prepared, and the tree of its points.
    source
        (N, 3) points of the source, downsampled.
    T
        The start.
    near
        How far the registrations may move `at` from the start; None for no limit.
    at
        (3,) a point of the source, metres; None takes its origin.

    Returns
    -------
    Array or None
        (4, 4); None if fewer than `MIN_CLOUD_POINTS` coincide at the start or the end,
        or it moves too far.
    """
    apart, _ = tree.query(se3.apply(T, source), distance_upper_bound=ICP_REACH)
    close = source[np.isfinite(apart)]
    if len(close) < MIN_CLOUD_POINTS:
        return None
    surface, inliers, start = surface_of(close), 0, T
    point = np.zeros((1, 3)) if at is None else at[None]
    at_once = ICP_STEPS if near is None else STEPS_AT_ONCE
    for distance in ICP_DISTANCES:
        for _ in range(0, ICP_STEPS, at_once):
            end = register(
                target,
                surface,
                T,
                method="GICP",
                max_correspondence_distance=distance,
                max_iterations=at_once,
            )
            T, inliers = end.T_target_source, end.inliers
            moved = se3.difference_at(T, start, point)
            if near and (moved.rotation > near.rotation or moved.translation > near.translation):
                return None
            if end.converged:
                break
    return T if inliers >= MIN_CLOUD_POINTS else None


def rms_after(match: Match, T: Array, count: int) -> float:
    """Residual of a match's poles under another pose near that of the match, metres.

    Parameters
    ----------
    match
        At the minimum of its squared residuals.
    T
        (4, 4) the other pose.
    count
        Source points on its poles.
    """
    step = se3.local(match.T_target_source, T)
    return float(np.sqrt(match.pole_rms**2 + step @ match.information @ step / count))
