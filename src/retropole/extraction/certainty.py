"""What makes a line that could be a pole a candidate: thick, interrupted, seen end on, or worn.

Such a line is not used as a confirmed pole, and is kept among the candidates. See
docs/evidence/detection.md, Certain or doubtful.
"""

from __future__ import annotations

import numpy as np

from ..base.datatypes import PointCloud
from .acceptance_shape import MAX_CONFIRMED_RMS, Failure
from .lines import HALF, RING_GAP, Line, line_coordinates
from .surroundings import piece_of, worn_by_a_body

MAX_GAP_STEPS = 3.5
"""A gap no longer than this many steps from ring to ring is none: two rings missed, since a return
may be lost in each, and half a step of unevenness where the cloud has no rings."""

MIN_SIGHT_ANGLE = float(np.radians(15.0))
"""A line that the sensor sees at a smaller angle, rad, lies on the ground or is the edge of
something: a pole that is 3 m away and leans by 35° towards a sensor 1.5 m above its middle is
seen at 28°."""


def doubt_of(cloud: PointCloud, line: Line, radius: float, knows_origin: bool) -> Failure | None:
    """State why a line that passes all other rules is not a confirmed pole; None if it is.

    Parameters
    ----------
    cloud, line
        The cloud, and the line found in it.
    radius
        Of the poles, metres.
    knows_origin
        Whether the beams started at the cloud's origin. A cloud that another program has moved has
        lost it.
    """
    return (
        too_thick_for_radius(cloud, line, radius)
        or _interrupted(cloud, line)
        or (_end_on(cloud, line) if knows_origin else None)
        or worn_by_a_body(cloud, line)
    )


def too_thick_for_radius(cloud: PointCloud, line: Line, radius: float) -> Failure | None:
    """Report that a line is thicker than a pole of a radius, metres; None if it is not."""
    limit = line.with_beams(MAX_CONFIRMED_RMS)
    scatter = _typical_scatter(cloud, line)
    if scatter <= limit:
        return None
    return Failure(
        "too_wide",
        f"its returns scatter by {1000 * scatter:.0f} mm about their line, {1000 * limit:.0f} mm "
        f"is the limit for a pole of {1000 * radius:.0f} mm radius",
    )


def _typical_scatter(cloud: PointCloud, line: Line) -> float:
    """Scatter of the middle one of the line's pieces, metres, or of all where that is less: a hand
    or a pole that crosses widens a few pieces only.
    """
    distance, along = line_coordinates(cloud.xyz[line.index], line.point, line.direction)
    piece = piece_of(along, along.min(), along.max())
    count = np.bincount(piece)
    square = np.bincount(piece, distance**2)
    middle = float(np.median(square[count > 0] / count[count > 0]))
    return min(line.rms, float(np.sqrt(middle)))


def _interrupted(cloud: PointCloud, line: Line) -> Failure | None:
    """A pole has no gap of half its length, except between rings that are far from each
    other."""
    order = np.argsort(line.along, kind="stable")
    gaps = np.diff(line.along[order])
    widest = int(np.argmax(gaps))
    gap = float(gaps[widest])
    if gap < HALF * line.length:
        return None
    if cloud.ring is not None:
        before, after = cloud.ring[line.index[order[[widest, widest + 1]]]]
        is_explained = abs(int(after) - int(before)) <= MAX_GAP_STEPS
    else:
        others = np.delete(gaps, widest)
        steps = others[others > RING_GAP]
        is_explained = len(steps) == 0 or gap <= MAX_GAP_STEPS * float(np.median(steps))
    if is_explained:
        return None
    reason = (
        f"{line.length:.2f} m long with a gap of {gap:.2f} m: two objects, or a partly hidden pole"
    )
    return Failure("interrupted", reason)


def _end_on(cloud: PointCloud, line: Line) -> Failure | None:
    sight = line.point - cloud.origin
    across = float(np.linalg.norm(np.cross(sight, line.direction)))
    angle = float(np.arctan2(across, abs(sight @ line.direction)))
    if angle >= MIN_SIGHT_ANGLE:
        return None
    reason = f"seen at {np.degrees(angle):.0f}° to its axis, nearly end on"
    return Failure("end_on", reason)
