"""What the points about a line form: a second pole, a wall behind it, or rings along it.

What *Sensitivity* means beside a constant: docs/detection.md.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..base.datatypes import DEFAULT_RADIUS, Array, BoolArray, IntArray
from ..base.se3 import principal_axes
from .acceptance_shape import MAX_LENGTH, MIN_LENGTH
from .clustering import MANY
from .lines import (
    FIT_ROUNDS,
    MOST,
    SEARCH_ROOM,
    Line,
    distance_and_place,
    in_canonical_order,
    principal_line,
    propose_lines,
)

MIN_CROSSING_ANGLE = float(np.radians(4.0))
"""Smallest angle between two poles that cross, rad. The other edge of a plate is parallel. In 150
clouds of poles that cross at 3 to 25° the same are found with 2° and 4°; with 8°, 20 are lost."""

PLANE_DISTANCE = 0.05
"""Points no farther from a plane are on it, metres: 5 σ of 10 mm, the range noise of most sensors
of the table. Sensitivity at 0.035: 6 fewer false; at 0.07: 6 more false."""

PLANE_MEDIANS = 1.5
"""Distances from the plane, in medians of all, that are kept for the next round. Sensitivity at
1.05: 2 fewer false; at 2.1: no effect."""

MIN_WALL_GAP = 0.08
"""A wall at this distance from the line, metres, is not one that the line lies on. A stripe is on
its wall. Sensitivity at 0.056: 2 more found; at 0.112: no effect."""

NEIGHBOUR_REACH = 0.3
"""Neighbours are looked for among points no farther than this from a sample first, metres; all are
asked where one has none there: the answer is the same."""

SWEEP_NEIGHBOURS = 4
"""Nearest neighbours of each return that tell the direction of the sweep; fewer returns than the
square of it say nothing: without that, 2 poles of an OS1 are lost in clouds without rings.
Sensitivity at 3: 1 more false; at 6: 4 fewer false."""

SWEEP_COSINE = 0.85
"""Neighbours within 32° of the line, by this cosine, lie in its direction. Sensitivity at 0.79: 12
fewer false; at 0.895: 2 more false."""

MAX_SWEEP_SHARE = 0.88
"""Largest share of the neighbours in the direction of the line. A third of all directions lie
within 32° on a plane: more than this is a pattern. Sensitivity at 0.832: 6 fewer false; at 0.916: 2
more false."""


def on_crossing_line(beside: Array, line: Line) -> BoolArray:
    """Tell which of the points beside a line lie on one other line that is not parallel to it.

    Parameters
    ----------
    beside
        (K, 3) points beside the line, metres.
    line
        The line itself.

    Returns
    -------
    BoolArray
        (K,) all false where no two of the points give such a line.
    """
    order = in_canonical_order(beside, np.arange(len(beside)))
    tube = DEFAULT_RADIUS + SEARCH_ROOM
    for guess in propose_lines(beside[order], MIN_LENGTH, MAX_LENGTH, tube, (tube, tube)):
        if abs(guess[1] @ line.direction) <= np.cos(MIN_CROSSING_ANGLE):
            inside = distance_and_place(beside, *guess).distances <= tube
            other = principal_line(beside[inside])
            return np.asarray(distance_and_place(beside, *other).distances <= tube)
    return np.zeros(len(beside), dtype=bool)


def is_wall_behind(beside: Array, own: Array) -> bool:
    """Whether the points beside a line lie on one plane that passes part of the line at a distance.

    A stripe lies in the plane all along; a pole that leans on the wall does not. At a corner or a
    rounded edge there is no single plane.

    Parameters
    ----------
    beside
        (K, 3) points beside the line, metres.
    own
        (N, 3) points of the line, metres.
    """
    kept = np.ones(len(beside), dtype=bool)
    for _ in range(FIT_ROUNDS):
        centre, axes = principal_axes(beside[kept])
        normal = axes[:, 0]
        distance = np.abs((beside - centre) @ normal)
        kept = distance <= max(PLANE_DISTANCE, PLANE_MEDIANS * float(np.median(distance)))
    gap = float(np.quantile(np.abs((own - centre) @ normal), MOST))
    share = float(np.mean(distance <= PLANE_DISTANCE))
    return share >= MOST and gap >= MIN_WALL_GAP


def runs_along_sweep(xyz: Array, near: IntArray, line: Line) -> bool:
    """Whether the line runs along a beam's sweep, as the returns about it show.

    The returns of one ring are much nearer to each other than to those of the next: around a line
    along a ring, nearest neighbours lie in its direction. Rings as close together as their returns
    say nothing.

    Parameters
    ----------
    xyz
        (N, 3) points of the cloud, metres.
    near
        (M,) index of the points about the line.
    line
        The line itself.
    """
    others = np.setdiff1d(near, line.index, assume_unique=True)
    if len(others) < SWEEP_NEIGHBOURS**2:
        return False
    points = xyz[others]
    # A sample that does not depend on the order of the points: those nearest to the line.
    distance, _ = distance_and_place(points, line.point, line.direction)
    order = np.argsort(distance, kind="stable")[:MANY]
    sample = points[order]
    # Of a dense cloud few points are so near to the sample that they can be its neighbours.
    around = points[distance <= distance[order[-1]] + NEIGHBOUR_REACH]
    away, neighbour = cKDTree(around).query(sample, SWEEP_NEIGHBOURS + 1)
    if away.max() > NEIGHBOUR_REACH:
        around = points
        _, neighbour = cKDTree(around).query(sample, SWEEP_NEIGHBOURS + 1)
    span = around[neighbour[:, 1:]] - sample[:, None]
    in_direction = np.abs(span @ line.direction) > SWEEP_COSINE * np.linalg.norm(span, axis=-1)
    return float(np.mean(in_direction)) > MAX_SWEEP_SHARE
