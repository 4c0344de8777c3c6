"""From a cloud to its taped poles: threshold, cluster, look for lines, test each (M2).

Nothing here asks which way is up or where the sensor stood: a cloud gives the same poles after any
rigid motion, and in whatever order its points come.

A vest beside a pole, or two crossing poles, are one cluster. So lines are looked for inside the
clusters, and what a line leaves is looked at again, until nothing long and thin is left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .clustering import clusters_of
from .datatypes import Array, BoolArray, Detection, IntArray, PointCloud, Pole, RejectedCluster
from .errors import Refusal
from .sensors import Sensor, threshold_for

MIN_POINTS = 6
MIN_ROWS = 3
"""What a line needs, so that noise on a few returns does not make one."""

MIN_LENGTH = 0.25
"""Least extent along the line, metres."""

MAX_LENGTH = 4.0
"""Most extent along the line, metres: what is longer is a fence or a kerb."""

MAX_RMS = 0.065
"""Most that the returns of a thick post lie from its middle line, metres (root mean square)."""

SLENDERNESS = 1.5
"""Least ratio of the extent along the line to that across it."""

SLACK = 0.04
"""Room about the pole's radius in which returns of noisy sensors are looked for, metres."""

TUBE = 0.10
"""Room about the radius beyond which a return is beside the pole, metres. Wide enough for a
roadside post."""

BESIDE = 0.35
"""A retro-reflective return between the tube and this distance of the line is beside it, metres."""

SURFACE = 0.28
"""Any return between the tube and so far beyond the radius is beside the line, metres."""

PIECES = 8
"""Pieces that a line is cut into, to see along how much of it other returns are beside it."""

CROWD = 0.7
MAX_CROWDED = 0.5
"""A piece is crowded with so many returns beside it for one of its own; no pole is crowded along
more than this share of it, except by a wall behind it."""

RETRO_CROWD = 0.3
MAX_RETRO_CROWDED = 0.35
"""The same for retro-reflective returns beside it: what else should shine there but the rest of a
sign, or bright ground?"""

BEHIND = 0.08
"""A surface that passes the line at this distance is not the one it lies on, metres."""

ROW = np.radians(0.1)
"""Where a cloud has no rings, returns in different steps of elevation of this height count as
different rows, rad."""

MAX_PAIRS = 1500
MAX_SEARCHED = 1200
"""Pairs of points that start a line, and points that they are tried on, in one search."""

FINALISTS = 12
"""Best lines of a search that are fitted and tested."""

MAX_LINES = 12
"""Searches in one cluster."""


@dataclass(frozen=True, eq=False)
class _Line:
    """A line through some retro-reflective points, and why it is no pole, if it is none."""

    rows: IntArray
    point: Array
    direction: Array
    length: float
    rms: float
    rings: int
    code: str
    reason: str


def extract_poles(
    cloud: PointCloud,
    *,
    sensor: Sensor | None = None,
    threshold: float | None = None,
    radius: float = 0.02,
) -> Detection:
    """Find the taped poles in a cloud, and say of every other bright thing why it is none.

    Parameters
    ----------
    cloud
        Points with intensity.
    sensor
        What recorded it; gives the threshold where none is given. None asks the cloud itself.
    threshold
        Intensity from which a return counts as retro-reflective.
    radius
        Of the poles, metres. Thicker posts, up to about 0.1 m, are found too.

    Returns
    -------
    Detection
        Poles with the most returns first; none at all is an answer.

    Raises
    ------
    Refusal
        ``no_intensity`` where the cloud has none, or the same one everywhere.
    """
    if cloud.intensity is None or len(cloud) == 0 or np.ptp(cloud.intensity) == 0:
        raise Refusal(
            "no_intensity",
            f"{cloud.source or 'the cloud'} has no intensity, or the same in all {len(cloud)} "
            "points, so that tape cannot be told from the rest; record it with intensity",
            {"points": len(cloud)},
        )
    chosen = threshold_for(cloud.intensity, sensor, threshold)
    is_retro = cloud.intensity >= chosen.value
    retro = np.flatnonzero(is_retro)
    poles: list[Pole] = []
    rejected: list[RejectedCluster] = []
    for cluster in clusters_of(cloud.xyz[retro]):
        found, refused = _search(cloud, retro[cluster], is_retro, radius)
        poles += found
        rejected += refused
    poles.sort(key=lambda pole: (-len(pole.index), pole.rms))
    rejected.sort(key=lambda cluster: -len(cluster.index))
    return Detection(tuple(poles), tuple(rejected), chosen.value, chosen.found, len(retro))


def _search(
    cloud: PointCloud, index: IntArray, is_retro: BoolArray, radius: float
) -> tuple[list[Pole], list[RejectedCluster]]:
    """Take the poles out of one cluster, line by line; the rest is rejected with its reason."""
    poles: list[Pole] = []
    left = _in_canonical_order(cloud.xyz, index)
    first_failure: _Line | None = None
    for _ in range(MAX_LINES):
        if len(left) < MIN_POINTS:
            break
        lines = _lines(cloud, left, is_retro, radius)
        if not lines:
            break
        accepted = [line for line in lines if not line.code]
        if accepted:
            line = max(accepted, key=lambda line: (len(line.rows), -line.rms))
            poles.append(_pole(cloud, line))
            left = np.setdiff1d(left, line.rows, assume_unique=True)
            left = _in_canonical_order(cloud.xyz, left)
            continue
        first_failure = first_failure or lines[0]
        break
    if len(left) == 0 or (poles and len(left) < MIN_POINTS):
        return poles, []
    if first_failure is not None:
        code, reason = first_failure.code, first_failure.reason
    else:
        code = "too_few_points"
        reason = f"{len(left)} points, a pole needs {MIN_POINTS}"
    return poles, [RejectedCluster(np.sort(left), cloud.xyz[left].mean(axis=0), code, reason)]


def _in_canonical_order(xyz: Array, index: IntArray) -> IntArray:
    """Sort points by their distance from their middle: the same after any motion or shuffle."""
    if len(index) == 0:
        return index
    distance = np.linalg.norm(xyz[index] - xyz[index].mean(axis=0), axis=1)
    return index[np.argsort(distance, kind="stable")]


def _lines(cloud: PointCloud, left: IntArray, is_retro: BoolArray, radius: float) -> list[_Line]:
    """Propose lines through pairs of points; fit and test those with the most points of their own.

    A line's score is the number of points in a slim tube about it less the number beside it, so
    that a line across a plate or over bright ground scores nothing.
    """
    step = 1 + (len(left) - 1) // MAX_SEARCHED
    points = cloud.xyz[left[::step]]
    i, j = np.triu_indices(len(points), 1)
    apart = np.linalg.norm(points[i] - points[j], axis=1)
    usable = np.flatnonzero((apart >= MIN_LENGTH) & (apart <= MAX_LENGTH))
    if len(usable) == 0:
        return [_failed(left, "too_short", f"no two of its points are {MIN_LENGTH:g} m apart")]
    usable = usable[:: 1 + (len(usable) - 1) // MAX_PAIRS]
    start = points[i[usable]]
    direction = (points[j[usable]] - start) / apart[usable, None]
    # Squared distance of every point from every line: |v|² − (v·n)², expanded to matrix products.
    along = direction @ points.T - np.einsum("pi,pi->p", direction, start)[:, None]
    square = (
        np.einsum("ni,ni->n", points, points)[None]
        - 2 * start @ points.T
        + np.einsum("pi,pi->p", start, start)[:, None]
    )
    across = square - along**2
    inside = np.count_nonzero(across <= (radius + SLACK) ** 2, axis=1)
    outside = np.count_nonzero((across > (radius + TUBE) ** 2) & (across < BESIDE**2), axis=1)
    score = inside - outside
    best = np.argsort(-score, kind="stable")[:FINALISTS]
    tested: list[_Line] = []
    for k in best:
        line = _fit(cloud, left, start[k], direction[k], radius)
        if any(np.array_equal(line.rows, other.rows) for other in tested):
            continue
        tested.append(line if line.code else _test_surroundings(cloud, line, is_retro, radius))
        if not tested[-1].code and len(line.rows) >= 0.9 * len(left):
            break
    return tested


def _failed(rows: IntArray, code: str, reason: str) -> _Line:
    return _Line(rows, np.zeros(3), np.zeros(3), 0.0, 0.0, 0, code, reason)


def _distance_and_place(xyz: Array, point: Array, direction: Array) -> tuple[Array, Array]:
    """Distances (N,) of points from a line, and their places (N,) along it."""
    offset = xyz - point
    along = offset @ direction
    return np.linalg.norm(offset - along[:, None] * direction, axis=1), along


def _principal_line(xyz: Array) -> tuple[Array, Array]:
    centre = xyz.mean(axis=0)
    _, _, axes = np.linalg.svd(xyz - centre, full_matrices=False)
    return centre, axes[0]


def _fit(cloud: PointCloud, left: IntArray, point: Array, direction: Array, radius: float) -> _Line:
    """Fit a line to the points about a first guess, and test its shape."""
    xyz = cloud.xyz[left]
    tube = radius + TUBE
    inside = np.zeros(len(left), dtype=bool)
    for _ in range(4):
        distance, _ = _distance_and_place(xyz, point, direction)
        inside = distance <= tube
        if np.count_nonzero(inside) < 3:
            break
        # Neighbours that touch the pole are many near it but few along it: the median holds.
        scale = 1.4826 * float(np.median(distance[inside]))
        tube = min(radius + TUBE, radius + 0.02 + 2.5 * scale)
        point, direction = _principal_line(xyz[inside])
    distance, along = _distance_and_place(xyz, point, direction)
    inside = distance <= tube
    rows = left[inside]
    if len(rows) < MIN_POINTS:
        return _failed(rows, "too_few_points", f"{len(rows)} points, a pole needs {MIN_POINTS}")
    length = float(np.ptp(along[inside]))
    rms = float(np.sqrt(np.mean(distance[inside] ** 2)))
    width = 4.0 * rms
    rings = _rows_hit(cloud, rows)
    code = reason = ""
    if length < MIN_LENGTH:
        code, reason = "too_short", f"{length:.2f} m long, a pole needs {MIN_LENGTH:g} m"
    elif length > MAX_LENGTH:
        code, reason = "too_long", f"{length:.2f} m long, a pole has {MAX_LENGTH:g} m at most"
    elif rings < MIN_ROWS:
        code, reason = "too_few_rows", f"{rings} rows of points, a pole needs {MIN_ROWS}"
    elif rms > MAX_RMS:
        code, reason = "too_wide", f"{width:.2f} m wide, a post has {4 * MAX_RMS:.2f} m at most"
    elif length < SLENDERNESS * width:
        code, reason = (
            "too_wide",
            f"{length:.2f} m long and {width:.2f} m wide, a pole is {SLENDERNESS:g} times longer",
        )
    return _Line(rows, point, direction, length, rms, rings, code, reason)


def _rows_hit(cloud: PointCloud, rows: IntArray) -> int:
    """How many beams hit a line: by ring where the cloud has rings, else by steps of elevation.

    Seen from a wrong origin the elevations of one beam scatter: then the test passes a single row
    that it should not, but never fails a pole.
    """
    if cloud.ring is not None:
        return len(np.unique(cloud.ring[rows]))
    rays = cloud.xyz[rows] - cloud.origin
    elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    return len(np.unique(np.floor(elevation / ROW)))


def _test_surroundings(cloud: PointCloud, line: _Line, is_retro: BoolArray, radius: float) -> _Line:
    """Test that a line stands free: along most of it, no surface that it is part of.

    The line is cut into pieces, and in each the returns beside it are weighed against its own. A
    stripe on a wall has the wall beside it all along; a pole that is held or touched somewhere
    does not, the stray returns about a bright edge are few, and the wall that a pole leans on
    passes behind it.
    """
    nearest, farthest = radius + TUBE, radius + SURFACE
    near = np.flatnonzero(np.abs(cloud.xyz - line.point).max(axis=1) <= line.length / 2 + farthest)
    distance, along = _distance_and_place(cloud.xyz[near], line.point, line.direction)
    _, ours = _distance_and_place(cloud.xyz[line.rows], line.point, line.direction)
    edges = np.linspace(ours.min(), ours.max() + 1e-9, PIECES + 1)
    own = np.histogram(ours, edges)[0]
    beside = (distance > nearest) & (distance < farthest)
    beside &= (along >= edges[0]) & (along < edges[-1])

    def crowded(which: BoolArray, crowd: float) -> float:
        neighbours = np.histogram(along[which], edges)[0]
        return float(np.mean(neighbours[own > 0] >= crowd * own[own > 0]))

    by_retro = crowded(beside & is_retro[near], RETRO_CROWD)
    by_all = crowded(beside, CROWD)
    where = f"{nearest:.2f} to {farthest:.2f} m beside it"
    if by_retro > MAX_RETRO_CROWDED:
        reason = f"along {by_retro:.0%} of it other retro-reflective returns lie {where}"
    elif by_all > MAX_CROWDED and not _passes_behind(cloud.xyz[near[beside]], line):
        reason = f"along {by_all:.0%} of it other returns lie {where}"
    else:
        return line
    reason += ": a plate, a stripe or an edge, no free-standing pole"
    return replace(line, code="part_of_a_surface", reason=reason)


def _passes_behind(beside: Array, line: _Line) -> bool:
    """Whether the surface of the points beside a line misses the line by `BEHIND` or more.

    Seen along the line the surface is a curve; its straight fit passes through the line where the
    line lies on it.
    """
    offset = beside - line.point
    across = offset - (offset @ line.direction)[:, None] * line.direction
    centre = across.mean(axis=0)
    _, _, axes = np.linalg.svd(across - centre, full_matrices=False)
    return float(np.linalg.norm(centre - (centre @ axes[0]) * axes[0])) >= BEHIND


def _pole(cloud: PointCloud, line: _Line) -> Pole:
    rows = np.sort(line.rows)
    xyz = cloud.xyz[rows]
    return Pole(xyz.mean(axis=0), line.direction, xyz, line.length, line.rms, line.rings, rows)
