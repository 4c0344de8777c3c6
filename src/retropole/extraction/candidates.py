"""Candidate poles: lines that a strict rule rejects, but that are as probably poles as not.

They are near a wall, next to a vest or another bright thing, have three to five returns, or tape
that is too dim for the threshold. Nothing rests on them until the other LiDAR and the scene confirm
them (`hypotheses.candidate_confirmation`; docs/evidence/detection.md, Candidate poles).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial

import numpy as np

from ..base.datatypes import Detection, PointCloud, Pole
from ..base.se3 import lengths
from ..base.sensors import Sensor, Threshold, lower_thresholds
from ..io.beams import with_trusted_rings
from ..io.scan_lines import with_rings
from .acceptance_shape import Failure
from .certainty import too_thick_for_radius
from .line_search import MAX_POLES, LineSearch, find_lines, near_box, parts_of
from .lines import LINK, MANY, MIN_LINE_POINTS, MIN_POLE_POINTS, SEARCH_ROOM, TUBE, clusters
from .poles import extract_poles, is_too_low, pole_on
from .sensor_pattern import beams_by
from .surroundings import Surroundings, along_the_sweeps

MIN_CANDIDATE_LENGTH = 0.16
"""Smallest extent of a candidate pole along its line, metres: three rings of a 16-beam sensor,
spaced by 2°, at 2.3 m."""

POINTING = 0.002
"""Beyond `NEAR_POLES_END`, the pointing error of beams scatters the returns of a
candidate by this more, rad: 25 mm at 15 m. Of tubes of 6 and 11 cm at 13 to 17 m
(benchmarks/masts.py, seed 0) it was 0.0016 to 0.003."""

MOST_PROPOSALS = 30
"""Lines that are tried in a group: a plate or a vest next to a pole takes more than `PROPOSALS`."""


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
        What recorded it; None if it is not known.

    Returns
    -------
    Detection
        The same, with `candidates` filled: those it has and those found now, at most `MAX_POLES`.
    """
    cloud = with_rings(with_trusted_rings(cloud), sensor)
    assert cloud.intensity is not None
    chosen = _threshold_of(detection)
    free = np.asarray(cloud.intensity >= chosen.at(lengths(cloud.xyz - cloud.origin)))
    for pole in detection.poles:
        free[pole.index] = False
    # What lies next to a plate that is taken for a pole is still next to something bright.
    bright = free.copy()
    retro = np.flatnonzero(free)
    columns = np.ascontiguousarray(cloud.xyz.T)
    search = LineSearch(
        radius,
        beams_by(sensor),
        partial(_failure_of, radius=radius),
        least_odds=0.0,
        fewest=MIN_LINE_POINTS,
        shortest=MIN_CANDIDATE_LENGTH,
        proposals=MOST_PROPOSALS,
        rooms=(SEARCH_ROOM, TUBE),
        shell=(radius + SEARCH_ROOM, radius + TUBE),
        pointing=POINTING,
    )
    found = list(detection.candidates)
    for group in clusters(cloud.xyz[retro], LINK):
        cluster = retro[group]
        parts, failure = parts_of(cloud, cluster)
        if len(cluster) > MANY:
            # A pole close to a large plate is taken for a part of its surface.
            parts.append(cluster)
        for part in parts:
            near = near_box(columns, part)
            is_bright = failure is not None or len(part) > MANY
            lines, _ = find_lines(cloud, near, part, free, bright, search, is_bright)
            found += [pole_on(cloud, each) for each in lines]
    return replace(detection, candidates=_best_of(found, len(cloud)))


def _failure_of(around: Surroundings, radius: float) -> Failure | None:
    """Report faults that the log-odds do not cover: a few stray returns, a thick line, and one
    along the rings."""
    cloud, line = around.cloud, around.line
    if len(line.index) < MIN_POLE_POINTS and cloud.ring is not None:
        # A dim return on the line is a hit, too: some rings hit only the edges of a pole.
        rings = np.unique(cloud.ring[line.index])
        hit = np.unique(cloud.ring[around.near[around.on_line]])
        if np.ptp(rings) > np.count_nonzero((hit >= rings[0]) & (hit <= rings[-1])):
            return Failure("too_few_rows", f"hit by {len(hit)} of {np.ptp(rings) + 1} rings")
    return too_thick_for_radius(cloud, line, radius) or along_the_sweeps(around)


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
        What recorded it; None if it is not known.

    Returns
    -------
    Detection
        The same, with more `candidates`, the most probable ones, at most `MAX_POLES`. Itself where
        its threshold was given.
    """
    assert cloud.intensity is not None
    chosen = _threshold_of(detection)
    found = list(detection.candidates)
    for lower in lower_thresholds(cloud.intensity, chosen):
        if is_too_low(cloud.intensity, lower.value):
            continue
        there = extract_poles(cloud, sensor=sensor, threshold=lower.value, radius=radius)
        found += (*there.poles, *with_candidates(cloud, there, radius, sensor).candidates)
    return replace(detection, candidates=_best_of(found, len(cloud), detection.poles))


def _threshold_of(detection: Detection) -> Threshold:
    return Threshold(detection.threshold, detection.threshold_source, detection.threshold_least)


def _best_of(found: Iterable[Pole], count: int, known: Iterable[Pole] = ()) -> tuple[Pole, ...]:
    """Of poles that share returns the most probable one; none that shares any with a known one."""
    taken = np.zeros(count, dtype=bool)
    for pole in known:
        taken[pole.index] = True
    kept: list[Pole] = []
    for pole in sorted(found, key=lambda pole: (-pole.log_odds, pole.rms)):
        if not taken[pole.index].any():
            kept.append(pole)
            taken[pole.index] = True
    return tuple(kept[:MAX_POLES])
