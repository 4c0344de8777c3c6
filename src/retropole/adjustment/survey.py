"""How what the LiDARs see is laid on a survey: poles by their shape, control points by name.

Then it is checked: in one frame, in metres, and all of it matched by what is seen. What matches
nothing that the LiDARs see is named, and left out. Where the unmatched part would fix another
frame, or fits as a mirror image or in another unit, it is undecidable which part is right.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from msgspec import structs

from ..base import quantities, se3
from ..base.datatypes import Array, Pole
from ..base.description import Site, SurveyedPole
from ..base.errors import Reason, Refusal
from ..base.quantities import counted
from ..hypotheses.correspondence import match_poles
from ..surfaces.visibility import OVERLAP_DISTANCE
from .shared import SharedPole

END_MARGIN = 0.3
"""Returns on a pole of which one end was surveyed lie on one side of that end, or at most this far
beyond, metres: a wrong end of the tape, and the poles' pose along the pole."""

ROUGH = 0.1
"""Poses may be off by as much before they are adjusted, metres: a survey that fits so well is laid
no better, and one that fits worse is not a separate frame."""

SAMPLES = 5
"""Points on a surveyed pole that represent returns when it is matched."""

LEAST_BASE = 0.3
"""Control points nearer to one line than this fix no frame, metres."""

MOST_TRIPLES = 60
"""Triples of control points that are tried, evenly of all there are."""


@dataclass(frozen=True, eq=False)
class Fit:
    """An alignment of the recordings to the survey, and the surveyed points that it matches.

    Attributes
    ----------
    T
        (4, 4) survey from the frame of the poses.
    poles, sightings
        Indices of the surveyed poles, and of the control points and their sightings.
    ends
        How many ends of poles and sightings are matched.
    rms
        How far they are from what is seen, metres.
    """

    T: Array
    poles: frozenset[int]
    sightings: frozenset[tuple[int, int]]
    ends: int
    rms: float

    @property
    def points(self) -> frozenset[int]:
        """Indices of the control points of which a sighting is matched."""
        return frozenset(q for q, _ in self.sightings)


def every_fit(
    site: Site, origins: Array, poses: dict[int, Array], poles: Sequence[SharedPole]
) -> list[Fit]:
    """Find the alignments of what the LiDARs see to the survey, the one that matches most first."""
    fits: list[Fit] = []
    for T in (*_by_poles(site, poles), *_by_points(site, origins, poses)):
        same = [k for k, other in enumerate(fits) if _same(T, other.T, poles)]
        if same and fits[same[0]].rms < ROUGH:
            continue
        fit = _fit(T, site, origins, poses, poles)
        if fit is None:
            continue
        if not same:
            fits.append(fit)
        elif order(fit) < order(fits[same[0]]):
            fits[same[0]] = fit
    return sorted(fits, key=order)


def order(fit: Fit) -> tuple[float, float]:
    """Those that match most come first, each end by how well: the less the farther it is off.

    A truncated quadratic (Torr and Zisserman 2000): one more that is matched to half a metre, with
    all others pulled along, is no more than what fits to centimetres.
    """
    return -fit.ends * (1.0 - (fit.rms / OVERLAP_DISTANCE) ** 2), fit.rms


def fixes_frame(site: Site, poles: frozenset[int], points: frozenset[int]) -> bool:
    """Whether some of what was surveyed fixes a frame by itself."""
    return sum(_is_line(site.poles[k]) for k in poles) >= 2 or len(points) >= 3


def _is_line(each: SurveyedPole) -> bool:
    return each.foot is not None and each.top is not None


def _by_poles(site: Site, poles: Sequence[SharedPole]) -> Iterator[Array]:
    """Align the axes that the LiDARs see to the surveyed ones: LiDARs and survey do not move, so
    that poles of all placements count together.
    """
    known = [each for each in site.poles if _is_line(each)]
    if len(known) < 2 or len(poles) < 2:
        return
    target = [_line(each.foot, each.top) for each in known]
    source = [_line(*pole.extent) for pole in poles]
    try:
        matches = match_poles(target, source, part=True)
    except Refusal:
        return
    for match in matches:
        if match.exact:
            yield match.T_target_source


def _line(foot: Array | None, top: Array | None) -> Pole:
    """Take two ends of an axis for a pole."""
    assert foot is not None
    assert top is not None
    along = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    length = float(np.linalg.norm(top - foot))
    return Pole(
        point=(foot + top) / 2,
        direction=(top - foot) / max(length, 1e-9),
        xyz=foot + along * (top - foot),
        length=length,
        rms=0.0,
        rings=SAMPLES,
        index=np.arange(SAMPLES),
    )


def _by_points(site: Site, origins: Array, poses: dict[int, Array]) -> Iterator[Array]:
    """Align the control points that the LiDARs see to the surveyed ones, and every three of
    them."""
    known, seen = [], []
    for q, point in enumerate(site.points):
        at = [there for _, there in sightings_of(site, q, origins, poses)]
        if at:
            known.append(point.at)
            seen.append(np.median(at, axis=0))
    a, b = np.array(known), np.array(seen)
    every = list(combinations(range(len(known)), 3))
    triples = every[:: 1 + len(every) // MOST_TRIPLES]
    for some in ([tuple(range(len(known)))] if len(known) > 3 else []) + triples:
        own = list(some)
        T = _onto(a[own], b[own])
        # Triangles of another shape are none of the same points.
        if T is not None and se3.lengths(se3.apply(T, b[own]) - a[own]).max() < OVERLAP_DISTANCE:
            yield T


def sightings_of(
    site: Site, point: int, origins: Array, poses: dict[int, Array]
) -> Iterator[tuple[int, Array]]:
    """Index of each sighting of a control point, and (3,) where it lies in the poses' frame."""
    for k, sight in enumerate(site.points[point].seen):
        if sight.lidar in poses:
            about = (sight.at - origins[sight.lidar])[None]
            yield k, se3.apply(poses[sight.lidar], about)[0]


def _onto(a: Array, b: Array) -> Array | None:
    """(4, 4) that lays points b (N, 3) on points a (Kabsch 1976); None where they are in line."""
    centred = a - a.mean(axis=0), b - b.mean(axis=0)
    if np.linalg.svd(centred[0])[1][1] < LEAST_BASE:
        return None
    U, _, Vt = np.linalg.svd(centred[0].T @ centred[1])
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return se3.from_rt(R, a.mean(axis=0) - R @ b.mean(axis=0))


def _fit(
    T: Array, site: Site, origins: Array, poses: dict[int, Array], poles: Sequence[SharedPole]
) -> Fit | None:
    """Find what of the survey matches under a pose; None where it fixes no frame or nothing
    matches."""
    gaps: list[float] = []
    matched: set[int] = set()
    sightings: set[tuple[int, int]] = set()
    there = [transformed(pole, T) for pole in poles]
    for k, each in enumerate(site.poles):
        found = pole_at(each, there)
        if found is not None:
            gaps += [axis_distance(end, found) for end in ends_of(each)]
            matched.add(k)
    for q, point in enumerate(site.points):
        for k, seen in sightings_of(site, q, origins, poses):
            gap = float(np.linalg.norm(se3.apply(T, seen[None])[0] - point.at))
            if gap < OVERLAP_DISTANCE:
                gaps.append(gap)
                sightings.add((q, k))
    lines = sum(_is_line(site.poles[k]) for k in matched)
    if lines < 2 and len(sightings) < 3 and not (lines and sightings):
        return None
    rms = float(np.sqrt(np.mean(np.square(gaps))))
    return Fit(T, frozenset(matched), frozenset(sightings), len(gaps), rms)


def ends_of(each: SurveyedPole) -> list[Array]:
    """(3,) each, the ends of a pole that were surveyed."""
    return [end for _, end, _ in each.ends]


def pole_at(each: SurveyedPole, poles: Sequence[SharedPole]) -> SharedPole | None:
    """Find the pole that a surveyed one is, in the frame of the survey."""
    near = [
        pole
        for pole in poles
        if pole.placement == each.placement
        and worst_offset(each, pole) < OVERLAP_DISTANCE
        and _is_between(each, pole)
    ]
    return min(near, key=lambda pole: worst_offset(each, pole), default=None)


def worst_offset(each: SurveyedPole, pole: SharedPole) -> float:
    """How far the worse end of a surveyed pole is from the axis of one that is seen, metres."""
    return max(axis_distance(end, pole) for end in ends_of(each))


def axis_distance(end: Array, pole: SharedPole) -> float:
    """How far a point is from the axis of a pole, metres."""
    return float(np.linalg.norm(np.cross(end - pole.point, pole.direction)))


def _is_between(each: SurveyedPole, pole: SharedPole) -> bool:
    """Whether the returns on a pole lie between its surveyed ends, or mostly, as far as known.

    Not all: height is what rough poses know least, and something bright on a pole makes it longer.
    """
    if each.foot is None or each.top is None:
        (end,) = ends_of(each)
        along = (pole.extent - end) @ pole.direction
        # All on one side of the end.
        return bool(min(along.max(), -along.min()) < END_MARGIN)
    length = float(np.linalg.norm(each.top - each.foot))
    along = (pole.extent - each.foot) @ (each.top - each.foot) / length
    between = min(along.max(), length) - max(along.min(), 0.0)
    return bool(between > np.ptp(along) / 2)


def _same(T: Array, other: Array, poles: Sequence[SharedPole]) -> bool:
    at = np.array([pole.point for pole in poles]) if poles else np.zeros((1, 3))
    return se3.difference_at(T, other, at).translation < OVERLAP_DISTANCE


def transformed(pole: SharedPole, T: Array) -> SharedPole:
    """Express a pole in another frame."""
    return replace(
        pole,
        point=se3.apply(T, pole.point[None])[0],
        direction=T[:3, :3] @ pole.direction,
        extent=se3.apply(T, pole.extent),
    )


SURVEY_UNITS = {"feet": 0.3048, "inches": 0.0254, "centimetres": 0.01, "millimetres": 0.001}
"""Units of coordinates other than metres, metres each."""

MOST_RMS = 0.02
"""Alignments of the survey to the recordings are distinguished if one fits twice as well, or within
this, metres."""


def align_to_survey(
    site: Site, origins: Array, poses: dict[int, Array], poles: Sequence[SharedPole]
) -> Fit:
    """Find how what the LiDARs see lies in the frame of the survey.

    Raises
    ------
    Refusal
        ``survey_unmatched``, ``survey_ambiguous``, or ``survey_contradicts``.
    """
    fits = every_fit(site, origins, poses, poles)
    _check_units(site, origins, poses, poles, fits)
    if not fits:
        raise Refusal(
            "survey_unmatched",
            f"nothing that was surveyed ({counted(len(site.poles), 'pole')}, "
            f"{counted(len(site.points), 'control point')}) fits what the LiDARs see: two poles "
            "with both ends, or three control points that are not in line, fix the frame; check "
            "placements, names and units",
            {"poles": len(site.poles), "points": len(site.points)},
        )
    best, *others = fits
    for other in others:
        _check_frames(site, best, other, poles)
    limit = 2.0 * max(best.rms, MOST_RMS)
    rivals = [fit for fit in others if fit.ends >= best.ends and fit.rms < limit]
    if rivals:
        raise Refusal(
            "survey_ambiguous",
            f"the survey fits the recordings in {1 + len(rivals)} ways, to "
            f"{1000 * best.rms:.0f} and {1000 * rivals[0].rms:.0f} mm: survey another pole, both "
            "ends of each, or a control point",
            {"ways": 1 + len(rivals), "rms_m": best.rms, "rival_rms_m": rivals[0].rms},
        )
    return best


def _check_frames(site: Site, best: Fit, other: Fit, poles: Sequence[SharedPole]) -> None:
    """Refuse if the points that the best alignment does not match fix another frame."""
    left = other.poles - best.poles, other.points - best.points
    if other.rms > ROUGH or not fixes_frame(site, *left):
        # Two lines fit others by chance, but hardly so well.
        return
    at = np.array([pole.point for pole in poles]) if poles else np.zeros((1, 3))
    difference = se3.difference_at(best.T, other.T, at)
    one, two = _names(site, best.poles, best.points), _names(site, *left)
    raise Refusal(
        "survey_contradicts",
        f"{one} fix one frame, {two} another, {quantities.error(difference.translation)} and "
        f"{np.degrees(difference.rotation):.1f}° from it: one of both was surveyed in another "
        "frame or is written wrongly; correct it, or leave it out of the site file",
        {
            "one": one,
            "other": two,
            "apart_m": difference.translation,
            "turned_deg": float(np.degrees(difference.rotation)),
        },
    )


def _check_units(
    site: Site,
    origins: Array,
    poses: dict[int, Array],
    poles: Sequence[SharedPole],
    fits: list[Fit],
) -> None:
    """Refuse where all, poles or control points fit better as a mirror image or in another unit."""
    if fits and fits[0].ends == _count_ends(site, poses) and fits[0].rms <= 2.0 * MOST_RMS:
        # Nothing fits clearly better. Points near one plane do as a mirror image of themselves.
        return
    parts = [(site, fits)]
    if site.poles and site.points:
        for part in (replace(site, points=()), replace(site, poles=())):
            parts.append((part, every_fit(part, origins, poses, poles)))
    for part, plain in parts:
        for name, factor, mirrored in _other_ways():
            signs = np.array([-factor if mirrored else factor, factor, factor])
            found = every_fit(_rewritten(part, signs), origins, poses, poles)
            if not found or not fixes_frame(part, found[0].poles, found[0].points):
                continue
            if plain and not _is_better(found[0], plain[0], _count_ends(part, poses)):
                continue
            which = _names(part, found[0].poles, found[0].points)
            raise Refusal(
                "survey_contradicts",
                f"{which} fit what the LiDARs see only {name}: correct the coordinates",
                {"one": which, "other": name},
            )


def _is_better(fit: Fit, plain: Fit, ends: int) -> bool:
    """Whether another way of writing the survey fits clearly better than the survey as it is."""
    if fit.ends == plain.ends:
        return plain.rms > 2.0 * max(fit.rms, MOST_RMS)
    # The whole survey, or more than a pole or a point that is wrong by itself.
    meets_more = plain.ends < fit.ends == ends or fit.ends > plain.ends + 2
    return meets_more and order(fit) < order(plain)


def _count_ends(site: Site, poses: dict[int, Array]) -> int:
    """How many ends of poles, and sightings by LiDARs that have poses, were surveyed."""
    sightings = sum(sight.lidar in poses for point in site.points for sight in point.seen)
    return sightings + sum(len(ends_of(each)) for each in site.poles)


def _other_ways() -> Iterator[tuple[str, float, bool]]:
    """Name, factor, and whether mirrored, of how coordinates may be written wrongly."""
    mirror = "as a mirror image (are x and y exchanged, or is a sign wrong?)"
    yield mirror, 1.0, True
    for unit, metres in SURVEY_UNITS.items():
        yield f"in {unit}", metres, False
        yield f"in {unit}, and {mirror}", metres, True
    yield "in metres, where they are taken for feet", 1.0 / SURVEY_UNITS["feet"], False


def _rewritten(site: Site, factors: Array) -> Site:
    """Write all that was surveyed with each coordinate times a factor (3,)."""

    def times(at: Array | None) -> Array | None:
        return None if at is None else at * factors

    surveyed = tuple(
        structs.replace(each, foot=times(each.foot), top=times(each.top)) for each in site.poles
    )
    points = tuple(structs.replace(each, at=each.at * factors) for each in site.points)
    return replace(site, poles=surveyed, points=points)


def _names(site: Site, poles: frozenset[int], points: frozenset[int]) -> str:
    """Name some poles and control points."""
    named = [site.poles[k].name for k in sorted(poles)]
    named += [site.points[q].name for q in sorted(points)]
    return ", ".join(named)


def list_unmet(
    site: Site, origins: Array, poses: dict[int, Array], poles: Sequence[SharedPole], fit: Fit
) -> Iterator[Reason]:
    """Name what was surveyed and matches nothing that the LiDARs see.

    Parameters
    ----------
    site, origins, poses, poles
        As `align_to_survey` takes them.
    fit
        How they lie in the frame of the survey.
    """
    there = [transformed(pole, fit.T) for pole in poles]
    for k, each in enumerate(site.poles):
        if k not in fit.poles:
            yield _unmet_pole(site, each, there)
    for q, point in enumerate(site.points):
        gaps = {
            k: float(np.linalg.norm(se3.apply(fit.T, seen[None])[0] - point.at))
            for k, seen in sightings_of(site, q, origins, poses)
        }
        off = {k: gap for k, gap in gaps.items() if (q, k) not in fit.sightings}
        if not off:
            continue
        by = ", ".join(site.lidars[point.seen[k].lidar].name for k in off)
        which = point.name if len(off) == len(gaps) else f"{point.name} as {by} sees it"
        gap = min(off.values())
        yield Reason(
            "survey_unmet",
            f"{which} is {quantities.error(gap)} from where it was surveyed, and was left out: "
            "check its coordinates, and where the LiDARs see it",
            {"observation": which, "gap_m": gap},
        )


def _unmet_pole(site: Site, each: SurveyedPole, poles: Sequence[SharedPole]) -> Reason:
    """Give the nearest pole that LiDARs see, or the placement that the pole is in."""
    where = site.placements[each.placement]
    values: dict[str, float | int | str] = {"observation": each.name, "placement": where}
    for p, name in enumerate(site.placements):
        if p != each.placement and pole_at(structs.replace(each, placement=p), poles):
            return Reason(
                "survey_unmet",
                f"{each.name} is surveyed at a pole of placement {name}, not at one of "
                f"{where}, and was left out: which placement does it belong to?",
                {**values, "other": name},
            )
    gaps = [worst_offset(each, pole) for pole in poles if pole.placement == each.placement]
    near = "the LiDARs see no pole there"
    if gaps:
        values["gap_m"] = min(gaps)
        near = f"the nearest that the LiDARs see is {quantities.error(min(gaps))} away"
    if gaps and min(gaps) < OVERLAP_DISTANCE:
        near = "what the LiDARs see there reaches beyond its surveyed ends"
    return Reason(
        "survey_unmet",
        f"placement {where} has no pole where {each.name} was surveyed ({near}), and it was "
        "left out: check its coordinates and placement, or whether anything hides it",
        values,
    )
