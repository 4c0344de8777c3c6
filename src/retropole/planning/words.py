"""The plan as a person reads it: where each pole stands, and what to expect."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.quantities import counted, error, percent
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
)
from ..site.answer import SiteCalibration
from .candidates import beams_met
from .information import divergences_of
from .place import Station
from .planner import Planned
from .rehearsal import Rehearsal

ASIDE = np.radians(45.0)
"""Within this angle a pole leans towards a LiDAR, away from it, or to a side, rad."""

UPRIGHT = np.radians(2.0)
"""A pole that leans by less stands upright, rad."""


def plan_document(
    planned: Planned, recordings: Sequence[tuple[str, str]], need: Need | None
) -> PolePlanDoc:
    """Write a plan as a document.

    Parameters
    ----------
    planned
        The plan.
    recordings
        Path and SHA-256 of each LiDAR's recording; empty where the place was drawn.
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
    met = None
    if need is not None:
        met = min(fitness(each.covariance, need).probability for each in predicted)
    return PolePlanDoc(
        lidars=lidars,
        placements=list(_placements(planned)),
        length_m=planned.candidates.length,
        radius_m=planned.candidates.radius,
        range_m=planned.reach,
        need=need,
        probability=met,
        predicted=predicted,
        more=[
            MoreDoc(
                what=each.what,
                error_m=each.error,
                alone_m=each.alone,
                gain=each.gain,
                is_worth_it=each.is_worth_it,
            )
            for each in planned.more
        ],
        rehearsal=_rehearsed(planned.rehearsal),
        words=list(sentences(planned, predicted, need, met)),
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
    stations, widths = planned.stations, divergences_of(planned.stations)
    views = [each.seen_from_place() for each in stations]
    number = 0
    for chosen in planned.chosen:
        poles = []
        for k in chosen:
            name, pole = _letter(number), planned.candidates.pole(k)
            number += 1
            seen = []
            for i in np.flatnonzero(planned.seen[k]):
                met = beams_met(pole, views[i], widths[i])
                rings = np.unique(views[i].rings[met.beam])
                seen.append(
                    SightDoc(
                        lidar=stations[i].name,
                        returns=len(met.beam),
                        rings=None if rings.min(initial=0) < 0 else len(rings),
                        distance_m=float(np.linalg.norm(pole.centre - stations[i].at)),
                    )
                )
            foot = planned.candidates.foot[k]
            lean, towards = leaning_words(foot, pole.axis, stations)
            poles.append(
                PlannedPoleDoc(
                    name=name,
                    foot_m=foot,
                    direction=pole.axis,
                    lean_rad=lean,
                    towards=towards,
                    words=pole_words(name, foot, lean, towards, stations),
                    seen=seen,
                )
            )
        yield PlannedPlacementDoc(poles=poles, tape=list(_tape(poles, stations)))


def _letter(number: int) -> str:
    """Name a pole: A to Z, then A2 and so on."""
    return chr(ord("A") + number % 26) + (str(number // 26 + 1) if number >= 26 else "")


def leaning_words(foot: Array, axis: Array, stations: Sequence[Station]) -> tuple[float, str]:
    """How far a pole leans, rad, and where to, as seen from the first LiDAR."""
    lean = float(np.arccos(np.clip(axis[2], -1.0, 1.0)))
    if lean < UPRIGHT:
        return 0.0, ""
    own = np.arctan2(axis[1], axis[0])
    for station in stations:
        away = foot[:2] - station.at[:2]
        if abs(_turn(own - np.arctan2(*-away[::-1]))) < np.radians(15.0):
            return lean, f"towards {station.name}"
    away = foot[:2] - stations[0].at[:2]
    turn = _turn(own - np.arctan2(*away[::-1]))
    name = stations[0].name
    if abs(turn) <= ASIDE:
        return lean, f"away from {name}"
    if abs(turn) >= np.pi - ASIDE:
        return lean, f"towards {name}"
    return lean, f"to the {'left' if turn > 0 else 'right'}, seen from {name}"


def _turn(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def pole_words(
    name: str, foot: Array, lean: float, towards: str, stations: Sequence[Station]
) -> str:
    """Say where a pole stands: ``pole A: 4.2 m from front, 30° left of its x axis, upright``."""
    first = stations[0]
    to = foot - first.at
    x = first.T[:2, 0]
    turn = np.degrees(_turn(np.arctan2(to[1], to[0]) - np.arctan2(x[1], x[0])))
    if abs(turn) < 5:
        side = "straight ahead (its x axis)"
    elif abs(turn) > 175:
        side = "straight behind"
    else:
        side = f"{abs(turn):.0f}° {'left' if turn > 0 else 'right'} of ahead (its x axis)"
    others = [f"{np.linalg.norm(foot[:2] - s.at[:2]):.1f} m from {s.name}" for s in stations[1:]]
    # Of many LiDARs the two nearest are enough.
    others = sorted(others, key=lambda each: float(each.split()[0]))[:2]
    way = "upright" if not towards else f"lean {np.degrees(lean):.0f}° {towards}"
    where = ", ".join([f"{np.linalg.norm(to[:2]):.1f} m from {first.name}", side, *others])
    return f"pole {name}: {where}; {way}"


def _tape(poles: Sequence[PlannedPoleDoc], stations: Sequence[Station]) -> Iterator[TapeDoc]:
    """Lengths that fix each foot: from below the nearest two LiDARs, and from other feet."""
    for k, pole in enumerate(poles):
        away = [float(np.linalg.norm(pole.foot_m[:2] - s.at[:2])) for s in stations]
        for i in np.argsort(away, kind="stable")[:2]:
            yield TapeDoc(start=f"below {stations[i].name}", end=pole.name, metres=away[i])
        for other in poles[:k]:
            gap = float(se3.lengths((pole.foot_m - other.foot_m)[None])[0])
            yield TapeDoc(start=other.name, end=pole.name, metres=gap)


def sentences(
    planned: Planned, predicted: Sequence[PredictedDoc], need: Need | None, met: float | None
) -> Iterator[str]:
    """Say what to expect, the most important first."""
    at = planned.reach
    worst = max(predicted, key=lambda each: displacement_bound(each.covariance, at))
    sigma = predicted_error(worst.covariance, (at,))[0].sigma_m
    alone = max(predicted_error(each, (at,))[0].sigma_m for each in planned.alone.covariance)
    whose = "" if len(predicted) == 1 else f" of {worst.lidar}, the least certain,"
    bound = displacement_bound(worst.covariance, at)
    yield (
        f"The error{whose} to expect at {at:g} m is {error(sigma)} (1 σ); with 95 % probability no "
        f"point up to there is off by more than {error(bound).removeprefix('± ')}. By the poles "
        f"alone it is {error(alone)}."
    )
    if need is not None and met is not None:
        yes = "will be met" if met >= 0.95 else "will hardly be met" if met < 0.5 else "may be met"
        yield f"The need, {need.words}, {yes}: probability {whole_percent(met)}."
    rehearsal = planned.rehearsal
    if rehearsal.status == "ok":
        yield "Poles put into your recordings were found and calibrated: verdict ok."
    else:
        first = rehearsal.reasons[0]
        yield (
            f"Poles put into your recordings gave the verdict {rehearsal.status} "
            f"({first.code}): {first.message}."
        )
    if planned.with_more is not None:
        more, other = planned.with_more
        why = f" ({other.reasons[0].code})" if other.reasons else ""
        yield f"With one {more.what} more it would be {other.status}{why}."
    if worst.budget:
        first_entry = worst.budget[0]
        yield (
            f"Main error source: {source_words(first_entry.name, first_entry.sensor)} "
            f"({percent(first_entry.share_at_30m)} of the variance at 30 m)."
        )
    for each in planned.more:
        worth = "worth it" if each.is_worth_it else "not worth it"
        yield (
            f"One {each.what} more: {error(each.error)} at {at:g} m, by the poles alone "
            f"{error(each.alone)}: {worth}."
        )
    for station in planned.stations:
        if not station.is_settled:
            yield (
                f"The pose of {station.name} is as you gave it: the recordings share too little to "
                "settle it."
            )
    feet = planned.candidates.foot
    names = map(_letter, range(len(planned.numbers)))
    named = [[(next(names), feet[k]) for k in own] for own in planned.chosen]
    for p, (before, after) in enumerate(pairwise(named), 2):
        carried = (
            f"{a} to {b} ({np.linalg.norm(there - here):.1f} m)"
            for (a, here), (b, there) in zip(before, after, strict=True)
        )
        yield f"For placement {p} carry {', '.join(carried)}."
    count = len(planned.candidates)
    yield f"Chosen from {counted(count, 'pole')} that could stand on the ground that was recorded."
