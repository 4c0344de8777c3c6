"""The plan as a person reads it: where each pole is, and what to expect."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from ..adjustment.answer import SiteCalibration
from ..base import se3
from ..base.datatypes import Array
from ..base.quantities import counted, error, percent
from ..base.reasons import explain
from ..base.uncertainty import RANGES, predicted_error, source_words
from ..base.uncertainty.purpose import (
    Need,
    displacement_bound,
    displacement_bounds,
    fitness,
    whole_percent,
)
from ..result import document_of, made_now
from ..result.pole_plan import (
    MoreDoc,
    PlannedPlacementDoc,
    PlannedPoleDoc,
    PolePlanDoc,
    PredictedDoc,
    RehearsalDoc,
    SightDoc,
    StationDoc,
    TapeDoc,
    below,
)
from .place import Station, beams_hit
from .planner import Planned, Rehearsal
from .prediction import divergences_of
from .stations import UPWARD

LEAN_STEP_DEG, PLACE_STEP_DEG = 5, 1
"""Steps in which the direction of a lean and that of a foot are given, degrees: by eye a lean is
set to about 5°, and 1° at 15 m, the farthest that a pole is from its LiDAR, is 0.26 m."""

LEAST_LINE = 0.5
"""LiDARs nearer to each other than this, seen from above, have no line to count angles from, m."""

BY_EYE = 4.0
"""Poles that lean at random are best at 1 m to this distance from each other, metres
(docs/poles.md)."""

WALK = (
    "Instead of setting up poles, walk with one in view of both: retropole watch TARGET SOURCE "
    "--carried. In 24 simulated walks of 40 s with two VLP-16, points 30 m away were off by 11 "
    "mm in the median, by at most 31 mm."
)
"""Instead of poles that are set up (benchmarks/carried.py, seeds 6000 to 6023)."""

UPRIGHT = np.radians(2.0)
"""A pole that leans by less is upright, rad."""


def plan_document(
    planned: Planned, recordings: Sequence[tuple[str, str]], need: Need | None
) -> PolePlanDoc:
    """Write a plan as a document.

    Parameters
    ----------
    planned
        The plan.
    recordings
        Path and SHA-256 of each LiDAR's recording; empty if the scene was drawn.
    need
        How accurate the answer must be.
    """
    stations = planned.stations
    lidars = [
        StationDoc(
            name=each.name,
            sensor="auto" if each.sensor is None else each.sensor.name,
            path=path,
            sha256=sha256,
            T_place_lidar=each.T_place_recording,
            height_m=abs(float(each.at[2])),
        )
        for each, (path, sha256) in zip(stations, recordings, strict=True)
    ]
    predicted = list(_predicted(planned))
    made = made_now()
    hits = None
    if need is not None:
        hits = min(fitness(each.covariance, need).probability for each in predicted)
    return PolePlanDoc(
        lidars=lidars,
        placements=list(_placements(planned)),
        length_m=planned.candidates.length,
        radius_m=planned.candidates.radius,
        range_m=planned.reach,
        need=need,
        probability=hits,
        predicted=predicted,
        more=[
            MoreDoc(
                what=each.what,
                error_m=each.error,
                alone_m=each.alone,
                gain=each.gain,
                is_worth_it=each.is_worth_it,
                status=each.status,
            )
            for each in planned.more
        ],
        rehearsal=_rehearsed(planned.rehearsal),
        words=list(sentences(planned, predicted, need, hits)),
        version=made.version,
        created=made.created,
    )


def _rehearsed(rehearsal: Rehearsal) -> RehearsalDoc:
    if not isinstance(rehearsal, SiteCalibration):
        return document_of(RehearsalDoc, rehearsal)
    # Of the LiDAR that is known least.
    errors = [one.predicted_error for one in rehearsal.lidars]
    worst = max(errors, key=lambda each: each[-1].sigma_m, default=())
    return document_of(RehearsalDoc, rehearsal, margin=None, predicted_error=list(worst))


def _predicted(planned: Planned) -> Iterator[PredictedDoc]:
    whole, alone = planned.predicted, planned.alone
    for station, covariance, by_poles, budget in zip(
        planned.stations[1:], whole.covariance, alone.covariance, whole.budget, strict=True
    ):
        yield PredictedDoc(
            lidar=station.name,
            covariance=covariance,
            predicted_error=list(predicted_error(covariance)),
            bounds_m=displacement_bounds(covariance, RANGES).tolist(),
            alone=list(predicted_error(by_poles)),
            budget=list(budget),
        )


def _placements(planned: Planned) -> Iterator[PlannedPlacementDoc]:
    stations, sights = planned.stations, sights_of(planned, planned.numbers)
    number = 0
    for chosen in planned.chosen:
        poles = []
        for k in chosen:
            name, seen = _letter(number), sights[number]
            number += 1
            foot, axis = planned.candidates.foot[k], planned.candidates.axis[k]
            lean, towards = leaning_words(foot, axis, stations)
            poles.append(
                PlannedPoleDoc(
                    name=name,
                    foot_m=foot,
                    direction=axis,
                    lean_rad=lean,
                    towards=towards,
                    words=pole_words(name, foot, lean, towards, stations),
                    seen=seen,
                )
            )
        yield PlannedPlacementDoc(poles=poles, tape=list(_tape(poles, stations)))


def sights_of(planned: Planned, numbers: Sequence[int]) -> list[list[SightDoc]]:
    """What each LiDAR will have of some possible poles; of each by those that see it."""
    stations, widths = planned.stations, divergences_of(planned.stations)
    views = [each.seen_from_place() for each in stations]
    found = []
    for k in numbers:
        pole, seen = planned.candidates.pole(k), []
        for i in np.flatnonzero(planned.seen[k]):
            hits = beams_hit(pole, views[i], widths[i])
            rings = np.unique(views[i].rings[hits.beam])
            seen.append(
                SightDoc(
                    lidar=stations[i].name,
                    returns=len(hits.beam),
                    rings=None if rings.min(initial=0) < 0 else len(rings),
                    distance_m=round(float(np.linalg.norm(pole.centre - stations[i].at)), 3),
                )
            )
        found.append(seen)
    return found


def _letter(number: int) -> str:
    """Name a pole: A to Z, then A2 and so on."""
    return chr(ord("A") + number % 26) + (str(number // 26 + 1) if number >= 26 else "")


class Viewpoint(NamedTuple):
    """Where a person looks from, and in which direction: what left and right are counted from.

    Attributes
    ----------
    lidar
        The LiDAR that the person is at.
    azimuth
        Of the line that angles are counted from, rad, in the frame of the scene.
    line
        The line, in words: ``the line to rear``.
    """

    lidar: Station
    azimuth: float
    line: str


def viewpoint_of(foot: Array, stations: Sequence[Station]) -> Viewpoint:
    """Choose from where the position of a foot (3,) is described.

    Of two LiDARs it is the first, along the line to the other; of more the nearest, along the line
    to the next. LiDARs above each other have no line: then it is ahead of the first.
    """
    own = list(stations)
    if len(own) > 2:
        own.sort(key=lambda each: _level_distance(foot, each.at))
    for other in own[1:]:
        if _level_distance(own[0].at, other.at) >= LEAST_LINE:
            way = other.at - own[0].at
            return Viewpoint(own[0], float(np.arctan2(way[1], way[0])), f"the line to {other.name}")
    # In the frame of the scene x is ahead of the first LiDAR.
    first = stations[0]
    axis = "x" if np.hypot(*first.T[:2, 0]) >= UPWARD else "z"
    return Viewpoint(first, 0.0, f"ahead of {first.name} (its {axis} axis)")


def leaning_words(foot: Array, axis: Array, stations: Sequence[Station]) -> tuple[float, str]:
    """How far a pole leans, rad, and where to, as seen from the LiDAR of its viewpoint."""
    lean = float(np.arccos(np.clip(axis[2], -1.0, 1.0)))
    if lean < UPRIGHT:
        return 0.0, ""
    lidar = viewpoint_of(foot, stations).lidar
    away = foot[:2] - lidar.at[:2]
    turn = _steps(np.arctan2(axis[1], axis[0]) - np.arctan2(away[1], away[0]), LEAN_STEP_DEG)
    # What leans towards the viewer and to his left turns clockwise.
    way, aside = ("away from", turn) if abs(turn) <= 90 else ("towards", 180 - abs(turn))
    side = "left" if turn > 0 else "right"
    if abs(turn) == 90:
        return lean, f"to the {side} as seen from {lidar.name}"
    if aside == 0:
        return lean, f"{way} {lidar.name}"
    return lean, f"{way} {lidar.name}, {abs(aside)}° to the {side} as seen from there"


def pole_words(
    name: str, foot: Array, lean: float, towards: str, stations: Sequence[Station]
) -> str:
    """Describe the position of a pole: ``pole A: 4.2 m from front, 30° left of the line to rear,
    upright``."""
    lidar, azimuth, line = viewpoint_of(foot, stations)
    to = foot - lidar.at
    turn = _steps(np.arctan2(to[1], to[0]) - azimuth, PLACE_STEP_DEG)
    side = f"{abs(turn)}° {'left' if turn > 0 else 'right'} of {line}"
    side = {0: f"on {line}", 180: f"opposite to {line}"}.get(abs(turn), side)
    others = sorted(
        (_level_distance(foot, each.at), each.name) for each in stations if each is not lidar
    )
    # Of many LiDARs the two nearest are enough.
    away = [f"{distance:.1f} m from {other}" for distance, other in others[:2]]
    way = "upright" if not towards else f"lean {np.degrees(lean):.0f}° {towards}"
    where = ", ".join([f"{_level_distance(foot, lidar.at):.1f} m from {lidar.name}", side, *away])
    return f"pole {name}: {where}; {way}"


def _level_distance(a: Array, b: Array) -> float:
    return float(np.linalg.norm(a[:2] - b[:2]))


def _steps(angle: float, step_deg: int) -> int:
    """Round an angle, rad, to steps: degrees above −180, at most 180."""
    turn = step_deg * round(float(np.degrees(angle)) / step_deg) % 360
    return turn - 360 if turn > 180 else turn


def _tape(poles: Sequence[PlannedPoleDoc], stations: Sequence[Station]) -> Iterator[TapeDoc]:
    """Lengths that fix each foot: from below the nearest two LiDARs, and from other feet."""
    for k, pole in enumerate(poles):
        away = [float(np.linalg.norm(pole.foot_m[:2] - s.at[:2])) for s in stations]
        for i in np.argsort(away, kind="stable")[:2]:
            yield TapeDoc(start=below(stations[i].name), end=pole.name, metres=away[i])
        for other in poles[:k]:
            gap = float(se3.lengths((pole.foot_m - other.foot_m)[None])[0])
            yield TapeDoc(start=other.name, end=pole.name, metres=gap)


def _titles(rehearsal: Rehearsal) -> Iterator[str]:
    """Titles of the reasons of a verdict, with their codes, each once."""
    for code in dict.fromkeys(each.code for each in rehearsal.reasons):
        known = explain(code)
        title = code if known is None else f"{known.title[0].lower()}{known.title[1:]} ({code})"
        yield title


def sentences(
    planned: Planned, predicted: Sequence[PredictedDoc], need: Need | None, met: float | None
) -> Iterator[str]:
    """Describe the expected result, the most important first."""
    at = planned.reach
    is_poor = planned.rehearsal.status != "ok" or (met is not None and met < 0.5)
    if is_poor and len(planned.stations) == 2:
        yield WALK
    worst = max(predicted, key=lambda each: displacement_bound(each.covariance, at))
    sigma = predicted_error(worst.covariance, (at,))[0].sigma_m
    alone = max(predicted_error(each, (at,))[0].sigma_m for each in planned.alone.covariance)
    whose = "" if len(predicted) == 1 else f" of {worst.lidar}, the least certain,"
    bound = displacement_bound(worst.covariance, at)
    yield (
        f"The expected error{whose} at {at:g} m is {error(sigma)} (1 σ); with 95 % probability no "
        f"point up to there is off by more than {error(bound).removeprefix('± ')}. By the poles "
        f"alone it is {error(alone)}."
    )
    if need is not None and met is not None:
        yes = "will be met" if met >= 0.95 else "will hardly be met" if met < 0.5 else "may be met"
        yield f"The need, {need.text}, {yes}: probability {whole_percent(met)}."
    rehearsal = planned.rehearsal
    if rehearsal.status == "ok":
        yield "Poles put into your recordings were found and calibrated: verdict ok."
    else:
        # What a calibration advises is in its messages; here `more` names what would help.
        why = "; ".join(_titles(rehearsal))
        yield f"Poles put into your recordings gave the verdict {rehearsal.status}: {why}."
    if worst.budget:
        first_entry = worst.budget[0]
        yield (
            f"Main error source: {source_words(first_entry.name, first_entry.sensor)} "
            f"({percent(first_entry.share_at_30m)} of the variance at 30 m)."
        )
    for each in planned.more:
        worth = "worth it" if each.is_worth_it else "not worth it"
        verdict = "" if each.status is None else f", verdict {each.status}"
        yield (
            f"One {each.what} more: {error(each.error)} at {at:g} m, by the poles alone "
            f"{error(each.alone)}{verdict}: {worth}."
        )
    if not is_poor and len(planned.stations) == 2:
        yield f"Another way: {WALK[0].lower()}{WALK[1:]}"
    feet = planned.candidates.foot
    gaps = [cdist(feet[own, :2], feet[own, :2]) for own in map(list, planned.chosen)]
    widest = max(float(each.max(initial=0.0)) for each in gaps)
    if widest > BY_EYE:
        yield (
            f"Feet at up to {widest:.1f} m from each other: beyond {BY_EYE:g} m the directions in "
            "which the poles lean matter, so lean them as planned."
        )
    for station in planned.stations:
        if not station.is_refined:
            yield (
                f"The pose of {station.name} is as you gave it: the recordings have too little "
                "in common to refine it."
            )
    names = map(_letter, range(len(planned.numbers)))
    named = [[(next(names), feet[k]) for k in own] for own in planned.chosen]
    for p, (before, after) in enumerate(pairwise(named), 2):
        carried = (
            f"{a} to {b} ({np.linalg.norm(there - here):.1f} m)"
            for (a, here), (b, there) in zip(before, after, strict=True)
        )
        yield f"For placement {p} carry {', '.join(carried)}."
    count = len(planned.candidates)
    yield f"Chosen from {counted(count, 'pole')} that could be set up on the recorded ground."
