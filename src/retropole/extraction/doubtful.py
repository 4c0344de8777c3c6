"""Doubtful poles: lines that a strict rule rejects, but that look like a pole in a bad place.

They stand near a wall, beside a vest or another bright thing, or have three to five returns. Most
of them are none, so nothing rests on them until the other LiDAR and the scene confirm them
(`matching.confirmation`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..datatypes import Array, BoolArray, Detection, IntArray, PointCloud, Pole
from ..io.rings import with_trusted_rings
from ..sensors import Sensor
from .acceptance_shape import (
    FEW_POLE_POINTS,
    MAX_LENGTH,
    MIN_LENGTH,
    MIN_POLE_POINTS,
    shape_failure,
)
from .acceptance_surroundings import (
    CROWD,
    MAX_HUGGING,
    along_the_sweeps,
    crowded_by_retro,
    in_single_file,
    untaped_between,
)
from .beams import Beams, beams_by
from .certainty import too_thick_for_radius
from .clustering import LINK, clusters
from .lines import (
    MAX_PROPOSING_POINTS,
    TUBE,
    Line,
    fit_line,
    in_canonical_order,
    propose_lines,
)
from .poles import SEARCH_ROOM, near_box, off_surfaces, pole_on
from .surroundings import RETRO_CROWD, Surroundings, crowded_share, surroundings_of

MIN_DOUBTFUL_POINTS = 3
"""Fewest returns on a doubtful pole, one on each of three rings: two points are always in line."""

CLINGING = 0.06
"""Bright returns from the edge of the tube to so far outside it cling to a line, metres: a plate
has the rest of itself there, and a pole has air. Two steps of 0.2° at 8 m. Of a stripe, the wall
itself is nearer than `MAX_HUGGING`."""

MAX_CLINGING_SHARE = 0.5
"""Largest share of the line's pieces to which something clings. Two bands of a vest cover less."""

MOST_PROPOSALS = 30
"""Lines that are tried in a group: a plate or a vest beside a pole takes more than `PROPOSALS`."""

MAX_DOUBTFUL_PER_PART = 4
"""Doubtful poles taken out of one group at most."""

MAX_FOUND_SHARE = 0.5
"""A doubtful pole of the first search is kept where no more than half of it is found again."""

MAX_DOUBTFUL = 8
"""Doubtful poles of a cloud that are kept, those with the most returns."""


def with_doubtful(
    cloud: PointCloud, detection: Detection, radius: float, sensor: Sensor | None = None
) -> Detection:
    """Look once more at what a detection rejected, and add the doubtful poles in it.

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
        The same, with `doubtful` filled: those it has and those found now, at most `MAX_DOUBTFUL`.
    """
    cloud = with_trusted_rings(cloud)
    assert cloud.intensity is not None
    free = np.asarray(cloud.intensity >= detection.threshold)
    for pole in detection.poles:
        free[pole.index] = False
    retro = np.flatnonzero(free)
    columns = np.ascontiguousarray(cloud.xyz.T)
    found: list[Pole] = []
    for group in clusters(cloud.xyz[retro], LINK):
        cluster = retro[group]
        if len(cluster) < MIN_DOUBTFUL_POINTS:
            continue
        near = near_box(columns, cluster)
        parts, fewest = [cluster], MIN_DOUBTFUL_POINTS
        if len(cluster) > MAX_PROPOSING_POINTS:
            parts, failure = off_surfaces(cloud, cluster)
            # Where most is bright, a line of few bright returns says nothing.
            fewest = MIN_DOUBTFUL_POINTS if failure is None else FEW_POLE_POINTS
        for part in parts:
            for line in _lines_in(cloud, near, part, free, radius, beams_by(sensor), fewest):
                free[line.index] = False
                found.append(pole_on(cloud, line))
    # Those that are found again are found without the bright things about them.
    found += [pole for pole in detection.doubtful if np.mean(free[pole.index]) > MAX_FOUND_SHARE]
    found.sort(key=lambda pole: (-len(pole.index), pole.rms))
    return replace(detection, doubtful=tuple(found[:MAX_DOUBTFUL]))


def _lines_in(
    cloud: PointCloud,
    near: IntArray,
    part: IntArray,
    free: BoolArray,
    radius: float,
    beams: Beams,
    fewest: int,
) -> list[Line]:
    """Find the doubtful poles of one group of bright points, the best supported first."""
    free = free.copy()
    found: list[Line] = []
    for _ in range(MAX_DOUBTFUL_PER_PART):
        left = part[free[part]]
        if len(left) < MIN_DOUBTFUL_POINTS:
            break
        left = in_canonical_order(cloud.xyz, left)
        tube = radius + SEARCH_ROOM
        shell = tube, radius + TUBE + CLINGING
        lines = [
            line
            for point, direction in propose_lines(
                cloud.xyz[left], MIN_LENGTH, MAX_LENGTH, tube, shell, MOST_PROPOSALS
            )
            for line in _slim_or_wide(cloud, near, left, free, (point, direction), radius, beams)
            if len(line.index) >= fewest
        ]
        if not lines:
            break
        best = max(lines, key=lambda line: (len(line.index), -line.rms))
        found.append(best)
        free[best.index] = False
    return found


def _slim_or_wide(
    cloud: PointCloud,
    near: IntArray,
    left: IntArray,
    free: BoolArray,
    guess: tuple[Array, Array],
    radius: float,
    beams: Beams,
) -> list[Line]:
    """Fit a line in a slim tube, and where that is no pole, in a wide one; none where neither is.

    A plate or a vest reaches into the wide one, and turns the line.
    """
    for room in (SEARCH_ROOM, TUBE):
        line = fit_line(cloud, left, *guess, radius, beams, room)
        if _may_be_pole(cloud, near, free, line, radius):
            return [line]
    return []


def _may_be_pole(
    cloud: PointCloud, near: IntArray, free: BoolArray, line: Line, radius: float
) -> bool:
    if shape_failure(cloud, line, fewest=MIN_DOUBTFUL_POINTS) is not None:
        return False
    if too_thick_for_radius(cloud, line, radius) is not None:
        return False
    is_few = len(line.index) < MIN_POLE_POINTS
    around = surroundings_of(cloud, near, free, line)
    if is_few and _skips_rings(around):
        return False
    bright, dim = around.is_retro & around.beside, ~around.is_retro & ~around.on_line
    reach = radius + TUBE + CLINGING
    is_clung_to = _is_clung_to(around, bright, reach, RETRO_CROWD)
    if is_clung_to or _is_clung_to(around, dim, MAX_HUGGING, CROWD):
        return False
    if is_few and crowded_by_retro(around) is not None:
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


def _is_clung_to(around: Surroundings, kind: BoolArray, within: float, crowd: float) -> bool:
    """Whether returns of a kind lie close beside most of the line, within some metres.

    ``crowd`` is how many for each of the line's own make a piece of it clung to.
    """
    places: Array = around.along[kind & (around.distance < within)]
    return crowded_share(around.line, places, crowd) > MAX_CLINGING_SHARE
