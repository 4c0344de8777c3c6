"""Planar surfaces: three linearly independent planes in both clouds give the pose.

J. Jiao et al., *A novel dual-LiDAR calibration algorithm using planar surfaces*, IV 2019; a rival
of Xue et al. 2019, Table IV. Planes are found by RANSAC in each cloud. Three of the one are
matched with three of the other in every order; their normals give the rotation and their offsets
the translation in closed form, and least squares of points on planes refines them. No start is
needed.

How to choose where many triples fit is left open there, and a corridor fits itself after a rotation
by 180°, to the millimetre in its planes. Here the surroundings decide: the share of points with a
neighbour in the other cloud, less the weighted share that stands where the other LiDAR looked
through. Where two different poses fit alike there is no answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array, BoolArray, PointCloud, PoseEstimate
from retropole.base.errors import Refusal
from retropole.surfaces.visibility import View, compare_views, view_of
from studies.planes.extraction import MAX_ROUNDS, PlaneSearch, extract_planes, triples
from studies.planes.poses import (
    MAX_REFINE_STEPS,
    SAME_PLANE_ANGLE,
    RefinedPose,
    agreement,
    candidate_poses,
    refine,
)

PLANES_SCORING_VOXEL = 0.3
"""Clouds are downsampled to one point per cube of this side, metres, before poses are scored."""

PLANES_SCORING_SAMPLE = 2000
"""Poses are scored on every n-th downsampled point so that about so many are left."""

PLANES_OVERLAP_DISTANCE = 0.15
"""A point overlaps the other cloud where it has a neighbour within this distance, metres: a pose
from planes is good to a few centimetres."""

VIOLATION_WEIGHT = 5.0
"""Weight of a point that stands where the other LiDAR looked through, against one that overlaps:
most points of a corridor overlap however it is rotated, and few can contradict."""

MAX_SCORED_POSES = 120
"""Different poses that are refined and scored; the rest agree on fewer planes."""

ALIKE = float(np.radians(1.0)), 0.1
"""Poses closer than both, rad and metres, are one candidate."""

DIFFERENT_POSE = float(np.radians(5.0)), 0.5
"""Poses further apart than either, rad and metres, are different answers."""

MIN_PLANES_SCORE = 0.15
"""Overlap less weighted violation, below which planes agree by chance."""

MIN_PLANES_MARGIN = 0.03
"""Score of the best pose over that of the next different one; shares of 2000 points have a standard
error of 0.01."""

REFINED_POINTS = 200
"""Points of each plane on which candidates are refined; the chosen one is refined on all."""


@dataclass(frozen=True, eq=False)
class ScoredPose:
    """A refined pose, and how it agrees with the surroundings.

    Attributes
    ----------
    refined
        On `REFINED_POINTS` of each plane.
    overlap
        Share of the points with a neighbour in the other cloud.
    score
        Overlap less `VIOLATION_WEIGHT` times the free-space violation; larger is better.
    """

    refined: RefinedPose
    overlap: float
    score: float


def planar_surfaces(
    target: PointCloud, source: PointCloud, rng: np.random.Generator
) -> PoseEstimate:
    """Find the pose that aligns the planes of the source with those of the target.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame, whose `PointCloud.origin` is where the beams start.
    rng
        Draws the hypotheses of the planes.

    Returns
    -------
    PoseEstimate
        The pose, and the RMS distance of the matched planes' points from each other's planes.

    Raises
    ------
    Refusal
        ``unmatched`` where a cloud has no three linearly independent planes, or no three of the one
        fit three of the other,
        ``no_overlap`` where some do but the surroundings contradict,
        ``ambiguous`` where different poses fit alike,
        ``not_converged`` where the refinement of the chosen pose still moves.
    """
    searches = extract_planes(target, rng), extract_planes(source, rng)
    for lidar, search in zip(("target", "source"), searches, strict=True):
        _require_three(lidar, search)
    planes = searches[0].planes, searches[1].planes
    samples = [[plane.sampled(REFINED_POINTS) for plane in each] for each in planes]
    candidates = candidate_poses(*planes)
    refined: list[RefinedPose] = []
    for T in _different(candidates, agreement(*planes, candidates)):
        # A candidate that has not converged is still scored: it only has to point to the answer,
        # which is refined again, on all points.
        found = refine(samples[0], samples[1], T)
        known = np.array([each.pose.T_target_source for each in refined]).reshape(-1, 4, 4)
        if found is not None and not _alike(known, found.pose.T_target_source).any():
            refined.append(found)
    if not refined:
        raise Refusal(
            "unmatched",
            f"no three of the target's {len(planes[0])} planes have the same angles between them "
            f"as three of the source's {len(planes[1])}, within "
            f"{np.degrees(SAME_PLANE_ANGLE):.0f}°; record where both LiDARs see the same three",
            {"planes_target": len(planes[0]), "planes_source": len(planes[1])},
        )
    views = [view_of(c, PLANES_SCORING_VOXEL, PLANES_SCORING_SAMPLE) for c in (target, source)]
    best = _best([score_pose(views[0], views[1], each) for each in refined])
    # Where the planes of all points no longer match as those of the sample did, the sample decides.
    final = refine(*planes, best.pose.T_target_source) or best
    if not final.converged:
        raise Refusal(
            "not_converged",
            f"the refinement on planes still moves after {MAX_REFINE_STEPS} steps; record where "
            "both LiDARs see more of the same planes",
            {"iterations": MAX_REFINE_STEPS},
        )
    return final.pose


def _require_three(lidar: str, search: PlaneSearch) -> None:
    """Refuse a cloud without three linearly independent planes."""
    if len(triples(search.planes)) > 0:
        return
    given_up = "" if search.complete else f", and the search was given up after {MAX_ROUNDS} rounds"
    raise Refusal(
        "unmatched",
        f"the {lidar} cloud has {len(search.planes)} planes, but no three that are linearly "
        f"independent{given_up}; record where the ground and two walls that are not parallel are "
        "seen",
        {"lidar": lidar, "planes": len(search.planes), "needed": 3},
    )


def _alike(poses: Array, T: Array) -> BoolArray:
    """Which of the poses (K, 4, 4) are the same candidate as another (4, 4)."""
    trace = np.einsum("kij,ij->k", poses[:, :3, :3], T[:3, :3])
    near = np.linalg.norm(poses[:, :3, 3] - T[:3, 3], axis=1) < ALIKE[1]
    return np.asarray(near & ((trace - 1) / 2 > np.cos(ALIKE[0])))


def _different(poses: Array, rank: Array) -> list[Array]:
    """The `MAX_SCORED_POSES` best ranked poses of which no two are alike."""
    kept: list[Array] = []
    rest = poses[np.argsort(-rank, kind="stable")]
    while len(rest) and len(kept) < MAX_SCORED_POSES:
        kept.append(rest[0])
        rest = rest[1:][~_alike(rest[1:], rest[0])]
    return kept


def score_pose(target: View, source: View, refined: RefinedPose) -> ScoredPose:
    """Score a pose by the surroundings: overlap less weighted free-space violation."""
    T = refined.pose.T_target_source
    found = compare_views(target, source, T, within=PLANES_OVERLAP_DISTANCE)
    score = found.overlap - VIOLATION_WEIGHT * found.free_space_violation
    return ScoredPose(refined, found.overlap, score)


def _best(scored: Sequence[ScoredPose]) -> RefinedPose:
    """Give the best pose, or refuse where it is not good, or not better than all others."""
    best, *others = sorted(scored, key=lambda s: -s.score)
    T = best.refined.pose.T_target_source
    apart = [se3.difference(T, each.refined.pose.T_target_source) for each in others]
    different = np.any(np.reshape(apart, (-1, 2)) >= np.array(DIFFERENT_POSE), axis=1)
    rivals = [*compress(others, different)]
    if best.score < MIN_PLANES_SCORE:
        raise Refusal(
            "no_overlap",
            f"under the best of {len(scored)} matches of planes {100 * best.overlap:.0f} % of the "
            f"points have a neighbour in the other cloud within {PLANES_OVERLAP_DISTANCE:g} m, and "
            "the score less what the other LiDAR looked through is "
            f"{best.score:.2f}, {MIN_PLANES_SCORE:g} is needed; record where both LiDARs see the "
            "same planes",
            {"overlap": best.overlap, "score": best.score, "needed": MIN_PLANES_SCORE},
        )
    if rivals and best.score - rivals[0].score < MIN_PLANES_MARGIN:
        raise Refusal(
            "ambiguous",
            f"two matches of planes fit alike: scores {best.score:.3f} and {rivals[0].score:.3f}, "
            f"{MIN_PLANES_MARGIN:g} apart are needed; record where no rotation maps the scene onto "
            "itself",
            {"score": best.score, "runner_up": rivals[0].score, "needed": MIN_PLANES_MARGIN},
        )
    return best.refined
