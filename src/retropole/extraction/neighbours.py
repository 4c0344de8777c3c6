"""What the points about a line form: a second pole, a wall behind it, or rings along it.

What *Sensitivity* means beside a constant: docs/detection.md.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..base.datatypes import Array, BoolArray, IntArray
from ..base.se3 import principal_axes
from .acceptance_shape import MIN_LENGTH
from .lines import Line, distance_and_place, principal_line

NEGLIGIBLE = 1e-9
"""A length that is none, metres: it keeps divisions from zero, and no measured distance is as
short."""

MIN_CROSSING_ANGLE = float(np.radians(8.0))
"""Smallest angle between two poles that cross, rad. The other edge of a plate is parallel.
Sensitivity at 5.6°: no effect; at 11°: 3 fewer false."""

CROSSING_TUBE = 0.06
"""Radius about the other line in which its points lie, metres: radius 2 cm and 4 cm of noise, as
`SEARCH_ROOM`. Sensitivity at 0.042: 2 fewer false; at 0.084: no effect."""

CROSSING_SAMPLE = 40
"""Points beside a line, at most, whose pairs propose the other line: 780 pairs. Sensitivity at 28:
1 fewer false; at 56: no effect."""

CROSSING_FITS = 2
"""Fits of the other line to the points about it. Two points propose it; the first fit finds the
rest, and the second includes those at the ends. Sensitivity at 1: 2 fewer false; at 3: no
effect."""

PLANE_ROUNDS = 4
"""Rounds of fitting a plane, each to the points near the plane of the round before. A plane that
still moves after them is taken as it lies: with too few points on it, it is no wall. Sensitivity at
3: no effect; at 6: 2 fewer false."""

MIN_PLANE_POINTS = 4
"""Three points always lie in a plane; the fourth tests it. Sensitivity from 3 to 6: no effect."""

PLANE_DISTANCE = 0.05
"""Points no farther from a plane are on it, metres: 5 σ of 10 mm, the range noise of most sensors
of the table. Sensitivity at 0.035: 6 fewer false; at 0.07: 6 more false."""

PLANE_MEDIANS = 1.5
"""Distances from the plane, in medians of all, that are kept for the next round. Sensitivity at
1.05: 2 fewer false; at 2.1: no effect."""

MIN_PLANE_SHARE = 0.7
"""Smallest share of the points beside a line that lie on a wall behind it. Sensitivity at 0.49: 6
more false; at 0.98: 8 poles lost, 6 fewer false."""

MIN_WALL_GAP = 0.08
"""A wall at this distance from the line, metres, is not one that the line lies on. A stripe is on
its wall. Sensitivity at 0.056: 2 more found; at 0.112: no effect."""

WALL_GAP_QUANTILE = 0.75
"""Quantile of the distances of the line's points from the wall that must reach `MIN_WALL_GAP`: a
pole that leans on a wall is near it along the rest. Sensitivity from 0.65 to 0.825: no effect."""

SWEEP_NEIGHBOURS = 4
"""Nearest neighbours of each return that tell the direction of the sweep. Sensitivity at 3: 1 more
false; at 6: 4 fewer false."""

MIN_SWEEP_GROUPS = 4
"""Fewest returns about a line, in groups of `SWEEP_NEIGHBOURS`; fewer say nothing. Sensitivity from
3 to 6: no effect."""

SWEEP_SAMPLE = 200
"""Returns, nearest to the line, whose neighbours are examined: it bounds the time. Sensitivity at
140: 1 fewer false; at 280: no effect."""

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
    _, along = distance_and_place(beside, line.point, line.direction)
    order = np.argsort(along, kind="stable")
    sample = beside[order[:: 1 + (len(beside) - 1) // CROSSING_SAMPLE]]
    i, j = np.triu_indices(len(sample), 1)
    span = sample[j] - sample[i]
    apart = np.linalg.norm(span, axis=1)
    cosine = np.abs(span @ line.direction) / np.maximum(apart, NEGLIGIBLE)
    usable = (apart >= MIN_LENGTH) & (cosine <= np.cos(MIN_CROSSING_ANGLE))
    if not usable.any():
        return np.zeros(len(beside), dtype=bool)
    start, direction = sample[i[usable]], span[usable] / apart[usable, None]
    offset = sample[None] - start[:, None]
    places = np.einsum("pni,pi->pn", offset, direction)
    square = np.einsum("pni,pni->pn", offset, offset) - places**2
    best = int(np.argmax(np.count_nonzero(square <= CROSSING_TUBE**2, axis=1)))
    at, to = start[best], direction[best]
    for _ in range(CROSSING_FITS):
        inside = distance_and_place(beside, at, to)[0] <= CROSSING_TUBE
        if np.count_nonzero(inside) >= 2:
            at, to = principal_line(beside[inside])
    return np.asarray(distance_and_place(beside, at, to)[0] <= CROSSING_TUBE)


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
    for _ in range(PLANE_ROUNDS):
        if np.count_nonzero(kept) < MIN_PLANE_POINTS:
            return False
        centre, axes = principal_axes(beside[kept])
        normal = axes[:, 0]
        distance = np.abs((beside - centre) @ normal)
        kept = distance <= max(PLANE_DISTANCE, PLANE_MEDIANS * float(np.median(distance)))
    gap = float(np.quantile(np.abs((own - centre) @ normal), WALL_GAP_QUANTILE))
    share = float(np.mean(distance <= PLANE_DISTANCE))
    return share >= MIN_PLANE_SHARE and gap >= MIN_WALL_GAP


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
    if len(others) < MIN_SWEEP_GROUPS * SWEEP_NEIGHBOURS:
        return False
    points = xyz[others]
    # A sample that does not depend on the order of the points: those nearest to the line.
    distance, _ = distance_and_place(points, line.point, line.direction)
    sample = points[np.argsort(distance, kind="stable")[:SWEEP_SAMPLE]]
    _, neighbour = cKDTree(points).query(sample, SWEEP_NEIGHBOURS + 1)
    span = points[neighbour[:, 1:]] - sample[:, None]
    length = np.maximum(np.linalg.norm(span, axis=-1), NEGLIGIBLE)
    cosine = np.abs(span @ line.direction) / length
    return float(np.mean(cosine > SWEEP_COSINE)) > MAX_SWEEP_SHARE
