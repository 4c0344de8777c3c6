"""Is this line a pole? Its shape, and whether it stands free.

A pole is thin, straight and long for its width, and has free air beside it. Stripes, edges of
signs and rows of a scan are thin and straight as well, but they are part of something.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from .datatypes import Array, BoolArray, IntArray, PointCloud

MIN_POINTS = 6
MIN_ROWS = 3
"""What a line needs, so that noise on a few returns does not make one."""

MIN_LENGTH = 0.25
"""Least extent along the line, metres: three beams of a 16-beam sensor at 4 m."""

MAX_LENGTH = 4.0
"""Most extent along the line, metres: what is longer is a fence or a kerb."""

TUBE = 0.10
"""Room about the radius in which returns of a pole lie, metres: wide enough for a thick post and
for a sensor with 3 cm of noise."""

THICK = 0.045
"""Root mean square distance from the line from which a pole is a thick post, metres. A pole of
6 cm radius seen with 3 cm of noise is below."""

THICK_POINTS = 10
"""A thick post needs so many points: a few returns of a far sign look the same."""

SLENDERNESS = 1.5
"""Least ratio of the extent along the line to that across it."""

TAPED = 0.8
"""A line that may be shorter than this is a pole only if it does not go on without tape, metres:
a sign seen edge-on stands on its post."""

EXTENDED = 0.6
"""It goes on where so many of the rows that fit beyond its end are there."""

FILE_STEP, FILE_SHARE = 0.08, 0.7
"""So short a line whose rows are nearer than this, metres, and have mostly one point each, is what
one beam leaves on a plate, unless the rings tell otherwise."""

DIM = 0.5
"""A return below this part of the threshold has no tape; those between may be tape seen badly."""

MAX_BARE = 0.5
"""So many returns without tape may lie between the points of a pole for each of these."""

ROW = 0.015
"""Returns whose places along the line differ by less come from one row, metres."""

GAP = 1.2
"""Points beyond such a gap along the line belong to something else, metres."""

BESIDE = 0.35
"""A return from the edge of the tube to this distance of the line is beside it, metres."""

PIECES = 8
"""Pieces that a line is cut into, to see along how much of it other returns are beside it."""

MAX_CROWDED_SHORT = 0.25
"""The limit of both shares below for a thick post, and a line that may be shorter than `TAPED`."""

CROWD, MAX_CROWDED = 0.7, 0.5
"""A piece is crowded with so many returns beside it for one of its own; no pole is crowded along
more than this share of it, except by a wall behind it."""

RETRO_CROWD, MAX_RETRO_CROWDED = 0.3, 0.5
"""The same for retro-reflective returns beside it: what else should shine there but the rest of a
sign, or bright ground? A vest at the pole covers less of it."""

CROSSING, CROSSING_LENGTH, CROSSING_REST = np.radians(8.0), 0.9, 0.15
"""Beside a line of this length, metres, returns that all but this share of it owes to one other
line, so far from parallel, are a second pole. Of a sign, more is left."""

CROSSING_TUBE = 0.06
"""How near that line, metres."""

CROSSING_SAMPLE = 40
"""Points beside a line that propose the other line."""

BEHIND = 0.08
"""A surface that passes the line at this distance is not the one it lies on, metres."""

STREAK_NEIGHBOURS, STREAK_COSINE, STREAK_SHARE = 6, 0.85, 0.75
"""Where so much of the nearest neighbours of nearby returns lie in the direction of the line, the
line runs along one beam's sweep: such a row is no pole however straight."""


SWEEP = 0.15
"""Points of one ring of a pole lie no farther apart along it, metres, even where it leans most."""

FAR_STEP, EVEN = 0.2, 1.3
"""Single points, metres apart, as evenly spaced as this ratio: one beam's returns far away. Where
rows of a pole are so far apart, they have two points or more, or gaps in between."""


@dataclass(frozen=True, eq=False)
class Line:
    """A line through some retro-reflective points, and why it is no pole, if it is none."""

    rows: IntArray
    point: Array
    direction: Array
    length: float
    rms: float
    rings: int
    tube: float
    code: str = ""
    reason: str = ""


def distance_and_place(xyz: Array, point: Array, direction: Array) -> tuple[Array, Array]:
    """Distances (N,) of points from a line, and their places (N,) along it, metres."""
    offset = xyz - point
    along = offset @ direction
    across = offset - along[:, None] * direction
    return np.sqrt(np.einsum("ni,ni->n", across, across)), along


def principal_line(xyz: Array) -> tuple[Array, Array]:
    """Centroid (3,) and direction (3,) of the line with the least squared distance to points."""
    centre = xyz.mean(axis=0)
    offset = xyz - centre
    return centre, np.asarray(np.linalg.eigh(offset.T @ offset)[1][:, 2])


def fit_line(
    cloud: PointCloud, left: IntArray, point: Array, direction: Array, radius: float
) -> Line:
    """Fit a line to those of the points ``left`` that are about a first guess; test its shape."""
    xyz = cloud.xyz[left]
    tube = radius + TUBE
    inside = np.zeros(len(left), dtype=bool)
    for _ in range(4):
        distance, along = distance_and_place(xyz, point, direction)
        inside = _in_one_piece(distance <= tube, along)
        if np.count_nonzero(inside) < 3:
            break
        # Neighbours that touch the pole are many near it but few along it: the median holds.
        scale = 1.4826 * float(np.median(distance[inside]))
        tube = min(radius + TUBE, radius + 0.02 + 2.5 * scale)
        point, direction = principal_line(xyz[inside])
    distance, along = distance_and_place(xyz, point, direction)
    inside = _in_one_piece(distance <= tube, along)
    rows = left[inside]
    if len(rows) < MIN_POINTS:
        reason = f"{len(rows)} points, a pole needs {MIN_POINTS}"
        return Line(rows, point, direction, 0.0, 0.0, 0, tube, "too_few_points", reason)
    length = float(np.ptp(along[inside]))
    rms = float(np.sqrt(np.mean(distance[inside] ** 2)))
    rings = _rows_hit(cloud, rows, along[inside])
    line = Line(rows, point, direction, length, rms, rings, tube)
    code, reason = _shape(line)
    if not code and _is_a_sweep(cloud, rows, along[inside]):
        code, reason = "along_a_beam", f"{len(rows)} points lie in the beams' direction of sweep"
    return replace(line, code=code, reason=reason)


def _in_one_piece(inside: BoolArray, along: Array) -> BoolArray:
    """Keep of the points inside the piece with the most points, where a `GAP` parts them."""
    index = np.flatnonzero(inside)
    order = index[np.argsort(along[index], kind="stable")]
    cuts = np.flatnonzero(np.diff(along[order]) > GAP) + 1
    kept = np.zeros_like(inside)
    if len(order):
        kept[max(np.split(order, cuts), key=len)] = True
    return kept


def _rows_hit(cloud: PointCloud, rows: IntArray, along: Array) -> int:
    """How many beams hit a line: by ring where the cloud has rings, else by gaps along it."""
    if cloud.ring is not None:
        return len(np.unique(cloud.ring[rows]))
    places = np.sort(along)
    pieces = np.split(places, np.flatnonzero(np.diff(places) > ROW) + 1)
    # Rows nearer than that leave no gaps, but fill a length that no single row has.
    return sum(max(1, int(np.ptp(piece) / (2 * ROW))) for piece in pieces)


def _is_a_sweep(cloud: PointCloud, rows: IntArray, along: Array) -> bool:
    """Whether the points of a line are returns that follow each other in a beam's sweep."""
    if cloud.ring is not None:
        _, member, counts = np.unique(cloud.ring[rows], return_inverse=True, return_counts=True)
        order = np.lexsort((along, member.reshape(-1)))
        ends = np.cumsum(counts)
        spans = along[order][ends - 1] - along[order][ends - counts]
        return float(np.median(spans)) > SWEEP
    gaps = np.diff(np.sort(along))
    low, high = np.quantile(gaps, [0.2, 0.8])
    return bool(low > FAR_STEP and high < EVEN * low)


def _shape(line: Line) -> tuple[str, str]:
    """Code and reason why a line has not the shape of a pole; empty where it has."""
    width = 4.0 * line.rms
    if line.length < MIN_LENGTH:
        return "too_short", f"{line.length:.2f} m long, a pole needs {MIN_LENGTH:g} m"
    if line.length > MAX_LENGTH:
        return "too_long", f"{line.length:.2f} m long, a pole has {MAX_LENGTH:g} m at most"
    if line.rings < MIN_ROWS:
        return "too_few_rows", f"{line.rings} rows of points, a pole needs {MIN_ROWS}"
    if line.length < SLENDERNESS * width:
        reason = f"{line.length:.2f} m long and {width:.2f} m wide"
        return "too_wide", f"{reason}, a pole is {SLENDERNESS:g} times longer"
    if line.rms > THICK and len(line.rows) < THICK_POINTS:
        reason = f"{width:.2f} m wide with {len(line.rows)} points"
        return "too_wide", f"{reason}, so thick a pole needs {THICK_POINTS}"
    return "", ""


def test_standing_free(cloud: PointCloud, near: IntArray, is_retro: BoolArray, line: Line) -> Line:
    """Test that a line stands free: along most of it, no surface that it is part of.

    The line is cut into pieces, and in each the returns beside it are weighed against its own. A
    stripe on a wall has the wall beside it all along; a pole that is held or touched somewhere
    does not, the stray returns about a bright edge are few, and the wall that a pole leans on
    passes behind it.

    Parameters
    ----------
    cloud, near
        The cloud, and the index (M,) of its points about the line: all within `BESIDE`, and more.
    is_retro
        (N,) which points of the cloud are retro-reflective.
    line
        What `fit_line` gave.

    Returns
    -------
    Line
        The same, with code and reason where it is no pole.
    """
    distance, along = distance_and_place(cloud.xyz[near], line.point, line.direction)
    _, ours = distance_and_place(cloud.xyz[line.rows], line.point, line.direction)
    low, high = float(ours.min()), float(ours.max())
    edges = np.linspace(low, high + 1e-9, PIECES + 1)
    own = np.histogram(ours, edges)[0]
    beside = (distance > line.tube) & (distance < BESIDE) & (along >= low) & (along <= high)
    where = f"{line.tube:.2f} to {BESIDE:.2f} m beside it"

    def crowded(places: Array, crowd: float) -> float:
        neighbours = np.histogram(places, edges)[0]
        return float(np.mean(neighbours[own > 0] >= crowd * own[own > 0]))

    def failed(code: str, reason: str) -> Line:
        return replace(line, code=code, reason=reason)

    step = line.length / max(line.rings - 1, 1)
    short = line.length + step < TAPED
    slender = line.rms <= THICK and len(line.rows) >= THICK_POINTS
    most = MAX_CROWDED_SHORT if short or line.rms > THICK else 1.0
    retro = beside & is_retro[near]
    by_retro = crowded(along[retro], RETRO_CROWD)
    if by_retro > min(most, MAX_RETRO_CROWDED) and line.length >= CROSSING_LENGTH and slender:
        rest = retro.copy()
        rest[retro] = ~_on_another_line(cloud.xyz[near[retro]], line)
        if crowded(along[rest], RETRO_CROWD) <= CROSSING_REST:
            retro, by_retro = rest, 0.0
    if by_retro > min(most, MAX_RETRO_CROWDED):
        return failed(
            "part_of_a_surface",
            f"along {by_retro:.0%} of it other retro-reflective returns lie {where}: a plate, "
            "a stripe or bright ground, no free-standing pole",
        )
    assert cloud.intensity is not None
    bare = ~is_retro[near] & (cloud.intensity[near] < DIM * cloud.intensity[line.rows].min())
    slim = distance <= 2 * line.rms + 0.02
    between = int(np.count_nonzero(bare & slim & (along > low) & (along < high)))
    if between > MAX_BARE * len(line.rows):
        return failed(
            "part_of_a_surface",
            f"{between} returns without tape lie between its {len(line.rows)} points",
        )
    other = beside & (~is_retro[near] | retro)
    by_all = crowded(along[other], CROWD)
    if by_all > min(most, MAX_CROWDED) and not _passes_behind(cloud.xyz[near[other]], line):
        return failed(
            "part_of_a_surface",
            f"along {by_all:.0%} of it other returns lie {where}: a plate, a stripe or an edge, "
            "no free-standing pole",
        )
    if cloud.ring is None and _runs_along_a_sweep(cloud.xyz, near, line):
        return failed(
            "along_a_beam", f"{len(line.rows)} points in the direction in which the beams sweep"
        )
    if not short or line.rms > THICK:
        return line
    if cloud.ring is None and step < FILE_STEP and line.rings > FILE_SHARE * len(line.rows):
        return failed(
            "along_a_beam",
            f"{len(line.rows)} points in single file, {100 * step:.0f} cm apart along "
            f"{line.length:.2f} m: as one beam leaves them on a plate",
        )
    bare &= distance < BESIDE
    needed = EXTENDED * min(PIECES, TAPED / step)
    ends = [beyond[bare & (beyond > 0)] for beyond in (along - high, low - along)]
    if by_all <= MAX_CROWDED_SHORT and max(_pieces_hit(end) for end in ends) >= needed:
        return failed(
            "goes_on_without_tape",
            f"{line.length:.2f} m long, and goes on without tape: a sign on its post",
        )
    return line


def _pieces_hit(places: Array) -> int:
    """In how many of `PIECES` equal pieces of the length `TAPED` there is some place."""
    return int(np.count_nonzero(np.histogram(places, PIECES, (0.0, TAPED))[0]))


def _on_another_line(beside: Array, line: Line) -> BoolArray:
    """Which of the points beside a line lie on one other line that is not parallel to it."""
    _, along = distance_and_place(beside, line.point, line.direction)
    beside_sorted = np.argsort(along, kind="stable")
    sample = beside[beside_sorted[:: 1 + (len(beside) - 1) // CROSSING_SAMPLE]]
    i, j = np.triu_indices(len(sample), 1)
    span = sample[j] - sample[i]
    apart = np.linalg.norm(span, axis=1)
    cosine = np.abs(span @ line.direction) / np.maximum(apart, 1e-9)
    usable = (apart >= MIN_LENGTH) & (cosine <= np.cos(CROSSING))
    if not usable.any():
        return np.zeros(len(beside), dtype=bool)
    start, direction = sample[i[usable]], span[usable] / apart[usable, None]
    offset = sample[None] - start[:, None]
    places = np.einsum("pni,pi->pn", offset, direction)
    square = np.einsum("pni,pni->pn", offset, offset) - places**2
    best = int(np.argmax(np.count_nonzero(square <= CROSSING_TUBE**2, axis=1)))
    point, direction = start[best], direction[best]
    for _ in range(2):
        inside = distance_and_place(beside, point, direction)[0] <= CROSSING_TUBE
        if np.count_nonzero(inside) >= 2:
            point, direction = principal_line(beside[inside])
    return np.asarray(distance_and_place(beside, point, direction)[0] <= CROSSING_TUBE)


def _passes_behind(beside: Array, line: Line) -> bool:
    """Whether the surface of the points beside a line misses the line by `BEHIND` or more.

    Seen along the line the surface is a curve; its straight fit passes through the line where the
    line lies on it.
    """
    offset = beside - line.point
    across = offset - (offset @ line.direction)[:, None] * line.direction
    centre = across.mean(axis=0)
    _, _, axes = np.linalg.svd(across - centre, full_matrices=False)
    return float(np.linalg.norm(centre - (centre @ axes[0]) * axes[0])) >= BEHIND


def _runs_along_a_sweep(xyz: Array, near: IntArray, line: Line) -> bool:
    """Whether the line runs along a beam's sweep, as the returns about it show.

    The returns of one beam are much nearer to each other than to those of the next: around a row
    of them, neighbours lie in its direction. Beams that are as close as their returns tell nothing.
    """
    others = np.setdiff1d(near, line.rows, assume_unique=True)
    if len(others) < 4 * STREAK_NEIGHBOURS:
        return False
    points = xyz[others]
    _, neighbour = cKDTree(points).query(points[:: 1 + len(points) // 200], STREAK_NEIGHBOURS + 1)
    span = points[neighbour[:, 1:]] - points[:: 1 + len(points) // 200][:, None]
    cosine = np.abs(span @ line.direction) / np.maximum(np.linalg.norm(span, axis=-1), 1e-9)
    return float(np.mean(cosine > STREAK_COSINE)) > STREAK_SHARE
