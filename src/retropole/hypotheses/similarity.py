"""Whether two clouds fit if one is mirrored or scaled, which no rigid motion can correct.

A change of the source is one number that multiplies its coordinates. Its size is the scale. A
negative one mirrors: any mirror differs from that through the origin by a rotation. Two skew lines
keep their angle; the ratio of their distances gives the scale. Poles that fit under a change are a
start, from which surfaces are registered point to plane (Chen and Medioni 1992) with robust weights
(Geman and McClure 1987); the scale is one column more of the normal equations, about the middle of
the points that correspond (Umeyama 1991).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import small_gicp
from scipy.spatial import cKDTree

from ..alignment.solver import ROUNDING
from ..base import se3
from ..base.datatypes import Array, Placement, PointCloud, Pole
from ..base.errors import Refusal
from ..base.uncertainty.confirmation import Confirmation
from ..surfaces.averaging import averaged
from ..surfaces.consistency import SceneObjects, consistency, objects_in
from ..surfaces.registration import MIN_CLOUD_POINTS, NORMAL_NEIGHBOURS, as_surface
from ..surfaces.visibility import (
    OVERLAP_DISTANCE,
    SCORING_SAMPLE,
    SCORING_VOXEL,
    View,
    compare_views,
    scoring_view,
    view_of,
)
from .correspondence import ANGLE_TOLERANCE, DISTANCE_TOLERANCE, all_pairs, match_poles, pair_starts
from .evidence import BETTER, MIN_TOTAL
from .icp_refinement import MOST_REFINED
from .one_pole import MOST_POLES

SAME_FACTOR = 0.05
"""Ratios of distances nearer to each other than this, as a fraction, are one factor: the scene
refines it."""

CLEARLY_BETTER = 1.15
"""Factor by which more must fit under a change than under a rigid motion: the ratio of the
points that lie on the other cloud's surfaces, times that of the agreeing minus the conflicting
voxels. Neither ratio is less than 1 by more than the factor `BETTER`: 2 % of scale are
within the tolerance of the depth. For three mirrored clouds with an answer, not on bare ground,
(benchmarks/deception.py, seeds below 120) the product was 1.18 in a street of plain fronts, and 1.7
and more in the others."""

MAX_CONFLICTING_CHANGED = 0.1
"""A change is confirmed if no larger share of the voxels conflicts with it, of `MIN_TOTAL` or
more."""

LEAST_CHANGE = 0.01
"""A factor is reported if it differs from 1 by more, and is that of a unit if it differs from it
by no more: the range errors of LiDARs are far smaller."""

DISTANCES = 1.5, 1.0, 0.6, 0.35, 0.35, 0.25, 0.25, 0.15, 0.15, 0.15
"""Largest distance of corresponding points, step by step of a fit, metres; residuals of a quarter
of it have a quarter weight."""

MAX_CHANGE = 0.15
"""Largest relative change of the factor in one fit: with ever fewer correspondences, clouds would
shrink to a point."""

ON_SURFACE = 0.05
"""Distance from the surface that halves the support of a point, metres."""


@dataclass(frozen=True, eq=False)
class Found:
    """A change that fits: the factor of the source, the pose (4, 4), and the evidence from the
    scene.

    `support` is the number of points of objects in the source that lie on the target's surfaces.
    """

    factor: float
    T: Array
    agreed: Confirmation
    support: float

    @property
    def is_confirmed(self) -> bool:
        """Whether enough agrees, and little enough conflicts, for a confirmed answer."""
        return (
            self.agreed.total >= MIN_TOTAL and self.agreed.contradicted <= MAX_CONFLICTING_CHANGED
        )

    def is_better(self, rigid: Found) -> bool:
        """Whether this change explains the scene clearly better than a rigid motion."""
        by_support = self.support / max(rigid.support, 1.0)
        by_voxels = self.voxels / max(rigid.voxels, 1)
        is_changed = self.factor < 0 or abs(np.log(self.factor)) > LEAST_CHANGE
        is_more = by_support * by_voxels >= CLEARLY_BETTER
        return bool(is_changed and is_more and BETTER * min(by_support, by_voxels) >= 1.0)

    @property
    def voxels(self) -> int:
        """Number of agreeing voxels minus that of conflicting ones."""
        return self.agreed.agreeing - self.agreed.contradicting


class Surfaces(NamedTuple):
    """The points of a downsampled cloud, and the unit normals (N, 3) of its surface at them."""

    tree: cKDTree
    normals: Array


@dataclass(frozen=True, eq=False)
class _Scene:
    """A placement, prepared: the target's view, and the source unchanged."""

    view: View
    standing: SceneObjects
    surfaces: Surfaces
    source: PointCloud


def changed_cloud(cloud: PointCloud, factor: float) -> PointCloud:
    """Multiply a cloud, and the origin of its beams."""
    sign = np.sign(factor)
    return replace(
        cloud, xyz=cloud.xyz * factor, origin=cloud.origin * factor, axis=cloud.axis * sign
    )


def changed_pole(pole: Pole, factor: float) -> Pole:
    """Multiply a pole; its thickness too."""
    size = abs(factor)
    return replace(
        pole,
        point=pole.point * factor,
        direction=pole.direction * np.sign(factor),
        xyz=pole.xyz * factor,
        length=pole.length * size,
        rms=pole.rms * size,
    )


def factors_of(target: Sequence[Pole], source: Sequence[Pole]) -> list[float]:
    """Find by which factors the source's poles may be scaled, `MOST_REFINED` most frequent."""
    pairs, others = all_pairs(target), all_pairs(source)
    sigma = np.hypot(pairs.sigma[:, None], others.sigma[None])
    alike = np.abs(pairs.angle[:, None] - others.angle[None]) <= ANGLE_TOLERANCE + 3 * sigma
    # Nearer lines do not determine a scale. In a cloud that is scaled down the error is scaled,
    # too.
    alike &= np.maximum(pairs.distance[:, None], others.distance[None]) > DISTANCE_TOLERANCE
    alike &= np.minimum(pairs.distance[:, None], others.distance[None]) > 0
    rows, columns = np.nonzero(alike)
    ratios = np.log(pairs.distance[rows] / others.distance[columns])
    near = np.abs(ratios[:, None] - ratios[None]) < SAME_FACTOR
    found: list[float] = []
    for k in np.argsort(-near.sum(axis=1), kind="stable"):
        if all(abs(ratios[k] - other) >= SAME_FACTOR for other in found):
            found.append(float(np.median(ratios[near[k]])))
    return [float(np.exp(each)) for each in found[:MOST_REFINED]]


def find_change(placement: Placement, rigid: Sequence[Array]) -> tuple[Found, Found | None] | None:
    """Find a change of the source under which a placement fits better than under any rigid motion.

    Parameters
    ----------
    placement
        With two poles or more in either cloud.
    rigid
        (4, 4) rigid motions that the poles allow; with none, all ways of matching two poles are
        used.

    Returns
    -------
    tuple of Found and (Found or None), or None
        The change that fits, and the best of the rigid motions.
    """
    target, source = placement.target.poles, placement.source.poles
    starts = list(rigid)
    if not starts:
        with suppress(Refusal):
            starts = [T for T, _ in pair_starts((target[0], target[1]), (source[0], source[1]))]
    changes = -1.0, *factors_of(target, source)
    tried = [(change, _matches(placement, change)) for change in changes]
    # Poles that nearly intersect do not determine a factor; the scene may.
    return _better(placement, starts, [*tried, (1.0, starts)])


def find_mirror(placement: Placement, T: Array) -> tuple[Found, Found | None] | None:
    """Find whether a placement fits clearly better mirrored than under the pose (4, 4) it has.

    It takes hardly any time if the poles do not fit mirrored, as most do not.
    """
    return _better(placement, [T], [(-1.0, _matches(placement, -1.0))])


def find_fit(placement: Placement) -> Found | None:
    """Find whether a placement fits unchanged except for a factor near 1."""
    starts = _matches(placement, 1.0)
    scene = _scene_of(placement) if starts else None
    found = [] if scene is None else _fitted(scene, 1.0, starts)
    return found[0] if found and found[0].is_confirmed else None


def _better(
    placement: Placement, rigid: Sequence[Array], tried: Sequence[tuple[float, list[Array]]]
) -> tuple[Found, Found | None] | None:
    """Give the first change, each with its starts, that is better than all rigid motions."""
    scene = _scene_of(placement) if any(starts for _, starts in tried) else None
    if scene is None:
        return None
    rivals: list[Found] | None = None
    for change, starts in tried:
        for found in _fitted(scene, change, starts):
            if found.is_confirmed:
                if rivals is None:
                    rivals = _fitted(scene, 1.0, rigid, MOST_REFINED, is_rigid=True)
                nearest = _counterparts(scene, found)
                rivals += _fitted(scene, 1.0, nearest, len(nearest), is_rigid=True)
                if all(found.is_better(rival) for rival in rivals):
                    return found, max(rivals, key=lambda rival: rival.support, default=None)
    return None


def _scene_of(placement: Placement) -> _Scene | None:
    """Prepare a placement; None if the target has too few points."""
    view = scoring_view(placement.target.cloud)
    surfaces = surfaces_of(view.tree)
    if surfaces is None:
        return None
    standing = _standing(placement.target.cloud)
    return _Scene(view, standing, surfaces, averaged(placement.source.cloud))


def _standing(cloud: PointCloud) -> SceneObjects:
    # The same recordings give the same answer.
    return objects_in(cloud, np.random.default_rng(0))


def _matches(placement: Placement, change: float) -> list[Array]:
    """Poses (4, 4) under which the poles fit exactly, those of the source once changed."""
    source = [changed_pole(pole, change) for pole in placement.source.poles[:MOST_POLES]]
    try:
        matches = match_poles(placement.target.poles[:MOST_POLES], source)
    except Refusal:
        return []
    return [match.T_target_source for match in matches if match.exact]


def _fitted(
    scene: _Scene, change: float, starts: Sequence[Array], most: int = 1, *, is_rigid: bool = False
) -> list[Found]:
    """Fit the source, once changed, from the starts (4, 4) that score best."""
    if not starts:
        return []
    view = view_of(changed_cloud(scene.source, change), SCORING_VOXEL, SCORING_SAMPLE)
    seen = [compare_views(scene.view, view, T, within=OVERLAP_DISTANCE) for T in starts]
    scores = np.array([each.overlap - each.free_space_violation for each in seen])
    found = []
    for k in np.argsort(-scores, kind="stable")[:most]:
        fit = fit_similarity(scene.surfaces, view.points, starts[k], free_factor=not is_rigid)
        if fit is None:
            continue
        T, by = fit
        standing = _standing(changed_cloud(scene.source, change * by))
        agreed = consistency(scene.standing, standing, T)
        on_surface = support(scene.surfaces, se3.apply(T, standing.points))
        found.append(Found(change * by, T, agreed, on_surface))
    return found


def _counterparts(scene: _Scene, found: Found) -> list[Array]:
    """Give the rigid motions (4, 4) that are nearest to the change that was found.

    For a scaled cloud it is the same rotation, about the middle of the cloud. A mirrored one
    is mirrored once more, in a vertical plane through the middle of the objects: a street
    or a corridor is then nearly unchanged.
    """
    whole = found.T @ np.diag([*[found.factor] * 3, 1.0])
    if found.factor > 0:
        middle, R = np.median(scene.source.xyz, axis=0), found.T[:3, :3]
        return [se3.from_rt(R, se3.apply(whole, middle[None])[0] - R @ middle)]
    points, up = scene.standing.points, scene.standing.up
    if len(points) < 3:
        return []
    whole[:3, :3] /= -found.factor
    middle = np.median(points, axis=0)
    level = (points - middle) - np.outer((points - middle) @ up, up)
    normals = np.linalg.svd(level, full_matrices=False)[2][:2]
    mirrors = [np.eye(3) - 2 * np.outer(n, n) for n in normals]
    return [se3.from_rt(M, middle - M @ middle) @ whole for M in mirrors]


def surfaces_of(tree: cKDTree) -> Surfaces | None:
    """Estimate the normals of the points of a tree; None if they are too few."""
    points = np.asarray(tree.data)
    if len(points) < MIN_CLOUD_POINTS:
        return None
    surface = as_surface(points)
    small_gicp.estimate_normals_covariances(
        surface.cloud, surface.tree, num_neighbors=NORMAL_NEIGHBOURS, num_threads=1
    )
    return Surfaces(tree, np.array(surface.cloud.normals())[:, :3])


def fit_similarity(
    target: Surfaces, source: Array, T_start: Array, *, free_factor: bool
) -> tuple[Array, float] | None:
    """Register points (N, 3) to surfaces, from a pose (4, 4) on.

    Returns
    -------
    tuple of array and float, or None
        Pose (4, 4) of the source once that is multiplied by the factor, which is 1 unless it is
        free. None if too little corresponds, or the factor leaves `MAX_CHANGE`.
    """
    moved, T, factor = se3.apply(T_start, source), T_start, 1.0
    for limit in DISTANCES:
        near, normals, residuals = _off(target, moved, limit)
        if np.count_nonzero(near) < MIN_CLOUD_POINTS:
            return None
        middle = moved[near].mean(axis=0)
        arms = moved[near] - middle
        J = np.column_stack([np.cross(arms, normals), normals, np.sum(arms * normals, axis=1)])
        J = J if free_factor else J[:, :6]
        weights = 1.0 / (1.0 + (residuals / (limit / 4)) ** 2) ** 2
        information = (J * weights[:, None]).T @ J
        # A small regularisation, in case surfaces do not constrain a direction.
        information += ROUNDING * np.trace(information) / len(information) * np.eye(J.shape[1])
        step = -np.linalg.solve(information, J.T @ (weights * residuals))
        by = 1.0 + float(step[6]) if free_factor else 1.0
        turn = by * se3.exp_so3(step[:3])
        moved = (moved - middle) @ turn.T + middle + step[3:6]
        factor *= by
        if abs(np.log(max(factor, 1e-9))) > MAX_CHANGE:
            return None
        # A point p becomes  by·E(q − m) + m + δ  with  q = T(factor·p).
        T = se3.from_rt((turn / by) @ T[:3, :3], turn @ (T[:3, 3] - middle) + middle + step[3:6])
    return T, factor


def support(target: Surfaces, moved: Array) -> float:
    """Number of some points (N, 3) on the target's surfaces; those near a surface have a smaller
    weight."""
    _, _, off = _off(target, moved, DISTANCES[0])
    return float(np.sum(1.0 / (1.0 + (off / ON_SURFACE) ** 2)))


def _off(target: Surfaces, moved: Array, limit: float) -> tuple[Array, Array, Array]:
    """Which points are near, the normals there, and the distances from the surface."""
    distance, index = target.tree.query(moved, distance_upper_bound=limit)
    near = np.isfinite(distance)
    normals, points = target.normals[index[near]], np.asarray(target.tree.data)[index[near]]
    return near, normals, np.einsum("ij,ij->i", normals, moved[near] - points)
