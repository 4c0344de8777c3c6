"""Poles and scene of a pair in one problem: the pose that both agree on.

The poles give a quadratic form of the pose and of the errors of both LiDARs (`alignment.network`);
the scene adds the distances between surface patches that both LiDARs see, which the same errors
move (`descent`). Where the search may end at several poses it starts from several; if poles and
scene disagree, the stated uncertainty covers both.

One place may decide a direction of the pose alone. A robust loss bounds how far one residual pulls,
not how much a far surface, seen by few beams, contributes to a rotation: it then fits by itself,
and its residual is not a check. So the answer is sought again without each such place, with weights
and partners anew, and what is stated covers both. Since a map was made cars may have driven off and
others parked almost there: whatever may have is one place, however large. What the surfaces leave
open in a map, the registration gives, as far as it does without each part of the surroundings
(`hypotheses.in_map`).

From where the search for the refined pose starts again, and when two ends are two minima.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from ..alignment.adjustment import SURROUNDINGS_SIGMA, BeamAlignment
from ..alignment.certainty import (
    Part,
    chi2_limit,
    excess,
    part_of,
    root_of,
    uncertainty_of_pair,
)
from ..alignment.network import PoleFactor, gaussian_factor, poses_of_pair
from ..alignment.unknowns import POSE
from ..base import se3
from ..base.datatypes import Array, PointCloud, PoseEstimate
from ..base.systematic import DEVICE_KINDS, ErrorModel, map_distortion
from ..base.uncertainty import SIGMAS, Uncertainty
from ..base.uncertainty.purpose import CONFIDENCE
from ..extraction.sensor_pattern import error_sizes
from ..hypotheses.by_place import DETERMINED
from ..hypotheses.in_map import scatter_without_parts
from ..hypotheses.placements import PairedPlacement, merge_clouds, remaining_sway_in
from ..surfaces.averaging import averaged
from ..surfaces.consistency import movable_objects
from ..surfaces.patch_pairs import (
    MIN_CORRESPONDENCE_DISTANCE,
    PatchSets,
    by_objects,
    every_nth_patch,
    pair_patches,
    some_of,
    without_errors,
)
from ..surfaces.patches import Patches, surface_patches
from .descent import (
    FEW,
    End,
    RefinementProblem,
    ScenePair,
    approach,
    converge,
    scene_pairs,
    support_of,
)
from .solved import Places, parts_of, places_of_poses

MAX_SHARE = 0.3
"""Most of the information along any direction that one place may hold without a word."""


@dataclass(frozen=True, eq=False)
class Decisive:
    """A place that alone decides a direction of the pose.

    Attributes
    ----------
    share
        Part of all information along that direction that it contributes.
    at
        (3,) its middle in the target's frame, metres.
    apart
        (6,) step from the answer to the one without it (`se3.local`).
    """

    share: float
    at: Array
    apart: Array


def leverage(places: Places) -> Array:
    """Largest share (C,) of the information along any direction that each place contributes.

    The largest eigenvalue of ``S^-½ S_c S^-½``: whatever the frame and the units.
    """
    root = np.linalg.cholesky(places.marginal)
    half = np.linalg.solve(root, places.information)
    whole = np.linalg.solve(root, half.transpose(0, 2, 1))
    return np.asarray(np.linalg.eigvalsh(whole)[:, -1])


def without_decisive(
    problem: RefinementProblem, end: End, covariance: Array
) -> Iterator[tuple[Decisive, RefinementProblem, End]]:
    """Seek the answer again without each place that decides a direction alone.

    Parameters
    ----------
    problem, end
        The problem of a pair, and the answer.
    covariance
        (12, 12) of the poles' poses.

    Yields
    ------
    Decisive, RefinementProblem, End
        The place, and problem (but for its `few`) and answer without it; places without which the
        rest of the scene gives no information are left out.
    """
    (term,), (scene,) = end.scene, problem.scenes
    pairs = term.pairs
    shares = leverage(places_of_poses(end))
    for c in np.argsort(-shares):
        if shares[c] <= MAX_SHARE:
            return
        kept = scene.sets.clusters != pairs.places[c]
        rest = replace(problem, scenes=(replace(scene, sets=some_of(scene.sets, kept)),))
        found = converge(rest, end, covariance)
        if found.scene:
            own = pairs.cluster == c
            at = np.average(pairs.at[own], axis=0, weights=term.weighed.weights[own])
            yield Decisive(float(shares[c]), at, se3.local(end.T[1], found.T[1])), rest, found


SEVERAL = chi2_limit(POSE)
"""Squared Mahalanobis distance from which two ends are two minima."""


def distance_sq(covariance: Array, T: Array, T_other: Array) -> float:
    """Squared Mahalanobis distance of one pose (4, 4) from another with a covariance (6, 6)."""
    step = se3.local(T, T_other)
    return float(step @ np.linalg.solve(covariance, step))


def approaches_from_afar(
    problem: RefinementProblem, near: End, poles: PoseEstimate, lever: float
) -> list[End]:
    """Approach from the ends of the poles' uncertainty, and keep the results at other poses.

    Where the uncertainty exceeds the distance of corresponding surfaces, the end of the search
    may depend on its start. The ends are `SIGMAS` to either side.
    """
    assert poles.covariance is not None
    scale = np.r_[np.full(3, 1.0 / max(lever, 1.0)), np.ones(3)]
    values, vectors = np.linalg.eigh(poles.covariance / np.outer(scale, scale))
    widest = float(np.sqrt(max(values[-1], 0.0)))
    if widest < MIN_CORRESPONDENCE_DISTANCE:
        return []
    step = SIGMAS * widest * vectors[:, -1] * scale
    found = [
        approach(
            problem,
            poses_of_pair(se3.retract(poles.T_target_source, sign * step)),
            of_source(poles.covariance),
        )
        for sign in (1.0, -1.0)
    ]
    return [end for end in found if end.scene and elsewhere(end, [near])]


def approaches_of_parts(
    problem: RefinementProblem, T: Array, known: Sequence[End], covariance: Array
) -> list[End]:
    """Approach with the parts of the patches not used yet; keep the results at other poses.

    Few patches may hold a direction, the ground between two façades: a part of them leads past a
    minimum that the others are caught in, where other starts do not.
    """
    (scene,) = problem.scenes
    kept: list[End] = []
    for k in range(1, FEW):
        part = replace(problem, scenes=(replace(scene, few=every_nth_patch(scene.sets, FEW, k)),))
        end = approach(part, T, covariance)
        if end.scene and elsewhere(end, [*known, *kept]):
            kept.append(end)
    return kept


def elsewhere(end: End, known: Sequence[End]) -> bool:
    """Whether an end is another minimum than any that is known."""
    return all(distance_sq(one.search[POSE:, POSE:], one.T[1], end.T[1]) > SEVERAL for one in known)


def of_source(covariance: Array) -> Array:
    """(12, 12) of both poses of a pair, of which the source's has a covariance (6, 6)."""
    return np.asarray(block_diag(np.zeros((POSE, POSE)), covariance))


DOUBT = float(POSE)
"""Squared Mahalanobis distance from the poles' pose, the mean of χ² with 6 degrees of freedom, from
which the search starts again with other parts of the patches. In 700 recordings of simulated
streets, corridors and harbors it was larger in 6 %."""

DISAGREE = chi2_limit(POSE, CONFIDENCE)
"""… and from which it is not taken for chance that the scene has another: the covariance then
covers both."""

SCALE = next(k for k, kind in enumerate(DEVICE_KINDS) if kind.field == "scale")
"""Which of the errors of a whole LiDAR is that of the scale of its ranges."""

MAX_SCALE_SIGMA = 0.1
"""1 σ of that scale from which the surfaces give no information about it."""

DISTORTION = "distortion of the map"
"""What a map errs by, in the error budget."""

UNSURE = 0.01
"""Part of their information that poles keep when the scene is used nearly alone: ten times their
1 σ. Of 48 recordings between which a pole was moved by 15 cm three were answered, 11 cm and more
off, two of them with a χ² below 17; with a larger limit, the scene conflicts with the poles."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """The pose that poles and scene agree on.

    Attributes
    ----------
    pose
        Pose, covariance, and RMS residual of the patches.
    uncertainty
        The covariance in its two kinds, and the budget.
    patches
        How many pairs of patches took part.
    mahalanobis_sq
        Squared Mahalanobis distance of the pose from that of the poles: χ² with 6 degrees of
        freedom where the stated uncertainties are right.
    from_poles
        The same step as rotation, rad, and translation, metres at the source's origin.
    other_minima
        Steps (6,) to the ends of the search from other starts within the poles' uncertainty, if
        they are other poses; empty mostly.
    converged, iterations
        Whether the last step was below its tolerance, and how many were taken.
    surfaces
        Patches of the target and the source, each in the frame of its LiDAR.
    corrected
        The same without the errors that were found of the LiDARs.
    end, parts
        Where the search ended, and every source of error.
    scale
        By which factor the source would have to be scaled, and its 1 σ, as if nothing were known of
        the error of its ranges' scale; None if nothing shows it.
    held
        (6, 6) the pose's covariance if every place is where it was: no `decisive` one moved.
    decisive
        Places that alone decide a direction of the pose, the most decisive first; empty mostly.
    """

    pose: PoseEstimate
    uncertainty: Uncertainty
    patches: int
    mahalanobis_sq: float
    from_poles: se3.PoseDifference
    other_minima: tuple[Array, ...]
    converged: bool
    iterations: int
    surfaces: tuple[Patches, Patches]
    corrected: tuple[Patches, Patches]
    end: End
    parts: tuple[Part, ...]
    held: Array
    scale: tuple[float, float] | None = None
    decisive: tuple[Decisive, ...] = ()


def refine_by_scene(paired: Sequence[PairedPlacement], aligned: BeamAlignment) -> Refinement | None:
    """Refine the poles' pose by the surfaces of all placements; None if there are too few."""
    targets, sources = zip(*(each.placement.scans for each in paired), strict=True)
    first, second = (error_sizes(scans[0].cloud, scans[0].sensor) for scans in (targets, sources))
    return refine(
        merge_clouds([averaged(scan.cloud) for scan in targets]),
        merge_clouds([averaged(scan.cloud) for scan in sources]),
        aligned.pose,
        factor=aligned.factor,
        model=ErrorModel(
            (first, second),
            aligned.radius.given_sigma,
            remaining_sway_in([each.placement for each in paired]),
        ),
    )


MOVED = 1.5
"""Root mean square of a place's residuals, in what the pose and they may be off by, from which it
is taken for another surface: a car parked at another place, or the back of a trunk."""


def without_moved(sets: PatchSets, T: Array, covariance: Array) -> PatchSets:
    """Leave out the parts of a map that have moved, each place as a whole.

    Parameters
    ----------
    sets
        Patches of both.
    T, covariance
        (4, 4) and (6, 6) a pose that all surfaces registered.
    """
    pairs = pair_patches(sets, T, covariance, origins_known=False)
    if pairs is None:
        return sets
    spread = np.sum(pairs.jacobian * (pairs.jacobian @ covariance), axis=1) + pairs.variance
    size = np.bincount(pairs.cluster)
    off = np.bincount(pairs.cluster, pairs.residuals**2 / spread) / size
    return some_of(sets, ~np.isin(sets.clusters, pairs.places[off > MOVED**2]))


def refine(
    target: PointCloud,
    source: PointCloud,
    poles: PoseEstimate,
    *,
    factor: PoleFactor | None = None,
    model: ErrorModel | None = None,
    start: Array | None = None,
    origins_known: bool = False,
) -> Refinement | None:
    """Let the scene sharpen the pose that the poles give.

    Parameters
    ----------
    target, source
        Clouds, each in the frame of its LiDAR.
    poles
        Pose and covariance of the poles.
    factor
        What the poles show of the pose and the errors; None takes `poles` for a normal distribution
        of the pose that gives no information about the errors.
    model
        Sizes of the errors; None takes those of unknown LiDARs.
    start
        (4, 4) where the search starts; None takes the poles' pose.
    origins_known
        Whether the beams of both clouds start where `PointCloud.origin` says; without, the front of
        an object and its back cannot be distinguished by their normals.

    Returns
    -------
    Refinement or None
        None if the scene has fewer than `MIN_PATCHES` common patches: too little information.
    """
    assert poles.covariance is not None
    patches = surface_patches(target), surface_patches(source)
    scenes = scene_pairs(patches, (0, 1))
    if not scenes:
        return None
    if target.is_map:
        T = poles.T_target_source if start is None else start
        objects = movable_objects(target, se3.apply(T, patches[1].centres))
        sets = without_moved(by_objects(scenes[0].sets, objects), T, poles.covariance)
        scenes = [ScenePair((0, 1), sets, every_nth_patch(sets, FEW))]
    given = gaussian_factor(poles) if factor is None else factor
    if model is not None:
        given = replace(given, left=np.array(model.left))
    factor = given.with_bands([np.unique(each.bands) for each in patches])
    groups = factor.unknowns.groups()
    known = (ErrorModel() if model is None else model).sigmas(groups)
    problem = RefinementProblem(factor, tuple(scenes), groups, known, origins_known)
    lever = float(np.median(se3.lengths(source.xyz - source.origin)))
    in_map = None
    if target.is_map:
        scatter = partial(scatter_without_parts, target, source)
        in_map = InMap(scatter, map_distortion(target.map_sigma))
    return refine_pair(problem, poles, (patches[0], patches[1]), lever, start, in_map)


def refine_pair(
    problem: RefinementProblem,
    poles: PoseEstimate,
    patches: tuple[Patches, Patches],
    lever: float,
    start: Array | None = None,
    in_map: InMap | None = None,
) -> Refinement | None:
    """Search the pose that poles and scene agree on from several starts, with its uncertainty.

    Parameters
    ----------
    problem
        Of two LiDARs, the first one's pose is fixed.
    poles
        The poles' pose of the second and its covariance.
    patches
        Of both, each in the frame of its LiDAR.
    lever
        Half of the second's points lie beyond this range, metres.
    start
        (4, 4) where the search starts; None takes the poles' pose.
    in_map
        What is known of the first, if it is a map.

    Returns
    -------
    Refinement or None
        None if the scene gives no information.
    """
    assert poles.covariance is not None
    first = poses_of_pair(poles.T_target_source if start is None else start)
    covariance = of_source(poles.covariance)
    coarse = problem.without_rings()
    near = approach(coarse, first, covariance)
    if not near.scene:
        return None
    starts = [near, *approaches_from_afar(coarse, near, poles, lever)]
    ends = _converged(problem, starts, covariance)
    if not ends:
        return None
    best = max(ends, key=support_of)
    mahalanobis_sq = _disagreement(coarse, best, poles)
    if mahalanobis_sq > DOUBT:
        starts = approaches_of_parts(problem, first, ends, covariance)
        ends += _converged(problem, starts, covariance)
        best = max(ends, key=support_of)
        mahalanobis_sq = _disagreement(problem, best, poles, within=True)
    highest = best
    # In a map both are of the same surfaces: the wider search finds the backs of thin ones.
    disagree = mahalanobis_sq > DISAGREE and in_map is None
    if disagree:
        # One of both is wrong by more than it states (Birge 1932): the poles are weighted
        # down by as much.
        share = POSE / mahalanobis_sq
        problem = replace(problem, factor=problem.factor.weakened(share))
        best = _converged_anew(problem, best, covariance / share) or best
        moved = distance_sq(poles.covariance, poles.T_target_source, best.T[1])
        mahalanobis_sq = max(mahalanobis_sq, moved)
    if in_map is not None:
        # The registration was of the same surfaces: it says where to search, and nothing more.
        problem = replace(problem, factor=problem.factor.weakened(UNSURE))
        best = _converged_anew(problem, best, covariance / UNSURE) or best
        more = _of_registration(problem, best, poles.T_target_source, in_map.scatter)
        if more is not None:
            problem = replace(problem, factor=more)
            (best,) = _converged(problem, [best], covariance) or [best]
    parts = parts_of(problem, best)
    own = uncertainty_of_pair(parts).covariance
    decisive, by_places = [], np.zeros((POSE, POSE))
    for place, without, rest in without_decisive(problem, best, covariance):
        decisive.append(place)
        less = excess(uncertainty_of_pair(parts_of(without, rest)).covariance, own)
        by_places += less + np.outer(place.apart, place.apart)
    others = [("one place that decides", by_places)] if decisive else []
    if in_map is not None:
        others.append((DISTORTION, in_map.distortion))
        # What a LiDAR may err by, its map may bend by: it has neither an axis nor an encoder.
        parts = tuple(
            part_of(DISTORTION, part.root, is_random=part.is_random) if part.lidar == 0 else part
            for part in parts
        )
    if disagree:
        # Which of both is not known: what is stated is never less than what the poles alone do.
        others.append(("poles and scene disagree", excess(poles.covariance, own)))
    parts += tuple(part_of(name, of_source(root_of(more))) for name, more in others)
    uncertainty = uncertainty_of_pair(parts)
    (term,) = best.scene
    T = best.T[1]
    minima = [
        se3.local(highest.T[1], one.T[1])
        for one in ends
        if distance_sq(own, highest.T[1], one.T[1]) > SEVERAL
    ]
    rms = float(np.sqrt(np.average(term.pairs.residuals**2, weights=term.weighed.weights)))
    errors = best.errors[term.place[2 * POSE :] - 2 * POSE]
    return Refinement(
        PoseEstimate(T, uncertainty.covariance, rms),
        uncertainty,
        len(term.weighed.weights),
        mahalanobis_sq,
        se3.difference(poles.T_target_source, T),
        tuple(minima),
        best.converged,
        best.iterations,
        patches,
        without_errors(term.sets, errors),
        best,
        parts,
        own,
        _scale_wanted(best, problem),
        tuple(decisive),
    )


Scatter = Callable[[Array, Array, Array, float], Array | None]
"""`in_map.scatter_without_parts` of two clouds."""


@dataclass(frozen=True, eq=False)
class InMap:
    """Of a map: the scatter of registrations in it, and (6, 6) the covariance of its distortion."""

    scatter: Scatter
    distortion: Array


def _of_registration(
    problem: RefinementProblem, best: End, T: Array, scatter: Scatter
) -> PoleFactor | None:
    """Add what a registration (4, 4) shows along the directions that the surfaces do not determine.

    Along all others it is of the same surfaces. None if there is no such direction, or the
    registration does not determine it either.
    """
    unit = SURROUNDINGS_SIGMA
    own = uncertainty_of_pair(parts_of(problem, best)).covariance / np.outer(unit, unit)
    variance, ways = np.linalg.eigh(own)
    ways = ways[:, variance > DETERMINED**2]
    covariance = scatter(T, ways, unit, DETERMINED) if ways.size else None
    if covariance is None:
        return None
    by = ways.T / unit
    factor = problem.factor.about(poses_of_pair(T))
    information = factor.information.copy()
    information[POSE : 2 * POSE, POSE : 2 * POSE] += by.T @ np.linalg.solve(covariance, by)
    return replace(factor, information=information)


def _converged(problem: RefinementProblem, starts: Sequence[End], covariance: Array) -> list[End]:
    """Let each converge, and leave out those that fail."""
    ends = [converge(problem, each, covariance) for each in starts]
    return [each for each in ends if each.scene]


def _disagreement(
    problem: RefinementProblem, best: End, poles: PoseEstimate, *, within: bool = False
) -> float:
    """Squared distance of the poses of poles and scene, in units of the σ that the poles state.

    If poles state a small σ for a wrong pose, the search does not reach the true surfaces: the
    scene is used again with poles of hardly any weight, and a search as wide as they may then be
    off. If also used `within` what the search left, other minima with less support do not
    contradict.
    """
    assert poles.covariance is not None
    T = poles.T_target_source
    apart = distance_sq(poles.covariance, T, best.T[1])
    alone = replace(problem, factor=problem.factor.weakened(UNSURE))
    wide = of_source(poles.covariance / UNSURE)
    found = [approach(alone, best.T, each) for each in ((wide, best.search) if within else (wide,))]
    far = max((each for each in found if each.scene), key=support_of, default=None)
    if far is None:
        return apart
    # Directions that the scene alone does not constrain contradict nothing.
    return max(apart, distance_sq(poles.covariance + far.search[POSE:, POSE:], T, far.T[1]))


def _converged_anew(problem: RefinementProblem, best: End, covariance: Array) -> End | None:
    """Converge with poles of lower weight, with as wide a search and without.

    A wider search may leave a good minimum for one with less support.
    """
    again = approach(problem, best.T, covariance)
    starts = [best, again] if again.scene and elsewhere(again, [best]) else [best]
    return max(_converged(problem, starts, covariance), key=support_of, default=None)


def _scale_wanted(end: End, problem: RefinementProblem) -> tuple[float, float] | None:
    """The estimate from the data alone of the scale between the LiDARs' ranges: without its prior.

    ``b`` is normal with the variance ``v`` and has had the prior precision ``p`` about 0: without,
    its information is ``1/v − p``. Mean of freeing the target's and the source's.
    """
    found = []
    unknowns = problem.factor.unknowns
    for lidar, sign in ((0, 1.0), (1, -1.0)):
        own = unknowns.device(lidar)[SCALE]
        k = own - unknowns.poses
        variance = float(end.inverse[own, own])
        information = 1.0 / variance - float(end.precision[k])
        if information * MAX_SCALE_SIGMA**2 < 1.0:
            return None
        found.append((sign * float(end.errors[k]) / variance / information, information))
    return 1.0 + (found[0][0] + found[1][0]) / 2, max(one[1] ** -0.5 for one in found)
