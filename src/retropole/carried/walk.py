"""The method on one page: from two recordings of a walk to a pose and a clock offset."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base.datatypes import DEFAULT_RADIUS, Array, PointCloud
from ..base.errors import Refusal
from ..base.sensors import Sensor
from ..base.systematic import sizes_of
from ..base.uncertainty import floor
from .adjustment import Adjusted, adjust, in_recordings
from .linear import Seen
from .rows import rows_of
from .start import FEWEST, WIDEST, Start, find_starts
from .track import Track, find_track
from .verdict import check_tracks, chosen

MOST_STARTS = 4
"""At most this many starts are adjusted: each takes about a second."""

WORST_START = 0.1
"""A start whose lines are further apart, rad, is none: of sound walks it was 0.010 to
0.020 (tuning seeds 0 to 5), of one whose common part was too short 0.18."""

APART = 0.1
"""Starts with one sign whose offsets are nearer to each other, s, fall into one basin."""


@dataclass(frozen=True, eq=False)
class WalkCalibration:
    """The answer of a walk.

    Attributes
    ----------
    T_target_source, covariance
        (4, 4), and (6, 6) over ``[φ, δ]``, rad and m, target axes, with unmodelled errors.
    offset, offset_sigma, drift, middle
        By how much the source's clock is ahead in the middle of what both saw, s, its 1 σ, its
        rate, and that middle by the target's clock, s.
    tracks
        What the target and the source saw.
    adjusted
        What else the adjustment says.
    """

    T_target_source: Array
    covariance: Array
    offset: float
    offset_sigma: float
    drift: float
    middle: float
    tracks: tuple[Track, Track]
    adjusted: Adjusted


def calibrate_walk(
    target: Iterable[PointCloud],
    source: Iterable[PointCloud],
    *,
    sensors: tuple[Sensor | None, Sensor | None] = (None, None),
    thresholds: tuple[float | None, float | None] = (None, None),
    radius: float = DEFAULT_RADIUS,
    ahead: float | None = None,
) -> WalkCalibration:
    """Find pose and clock offset of two LiDARs before which one pole is carried.

    Parameters
    ----------
    target, source
        The sweeps of each, with intensity and with a time for each point by the LiDAR's clock.
    sensors
        What recorded them; None if it is not known.
    thresholds
        Intensity from which a return is treated as retro-reflective; None for the sensor's.
    radius
        Of the pole, metres.
    ahead
        As of `calibrate_tracks`.

    Raises
    ------
    Refusal
        If a recording shows no walk, or the walk gives no answer.
    """
    of_both = zip((target, source), sensors, thresholds, strict=True)
    tracks = [find_track(each, s, threshold=t, radius=radius) for each, s, t in of_both]
    return calibrate_tracks((tracks[0], tracks[1]), sensors, radius, ahead)


def calibrate_tracks(
    tracks: tuple[Track, Track],
    sensors: tuple[Sensor | None, Sensor | None],
    radius: float,
    ahead: float | None = None,
) -> WalkCalibration:
    """Find pose and clock offset from what both LiDARs saw of the pole.

    Parameters
    ----------
    tracks
        Of the target and the source.
    sensors, radius
        As of `calibrate_walk`.
    ahead
        By how much the source's clock is ahead as it is otherwise known, to within `WIDEST`, s.
        None: not at all, or where the walks are then apart, as if both began together.

    Raises
    ------
    Refusal
        As `calibrate_walk`.
    """
    return taken(solve_tracks(tracks, sensors, radius, ahead))


@dataclass(frozen=True, eq=False)
class Solved:
    """What fits two tracks: a solution for each start, about the start of the beams.

    ``ahead`` is by how much the source's clock was taken to be ahead, s; offsets are beside it.
    """

    tracks: tuple[Track, Track]
    ahead: float
    solutions: tuple[Adjusted, ...]


def solve_tracks(
    tracks: tuple[Track, Track],
    sensors: tuple[Sensor | None, Sensor | None],
    radius: float,
    ahead: float | None = None,
) -> Solved:
    """Adjust the walk from each start, as `calibrate_tracks` does before it judges.

    Raises
    ------
    Refusal
        ``two_walks`` and ``no_common_walk``.
    """
    check_tracks(tracks)
    if ahead is None:
        ahead = apart(*tracks)
    times, stamps = tracks[1].times - ahead, tracks[1].stamps - ahead
    both = tracks[0], replace(tracks[1], times=times, stamps=stamps)
    starts = distinct(find_starts(*both))
    if not starts or starts[0].cost > WORST_START:
        raise Refusal(
            "no_common_walk",
            f"with clocks that differ by up to {WIDEST:g} s, no {FEWEST} sweeps of the target are "
            "there in which the source sees the pole too: record both at once, and walk where "
            "both see it",
            {"target": len(tracks[0].times), "source": len(tracks[1].times)},
        )
    target, source = (
        Seen(rows_of(track, sensor, radius), sizes_of(sensor))
        for track, sensor in zip(both, sensors, strict=True)
    )
    solutions = [adjust(start, both, (target, source), radius) for start in starts]
    return Solved(tracks, ahead, tuple(solutions))


def taken(solved: Solved) -> WalkCalibration:
    """Take the solution that is the answer, in the frames of the recordings.

    Raises
    ------
    Refusal
        As `verdict.chosen`.
    """
    best = chosen(solved.solutions)
    best = in_recordings(best, *(track.T_recording_beams for track in solved.tracks))
    covariance = best.covariance[:6, :6] + floor()
    return WalkCalibration(
        best.T_target_source,
        covariance,
        best.offset + solved.ahead,
        float(np.sqrt(best.covariance[6, 6])),
        best.drift,
        best.middle,
        solved.tracks,
        best,
    )


def apart(target: Track, source: Track) -> float:
    """Offset of the clocks, s, where the walks do not overlap by half as they are; else 0.

    Taken from where the pole was first seen.
    """
    begins, ends = ([each.times[k] for each in (target, source)] for k in (0, -1))
    shorter = min(target.times[-1] - target.times[0], source.times[-1] - source.times[0])
    if min(ends) - max(begins) >= shorter / 2:
        return 0.0
    return float(source.times[0] - target.times[0])


def distinct(starts: Sequence[Start]) -> list[Start]:
    """Leave out starts in the basin of a better one, and all but the best few."""
    kept: list[Start] = []
    for start in starts:
        same = [k for k in kept if k.flipped == start.flipped]
        if all(abs(k.offset - start.offset) > APART for k in same):
            kept.append(start)
    return kept[:MOST_STARTS]
