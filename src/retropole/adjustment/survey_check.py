"""Whether a survey agrees with itself: in one frame, in metres, and all of it met by what is seen.

What is met by nothing that the LiDARs see is named, and left out. Where what is not met would fix
another frame, or fits as a mirror image or in another unit, nobody can tell which part is right.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from msgspec import structs

from ..base import quantities, se3
from ..base.datatypes import Array
from ..base.description import Site, SurveyedPole
from ..base.errors import Reason, Refusal
from ..base.quantities import counted
from .onto_survey import (
    NEAR_SURVEYED,
    ROUGH,
    Fit,
    ends_of,
    every_fit,
    farthest_beside,
    fixes_frame,
    order,
    pole_at,
    sightings_of,
    transformed,
)
from .shared import SharedPole

SURVEY_UNITS = {"feet": 0.3048, "inches": 0.0254, "centimetres": 0.01, "millimetres": 0.001}
"""Units that coordinates come in beside metres, metres each."""

MOST_RMS = 0.02
"""Ways of laying the survey on what is seen are told apart where one fits twice as well, or so well
as this, metres."""


def lay_on_survey(
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
    alike = 2.0 * max(best.rms, MOST_RMS)
    rivals = [fit for fit in others if fit.ends >= best.ends and fit.rms < alike]
    if rivals:
        raise Refusal(
            "survey_ambiguous",
            f"what was surveyed fits what the LiDARs see in {1 + len(rivals)} ways, to "
            f"{1000 * best.rms:.0f} and {1000 * rivals[0].rms:.0f} mm: survey another pole, both "
            "ends of each, or a control point",
            {"ways": 1 + len(rivals), "rms_m": best.rms, "rival_rms_m": rivals[0].rms},
        )
    return best


def _check_frames(site: Site, best: Fit, other: Fit, poles: Sequence[SharedPole]) -> None:
    """Refuse where what is not met by the best way fixes another frame by itself."""
    left = other.poles - best.poles, other.points - best.points
    if other.rms > ROUGH or not fixes_frame(site, *left):
        # Two lines fit others by chance, but hardly so well.
        return
    at = np.array([pole.point for pole in poles]) if poles else np.zeros((1, 3))
    apart = se3.difference_at(best.T, other.T, at)
    one, two = _names(site, best.poles, best.points), _names(site, *left)
    raise Refusal(
        "survey_contradicts",
        f"{one} fix one frame, {two} another, {quantities.error(apart.translation)} and "
        f"{np.degrees(apart.rotation):.1f}° from it: one of both was surveyed in another frame or "
        "is written wrongly; correct it, or leave it out of the site file",
        {
            "one": one,
            "other": two,
            "apart_m": apart.translation,
            "turned_deg": float(np.degrees(apart.rotation)),
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
    # All of it, or more than a pole or a point that is wrong by itself.
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
    """Name what was surveyed and nothing that the LiDARs see meets.

    Parameters
    ----------
    site, origins, poses, poles
        As `lay_on_survey` takes them.
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
    """Say where the nearest pole is that LiDARs see, or in which placement the pole stands."""
    where = site.placements[each.placement]
    values: dict[str, float | int | str] = {"observation": each.name, "placement": where}
    for p, name in enumerate(site.placements):
        if p != each.placement and pole_at(structs.replace(each, placement=p), poles):
            return Reason(
                "survey_unmet",
                f"{each.name} is surveyed where a pole of placement {name} stands, not one of "
                f"{where}, and was left out: which placement does it belong to?",
                {**values, "other": name},
            )
    gaps = [farthest_beside(each, pole) for pole in poles if pole.placement == each.placement]
    near = "the LiDARs see no pole there"
    if gaps:
        values["gap_m"] = min(gaps)
        near = f"the nearest that the LiDARs see is {quantities.error(min(gaps))} beside it"
    if gaps and min(gaps) < NEAR_SURVEYED:
        near = "what the LiDARs see there reaches beyond its surveyed ends"
    return Reason(
        "survey_unmet",
        f"no pole of placement {where} stands where {each.name} was surveyed ({near}), and it was "
        "left out: check its coordinates and placement, or whether anything hides it",
        values,
    )
