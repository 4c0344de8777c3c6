"""Poses from planes: in closed form from three, refined by least squares on all that match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import NamedTuple

import numpy as np

from retropole.alignment.solver import Solution
from retropole.base import se3
from retropole.base.datatypes import Array, BoolArray, PoseEstimate
from studies.planes.extraction import MIN_INDEPENDENCE, Plane, independence, triples

SAME_PLANE_ANGLE = float(np.radians(3.0))
"""Triples may match if the angles between their planes differ by no more than this, rad."""

SAME_NORMAL = float(np.radians(4.0))
"""Under a pose two planes are one if their normals agree within this, rad, …"""

SAME_OFFSETS = (0.3, 0.15)
"""… and the middle of each lies so near the other, metres: before and after a first refinement."""

HUBER_DISTANCE = 0.05
"""Distances of points from their plane count in full up to here, metres: a plane's thickness."""

MAX_REFINE_STEPS = 8
SMALL_REFINE_STEP = 1e-6
"""A refinement has converged when its step is shorter than this, rad and metres together."""


class Linearised(NamedTuple):
    """Distances (N,) of matched points from each other's planes, and their (N, 6) derivative."""

    residuals: Array
    jacobian: Array


class _NormalEquations(NamedTuple):
    """Gradient (6,) and Gauss–Newton matrix (6, 6) of the weighted squares."""

    gradient: Array
    curvature: Array


class Matched(NamedTuple):
    """Which planes are one under a pose: (..., P, Q), and how far apart they are, metres."""

    same: BoolArray
    apart: Array


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A pose refined on its matching planes.

    Attributes
    ----------
    pose
        With the RMS distance of the matched planes' points from each other's planes.
    converged
        Whether the last step of the least squares was small.
    """

    pose: PoseEstimate
    converged: bool


def candidate_poses(target: Sequence[Plane], source: Sequence[Plane]) -> Array:
    """Match every three independent planes of the source with every three of the target.

    All orders are tried. The rotation solves the orthogonal Procrustes problem of the normals; the
    translation the three equations ``n_target · t = d_source − d_target`` of the offsets.

    Returns
    -------
    (K, 4, 4) float64
        Poses, target from source. Triples whose planes have other angles between them, or that
        only a reflection maps onto each other, are left out.
    """
    (a, d), (b, e) = _equations(target), _equations(source)
    orders = np.array(list(permutations(range(3))))
    first, second = triples(target), triples(source)[:, orders].reshape(-1, 3)
    apart = _angles(a[first])[:, None] - _angles(b[second])
    i, j = np.nonzero(np.all(np.abs(apart) < SAME_PLANE_ANGLE, axis=2))
    first, second = first[i], second[j]
    a, b = a[first], b[second]
    u, _, vt = np.linalg.svd(np.einsum("kpi,kpj->kij", a, b))
    proper = np.linalg.det(u @ vt) > 0
    # Of mirrored triples Procrustes would still give the rotation nearest to a reflection.
    R = (u @ vt)[proper]
    gap = e[second[proper]] - d[first[proper]]
    T = np.tile(np.eye(4), (len(R), 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = np.linalg.solve(a[proper], gap[..., None])[..., 0]
    return T


def _equations(planes: Sequence[Plane]) -> tuple[Array, Array]:
    """Normals (P, 3) and offsets (P,) of planes."""
    normals = np.array([plane.normal for plane in planes]).reshape(-1, 3)
    return normals, np.array([plane.offset for plane in planes])


def _angles(normals: Array) -> Array:
    """Angles (K, 3) between the first and second, second and third, third and first of triples."""
    cosines = np.einsum("kpi,kpi->kp", normals, np.roll(normals, -1, 1))
    return np.asarray(np.arccos(np.clip(cosines, -1, 1)))


def agreement(target: Sequence[Plane], source: Sequence[Plane], T: Array) -> Array:
    """Rank poses (K, 4, 4) by the support of the planes that are one under them: (K,).

    A plane counts once, with its best partner; the square root keeps one large plane from deciding.
    """
    same, _ = _matched(target, source, T, SAME_OFFSETS[0])
    sizes = _shared_support(target, source)
    return np.asarray(np.max(same * np.sqrt(sizes), axis=2, initial=0.0).sum(axis=1))


def _matched(
    target: Sequence[Plane], source: Sequence[Plane], T: Array, same_offset: float
) -> Matched:
    """Match planes under poses (..., 4, 4)."""
    (a, d), (b, e) = _equations(target), _equations(source)
    at, bt = (np.array([p.xyz.mean(axis=0) for p in each]) for each in (target, source))
    R, t = T[..., :3, :3], T[..., :3, 3]
    # Normals and middles of the source's planes in the target's frame.
    normals = b @ np.swapaxes(R, -1, -2)
    middles = bt @ np.swapaxes(R, -1, -2) + t[..., None, :]
    alike = a @ np.swapaxes(normals, -1, -2) > np.cos(SAME_NORMAL)
    off_target = np.abs(a @ np.swapaxes(middles, -1, -2) + d[:, None])
    along = at @ np.swapaxes(normals, -1, -2) - (normals @ t[..., None])[..., 0][..., None, :]
    apart = np.maximum(off_target, np.abs(along + e))
    return Matched(alike & (apart < same_offset), apart)


def _shared_support(target: Sequence[Plane], source: Sequence[Plane]) -> Array:
    """Give the lesser support (P, Q) of every two planes."""
    supports = [np.array([float(p.support) for p in each]) for each in (target, source)]
    return np.asarray(np.minimum(supports[0][:, None], supports[1]))


def refine(target: Sequence[Plane], source: Sequence[Plane], T: Array) -> RefinedPose | None:
    """Bring the points of matched planes onto each other's planes: Gauss–Newton, Huber weights.

    Minimises ``Σ (n_t · (R p_s + t) + d_t)² + Σ (n_s · Rᵀ (p_t − t) + d_s)²`` over the points of
    both, so that swapping the clouds inverts the answer.

    Returns
    -------
    RefinedPose or None
        None where the planes that are one under ``T`` are not three independent ones.
    """
    rms, converged = 0.0, False
    sizes = _shared_support(target, source)
    for same_offset, nearest in zip(SAME_OFFSETS, (False, True), strict=True):
        same, apart = _matched(target, source, T, same_offset)
        # A rough pose may put a wall on the niche beside it: first by size, then by distance.
        cost = np.where(same, apart if nearest else -sizes, np.inf)
        pairs = [
            (target[i], source[j])
            for i, j in zip(*np.nonzero(same), strict=True)
            if cost[i, j] == cost[i].min() == cost[:, j].min()
        ]
        normals = np.array([plane.normal for plane, _ in pairs]).reshape(-1, 3)
        if len(pairs) < 3 or independence(normals) < MIN_INDEPENDENCE:
            return None
        solved = _solve(pairs, T)
        T, converged = solved.point, solved.converged
        rms = float(np.sqrt(np.mean(linearised(pairs, T).residuals ** 2)))
    return RefinedPose(PoseEstimate(T, None, rms), converged)


def _solve(pairs: Sequence[tuple[Plane, Plane]], T: Array) -> Solution[Array]:
    """Repeat Gauss–Newton steps of the pose (4, 4): the Huber weights change from step to step."""
    for iteration in range(1, MAX_REFINE_STEPS + 1):
        normal = _normal_equations(linearised(pairs, T))
        step = -np.asarray(np.linalg.solve(normal.curvature, normal.gradient), np.float64)
        T = se3.retract(T, step)
        if np.linalg.norm(step) < SMALL_REFINE_STEP:
            return Solution(T, True, iteration)
    return Solution(T, False, MAX_REFINE_STEPS)


def _normal_equations(at: Linearised) -> _NormalEquations:
    """Weight the residuals (Huber) and form the normal equations."""
    weight = np.minimum(1.0, HUBER_DISTANCE / np.maximum(np.abs(at.residuals), 1e-12))
    weighted = at.jacobian * weight[:, None]
    return _NormalEquations(weighted.T @ at.residuals, weighted.T @ at.jacobian)


def linearised(pairs: Sequence[tuple[Plane, Plane]], T: Array) -> Linearised:
    """Linearise the distances of matched points from each other's planes about a pose (4, 4).

    Parameters
    ----------
    pairs
        A plane of the target, and the plane of the source that is the same.
    T
        Target from source. The derivative is by the step ``[φ, δ]`` of `se3.retract`.
    """
    residuals, jacobians = [], []
    R, t = T[:3, :3], T[:3, 3]
    for ours, theirs in pairs:
        n, m = ours.normal, R @ theirs.normal
        rotated, beyond = theirs.xyz @ R.T, ours.xyz - t
        residuals += [rotated @ n + n @ t + ours.offset, beyond @ m + theirs.offset]
        jacobians += [
            np.hstack([rotated @ se3.hat(-n).T, np.broadcast_to(n, rotated.shape)]),
            np.hstack([beyond @ se3.hat(m).T, np.broadcast_to(-m, beyond.shape)]),
        ]
    return Linearised(np.concatenate(residuals), np.vstack(jacobians))
