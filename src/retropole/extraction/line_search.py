"""One search for lines in a group of bright points: propose, fit, judge, take the best, repeat.

Confirmed poles (`poles`) and candidates (`candidates`) are found by it; `LineSearch` sets how
strictly.

What *Sensitivity* means at a constant: docs/evidence/detection.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.se3 import principal_axes
from .acceptance_shape import (
    FEW_POLE_POINTS,
    MAX_LENGTH,
    MIN_LENGTH,
    THICK_RMS,
    Failure,
    shape_failure,
)
from .lines import (
    HALF,
    MANY,
    MAX_NEIGHBOUR_DISTANCE,
    MIN_LINE_POINTS,
    MIN_POLE_POINTS,
    MOST,
    SEARCH_ROOM,
    Line,
    clusters,
    fit_line,
    fit_lines,
    in_canonical_order,
    on_surface,
    propose_lines,
)
from .odds import log_odds
from .sensor_pattern import NEAR_POLES_END, Beams
from .surroundings import SHORT_LENGTH, Surroundings, surroundings_of

MAX_POLES = 8
"""Largest number of poles removed from one group, and of candidates kept of a cloud, the most
probable ones; what is left then is rejected with a reason that says so. Sensitivity from 8 to 17:
no effect."""


class LineSearch(NamedTuple):
    """What lines are looked for, and how strictly.

    Attributes
    ----------
    radius, beams
        Of the poles, metres, and what is known of the beams that hit them.
    failure_of
        Gives the reason why a line in its surroundings is no such line; None if it is.
    fewest, shortest
        Returns that it needs, and extent along it, metres.
    least_odds
        Log-odds that it is a pole (`odds`), at least.
    proposals
        Largest number of lines that are tried.
    rooms
        About the radius in which its returns lie, metres: in the next where it fails in one.
    shell
        Inner and outer radius about a proposed line in which other bright returns speak against
        it, metres.
    pointing
        Pointing error of beams at poles beyond `NEAR_POLES_END`, rad.
    """

    radius: float
    beams: Beams
    failure_of: Callable[[Surroundings], Failure | None]
    fewest: int
    shortest: float
    least_odds: float
    proposals: int
    rooms: tuple[float, ...]
    shell: tuple[float, float]
    pointing: float = 0.0


class Judged(NamedTuple):
    """A line, the log-odds that it is a pole, −∞ if it is not sought, and why; None if it is."""

    line: Line
    log_odds: float
    failure: Failure | None


def parts_of(cloud: PointCloud, cluster: IntArray) -> tuple[list[IntArray], Failure | None]:
    """Split a large cluster without the bright surfaces in it; report if most of it is these."""
    if len(cluster) <= MANY:
        return [cluster], None
    flat = on_surface(cloud.xyz[cluster])
    rest = cluster[~flat]
    parts = [rest[group] for group in clusters(cloud.xyz[rest], MAX_NEIGHBOUR_DISTANCE)]
    share = np.count_nonzero(flat) / len(cluster)
    if share <= HALF:
        return parts, None
    reason = f"{share:.0%} of {len(cluster)} points are inside a bright surface"
    return parts, Failure("part_of_a_surface", reason)


def near_box(columns: Array, cluster: IntArray) -> IntArray:
    """Index of all points in the box about a cluster and `SHORT_LENGTH` more; columns is (3, N)."""
    index: IntArray | None = None
    for column in columns:
        low, high = column[cluster].min() - SHORT_LENGTH, column[cluster].max() + SHORT_LENGTH
        values = column if index is None else column[index]
        inside = np.flatnonzero((values >= low) & (values <= high))
        index = inside if index is None else index[inside]
    assert index is not None
    return index


def find_lines(
    cloud: PointCloud,
    near: IntArray,
    part: IntArray,
    free: BoolArray,
    bright: BoolArray,
    search: LineSearch,
    is_saturated: bool,
) -> tuple[list[Judged], Failure | None]:
    """Find lines among bright points, the best first, and say why the rest is none.

    Parameters
    ----------
    cloud
        Where the points are from.
    near
        (M,) index of all points about them: all within `SHORT_LENGTH`, or more.
    part
        (P,) index of the bright points to search.
    free
        (N,) which points of the cloud are bright and on no line yet; those of the lines that are
        found are removed from it.
    bright
        (N,) which are evidence against a line near them.
    search
        What to look for.
    is_saturated
        Whether a bright surface is most of the cluster, so that lines abound in it.

    Returns
    -------
    tuple
        The lines; and why the rest is none; None if too few points are left.
    """
    found: list[Judged] = []
    for _ in range(MAX_POLES):
        left = part[free[part]]
        if len(left) < search.fewest:
            break
        left = in_canonical_order(cloud.xyz, left)
        best: Judged | None = None
        first: Judged | None = None
        for each in _judged(cloud, near, left, free, bright, search, is_saturated):
            if each.failure is not None:
                first = first or each
            elif best is None or each.log_odds > best.log_odds:
                best = each
        if best is None:
            return found, _failure_of_all(cloud, left, first)
        found.append(best)
        free[best.line.index] = False
    return found, None


def _judged(
    cloud: PointCloud,
    near: IntArray,
    left: IntArray,
    free: BoolArray,
    bright: BoolArray,
    search: LineSearch,
    is_saturated: bool,
) -> Iterator[Judged]:
    """Fit lines to points, and judge each; in a wider room those that fail in the first.

    A plate or a vest reaches into the wide room, and turns the line.
    """
    radius, beams = search.radius, search.beams
    tube = radius + SEARCH_ROOM
    guesses = propose_lines(
        cloud.xyz[left], search.shortest, MAX_LENGTH, tube, search.shell, search.proposals
    )
    for room in search.rooms:
        failed = []
        known: set[bytes] = set()
        lines = fit_lines(cloud, left, guesses, radius, beams, room)
        for guess, line in zip(guesses, lines, strict=True):
            # Many guesses lead to the same line.
            same = line.index.tobytes()
            if same in known:
                continue
            known.add(same)
            judged = _judge(cloud, near, free, bright, line, room, search)
            if judged.failure is None and is_saturated:
                judged = judged._replace(failure=_failure_in_brightness(judged.line))
            if judged.failure is not None:
                failed.append(guess)
            yield judged
        guesses = failed


def _judge(
    cloud: PointCloud,
    near: IntArray,
    free: BoolArray,
    bright: BoolArray,
    line: Line,
    room: float,
    search: LineSearch,
) -> Judged:
    """Add all points on a line, and judge it."""
    line = _from_afar(cloud, line, search.pointing)
    failure = shape_failure(cloud, line, search.fewest, search.shortest)
    if failure is not None:
        return Judged(line, -np.inf, failure)
    # A pole that something hides in part is two clusters, and of one next to a plate a part may
    # are treated as surface.
    on = near[free[near]]
    whole = fit_line(cloud, on, line.point, line.direction, search.radius, search.beams, room)
    if len(whole.index) > len(line.index):
        whole = _from_afar(cloud, whole, search.pointing)
        if shape_failure(cloud, whole, search.fewest, search.shortest) is None:
            line = whole
    around = surroundings_of(cloud, near, bright, line)
    failure = search.failure_of(around)
    if failure is not None:
        return Judged(line, -np.inf, failure)
    odds = log_odds(around, search.radius)
    if odds < search.least_odds:
        reason = f"log-odds of {odds:.1f} that it is a pole, {search.least_odds:g} are needed"
        failure = Failure("part_of_a_surface", reason)
    return Judged(line, odds, failure)


def _from_afar(cloud: PointCloud, line: Line, pointing: float) -> Line:
    """Grant a far line the scatter across the beams that grows with the distance."""
    away = float(np.linalg.norm(line.point - cloud.origin))
    more = pointing * np.sqrt(max(away**2 - NEAR_POLES_END**2, 0.0))
    return replace(line, beam_scatter=float(np.hypot(line.beam_scatter, more)))


def _failure_in_brightness(line: Line) -> Failure | None:
    """Where a bright surface is most of the cluster, only a slim line of many points is a pole."""
    if line.rms <= line.with_beams(THICK_RMS) and len(line.index) >= FEW_POLE_POINTS:
        return None
    reason = f"{len(line.index)} points in line inside a bright surface"
    return Failure("part_of_a_surface", reason)


def _failure_of_all(cloud: PointCloud, left: IntArray, first: Judged | None) -> Failure:
    """Put a description of the points in front, if only a part was tested as a line."""
    if first is None or first.failure is None:
        nothing = f"no {MIN_LINE_POINTS} of its points lie in line over {MIN_LENGTH:g} m"
        return Failure("too_short", nothing)
    line, failure = first.line, first.failure
    if len(line.index) >= MOST * len(left):
        return failure
    centre, axes = principal_axes(cloud.xyz[left])
    extent = np.ptp((cloud.xyz[left] - centre) @ axes, axis=0)
    size = f"{len(left)} points, {extent[2]:.2f} × {extent[1]:.2f} m"
    return Failure(failure.code, f"{size}; of {len(line.index)} of them in line: {failure.reason}")


def why_left(free: BoolArray, parts: list[IntArray]) -> Failure:
    """State why points are left if no line was tried and rejected."""
    most = max((int(np.count_nonzero(free[part])) for part in parts), default=0)
    if most >= MIN_POLE_POINTS:
        reason = f"{most} points left after {MAX_POLES} poles, no more are searched for"
    else:
        reason = (
            f"no {MIN_POLE_POINTS} points close together away from poles and surfaces, the "
            "minimum for a pole"
        )
    return Failure("too_few_points", reason)
