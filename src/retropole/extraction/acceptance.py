"""Is this line a pole? Its shape, and whether it stands free.

A pole is thin, straight and long for its width, and has free air beside it. Stripes, edges of
signs and rows of a scan are thin and straight as well, but they are part of something. The
sensor's place is asked only to find a row of one beam: clouds that were moved have lost it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..datatypes import Array, BoolArray, IntArray, PointCloud
from .clustering import Line, distance_and_place, principal_line

MIN_POLE_POINTS = 6
MIN_POLE_RINGS = 3
"""What a line needs, so that noise on a few returns does not make one."""

MIN_LENGTH = 0.25
"""Least extent along the line, metres: three beams of a 16-beam sensor at 4 m."""

MAX_LENGTH = 4.0
"""Most extent along the line, metres: what is longer is a fence or a kerb."""

THICK = 0.045
"""Root mean square distance from the line from which a pole is a thick post, metres. A pole of
6 cm radius seen with 3 cm of noise is below."""

TOO_THICK, THICK_LENGTH = 0.06, 1.5
"""A thick post is no thicker than the first and no longer than the second, metres."""

SLENDERNESS = 1.5
"""Least ratio of the extent along the line to that across it."""

FEW_POLE_POINTS = 10
"""With fewer points a line passes for a pole only if it is slim and has next to nothing beside it:
a few returns of a far sign look the same."""

FEW_THICK = 0.035
"""Root mean square distance from the line above which a few points are no slim pole, metres."""

TAPED = 0.8
"""A line that may be shorter than this, metres, is a pole only under the stricter tests below."""

MAX_CROWDED_STRICT = 0.25
"""The limit of both shares below for thick, short and few."""

BESIDE, FAR_BESIDE = 0.35, 0.6
"""A return from the edge of the tube to this distance of the line is beside it, metres: to the
second where rows are as far apart, and so may be the columns of a sign."""

AROUND, MAX_AROUND = 0.4, 0.2
"""About a thick or short line or one of few points, so far beyond its ends, metres, little else
shines, by the share of its own points: kerbs, tussocks and stones on bright ground have plenty."""

ONE_ROW, IN_SIGHT = np.radians(0.1), 200.0
"""Returns whose elevations span less than this come from one beam, rad. Beyond this distance,
metres, the origin is none that a pole was seen from, and elevations say nothing."""

PIECES = 8
"""Pieces that a line is cut into, to see along how much of it other returns are beside it."""

CROWD, MAX_CROWDED = 0.7, 0.5
"""A piece is crowded with so many returns beside it for one of its own; no pole is crowded along
more than this share of it, except by a wall behind it."""

RETRO_CROWD, MAX_RETRO_CROWDED = 0.3, 0.5
"""The same for retro-reflective returns beside it: what else should shine there but the rest of a
sign, or bright ground? A vest at the pole covers less of it."""

CROSSING, CROSSING_LENGTH, CROSSING_REST = np.radians(8.0), 0.9, 0.15
"""Beside a line of this length, metres, returns that all but this share of it owes to one other
line, so far from parallel, are a second pole. Of a sign, more is left."""

CROSSING_TUBE, CROSSING_SAMPLE = 0.06, 40
"""How near that line they are, metres, and how many of them propose it."""

HUGGED = 0.09
"""What crowds a line nearer than this, metres, is not behind it."""

WALL_BEHIND, FLAT, FLAT_SHARE = 0.08, 0.05, 0.7
"""A wall that passes the line at the first distance, metres, is not one that it lies on. A wall is
where so much of the points beside the line lie within the second distance of a plane."""

DIM = 0.5
"""A return below this part of the line's dimmest has no tape; others may be tape seen badly."""

MAX_BARE = 0.5
"""So many returns without tape may lie between the points of a pole for each of these."""

EXTENDED = 0.6
"""A line goes on beyond its end where so many of the rows that fit there are there."""

SWEEP = 0.15
"""Points of one ring of a pole lie no farther apart along it, metres, even where it leans most."""

FAR_STEP, EVEN = 0.2, 1.3
"""Single points, metres apart, as evenly spaced as this ratio: one beam's returns far away. Where
rows of a pole are so far apart, they have two points or more, or gaps in between."""

FILE_STEP, FILE_SHARE = 0.15, 0.7
"""A short line whose rows are nearer than this, metres, and have mostly one point each, is what
one beam leaves on a plate, unless the rings tell otherwise."""

STREAK_NEIGHBOURS, STREAK_COSINE, STREAK_SHARE = 4, 0.85, 0.88
"""Where so much of the nearest neighbours of the returns around lie in the direction of the line,
it runs along one beam's sweep: such a row is no pole however straight."""

Failure = tuple[str, str]
"""Code, and reason in words and numbers."""


def shape_failure(cloud: PointCloud, line: Line) -> Failure | None:
    """Say why a line has not the shape of a pole; None where it has."""
    count, width = len(line.rows), 4.0 * line.rms
    size = f"{line.length:.2f} m long and {width:.2f} m wide"
    if count < MIN_POLE_POINTS:
        return "too_few_points", f"{count} points in line, a pole needs {MIN_POLE_POINTS}"
    if line.length < MIN_LENGTH:
        return "too_short", f"{line.length:.2f} m long, a pole needs {MIN_LENGTH:g} m"
    if line.length > MAX_LENGTH:
        return "too_long", f"{line.length:.2f} m long, a pole has {MAX_LENGTH:g} m at most"
    if line.rings < MIN_POLE_RINGS:
        return "too_few_rows", f"{line.rings} rows of points, a pole needs {MIN_POLE_RINGS}"
    if line.length < SLENDERNESS * width:
        return "too_wide", f"{size}, a pole is {SLENDERNESS:g} times longer than wide"
    if line.rms > TOO_THICK or (line.rms > THICK and line.length > THICK_LENGTH):
        return "too_wide", f"{size}, more than any post"
    if line.rms > FEW_THICK and count < FEW_POLE_POINTS:
        return "too_wide", f"{size} with {count} points, so thick a post needs {FEW_POLE_POINTS}"
    if _is_a_sweep(cloud, line):
        return "along_a_beam", f"{count} points that follow each other in a beam's sweep"
    return None


def _is_a_sweep(cloud: PointCloud, line: Line) -> bool:
    """Whether the points of a line are returns that follow each other in a beam's sweep."""
    if cloud.ring is None:
        rays = cloud.xyz[line.rows] - cloud.origin
        elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
        if np.linalg.norm(rays[0]) < IN_SIGHT and np.ptp(elevation) < ONE_ROW:
            return True
    else:
        _, member, counts = np.unique(
            cloud.ring[line.rows], return_inverse=True, return_counts=True
        )
        along = line.along[np.lexsort((line.along, member.reshape(-1)))]
        last = np.cumsum(counts) - 1
        return float(np.median(along[last] - along[last + 1 - counts])) > SWEEP
    gaps = np.diff(np.sort(line.along))
    low, high = np.quantile(gaps, [0.1, 0.6])
    return bool(low > FAR_STEP and high < EVEN * low)


def surroundings_failure(
    cloud: PointCloud, near: IntArray, is_retro: BoolArray, line: Line
) -> Failure | None:
    """Say what a line is part of; None where it stands free.

    The line is cut into pieces, and in each the returns beside it are weighed against its own. A
    stripe on a wall has the wall beside it all along; a pole that is held or touched somewhere
    does not, the stray returns about a bright edge are few, and the wall that a pole leans on
    passes behind it.

    Parameters
    ----------
    cloud, near
        The cloud, and the index (M,) of its points about the line: all within `TAPED`, or more.
    is_retro
        (N,) which points of the cloud are retro-reflective and on no other pole.
    line
        One that `shape_failure` finds nothing wrong with.
    """
    assert cloud.intensity is not None
    distance, along = distance_and_place(cloud.xyz[near], line.point, line.direction)
    low, high = float(line.along.min()), float(line.along.max())
    edges = np.linspace(low, high + 1e-9, PIECES + 1)
    own = np.histogram(line.along, edges)[0]
    thick, short = line.rms > THICK, line.length + line.step < TAPED
    few = len(line.rows) < FEW_POLE_POINTS
    strict = thick or short or few
    reach = float(np.clip(1.2 * line.step, BESIDE, FAR_BESIDE))
    beside = (distance > line.tube) & (distance < reach) & (along >= low) & (along <= high)
    where = f"{line.tube:.2f} to {reach:.2f} m beside it"

    def crowded(which: BoolArray, crowd: float) -> float:
        neighbours = np.histogram(along[which], edges)[0]
        return float(np.mean(neighbours[own > 0] >= crowd * own[own > 0]))

    retro = beside & is_retro[near]
    by_retro = crowded(retro, RETRO_CROWD)
    if few:
        by_retro = max(by_retro, min(1.0, np.count_nonzero(retro) / len(line.rows)))
    if strict:
        away = np.linalg.norm(cloud.xyz[near] - line.point, axis=1)
        around = is_retro[near] & (distance > line.tube) & (away < line.length / 2 + AROUND)
        others = int(np.count_nonzero(around))
        if others > MAX_AROUND * len(line.rows):
            return "part_of_a_surface", (
                f"{others} other retro-reflective returns lie about its {len(line.rows)}: a patch "
                "of something bright, no free-standing pole"
            )
    if by_retro > MAX_RETRO_CROWDED and line.length >= CROSSING_LENGTH and not strict:
        rest = retro.copy()
        rest[retro] = ~_on_another_line(cloud.xyz[near[retro]], line)
        if crowded(rest, RETRO_CROWD) <= CROSSING_REST:
            retro, by_retro = rest, 0.0
    if by_retro > (MAX_CROWDED_STRICT if strict else MAX_RETRO_CROWDED):
        return "part_of_a_surface", (
            f"along {by_retro:.0%} of it other retro-reflective returns lie {where}: a plate, "
            "a stripe or bright ground, no free-standing pole"
        )
    bare = ~is_retro[near] & (cloud.intensity[near] < DIM * cloud.intensity[line.rows].min())
    slim = distance <= 2 * line.rms + 0.02
    between = int(np.count_nonzero(bare & slim & (along > low) & (along < high)))
    if between > MAX_BARE * len(line.rows):
        reason = f"{between} returns without tape lie between its {len(line.rows)} points"
        return "part_of_a_surface", reason
    other = beside & (~is_retro[near] | retro)
    by_all = crowded(other, CROWD)
    hugged = crowded(~is_retro[near] & ~slim & (distance < HUGGED), CROWD) > MAX_CROWDED
    if by_all > (MAX_CROWDED_STRICT if strict and not thick else MAX_CROWDED) and (
        short or hugged or not _passes_behind(cloud.xyz[near[other]], cloud.xyz[line.rows])
    ):
        return "part_of_a_surface", (
            f"along {by_all:.0%} of it other returns lie {where}: a plate, a stripe or an edge, "
            "no free-standing pole"
        )
    if cloud.ring is None and _runs_along_a_sweep(cloud.xyz, near, line):
        reason = f"{len(line.rows)} points in the direction in which the beams sweep"
        return "along_a_beam", reason
    if not short:
        return None
    if cloud.ring is None and line.step < FILE_STEP and line.rings > FILE_SHARE * len(line.rows):
        return "along_a_beam", (
            f"{len(line.rows)} points in single file, {100 * line.step:.0f} cm apart along "
            f"{line.length:.2f} m: as one beam leaves them on a plate"
        )
    bare &= distance < reach
    ends = [beyond[bare & (beyond > 0)] for beyond in (along - high, low - along)]
    needed = EXTENDED * min(PIECES, TAPED / line.step)
    if not thick and max(_pieces_hit(end) for end in ends) >= needed:
        return "goes_on_without_tape", (
            f"{line.length:.2f} m long, and goes on without tape: a sign on its post"
        )
    return None


def _pieces_hit(places: Array) -> int:
    """In how many of `PIECES` equal pieces of the length `TAPED` there is some place."""
    return int(np.count_nonzero(np.histogram(places, PIECES, (0.0, TAPED))[0]))


def _on_another_line(beside: Array, line: Line) -> BoolArray:
    """Which of the points beside a line lie on one other line that is not parallel to it."""
    _, along = distance_and_place(beside, line.point, line.direction)
    order = np.argsort(along, kind="stable")
    sample = beside[order[:: 1 + (len(beside) - 1) // CROSSING_SAMPLE]]
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
    at, to = start[best], direction[best]
    for _ in range(2):
        inside = distance_and_place(beside, at, to)[0] <= CROSSING_TUBE
        if np.count_nonzero(inside) >= 2:
            at, to = principal_line(beside[inside])
    return np.asarray(distance_and_place(beside, at, to)[0] <= CROSSING_TUBE)


def _passes_behind(beside: Array, own: Array) -> bool:
    """Whether the points beside a line lie on one plane that misses part of the line by `WALL_BEHIND`.

    A stripe lies in the plane all along, a pole that leans on it does not; at a corner or a rounded
    edge there is no single plane.
    """
    kept = np.ones(len(beside), dtype=bool)
    for _ in range(4):
        if np.count_nonzero(kept) < 4:
            return False
        centre = beside[kept].mean(axis=0)
        offset = beside[kept] - centre
        normal = np.linalg.eigh(offset.T @ offset)[1][:, 0]
        distance = np.abs((beside - centre) @ normal)
        kept = distance <= max(FLAT, 1.5 * float(np.median(distance)))
    gap = float(np.quantile(np.abs((own - centre) @ normal), 0.75))
    return float(np.mean(distance <= FLAT)) >= FLAT_SHARE and gap >= WALL_BEHIND


def _runs_along_a_sweep(xyz: Array, near: IntArray, line: Line) -> bool:
    """Whether the line runs along a beam's sweep, as the returns about it show.

    The returns of one beam are much nearer to each other than to those of the next: around a row
    of them, neighbours lie in its direction. Beams as close as their returns tell nothing.
    """
    others = np.setdiff1d(near, line.rows, assume_unique=True)
    if len(others) < 4 * STREAK_NEIGHBOURS:
        return False
    points = xyz[others]
    # A sample that does not depend on the order of the points: those nearest to the line.
    distance, _ = distance_and_place(points, line.point, line.direction)
    asked = points[np.argsort(distance, kind="stable")[:200]]
    _, neighbour = cKDTree(points).query(asked, STREAK_NEIGHBOURS + 1)
    span = points[neighbour[:, 1:]] - asked[:, None]
    cosine = np.abs(span @ line.direction) / np.maximum(np.linalg.norm(span, axis=-1), 1e-9)
    return float(np.mean(cosine > STREAK_COSINE)) > STREAK_SHARE
