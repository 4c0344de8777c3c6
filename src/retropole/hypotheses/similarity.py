"""The search for a mirror or a factor under which poles and scene fit; see `similarity`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Placement, PointCloud, Pole
from ..base.errors import Refusal
from ..base.uncertainty.confirmation import Confirmation
from ..surfaces.averaging import averaged
from ..surfaces.consistency import Standing, consistency, standing_in
from ..surfaces.disambiguation import SCORING_SAMPLE, SCORING_VOXEL
from ..surfaces.similarity_fit import Planes, fit_similarity, planes_of, support
from ..surfaces.visibility import OVERLAP_DISTANCE, View, compare_views, view_of
from .correspondence import match_poles
from .evidence import MIN_TOTAL
from .line_pairs import pair_starts
from .similar import Change, changed_cloud, changed_pole, factors_of

CHANGES_TRIED = 3
"""So many rigid poses, the best scored first, and factors, the most frequent first, are fitted."""

POLES_TRIED = 6
"""So many poles of each cloud, the best supported first, are matched under a change: where nothing
fits, a row of 13 takes 20 s for each (seed 14 of a harbor, beside a profiler)."""

CLEARLY_BETTER, AS_MANY = 1.15, 0.95
"""By the first factor more points lie on the other cloud's surfaces than under any rigid motion,
in a mirrored cloud times that by which more voxels agree, neither being fewer. In a scaled one
voxels are no fewer than by the last: 2 % of scale are within the tolerance of the depth. Of three
mirrored clouds that were answered off bare ground (benchmarks/deception.py, seeds below 120) the
product was 1.18 in a street of plain fronts, and 1.7 and more in the others."""

MAX_CONFLICTING_CHANGED = 0.1
"""What fits is confirmed where no larger share of the voxels conflicts with it, of `MIN_TOTAL` or
more."""

MORE_CONFLICTING = 0.01
"""By no more the share of the voxels that conflict with it is above that of a rigid motion."""

LEAST_CHANGE = 0.01
"""A factor is named where it differs from 1 by more: LiDARs' ranges err by far less."""


@dataclass(frozen=True, eq=False)
class Found:
    """What fits: the change of the source, the pose (4, 4) then, and what the scene says."""

    change: Change
    T: Array
    agreed: Confirmation
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


def find_change(
    placement: Placement, rigid: Sequence[Array], *, is_changed: bool = False
) -> tuple[Found, Found | None] | None:
    """Find a change of the source under which a placement fits as under no rigid motion.

    Parameters
    ----------
    placement
        With two poles or more in either cloud.
    rigid
        (4, 4) rigid motions that the poles allow; none takes all ways of laying two on two.
    is_changed
        Whether a cloud has been brought to another unit: then it is only asked whether it fits.

    Returns
    -------
    tuple of Found and (Found or None), or None
        What fits, and the best of the rigid motions.
    """
    place = _prepared(placement)
    if place is None:
        return None
    if is_changed:
        best = _best(place, Change(), _matched(place, Change()))
        return (best, None) if best is not None and _is_confirmed(best.agreed) else None
    starts = rigid or _any_way(place.target, place.source)
    rivals = _fitted(place, Change(), starts, CHANGES_TRIED, free_factor=False)
    for change in _changes(place):
        # Poles that nearly meet tell no factor; the scene may.
        found = _best(place, change, starts if change == Change() else _matched(place, change))
        if found is None or not _is_confirmed(found.agreed):
            continue
        rivals += _counterparts(place, found)
        if all(_is_better(found, rival) for rival in rivals):
            return found, max(rivals, key=lambda rival: rival.support, default=None)
    return None


def find_mirror(placement: Placement, T: Array) -> tuple[Found, Found] | None:
    """Find whether a placement fits clearly better mirrored than under the pose (4, 4) it has.

    It costs hardly anything where the poles do not fit mirrored, as most do not.
    """
    change = Change(mirrored=True)
    starts = _matches(placement.target.poles, placement.source.poles, change)
    place = _prepared(placement) if starts else None
    if place is None:
        return None
    found = _best(place, change, starts)
    rivals = _fitted(place, Change(), [T], 1, free_factor=False)
    if found is None or not rivals or not _is_confirmed(found.agreed):
        return None
    return (found, rivals[0]) if _is_better(found, rivals[0]) else None


def _prepared(placement: Placement) -> _Place | None:
    """Prepare a placement; None where the target has too few points."""
    view = view_of(placement.target.cloud, SCORING_VOXEL, SCORING_SAMPLE)
    planes = planes_of(view.tree)
    if planes is None:
        return None
    return _Place(
        placement.target.poles,
        placement.source.poles,
        view,
        _standing(placement.target.cloud),
        planes,
        averaged(placement.source.cloud),
    )


def _changes(place: _Place) -> Iterator[Change]:
    yield Change(mirrored=True)
    yield from (Change(each) for each in factors_of(place.target, place.source, CHANGES_TRIED))
    yield Change()


def _matches(target: Sequence[Pole], source: Sequence[Pole], change: Change) -> list[Array]:
    """Poses (4, 4) under which the poles fit exactly, those of the source once changed."""
    target, source = target[:POLES_TRIED], source[:POLES_TRIED]
    try:
        matches = match_poles(target, [changed_pole(pole, change) for pole in source])
    except Refusal:
        return []
    return [match.T_target_source for match in matches if match.exact]


def _matched(place: _Place, change: Change) -> list[Array]:
    return _matches(place.target, place.source, change)


def _best(place: _Place, change: Change, starts: Sequence[Array]) -> Found | None:
    """Fit the best scored of the starts (4, 4), of a cloud that is not mirrored with its factor."""
    return next(iter(_fitted(place, change, starts, 1, free_factor=not change.mirrored)), None)


def _fitted(
    place: _Place, change: Change, starts: Sequence[Array], most: int, *, free_factor: bool
) -> list[Found]:
    """Fit from the starts (4, 4) that score best."""
    if not starts:
        return []
    cloud = changed_cloud(place.cloud, change)
    view = view_of(cloud, SCORING_VOXEL, SCORING_SAMPLE)
    scores = []
    for T in starts:
        agreed = compare_views(place.view, view, T, within=OVERLAP_DISTANCE)
        scores.append(agreed.overlap - agreed.free_space_violation)
    standing = _standing(cloud)
    found = []
    for k in np.argsort(-np.array(scores), kind="stable")[:most]:
        fit = fit_similarity(place.planes, view.points, starts[k], free_factor=free_factor)
        if fit is None:
            continue
        if free_factor:
            standing = _standing(changed_cloud(cloud, Change(fit.factor)))
        found.append(
            Found(
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


def _counterparts(place: _Place, found: Found) -> list[Found]:
    """Fit the rigid motions that come nearest to what was found.

    Of a scaled cloud it is the same rotation, about the middle of the cloud. A mirrored one is
    mirrored once more, in an upright plane through the middle of what stands: a street or a
    corridor is then nearly what it was.
    """
    whole = found.T @ np.diag([*found.change.diagonal, 1.0])
    if not found.change.mirrored:
        middle = np.median(place.cloud.xyz, axis=0)[None]
        R = found.T[:3, :3]
        start = se3.from_rt(R, (se3.apply(whole, middle) - middle @ R.T)[0])
        return _fitted(place, Change(), [start], 1, free_factor=False)
    points = place.standing.points
    if len(points) < 3:
        return []
    middle, up = np.median(points, axis=0), place.standing.up
    level = (points - middle) - np.outer((points - middle) @ up, up)
    starts = []
    for n in np.linalg.svd(level, full_matrices=False)[2][:2]:
        again = np.eye(4)
        again[:3, :3] -= 2 * np.outer(n, n)
        again[:3, 3] = 2 * (n @ middle) * n
        starts.append(again @ whole)
    return _fitted(place, Change(), starts, len(starts), free_factor=False)


def _standing(cloud: PointCloud) -> Standing:
    # The same recordings give the same answer.
    return standing_in(cloud, np.random.default_rng(0))


def _is_confirmed(agreed: Confirmation) -> bool:
    """Whether as much agrees, and as little conflicts, as in an answer that the scene confirms."""
    return agreed.total >= MIN_TOTAL and agreed.contradicted <= MAX_CONFLICTING_CHANGED


def _is_better(found: Found, rigid: Found) -> bool:
    """Whether a change explains the scene clearly better than a rigid motion."""
    if found.agreed.contradicted > rigid.agreed.contradicted + MORE_CONFLICTING:
        return False
    by_support = found.support / max(rigid.support, 1.0)
    by_agreeing = found.agreed.agreeing / max(rigid.agreed.agreeing, 1)
    if found.change.mirrored:
        return min(by_support, by_agreeing) >= 1.0 and by_support * by_agreeing >= CLEARLY_BETTER
    is_scaled = abs(np.log(found.change.factor)) > LEAST_CHANGE
    return bool(is_scaled and by_support >= CLEARLY_BETTER and by_agreeing >= AS_MANY)
