"""Planar surfaces: three linearly independent planes in both clouds give the pose (M9).

J. Jiao et al., *A novel dual-LiDAR calibration algorithm using planar surfaces*, IV 2019. Planes
are found by RANSAC in each cloud, three of the one laid on three of the other in every order,
rotation taken from the normals and translation from the offsets in closed form, and refined by
least squares of points on planes. No start is needed.

How to choose where many triples fit is left open there, and a corridor fits itself after half a
turn, to the millimetre in its planes. Here the surroundings choose: the share of points with a
neighbour in the other cloud, less that which stands where the other LiDAR looked through. Where
two different poses fit alike there is no answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from scipy.spatial import cKDTree

from ... import se3
from ...datatypes import Array, BoolArray, PointCloud, PoseEstimate
from ...errors import Refusal
from ...scene.disambiguation import RangeImage, free_space_violation, range_image
from ...scene.registration import voxel_downsample
from .plane_extraction import MIN_INDEPENDENCE, Plane, extract_planes, independence, triples

SAME_PLANE_ANGLE = float(np.radians(3.0))
"""Triples may match if the angles between their planes differ by no more than this."""

SAME_NORMAL, SAME_OFFSETS = float(np.radians(4.0)), (0.3, 0.15)
"""Under a pose two planes are one if their normals agree so far, rad, and the middle of each lies
so near the other, metres: before and after a first refinement."""

ROBUST = 0.05
"""Distances of points from their plane count in full up to here, metres (Huber)."""

SCORING_VOXEL_PLANES = 0.3
"""Clouds are thinned to one point per cube of this side, metres, before poses are judged."""

SCORING_SAMPLE = 2000
"""Poses are judged on every n-th thinned point so that about so many are left."""

OVERLAP_WITHIN = 0.15
"""A point overlaps the other cloud where it has a neighbour within this distance, metres."""

VIOLATION_WEIGHT = 5.0
"""What a point weighs that stands where the other LiDAR looked through, against one that overlaps:
most points of a corridor overlap however it is turned, and few can contradict."""

MAX_SCORED_POSES = 120
"""Different poses that are refined and judged, those first that lay most planes on each other."""

ALIKE = float(np.radians(1.0)), 0.1
"""Poses closer than both, rad and metres, are one candidate."""

DIFFERENT_POSE = float(np.radians(5.0)), 0.5
"""Poses further apart than either, rad and metres, are different answers."""

MIN_SCORE = 0.15
"""Overlap less weighted contradiction, below which planes agree by chance."""

MIN_MARGIN = 0.03
"""Score of the best pose over that of the next different one; shares of 2000 points have a standard
error of 0.01."""

REFINE_ITERATIONS = 8

SKETCH = 200
"""Points of each plane on which candidates are refined; the chosen one is, on all."""


@dataclass(frozen=True, eq=False)
class ScoredPose:
    """A refined pose, and what the surroundings say of it."""

    stage: PoseEstimate
    overlap: float
    score: float


def planar_surfaces(
    target: PointCloud, source: PointCloud, *, rng: np.random.Generator
) -> PoseEstimate:
    """Find the pose that lays the planes of the source on those of the target.

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
        ``too_few_planes`` where a cloud has no three linearly independent planes,
        ``planes_unmatched`` where no three of the one fit three of the other,
        ``no_overlap`` where some do and the surroundings deny it,
        ``ambiguous`` where different poses fit alike.
    """
    of_target, of_source = extract_planes(target, rng), extract_planes(source, rng)
    for lidar, found in (("target", of_target), ("source", of_source)):
        if len(triples(found)) == 0:
            raise Refusal(
                "too_few_planes",
                f"the {lidar} cloud has {len(found)} planes, but no three that are linearly "
                "independent; record where the ground and two walls that are not parallel are "
                "seen",
                {"lidar": lidar, "planes": len(found), "needed": 3},
            )
    candidates = candidate_poses(of_target, of_source)
    scene = Surroundings.of(target), Surroundings.of(source)
    sketches = [[p.thinned(SKETCH) for p in planes] for planes in (of_target, of_source)]
    stages: list[PoseEstimate] = []
    for T in _different(candidates, _agreement(of_target, of_source, candidates)):
        stage = refine(sketches[0], sketches[1], T)
        if stage is not None and not _known(stage, stages):
            stages.append(stage)
    judged = [score_pose(*scene, stage) for stage in stages]
    if not judged:
        raise Refusal(
            "planes_unmatched",
            f"no three of the target's {len(of_target)} planes stand as three of the source's "
            f"{len(of_source)} do, within {np.degrees(SAME_PLANE_ANGLE):.0f}°; record where both LiDARs "
            "see the same three",
            {"planes_target": len(of_target), "planes_source": len(of_source)},
        )
    chosen = _chosen(judged)
    return refine(of_target, of_source, chosen.T_target_source) or chosen


def candidate_poses(target: list[Plane], source: list[Plane]) -> Array:
    """Lay every three independent planes of the source on every three of the target, in any order.

    Rotation: the orthogonal Procrustes problem of the normals; translation: the three equations
    ``n_target · t = d_source − d_target`` of the offsets.

    Returns
    -------
    (K, 4, 4) float64
        Poses, target from source; triples whose planes stand otherwise to each other, or that only
        a reflection lays on each other, are left out.
    """
    normals = [np.array([p.normal for p in each]).reshape(-1, 3) for each in (target, source)]
    offsets = [np.array([p.offset for p in each]) for each in (target, source)]
    orders = np.array(list(permutations(range(3))))
    first, second = triples(target), triples(source)[:, orders].reshape(-1, 3)
    angles = [_angles(normals[0][first]), _angles(normals[1][second])]
    i, j = np.nonzero(
        np.all(np.abs(angles[0][:, None] - angles[1][None]) < SAME_PLANE_ANGLE, axis=2)
    )
    first, second = first[i], second[j]
    a, b = normals[0][first], normals[1][second]
    u, _, vt = np.linalg.svd(np.einsum("kpi,kpj->kij", a, b))
    proper = np.linalg.det(u @ vt) > 0
    # Of mirrored triples Procrustes would still give the rotation nearest to a reflection.
    R = (u @ vt)[proper]
    gap = offsets[1][second[proper]] - offsets[0][first[proper]]
    T = np.tile(np.eye(4), (len(R), 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = np.linalg.solve(a[proper], gap[..., None])[..., 0]
    return T


def _angles(normals: Array) -> Array:
    """Angles (K, 3) between the first and second, second and third, third and first of triples."""
    cosines = np.einsum("kpi,kpi->kp", normals, np.roll(normals, -1, 1))
    return np.asarray(np.arccos(np.clip(cosines, -1, 1)))


def _matched(
    target: list[Plane], source: list[Plane], T: Array, same_offset: float
) -> tuple[Array, Array]:
    """Tell which planes are one under poses (..., 4, 4): (..., P, Q) bool, and how far apart they
    are, metres."""
    a, b = (np.array([p.normal for p in each]) for each in (target, source))
    d, e = (np.array([p.offset for p in each]) for each in (target, source))
    at, bt = (np.array([p.xyz.mean(axis=0) for p in each]) for each in (target, source))
    R, t = T[..., :3, :3], T[..., :3, 3]
    turned = b @ np.swapaxes(R, -1, -2)
    moved = bt @ np.swapaxes(R, -1, -2) + t[..., None, :]
    alike = a @ np.swapaxes(turned, -1, -2) > np.cos(SAME_NORMAL)
    off_target = np.abs(a @ np.swapaxes(moved, -1, -2) + d[:, None])
    along = at @ np.swapaxes(turned, -1, -2) - (turned @ t[..., None])[..., 0][..., None, :]
    apart = np.maximum(off_target, np.abs(along + e))
    return alike & (apart < same_offset), apart


def _shared_support(target: list[Plane], source: list[Plane]) -> Array:
    """Give the lesser support (P, Q) of every two planes."""
    supports = [np.array([float(p.support) for p in each]) for each in (target, source)]
    return np.asarray(np.minimum(supports[0][:, None], supports[1]))


def _agreement(target: list[Plane], source: list[Plane], T: Array) -> Array:
    """How many points lie on planes that are one under each of the poses (K, 4, 4)."""
    same, _ = _matched(target, source, T, SAME_OFFSETS[0])
    sizes = _shared_support(target, source)
    # A plane counts once, with its best partner; the square root keeps one large one from deciding.
    return np.asarray(np.max(same * np.sqrt(sizes), axis=2, initial=0.0).sum(axis=1))


def _known(stage: PoseEstimate, others: list[PoseEstimate]) -> bool:
    """Tell whether a pose is that of one of others."""
    if not others:
        return False
    return bool(
        np.any(_alike(np.array([s.T_target_source for s in others]), stage.T_target_source))
    )


def _alike(poses: Array, T: Array) -> BoolArray:
    """Tell which of the poses (K, 4, 4) are one candidate with another."""
    trace = np.einsum("kij,ij->k", poses[:, :3, :3], T[:3, :3])
    near = np.linalg.norm(poses[:, :3, 3] - T[:3, 3], axis=1) < ALIKE[1]
    return np.asarray(near & ((trace - 1) / 2 > np.cos(ALIKE[0])))


def _within(limits: tuple[float, float], T: Array, other: Array) -> bool:
    """Tell whether two poses are closer than a rotation (rad) and a translation (metres)."""
    step = se3.local(T, other)
    return bool(np.linalg.norm(step[:3]) < limits[0] and np.linalg.norm(step[3:]) < limits[1])


def _different(poses: Array, rank: Array) -> list[Array]:
    """The `MAX_SCORED_POSES` best ranked poses of which no two are alike."""
    kept: list[Array] = []
    rest = poses[np.argsort(-rank, kind="stable")]
    while len(rest) and len(kept) < MAX_SCORED_POSES:
        best = rest[0]
        kept.append(best)
        alike = _alike(rest, best)
        alike[0] = True
        rest = rest[~alike]
    return kept


def refine(target: list[Plane], source: list[Plane], T: Array) -> PoseEstimate | None:
    """Lay the points of matched planes on each other's planes, by Gauss-Newton with Huber weights.

    Minimises ``Σ (n_t · (R p_s + t) + d_t)² + Σ (n_s · Rᵀ (p_t − t) + d_s)²`` over the points of
    both, so that swapping the clouds inverts the answer.

    Returns
    -------
    PoseEstimate or None
        None where the planes that are one under ``T`` are not three independent ones.
    """
    rms = 0.0
    sizes = _shared_support(target, source)
    for same_offset, nearest in zip(SAME_OFFSETS, (False, True), strict=True):
        same, apart = _matched(target, source, T, same_offset)
        # A rough pose may lay a wall on the niche beside it: first go by size, then by distance.
        cost = np.where(same, apart if nearest else -sizes, np.inf)
        pairs = [
            (i, j)
            for i, j in zip(*np.nonzero(same), strict=True)
            if cost[i, j] == cost[i].min() == cost[:, j].min()
        ]
        normals = np.array([target[i].normal for i, _ in pairs]).reshape(-1, 3)
        if len(pairs) < 3 or independence(normals) < MIN_INDEPENDENCE:
            return None
        for _ in range(REFINE_ITERATIONS):
            residuals, jacobian = _residuals(target, source, pairs, T)
            weight = np.minimum(1.0, ROBUST / np.maximum(np.abs(residuals), 1e-12))
            weighted = jacobian * weight[:, None]
            step = np.asarray(
                np.linalg.solve(weighted.T @ jacobian, -weighted.T @ residuals), float
            )
            T = se3.retract(T, step)
            if np.linalg.norm(step) < 1e-6:
                break
        rms = float(np.sqrt(np.mean(_residuals(target, source, pairs, T)[0] ** 2)))
    return PoseEstimate(T, None, rms)


def _residuals(
    target: list[Plane], source: list[Plane], pairs: list[tuple[int, int]], T: Array
) -> tuple[Array, Array]:
    """Distances (N,) of matched points from each other's planes, and their (N, 6) derivative."""
    residuals, jacobians = [], []
    R, t = T[:3, :3], T[:3, 3]
    for i, j in pairs:
        n, m = target[i].normal, R @ source[j].normal
        turned, gone = source[j].xyz @ R.T, target[i].xyz - t
        residuals += [turned @ n + n @ t + target[i].offset, gone @ m + source[j].offset]
        jacobians += [
            np.hstack([turned @ se3.hat(-n).T, np.broadcast_to(n, turned.shape)]),
            np.hstack([gone @ se3.hat(m).T, np.broadcast_to(-m, gone.shape)]),
        ]
    return np.concatenate(residuals), np.vstack(jacobians)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A cloud made ready for judging poses: a sample of it, its neighbours, how far it saw."""

    sample: Array
    tree: cKDTree
    image: RangeImage

    @classmethod
    def of(cls, cloud: PointCloud) -> Surroundings:
        """Thin a cloud and sort it."""
        points = voxel_downsample(cloud.xyz, SCORING_VOXEL_PLANES)
        return cls(
            points[:: 1 + len(points) // SCORING_SAMPLE], cKDTree(points), range_image(cloud)
        )


def score_pose(target: Surroundings, source: Surroundings, stage: PoseEstimate) -> ScoredPose:
    """Hear the surroundings on a pose: overlap less contradiction, the mean of both directions."""
    overlaps, contradictions = [], []
    T = stage.T_target_source
    for one, moved in (
        (target, se3.apply(T, source.sample)),
        (source, se3.apply(se3.inverse(T), target.sample)),
    ):
        distance = one.tree.query(moved, distance_upper_bound=OVERLAP_WITHIN)[0]
        overlaps.append(float(np.mean(np.isfinite(distance))))
        contradictions.append(free_space_violation(one.image, moved))
    overlap = float(np.mean(overlaps))
    return ScoredPose(stage, overlap, overlap - VIOLATION_WEIGHT * float(np.mean(contradictions)))


def _chosen(judged: list[ScoredPose]) -> PoseEstimate:
    """Give the best pose, or refuse where it is not good, or not better than all others."""
    best, *others = sorted(judged, key=lambda j: -j.score)
    T = best.stage.T_target_source
    others = [j for j in others if not _within(DIFFERENT_POSE, T, j.stage.T_target_source)]
    if best.score < MIN_SCORE:
        raise Refusal(
            "no_overlap",
            f"under the best of {len(judged)} matches of planes {100 * best.overlap:.0f} % of the "
            f"points have a neighbour in the other cloud within {OVERLAP_WITHIN:g} m, and the score less "
            f"what the other LiDAR looked through is {best.score:.2f}, {MIN_SCORE:g} is needed; "
            "record where both LiDARs see the same planes",
            {"overlap": best.overlap, "score": best.score, "needed": MIN_SCORE},
        )
    if others and best.score - others[0].score < MIN_MARGIN:
        raise Refusal(
            "ambiguous",
            f"two matches of planes fit alike: scores {best.score:.3f} and {others[0].score:.3f}, "
            f"{MIN_MARGIN:g} apart are needed; record where no turn lays the scene on itself",
            {"score": best.score, "runner_up": others[0].score, "needed": MIN_MARGIN},
        )
    return best.stage
