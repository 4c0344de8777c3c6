"""Candidate poles: lines that a strict rule rejects, but that look like a pole in a bad place.

They stand near a wall, beside a vest or another bright thing, or have three to five returns. Most
of them are none, so nothing rests on them until the other LiDAR and the scene confirm them
(`hypotheses.candidate_confirmation`).

Poles whose tape is too dim for the threshold: old, far, or met at its edges.

By a low threshold much else is bright, so that what is found there is doubtful
(docs/evidence/detection.md, Candidate poles).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array, BoolArray, Detection, IntArray, PointCloud, Pole
from ..base.se3 import lengths
from ..base.sensors import Sensor, Threshold, lower_thresholds
from ..io.beams import MAX_RING_SPREAD, ring_spread, with_trusted_rings
from ..io.scan_lines import with_rings_shown
from .acceptance_shape import (
    FEW_POLE_POINTS,
    MAX_LENGTH,
    MIN_LENGTH,
    MIN_POLE_POINTS,
    shape_failure,
)
from .certainty import MAX_SURE_RMS, too_thick_for_radius
from .lines import (
    HALF,
    LINK,
    LITTLE,
    MANY,
    MIN_LINE_POINTS,
    MOST,
    SEARCH_ROOM,
    TUBE,
    Guess,
    Line,
    clusters,
    fit_lines,
    in_canonical_order,
    propose_lines,
)
from .poles import MAX_POLES, extract_poles, is_too_low, near_box, off_surfaces, pole_on
from .sensor_pattern import NEAR_POLES_END, Beams, beams_by
from .surroundings import (
    Surroundings,
    along_the_sweeps,
    close_beside,
    cluttered_share,
    in_single_file,
    stands_behind,
    surroundings_of,
    untaped_between,
)


def with_dimmer_candidates(
    cloud: PointCloud, detection: Detection, radius: float, sensor: Sensor | None = None
) -> Detection:
    """Add the poles whose tape is too dim for the threshold, each at the highest that shows it.

    By a low threshold much else is bright, so that these are doubtful too.

    Parameters
    ----------
    cloud
        The cloud of the detection.
    detection
        As `extract_poles` or `with_candidates` gives it.
    radius
        Of the poles, metres.
    sensor
        What recorded it; None where it is not known.

    Returns
    -------
    Detection
        The same, with more `candidates`, those it has first; at most `MAX_POLES`. Itself
        where its threshold was given.
    """
    assert cloud.intensity is not None
    chosen = _threshold_of(detection)
    found: list[Pole] = []
    less: list[Pole] = []
    for lower in lower_thresholds(cloud.intensity, chosen):
        if is_too_low(cloud.intensity, lower.value):
            continue
        there = extract_poles(cloud, sensor=sensor, threshold=lower.value, radius=radius)
        found += _apart_from((*detection.poles, *found), there.poles, len(cloud))
        less += with_candidates(cloud, there, radius, sensor).candidates
    # Of one that is doubtful at the threshold too, a lower one shows more.
    kept = _apart_from(found, detection.candidates, len(cloud))
    doubtful = without_repeats(kept, len(cloud)) + without_repeats(found, len(cloud))
    # Much is bright by a low threshold: of what is doubtful there, only what shares nothing.
    for pole in without_repeats(less, len(cloud)):
        doubtful += _apart_from((*detection.poles, *doubtful), (pole,), len(cloud))
    return replace(detection, candidates=tuple(doubtful[:MAX_POLES]))


def _threshold_of(detection: Detection) -> Threshold:
    return Threshold(detection.threshold, detection.threshold_source, detection.threshold_least)


def _apart_from(known: Sequence[Pole], poles: Sequence[Pole], count: int) -> list[Pole]:
    """Those of some poles that share no return with the known ones."""
    taken = np.zeros(count, dtype=bool)
    for pole in known:
        taken[pole.index] = True
    return [pole for pole in poles if not taken[pole.index].any()]


MIN_CANDIDATE_LENGTH = 0.16
"""Smallest extent of a candidate pole along its line, metres: three rings of a 16-beam sensor, 2°
apart, at 2.3 m. A shorter one than `MIN_LENGTH` needs `MIN_POLE_POINTS`, and is looked for only in
what the longer ones leave."""

CLINGING = 0.06
"""Bright returns from the edge of the tube to so far outside it cling to a line, metres: a plate
has the rest of itself there, and a pole has air. Two steps of 0.2° at 8 m. Of a stripe, the wall
itself is nearer than `MAX_CLOSE`."""

POINTING = 0.002
"""Beyond `NEAR_POLES_END`, what beams point beside where they should scatters the returns of a
candidate by this more, rad: 25 mm at 15 m. Of tubes of 6 and 11 cm at 13 to 17 m
(benchmarks/masts.py, seed 0) it was 0.0016 to 0.003."""

MOST_PROPOSALS = 30
"""Lines that are tried in a group: a plate or a vest beside a pole takes more than `PROPOSALS`."""

MAX_CANDIDATES_PER_PART = 4
"""Candidate poles taken out of one group at most."""


class Sought(NamedTuple):
    """What lines are looked for: their least extent, metres, and returns, and where to look.

    ``radius`` is that of the poles, metres, and ``beams`` what met them. ``shell`` is the inner and
    outer radius about a proposed line in which other bright returns speak against it, metres.
    """

    radius: float
    beams: Beams
    shortest: float
    fewest: int
    shell: tuple[float, float]


class Fitted(NamedTuple):
    """A line that may be a pole, and how many bright returns are close beside it."""

    line: Line
    beside: int


def with_candidates(
    cloud: PointCloud, detection: Detection, radius: float, sensor: Sensor | None = None
) -> Detection:
    """Look once more at what a detection rejected, and add the candidate poles in it.

    Parameters
    ----------
    cloud
        The cloud of the detection.
    detection
        As `extract_poles` gives it.
    radius
        Of the poles, metres.
    sensor
        What recorded it; None where it is not known.

    Returns
    -------
    Detection
        The same, with `candidates` filled: those it has and those found now, at most `MAX_POLES`.
    """
    cloud = with_trusted_rings(cloud)
    cloud = with_rings_shown(cloud) if sensor is None or sensor.rings else cloud
    assert cloud.intensity is not None
    chosen = _threshold_of(detection)
    free = np.asarray(cloud.intensity >= chosen.at(lengths(cloud.xyz - cloud.origin)))
    for pole in detection.poles:
        free[pole.index] = False
    retro = np.flatnonzero(free)
    columns = np.ascontiguousarray(cloud.xyz.T)
    found: list[Pole] = []
    for group in clusters(cloud.xyz[retro], LINK):
        cluster = retro[group]
        if len(cluster) < MIN_LINE_POINTS:
            continue
        near = near_box(columns, cluster)
        for part, sought in _searches(cloud, cluster, radius, beams_by(sensor)):
            # Of a wall a part is small, and so is what may be beside a line in it.
            about = near if len(part) == len(cluster) else near_box(columns, part)
            for line in _lines_in(cloud, about, part, free, sought):
                best = line
                if len(part) < len(cluster):
                    # Of a pole beside a plate, a part may count as surface.
                    left, guess = cluster[free[cluster]], (line.point, line.direction)
                    for whole in _slim_or_wide(cloud, near, left, free, [guess], sought):
                        if len(whole.line.index) > len(line.index):
                            best = whole.line
                free[best.index] = False
                found.append(pole_on(cloud, best))
    found = without_repeats([*found, *detection.candidates], len(cloud))
    return replace(detection, candidates=tuple(found[:MAX_POLES]))


def _searches(
    cloud: PointCloud, cluster: IntArray, radius: float, beams: Beams
) -> Iterator[tuple[IntArray, Sought]]:
    """In which points of a group to look for what, one search after the other."""
    shell = radius + SEARCH_ROOM, _reach(radius)
    gap = radius + SEARCH_ROOM, radius + TUBE
    is_large = len(cluster) > MANY
    parts, fewest = [cluster], MIN_LINE_POINTS
    if is_large:
        parts, failure = off_surfaces(cloud, cluster)
        # Where most is bright, a line of few bright returns says nothing.
        fewest = MIN_LINE_POINTS if failure is None else FEW_POLE_POINTS
    for part in parts:
        yield part, Sought(radius, beams, MIN_LENGTH, fewest, shell)
    if is_large:
        # A pole close beside a large plate is taken for a part of its surface, or has so much of it
        # in the shell that nothing speaks for it. Between the two there is a gap.
        yield cluster, Sought(radius, beams, MIN_LENGTH, FEW_POLE_POINTS, gap)
    for part in parts:
        fewest_of_short = max(fewest, MIN_POLE_POINTS)
        yield part, Sought(radius, beams, MIN_CANDIDATE_LENGTH, fewest_of_short, shell)


def without_repeats(found: list[Pole], count: int) -> list[Pole]:
    """Keep of poles that share returns the slim one, of these the one with the most returns.

    A wide one holds bright things about it, and one with few returns is a part of another. Short
    ones come last.
    """
    taken = np.zeros(count, dtype=bool)
    kept = []
    for pole in sorted(found, key=lambda pole: (pole.rms > MAX_SURE_RMS, *_rank(pole))):
        if not taken[pole.index].any():
            kept.append(pole)
            taken[pole.index] = True
    return sorted(kept, key=_rank)


def _rank(pole: Pole) -> tuple[bool, int, float]:
    return pole.length < MIN_LENGTH, -len(pole.index), pole.rms


def _lines_in(
    cloud: PointCloud, near: IntArray, part: IntArray, free: BoolArray, sought: Sought
) -> list[Line]:
    """Find the candidate poles of one group of bright points, the best supported first."""
    free = free.copy()
    found: list[Line] = []
    for _ in range(MAX_CANDIDATES_PER_PART):
        left = part[free[part]]
        if len(left) < MIN_LINE_POINTS:
            break
        left = in_canonical_order(cloud.xyz, left)
        tube = sought.radius + SEARCH_ROOM
        guesses = propose_lines(
            cloud.xyz[left], sought.shortest, MAX_LENGTH, tube, sought.shell, MOST_PROPOSALS
        )
        candidates = _slim_or_wide(cloud, near, left, free, guesses, sought)
        if not candidates:
            break
        # As proposals are: a line of a vest and of half the pole has more returns than the pole.
        best = max(
            candidates, key=lambda each: (len(each.line.index) - each.beside, -each.line.rms)
        ).line
        found.append(best)
        free[best.index] = False
    return found


def _slim_or_wide(
    cloud: PointCloud,
    near: IntArray,
    left: IntArray,
    free: BoolArray,
    guesses: Sequence[Guess],
    sought: Sought,
) -> list[Fitted]:
    """Fit lines in slim tubes, and those that are no pole in wide ones; leave out what neither is.

    A plate or a vest reaches into the wide one, and turns the line.
    """
    found: dict[int, Fitted] = {}
    for room in (SEARCH_ROOM, TUBE):
        rest = [k for k in range(len(guesses)) if k not in found]
        own = [guesses[k] for k in rest]
        lines = fit_lines(cloud, left, own, sought.radius, sought.beams, room)
        # Many guesses lead to the same line.
        known: dict[tuple[bytes, ...], Fitted | None] = {}
        for k, line in zip(rest, lines, strict=True):
            same = line.index.tobytes(), line.point.tobytes(), line.direction.tobytes()
            if same not in known:
                known[same] = _fitted(cloud, near, free, _from_afar(cloud, line), sought)
            fitted = known[same]
            if fitted is not None:
                found[k] = fitted
    return [found[k] for k in sorted(found)]


def _fitted(
    cloud: PointCloud, near: IntArray, free: BoolArray, line: Line, sought: Sought
) -> Fitted | None:
    """Count what is bright beside a line that may be a pole; None where it may not."""
    if shape_failure(cloud, line, sought.fewest, sought.shortest) is not None:
        return None
    around = surroundings_of(cloud, near, free, line)
    clinging = around.is_retro & around.beside & (around.distance < _reach(sought.radius))
    if not _may_be_pole(around, clinging, sought.radius):
        return None
    return Fitted(line, int(np.count_nonzero(clinging)))


def _from_afar(cloud: PointCloud, line: Line) -> Line:
    """Grant a far line the scatter across the beams that grows with the distance."""
    away = float(np.linalg.norm(line.point - cloud.origin))
    more = POINTING * np.sqrt(max(away**2 - NEAR_POLES_END**2, 0.0))
    return replace(line, beam_scatter=float(np.hypot(line.beam_scatter, more)))


def _reach(radius: float) -> float:
    """How far from a line bright things cling to it, metres."""
    return radius + TUBE + CLINGING


def _may_be_pole(around: Surroundings, clinging: BoolArray, radius: float) -> bool:
    """Whether a line may be a pole, given the bright returns that cling to it."""
    line = around.line
    if too_thick_for_radius(around.cloud, line, radius) is not None:
        return False
    is_few = len(line.index) < MIN_POLE_POINTS
    if is_few and _skips_rings(around):
        return False
    if _has_clutter(around, clinging, LITTLE) or _has_close_clutter(around):
        return False
    if is_few and np.count_nonzero(clinging) > LITTLE * len(line.index):
        return False
    return not (untaped_between(around) or along_the_sweeps(around) or in_single_file(around))


def _skips_rings(around: Surroundings) -> bool:
    """Whether more than one ring between those that hit the line missed it.

    A dim return on the line is a hit: of a coarse sensor's rings, some meet only the edges of a
    pole, where tape is dim.
    """
    cloud, line = around.cloud, around.line
    if cloud.ring is None:
        return False
    rings = np.unique(cloud.ring[line.index])
    hit = np.unique(cloud.ring[around.near[around.on_line]])
    hit = hit[(hit >= rings[0]) & (hit <= rings[-1])]
    return bool(np.ptp(rings) > len(hit))


def _has_close_clutter(around: Surroundings) -> bool:
    """Whether other returns lie close beside most of the line, and not only behind it."""
    close = close_beside(around)
    if not _has_clutter(around, close, MOST):
        return False
    if ring_spread(around.cloud) > MAX_RING_SPREAD:
        return True  # where the sensor stood is not known, nor what is behind
    return _has_clutter(around, close & ~stands_behind(around, close), MOST)


def _has_clutter(around: Surroundings, close: BoolArray, density: float) -> bool:
    """Whether close returns lie beside most of the line.

    ``density`` is how many for each of the line's own make clutter of them in a piece of it.
    """
    places: Array = around.along[close]
    return cluttered_share(around.line, places, density) > HALF
