"""Whether a cloud is mirrored or scaled: what a rigid motion cannot put right, named as such.

After a refusal the poles are matched again with one cloud mirrored, and with one cloud scaled. What
is found counts only where the scene then agrees well, and clearly better than under any rigid
motion: under those that the poles allow, and under those that come nearest to what was found, since
a place may be its own mirror image but for a few things in it. It never gives a pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import se3
from ..datatypes import Array, Hypothesis, Placement, PointCloud, Pole, Scan
from ..errors import Refusal
from ..matching.correspondence import match_poles, pair_starts
from ..matching.similar import Change, changed_cloud, changed_pole, factors_of
from .consistency import (
    MAX_CONTRADICTED,
    MIN_AGREEING,
    MIN_TOTAL,
    Consistency,
    Standing,
    consistency,
    standing_in,
)
from .disambiguation import SCORING_SAMPLE, SCORING_VOXEL
from .refinement import Refinement
from .similarity_fit import Planes, fit_similarity, planes_of, support
from .visibility import OVERLAP_DISTANCE, View, compare_views, view_of

EXPLAINED = {
    *("too_few_poles", "parallel_poles", "no_match", "pole_count", "ambiguous", "no_overlap"),
    *("placements_disagree", "poor_fit", "poles_inconsistent", "degenerate_poles"),
    *("poles_scene_contradict", "scene_contradicts", "prior_contradicted"),
}
"""Refusals that a mirrored or scaled cloud may cause."""

FIT_SAMPLE = 3000
"""The fit takes every n-th point so that about so many are left."""

RIGID_TRIED, FACTORS_TRIED = 2, 3
"""So many rigid poses, the best scored first, and factors, the most frequent first, are fitted."""

BETTER_SUPPORT, BETTER_AGREEING, AS_MANY = 1.15, 1.05, 0.95
"""By the first factor more points lie on the other cloud's surfaces than under any rigid motion. In
a mirrored cloud by the second more places agree, too. In a scaled one no fewer than by the last:
2 % of scale are within the tolerance of the depth."""

WORSE_CONTRADICTED = 0.01
"""By no more the share of the places that deny it is above that of a rigid motion."""

LEAST_CHANGE = 0.01
"""A factor is named where it differs from 1 by more: LiDARs' ranges err by far less."""

SCALE_SIGMAS = 3.0
"""An answer's scale is denied where it is off by more than `LEAST_CHANGE` and so many σ."""

UNITS = {
    "feet": 0.3048,
    "inches": 0.0254,
    "centimetres": 0.01,
    "millimetres": 0.001,
}
"""Units that clouds come in, metres."""

SAME_UNIT = 0.02
"""A factor is taken for that of a unit where it differs by no larger part."""

REACH_RATIO = 2.5
"""A unit is tried where it brings the median ranges of both clouds to within this factor."""

LEVEL = 0.5
"""Cosine between the LiDARs' axes from which both stand upright, or one is upside down."""

Find = Callable[[PointCloud], Scan]


@dataclass(frozen=True, eq=False)
class _Found:
    """What fits: the change of the source, the pose (4, 4) then, and what the scene says."""

    change: Change
    T: Array
    agreed: Consistency
    support: float


@dataclass(frozen=True, eq=False)
class _Place:
    """A placement, prepared: poles of both, the target's views, and the source as it is."""

    target: tuple[Pole, ...]
    source: tuple[Pole, ...]
    view: View
    standing: Standing
    planes: Planes
    cloud: PointCloud


def explained(
    refusal: Refusal,
    placements: Sequence[Placement],
    hypotheses: Sequence[Hypothesis],
    find: tuple[Find, Find],
) -> Refusal:
    """Say of a refusal where a mirrored or scaled cloud is its cause.

    Parameters
    ----------
    refusal
        Why there is no answer.
    placements
        What was found.
    hypotheses
        Rigid poses from the source of the first placement; empty where the poles gave none.
    find
        Find the poles in a target's and in a source's cloud.

    Returns
    -------
    Refusal
        ``mirrored`` or ``wrong_scale``; the same as was given where neither is found.
    """
    if refusal.code not in EXPLAINED or not placements:
        return refusal
    first = placements[0]
    poles = min(len(first.target.poles), len(first.source.poles))
    if poles > 1:
        rigid = [each.match.T_target_source for each in hypotheses]
        found = _found_in(first, rigid)
        if found is not None:
            return _refusal(*found, first)
    for factor, changed in _in_other_units(first, find):
        found = _found_in(changed, (), is_changed=True)
        if found is not None:
            best, rival = found
            change = replace(best.change, factor=best.change.factor * factor)
            return _refusal(replace(best, change=change), rival, first)
    return refusal


def check_scale(refined: Refinement | None) -> None:
    """Refuse an answer whose surfaces and poles want the source to be scaled.

    Raises
    ------
    Refusal
        ``wrong_scale``.
    """
    if refined is None or refined.scale is None:
        return
    factor, sigma = refined.scale
    if abs(factor - 1.0) <= max(LEAST_CHANGE, SCALE_SIGMAS * sigma):
        return
    raise Refusal(
        "wrong_scale",
        f"lengths in the source must be multiplied by {factor:.4f} (1 σ: {sigma:.4f}) to be those "
        f"in the target{_unit_words(factor)}: one of the two clouds is scaled",
        {"factor": factor, "sigma": sigma, **_unit_values(factor)},
    )


def _found_in(
    placement: Placement, rigid: Sequence[Array], *, is_changed: bool = False
) -> tuple[_Found, _Found | None] | None:
    """Find the change under which a placement fits, and the best of the rigid motions."""
    view = view_of(placement.target.cloud, SCORING_VOXEL, SCORING_SAMPLE)
    planes = planes_of(view.tree)
    if planes is None:
        return None
    place = _Place(
        placement.target.poles,
        placement.source.poles,
        view,
        _standing(placement.target.cloud),
        planes,
        placement.source.cloud,
    )
    if is_changed:
        best = _best(place, Change(), None, free_factor=True)
        return None if best is None or not _is_confirmed(best.agreed) else (best, None)
    starts = rigid or _any_way(place.target, place.source)
    rivals = _fitted(place, Change(), starts, RIGID_TRIED, free_factor=False)
    for change in _changes(place):
        found = _best(place, change, None if change != Change() else starts)
        if found is None or not _is_confirmed(found.agreed):
            continue
        if found.change.mirrored:
            rivals += _counterparts(place, found)
        if all(_is_better(found, rival) for rival in rivals):
            return found, max(rivals, key=lambda rival: rival.support, default=None)
    return None


def _changes(place: _Place) -> Iterator[Change]:
    yield Change(mirrored=True)
    yield from (Change(each) for each in factors_of(place.target, place.source, FACTORS_TRIED))
    # Poles that nearly meet tell no factor; the scene may.
    yield Change()


def _best(
    place: _Place, change: Change, starts: Sequence[Array] | None, free_factor: bool | None = None
) -> _Found | None:
    """Fit what the poles allow under a change, or from given starts; the best scored."""
    if starts is None:
        try:
            poles = [changed_pole(pole, change) for pole in place.source]
            matches = match_poles(place.target, poles)
        except Refusal:
            return None
        starts = [match.T_target_source for match in matches if match.exact]
    free = not change.mirrored if free_factor is None else free_factor
    return next(iter(_fitted(place, change, starts, 1, free_factor=free)), None)


def _fitted(
    place: _Place, change: Change, starts: Sequence[Array], most: int, *, free_factor: bool
) -> list[_Found]:
    """Fit from the starts (4, 4) that score best."""
    if not starts:
        return []
    cloud = changed_cloud(place.cloud, change)
    view = view_of(cloud, SCORING_VOXEL, SCORING_SAMPLE)
    scores = []
    for T in starts:
        agreed = compare_views(place.view, view, T, within=OVERLAP_DISTANCE)
        scores.append(agreed.overlap - agreed.free_space_violation)
    points = view.points[:: 1 + len(view.points) // FIT_SAMPLE]
    standing = _standing(cloud)
    found = []
    for k in np.argsort(-np.array(scores), kind="stable")[:most]:
        fit = fit_similarity(place.planes, points, starts[k], free_factor=free_factor)
        if fit is None:
            continue
        if free_factor:
            standing = _standing(changed_cloud(cloud, Change(fit.factor)))
        found.append(
            _Found(
                replace(change, factor=change.factor * fit.factor),
                fit.T,
                consistency(place.standing, standing, fit.T),
                support(place.planes, se3.apply(fit.T, standing.points)),
            )
        )
    return found


def _any_way(target: Sequence[Pole], source: Sequence[Pole]) -> list[Array]:
    """Lay the best two poles on each other in all ways, whether they fit or not."""
    try:
        starts = pair_starts((target[0], target[1]), (source[0], source[1]))
    except Refusal:
        return []
    return [T for T, _ in starts]


def _counterparts(place: _Place, found: _Found) -> list[_Found]:
    """Fit the rigid motions that come nearest to a mirrored one.

    Mirrored once more, in an upright plane through the middle of what stands: a street or a
    corridor is then nearly what it was.
    """
    points = place.standing.points
    if len(points) < 3:
        return []
    middle = np.median(points, axis=0)
    up = place.standing.up
    level = (points - middle) - np.outer((points - middle) @ up, up)
    axes = np.linalg.svd(level, full_matrices=False)[2][:2]
    starts = []
    for n in axes:
        again = np.eye(4)
        again[:3, :3] -= 2 * np.outer(n, n)
        again[:3, 3] = 2 * (n @ middle) * n
        starts.append(again @ found.T @ np.diag([*found.change.diagonal, 1.0]))
    return _fitted(place, Change(), starts, len(starts), free_factor=False)


def _standing(cloud: PointCloud) -> Standing:
    # The same recordings give the same answer.
    return standing_in(cloud, np.random.default_rng(0))


def _is_confirmed(agreed: Consistency) -> bool:
    """Whether as much agrees, and as little denies, as in an answer that the scene confirms."""
    enough = agreed.agreeing >= MIN_AGREEING and agreed.total >= MIN_TOTAL
    return enough and agreed.contradicted <= MAX_CONTRADICTED


def _is_better(found: _Found, rigid: _Found) -> bool:
    """Whether a change explains the scene clearly better than a rigid motion."""
    if not found.change.mirrored and abs(np.log(found.change.factor)) <= LEAST_CHANGE:
        return False
    least = BETTER_AGREEING if found.change.mirrored else AS_MANY
    return (
        found.support >= BETTER_SUPPORT * rigid.support
        and found.agreed.agreeing >= least * rigid.agreed.agreeing
        and found.agreed.contradicted <= rigid.agreed.contradicted + WORSE_CONTRADICTED
    )


def _in_other_units(
    placement: Placement, find: tuple[Find, Find]
) -> Iterator[tuple[float, Placement]]:
    """Find the poles again with one cloud brought to the other's unit; the source's factor first.

    In feet a pole of 4 cm is as thick as one of 13 cm, and is none.
    """
    clouds = placement.target.cloud, placement.source.cloud
    if any(len(cloud) == 0 for cloud in clouds):
        return
    far = [float(np.median(np.linalg.norm(each.xyz - each.origin, axis=1))) for each in clouds]
    for unit in UNITS.values():
        for factor in (unit, 1.0 / unit):
            off = abs(np.log(far[0] / (factor * far[1])))
            is_near = off < min(np.log(REACH_RATIO), abs(np.log(far[0] / far[1])))
            if not is_near:
                continue
            source = find[1](changed_cloud(clouds[1], Change(factor)))
            if len(source.poles) > 1 and len(placement.target.poles) > 1:
                yield factor, replace(placement, source=source)
            target = find[0](changed_cloud(clouds[0], Change(1.0 / factor)))
            if len(target.poles) > 1 and len(placement.source.poles) > 1:
                yield factor, replace(placement, target=target)


def _refusal(found: _Found, rigid: _Found | None, placement: Placement) -> Refusal:
    agreed = found.agreed
    figures = {
        "agreeing": agreed.agreeing,
        "contradicting": agreed.contradicting,
        **({} if rigid is None else {"rigid_agreeing": rigid.agreed.agreeing}),
        **({} if rigid is None else {"rigid_contradicting": rigid.agreed.contradicting}),
    }
    shown = f"{agreed.agreeing} of {agreed.total} places off the ground then agree"
    if rigid is not None:
        shown += f", {rigid.agreed.agreeing} of {rigid.agreed.total} under the best rigid motion"
    if not found.change.mirrored:
        factor = found.change.factor
        return Refusal(
            "wrong_scale",
            f"lengths in the source must be multiplied by {factor:.4f} to be those in the target"
            f"{_unit_words(factor)}: {shown}; bring both clouds to metres",
            {"factor": factor, **_unit_values(factor), **figures},
        )
    axis = _mirrored_axis(found, placement)
    words = {
        "horizontal": "one horizontal axis",
        "vertical": "the vertical axis, or a horizontal one where a LiDAR hangs upside down,",
        "unknown": "one axis",
    }[axis]
    return Refusal(
        "mirrored",
        f"{words} of one of the two clouds is reversed: {shown}; look at the driver's axes "
        "(left-handed?), and at what converted the files",
        {"axis": axis, "lidar": "one of the two", **figures},
    )


def _mirrored_axis(found: _Found, placement: Placement) -> str:
    """Which axis is reversed, as far as the LiDARs' own axes tell under the pose.

    Two horizontal ones differ by a rotation about the vertical one.
    """
    moved = found.T[:3, :3] @ changed_cloud(placement.source.cloud, found.change).axis
    cosine = float(placement.target.cloud.axis @ moved)
    if abs(cosine) < LEVEL:
        return "unknown"
    return "horizontal" if cosine > 0 else "vertical"


def _unit_of(factor: float) -> str | None:
    """Name the unit that one of two clouds is in, where a factor is that of one to metres."""
    for name, size in UNITS.items():
        if abs(abs(np.log(factor)) + np.log(size)) < SAME_UNIT:
            return name
    return None


def _unit_words(factor: float) -> str:
    name = _unit_of(factor)
    if name is None:
        return ""
    lidar = "source" if factor < 1 else "target"
    return f" ({UNITS[name]:g}: is the {lidar} in {name}?)"


def _unit_values(factor: float) -> dict[str, float | int | str]:
    name = _unit_of(factor)
    return {} if name is None else {"unit": name, "unit_m": UNITS[name]}
