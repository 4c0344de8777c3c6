"""The method on one page: from recordings of a walk to poses and clock offsets.

Of a pair, and in `solve_tracks` of any number of LiDARs: poses of pairs are chained from the first
LiDAR on, along the pairs that fit best for longest.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from ..base import se3
from ..base.datatypes import DEFAULT_RADIUS, Array, PointCloud
from ..base.errors import Refusal
from ..base.sensors import Sensor
from ..base.systematic import sizes_of
from ..base.uncertainty import floor
from .adjustment import Adjusted, adjust, in_recordings
from .linear import Seen
from .rows import rows_of
from .start import FEWEST, WIDEST, Poses, Start, find_starts
from .track import Track, find_track
from .verdict import PAIR, check_tracks, chosen

MOST_STARTS = 4
"""At most this many starts of a pair are adjusted: each takes about a second."""

WORST_START = 0.1
"""A start whose lines differ by more, rad, is none: of sound walks it was 0.010 to
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
        None: not at all, or if the walks then do not overlap, as if both began together.

    Raises
    ------
    Refusal
        As `calibrate_walk`.
    """
    late = None if ahead is None else np.array([0.0, ahead])
    return taken(solve_tracks(tracks, sensors, radius, late))


@dataclass(frozen=True, eq=False)
class Solved:
    """What fits all tracks: a solution for each start, about the start of the beams.

    ``ahead`` (L,) is by how much each clock was taken to be ahead, s; offsets are in addition to
    it.
    """

    tracks: tuple[Track, ...]
    ahead: Array
    solutions: tuple[Adjusted, ...]


def solve_tracks(
    tracks: Sequence[Track],
    sensors: Sequence[Sensor | None],
    radius: float,
    ahead: Array | None = None,
    names: Sequence[str] = PAIR,
) -> Solved:
    """Adjust the walk from each start, as `calibrate_tracks` does before it judges.

    Parameters
    ----------
    tracks, sensors
        Of each LiDAR, the target first.
    radius
        Of the pole, metres.
    ahead
        (L,) by how much each clock is ahead of the target's, as of `calibrate_tracks`.
    names
        Of the LiDARs, for messages.

    Raises
    ------
    Refusal
        ``two_walks`` and ``no_common_walk``.
    """
    check_tracks(tracks)
    if ahead is None:
        ahead = apart(tracks)
    near = [
        replace(track, times=track.times - late, stamps=track.stamps - late)
        for track, late in zip(tracks, ahead, strict=True)
    ]
    links = _links(near, names)
    seen = [
        Seen(rows_of(track, sensor, radius), sizes_of(sensor))
        for track, sensor in zip(near, sensors, strict=True)
    ]
    solved: dict[tuple[int, ...], Adjusted] = {}
    best = (0,) * len(links)
    while True:
        # Another basin of one pair at a time: what two change costs more than what one does.
        others = (
            (*best[:at], k, *best[at + 1 :])
            for at, (_, starts) in enumerate(links)
            for k in range(len(starts))
        )
        for which in others:
            if which not in solved:
                poses = _chained(links, which)
                solved[which] = adjust(poses, near, seen, radius)
        before, best = best, min(solved, key=lambda which: solved[which].cost)
        if best == before:
            return Solved(tuple(tracks), ahead, tuple(solved.values()))


Link = tuple[tuple[int, int], list[Start]]
"""Two LiDARs that both see the walk, and the starts of the second in the frame of the first."""


def _links(tracks: Sequence[Track], names: Sequence[str]) -> list[Link]:
    """Find the pairs that link all LiDARs best, from the first one on.

    Raises
    ------
    Refusal
        ``no_common_walk`` if there are none.
    """
    count = len(tracks)
    found: dict[tuple[int, int], list[Start]] = {}
    for pair in combinations(range(count), 2):
        starts = distinct(find_starts(*(tracks[k] for k in pair)))
        if starts and starts[0].cost <= WORST_START:
            found[pair] = starts
    costs = np.zeros((count, count))
    for (i, j), (best, *_) in found.items():
        # At some offset, parts of two walks fit by chance; long ones do not. 0 would be no link.
        costs[i, j] = max(best.cost, 1e-9) / best.common
    tree = minimum_spanning_tree(costs)
    order, before = breadth_first_order(tree, 0, directed=False)
    if len(order) < count:
        linked, others = (
            [names[k] for k in range(count) if (k in order) == is_linked]
            for is_linked in (True, False)
        )
        one, other = (
            " and ".join(f"the {name}" if names is PAIR else name for name in each)
            for each in (linked, others)
        )
        all_of_them = "both" if count == 2 else "all"
        raise Refusal(
            "no_common_walk",
            f"with clocks that differ by up to {WIDEST:g} s, no {FEWEST} sweeps of {one} are "
            f"there in which {other} sees the pole too: record {all_of_them} at once, and walk "
            "where both see it",
            {name: len(track.times) for name, track in zip(names, tracks, strict=True)},
        )
    links = []
    for k in order[1:]:
        first, second = sorted((int(before[k]), int(k)))
        links.append(((first, second), found[first, second]))
    return links


def _chained(links: Sequence[Link], which: Sequence[int]) -> Poses:
    """Chain poses and clock offsets of pairs, one start of each, from the first LiDAR on."""
    count = len(links) + 1
    T, offsets = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count)
    known = {0}
    for ((first, second), starts), k in zip(links, which, strict=True):
        start = starts[k]
        if first in known:
            T[second] = T[first] @ start.T_target_source
            offsets[second] = offsets[first] + start.offset
        else:
            T[first] = T[second] @ se3.inverse(start.T_target_source)
            offsets[first] = offsets[second] - start.offset
        known |= {first, second}
    return Poses(T, offsets)


def taken(solved: Solved) -> WalkCalibration:
    """Take the solution of a pair that is the answer, in the frames of the recordings.

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
        best.offset + float(solved.ahead[1]),
        float(best.clock_sigmas[1]),
        float(best.clocks[1, 1]),
        float(best.middles[1]),
        (solved.tracks[0], solved.tracks[1]),
        best,
    )


def apart(tracks: Sequence[Track]) -> Array:
    """Offsets of the clocks (L,) from that of the first, s.

    0 of those whose walks overlap by half as they are; of others taken from where the pole was
    first seen by any whose walks do.
    """
    begins, ends = (np.array([each.times[k] for each in tracks]) for k in (0, -1))
    common = np.minimum.outer(ends, ends) - np.maximum.outer(begins, begins)
    overlap = common >= np.minimum.outer(ends - begins, ends - begins) / 2
    count, group = connected_components(overlap, directed=False)
    first = np.array([begins[group == k].min() for k in range(count)])
    return np.where(group == group[0], 0.0, first[group] - first[group[0]])


def distinct(starts: Sequence[Start]) -> list[Start]:
    """Leave out starts in the basin of a better one, and all but the best few."""
    kept: list[Start] = []
    for start in starts:
        same = [k for k in kept if k.flipped == start.flipped]
        if all(abs(k.offset - start.offset) > APART for k in same):
            kept.append(start)
    return kept[:MOST_STARTS]
