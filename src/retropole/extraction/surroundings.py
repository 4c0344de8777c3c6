"""Whether a line is isolated: one function for each rule, and the points around a line.

Stripes, edges of signs and rings of a scan are thin and straight like a pole, but they are part of
something. A pole has free space around it. Points about it may be a second pole, or a wall behind
it.

A band is on the body or in the hand of a person: the body continues above and below it, with free
space around. A pole reaches the ground and is as high as a person, so that nothing near it
continues beyond both of its ends. A wall does, but has no end next to the line either.

What *Sensitivity* means at a constant: docs/evidence/detection.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from ..base.datatypes import DEFAULT_RADIUS, Array, BoolArray, IntArray, PointCloud
from ..base.quantities import counted
from ..base.se3 import lengths, principal_axes
from .acceptance_shape import (
    FEW_POLE_POINTS,
    MAX_LENGTH,
    MIN_LENGTH,
    THICK_RMS,
    Failure,
)
from .lines import (
    FIT_ROOM,
    FIT_ROUNDS,
    HALF,
    LITTLE,
    MANY,
    MAX_NEIGHBOUR_DISTANCE,
    MIN_LINE_POINTS,
    MOST,
    SEARCH_ROOM,
    Line,
    in_canonical_order,
    line_coordinates,
    principal_line,
    propose_lines,
    to_nearest,
)

MIN_CROSSING_ANGLE = float(np.radians(4.0))
"""Smallest angle between two poles that cross, rad. The other edge of a plate is parallel. In 150
clouds of poles that cross at 3 to 25° the same are found with 2° and 4°; with 8°, 20 are lost."""

MAX_CLOSE = 0.09
"""Clutter nearer to a line than this, metres, is not a wall behind it. Sensitivity at 0.063: no
effect; at 0.126: 2 fewer false."""

PLANE_MEDIANS = 1.5
"""Distances from the plane, in medians of all, that are kept for the next round. Sensitivity at
1.05: 2 fewer false; at 2.1: no effect."""

SWEEP_NEIGHBOURS = 8
"""Nearest neighbours of each return that show the direction of the sweep. Fewer returns than twice
this number give no information: without that limit, 2 poles of an OS1 are lost in clouds without
rings."""

MAX_SWEEP_SHARE = 0.78
"""Largest share of the direction of the line in the squared steps to these neighbours: ½ on a
plane that is scanned evenly. It was 0.82 to 0.94 about lines along the rings of bright ground, and
0.74 at most about poles (staged clouds without rings, benchmarks/detection.py, seeds 1 and 2).
Range noise as large as a step changes the direction of single ones, but hardly their sum."""


def on_crossing_line(nearby: Array, line: Line) -> BoolArray:
    """Find which of the points next to a line lie on one other line that is not parallel to it.

    Parameters
    ----------
    nearby
        (K, 3) points next to the line, metres.
    line
        The line itself.

    Returns
    -------
    BoolArray
        (K,) all false where no two of the points give such a line.
    """
    order = in_canonical_order(nearby, np.arange(len(nearby)))
    tube = DEFAULT_RADIUS + SEARCH_ROOM
    for guess in propose_lines(nearby[order], MIN_LENGTH, MAX_LENGTH, tube, (tube, tube)):
        if abs(guess[1] @ line.direction) <= np.cos(MIN_CROSSING_ANGLE):
            inside = line_coordinates(nearby, *guess).distances <= tube
            other = principal_line(nearby[inside])
            return np.asarray(line_coordinates(nearby, *other).distances <= tube)
    return np.zeros(len(nearby), dtype=bool)


def is_wall_behind(nearby: Array, own: Array) -> bool:
    """Whether the points next to a line lie on one plane that passes part of the line at a
    distance.

    A stripe lies in the plane all along; a pole that leans on the wall does not. At a corner or a
    rounded edge there is no single plane.

    Parameters
    ----------
    nearby
        (K, 3) points next to the line, metres.
    own
        (N, 3) points of the line, metres.
    """
    kept = np.ones(len(nearby), dtype=bool)
    for _ in range(FIT_ROUNDS):
        centre, axes = principal_axes(nearby[kept])
        normal = axes[:, 0]
        distance = np.abs((nearby - centre) @ normal)
        kept = distance <= max(SEARCH_ROOM, PLANE_MEDIANS * float(np.median(distance)))
    gap = float(np.quantile(np.abs((own - centre) @ normal), MOST))
    share = float(np.mean(distance <= SEARCH_ROOM))
    return share >= MOST and gap >= MAX_CLOSE


def runs_along_sweep(xyz: Array, near: IntArray, line: Line) -> bool:
    """Whether the line runs along a beam's sweep, judged by the returns about it.

    The returns of one ring are much nearer to each other than to those of the next: around a line
    along a ring, nearest neighbours lie in its direction. Rings as close together as their returns
    give no information. The criterion is the share along the line of the squared steps to them.

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
    if len(others) < 2 * SWEEP_NEIGHBOURS:
        return False
    points = xyz[others]
    # A sample that does not depend on the order of the points: those nearest to the line.
    distance, _ = line_coordinates(points, line.point, line.direction)
    order = np.argsort(distance, kind="stable")[:MANY]
    sample = points[order]
    # In a dense cloud few points are near enough to the sample to be its neighbours.
    around = points[distance <= distance[order[-1]] + MAX_NEIGHBOUR_DISTANCE]
    away, neighbour = cKDTree(around).query(sample, SWEEP_NEIGHBOURS + 1)
    if away.max() > MAX_NEIGHBOUR_DISTANCE:
        around = points
        _, neighbour = cKDTree(around).query(sample, SWEEP_NEIGHBOURS + 1)
    span = around[neighbour[:, 1:]] - sample[:, None]
    return float(np.sum((span @ line.direction) ** 2)) > MAX_SWEEP_SHARE * float(np.sum(span**2))


SHORT_LENGTH = 0.8
"""A line that may be shorter than this, metres, is short and has strict limits: edges of signs and
of lamps are. It is the least length of tape that the advice in `reasons` requires. Sensitivity at
0.56: 2 more found, 13 more false; at 1.12: 3 poles lost, 4 fewer false."""

PIECES = 8
"""Pieces that a line is cut into, to see along how much of it other returns are next to it.
Sensitivity at 6: 3 recorded posts lost, 1 more found, 3 fewer false; at 11: 1 pole lost, 4 fewer
false."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A line, and the points of its cloud about it, as used by the rules.

    Attributes
    ----------
    cloud, line
        The cloud, and the line found in it.
    near
        (M,) index of the points about the line.
    distance, along
        (M,) their distances from the line, and their positions along it, metres.
    neighbour_limit
        Up to which distance from the line points are its neighbours, metres.
    is_retro
        (M,) which of them are retro-reflective and on no other pole.
    on_line
        (M,) which lie on the line, taped or not.
    untaped
        (M,) which are too dim for tape.
    nearby
        (M,) which lie next to the line, outside its tube and between its ends.
    is_thick, is_short, has_few_points
        Why a line is suspect: a post may be thick, a sign's edge short, a far sign have few
        returns.
    """

    cloud: PointCloud
    line: Line
    near: IntArray
    distance: Array
    along: Array
    neighbour_limit: float
    is_retro: BoolArray
    on_line: BoolArray
    untaped: BoolArray
    nearby: BoolArray
    is_thick: bool
    is_short: bool
    has_few_points: bool

    @property
    def is_suspect(self) -> bool:
        """Whether the line must pass the strict limits."""
        return self.is_thick or self.is_short or self.has_few_points

    @cached_property
    def retro_neighbours(self) -> BoolArray:
        """The retro-reflective neighbours (M,), without a pole that crosses: one other
        line, where that leaves almost no neighbours of this one.
        """
        found = self.nearby & self.is_retro
        if self.is_suspect or cluttered_share(self.line, self.along[found], LITTLE) <= HALF:
            return found
        rest = found.copy()
        rest[found] = ~on_crossing_line(self.cloud.xyz[self.near[found]], self.line)
        is_pole = cluttered_share(self.line, self.along[rest], LITTLE) < LITTLE
        return rest if is_pole else found


def surroundings_of(
    cloud: PointCloud, near: IntArray, is_retro: BoolArray, line: Line
) -> Surroundings:
    """Compute the quantities used by several rules.

    Parameters
    ----------
    cloud, near
        The cloud, with intensity, and the index (M,) of its points about the line: all within
        `SHORT_LENGTH`, or more.
    is_retro
        (N,) which points of the cloud are retro-reflective and on no other pole.
    line
        One that passes `shape_failure`.
    """
    assert cloud.intensity is not None
    distance, along = line_coordinates(cloud.xyz[near], line.point, line.direction)
    # If rings are sparser, so may be the columns of a sign.
    limit = max(MAX_NEIGHBOUR_DISTANCE, line.step)
    nearby = (distance > line.tube) & (distance < limit)
    nearby &= (along >= line.low) & (along <= line.high)
    retro = is_retro[near]
    dimmest = cloud.intensity[line.index].min()
    return Surroundings(
        cloud=cloud,
        line=line,
        near=near,
        distance=distance,
        along=along,
        neighbour_limit=limit,
        is_retro=retro,
        on_line=distance <= line.width / 2 + FIT_ROOM,
        untaped=~retro & (cloud.intensity[near] < HALF * dimmest),
        nearby=nearby,
        is_thick=line.rms > line.with_beams(THICK_RMS),
        # Rings half a step beyond either end may just have missed it.
        is_short=line.length + line.step < SHORT_LENGTH,
        has_few_points=len(line.index) < FEW_POLE_POINTS,
    )


def cluttered_share(line: Line, places: Array, density: float) -> float:
    """Share of the line's pieces with ``density`` or more neighbours for each point of the line.

    Pieces without points of the line are not used; ``places`` (K,) are the positions of the
    neighbours along it.
    """
    span = line.low, line.high
    places = places[(places >= span[0]) & (places <= span[1])]
    own, neighbours = (
        np.bincount(piece_of(each, *span), minlength=PIECES) for each in (line.along, places)
    )
    return float(np.mean(neighbours[own > 0] >= density * own[own > 0]))


def piece_of(places: Array, low: float, high: float) -> IntArray:
    """(N,) which of `PIECES` equal pieces of a length places (N,) along it are in."""
    edges = np.linspace(low, high, PIECES + 1)
    return np.asarray(np.searchsorted(edges[1:-1], places, side="right"))


BODY_REACH = 0.65
"""Largest distance of a body from its band, metres: the band at arm's length, half a metre,
and a body 0.3 m deep, half of which is seen."""

AIR = 1.1
"""Up to this distance from the band, metres, there is free space about a body."""

BEYOND_BAND = 0.15
"""A body continues beyond both ends by this plus a step from ring to ring, metres."""


def worn_by_a_body(cloud: PointCloud, line: Line) -> Failure | None:
    """Report that a line is a band on a body; None if it is not.

    Parameters
    ----------
    cloud, line
        The cloud, and the line found in it.
    """
    low, high = line.low, line.high
    beyond = max(BEYOND_BAND, line.step)
    half = max(high, -low) + 2 * beyond + line.step
    reach = float(np.hypot(half, AIR))
    near = cloud.xyz.take(np.flatnonzero(np.abs(cloud.xyz[:, 0] - line.point[0]) < reach), axis=0)
    near = near[lengths(near - line.point) < reach]
    distance, along = line_coordinates(near, line.point, line.direction)
    body = (distance > line.tube) & (distance <= BODY_REACH)
    around = (distance > BODY_REACH) & (distance <= AIR)

    def is_free(part: BoolArray) -> bool:
        """Whether there are points of a body in a part (M,), and free space about it."""
        own = np.count_nonzero(body & part)
        return bool(own >= MIN_LINE_POINTS and np.count_nonzero(around & part) <= LITTLE * own)

    if not is_free((along >= low) & (along <= high)):
        return None
    if np.mean(to_nearest(along[body], line.along) < line.step) < MOST:
        return None
    above = (along > high) & (along < high + beyond + line.step)
    below = (along < low) & (along > low - beyond - line.step)
    if not (is_free(above) and is_free(below)):
        return None
    count = int(np.count_nonzero(body & (along >= low) & (along <= high)))

    return Failure(
        "on_a_body",
        f"{counted(count, 'return')} up to {BODY_REACH:g} m next to it "
        f"{'goes' if count == 1 else 'go'} beyond both its ends, with free space around "
        "them: a band on a person's body or in the hand",
    )


EDGE_QUANTILE = 0.9
"""A dim return is from the edge of a pole if it lies farther to the side than this share of the
bright ones: tape at a grazing angle is dim, and begins where bright tape ends. On a post without
tape this happens by chance for one in ten."""


def surroundings_failure(around: Surroundings) -> Failure | None:
    """Find the object that a line is part of; None if it is isolated.

    The line is cut into pieces, and in each the number of returns next to it is compared with that
    on it. A stripe on a wall has the wall next to it all along. A pole that is gripped or touched
    at some point does not; the stray returns about a bright edge are few; and the wall that a pole
    leans on passes behind it.
    """
    return (
        retro_clutter(around)
        or untaped_between(around)
        or _clutter_of_any_kind(around)
        or along_the_sweeps(around)
        or _goes_on_without_tape(around)
    )


def retro_clutter(around: Surroundings) -> Failure | None:
    """A pole has no retro-reflective returns all along it, except those of a pole that crosses."""
    line, nearby = around.line, around.retro_neighbours
    share = cluttered_share(line, around.along[nearby], LITTLE)
    if around.has_few_points:
        share = max(share, min(1.0, np.count_nonzero(nearby) / len(line.index)))
    if share <= (LITTLE if around.is_suspect else HALF):
        return None
    return Failure(
        "part_of_a_surface",
        f"along {share:.0%} of it other retro-reflective returns lie {_where(around)}: a plate, "
        "a stripe or bright ground, not an isolated pole",
    )


def untaped_between(around: Surroundings) -> Failure | None:
    """A pole is taped all along: few returns without tape lie between its points.

    A dim one at the height of a bright one, or farther to the side, is from the edge of the pole,
    where tape is hit at a grazing angle.
    """
    between = (around.along > around.line.low) & (around.along < around.line.high)
    dim = around.untaped & around.on_line & between
    distance = to_nearest(around.line.along, around.along[dim])
    alone = distance > max(LITTLE * around.line.step, FIT_ROOM)
    own = len(around.line.index)
    if np.count_nonzero(alone) <= HALF * own:
        return None
    count = int(np.count_nonzero(alone & ~_at_the_edges(around, dim)))
    if count <= HALF * own:
        return None
    lie = counted(count, "return without tape lies", "returns without tape lie")
    reason = f"{lie} between its {counted(own, 'point')}"
    return Failure("part_of_a_surface", reason)


def _at_the_edges(around: Surroundings, dim: BoolArray) -> BoolArray:
    """Which of the dim returns (K of M) lie farther to the side than the line's points.

    The side is the direction across the line in which the dim returns spread most beyond the
    others: noise along the beam is in both. So the sensor's position need not be known.
    """
    line, xyz = around.line, around.cloud.xyz
    offsets = [xyz[index] - line.point for index in (line.index, around.near[dim])]
    own, others = (each - np.outer(each @ line.direction, line.direction) for each in offsets)
    spread = others.T @ others / max(len(others), 1) - own.T @ own / len(own)
    side = np.linalg.eigh(spread)[1][:, 2]
    places, dim_places = own @ side, others @ side
    middle = np.median(places)
    reach = np.quantile(np.abs(places - middle), EDGE_QUANTILE)
    return np.asarray(np.abs(dim_places - middle) > reach)


def _clutter_of_any_kind(around: Surroundings) -> Failure | None:
    """A pole has no returns of any kind all along it, except those of a wall behind it."""
    line, xyz = around.line, around.cloud.xyz
    nearby = around.nearby & (~around.is_retro | around.retro_neighbours)
    share = cluttered_share(line, around.along[nearby], MOST)
    is_strict = around.is_suspect and not around.is_thick
    if share <= (LITTLE if is_strict else HALF):
        return None
    close = ~around.is_retro & ~around.on_line & (around.distance < MAX_CLOSE)
    is_close = cluttered_share(line, around.along[close], MOST) > HALF
    if not (around.is_short or is_close) and is_wall_behind(
        xyz[around.near[nearby]], xyz[line.index]
    ):
        return None
    return Failure(
        "part_of_a_surface",
        f"along {share:.0%} of it other returns lie {_where(around)}: a plate, a stripe or an "
        "edge, not an isolated pole",
    )


def along_the_sweeps(around: Surroundings) -> Failure | None:
    """A pole runs across the rings; the rings themselves show it better, if the cloud has them."""
    cloud, line = around.cloud, around.line
    if cloud.ring is not None or not runs_along_sweep(cloud.xyz, around.near, line):
        return None
    reason = f"{len(line.index)} points along the sweep of the beams"
    return Failure("along_a_beam", reason)


def _goes_on_without_tape(around: Surroundings) -> Failure | None:
    """A short pole ends where its tape ends; a sign continues as its post."""
    if not around.is_short or around.is_thick:
        return None
    line = around.line
    untaped = around.untaped & (around.distance < around.neighbour_limit)
    above, below = around.along - line.high, line.low - around.along
    needed = MOST * min(PIECES, SHORT_LENGTH / line.step)
    if max(_pieces_hit(beyond[untaped & (beyond > 0)]) for beyond in (above, below)) < needed:
        return None
    reason = f"{line.length:.2f} m long, and continues without tape: a sign on its post"
    return Failure("goes_on_without_tape", reason)


def _pieces_hit(places: Array) -> int:
    """Number of the `PIECES` equal pieces of the length `SHORT_LENGTH` that contain a position."""
    return int(np.count_nonzero(np.histogram(places, PIECES, (0.0, SHORT_LENGTH))[0]))


def _where(around: Surroundings) -> str:
    return f"{around.line.tube:.2f} to {around.neighbour_limit:.2f} m next to it"
