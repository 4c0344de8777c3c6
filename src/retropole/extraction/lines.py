"""Propose the lines that some bright points may lie on, and fit each to the points about it.

Bright points are grouped first, and those inside a bright surface distinguished from those along a
line. Only distances between points are used: a cloud gives the same groups and lines after any
rigid motion, and in any order of its points. What *Sensitivity* means at a constant:
docs/evidence/detection.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from ..base.datatypes import DEFAULT_RADIUS, Array, BoolArray, IntArray, PointCloud
from ..base.se3 import principal_axes
from ..base.uncertainty import MAD_TO_SIGMA
from .sensor_pattern import RMS_PER_RADIUS, UNKNOWN, Beams, beam_scatter

LINK = 1.2
"""Points with no longer step between them are one cluster, metres. Longer than two ring spacings of
a 16-beam sensor, 2° each, up to 17 m (2 · 17 m · tan 2° = 1.19 m): a lost ring does not divide a
pole. Sensitivity at 0.84: 6 poles lost, 3 fewer false; at 1.68: 1 fewer false."""

MAX_NEIGHBOUR_DISTANCE = 0.35
"""A return from the edge of the tube to this distance of the line is its neighbour, metres: the
spacing of rings of 2° at 10 m. Sensitivity at 0.245: 4 more found, 7 more false; at 0.49: 17
poles lost, 5 of them recorded posts, 16 fewer false."""

MANY = 400
"""Of more points than this, a sample represents all: here one for each occupied `SEARCH_ROOM`, in a
search for lines every second, third … It bounds their pairs: 400 points have 80,000, a bright
ground of 5,000 points 12 million. Larger clusters are searched without the bright surfaces in them.
Sensitivity at 280: 1 more found, 2 fewer false; at 560: 3 poles lost, 5 fewer false."""

MIN_POLE_POINTS = 6
"""Fewest returns on a pole: two on each of three rings. At 5 m a pole 4 cm thick spans 0.46°, two
steps of 0.2°. Sensitivity at 4: 1 more false; at 8: 2 poles lost."""

PATCH_RADIUS = 0.3
"""Radius of the neighbourhood that distinguishes a surface from a line, metres: wider than the 0.12
m radius of a pole's tube, so that a line is narrow in it. Sensitivity at 0.21: 4 fewer false; at
0.42: 1 more found, 8 fewer false."""

PATCH_WIDTH = 0.09
"""Standard deviation across a neighbourhood, in its second direction, from which it is a surface,
metres. Points spread over a disc of 0.3 m have 0.15, over the half of one at an edge 0.079, and on
a pole no more than `MAX_RMS`, 0.06. Sensitivity at 0.063: 1 more found, 5 fewer false; at 0.126: 4
fewer false."""


def clusters(xyz: Array, link: float) -> list[IntArray]:
    """Group points that chains of steps no longer than ``link`` connect.

    Parameters
    ----------
    xyz
        (N, 3) points, metres.
    link
        Longest step, metres; between cells of `SEARCH_ROOM` where the points are many.

    Returns
    -------
    list
        Index (M,) of the points of each group, the largest first.
    """
    if len(xyz) == 0:
        return []
    centre, member = _cells(xyz)
    count, label = _labels(centre, link)
    label = label[member]
    order = np.argsort(label, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])
    return sorted(groups, key=len, reverse=True)


def on_surface(xyz: Array) -> BoolArray:
    """Find the points inside a bright surface: wide in two directions about each point.

    Saturated ground and large signs are thousands of points, in which chance lines abound. Lines
    are searched for among the remaining points.

    Parameters
    ----------
    xyz
        (N, 3) points, metres.

    Returns
    -------
    BoolArray
        (N,) true inside a surface.
    """
    centre, member = _cells(xyz)
    near = _neighbours(centre, PATCH_RADIUS)
    near = (near + near.T).tocsr()
    local = centre - centre.mean(axis=0)
    second = np.einsum("ni,nj->nij", local, local).reshape(-1, 9)
    moments = np.hstack([np.ones((len(local), 1)), local, second])
    sums = near @ moments
    sums += moments
    count = sums[:, :1]
    mean = sums[:, 1:4] / count
    scatter = (sums[:, 4:] / count).reshape(-1, 3, 3) - np.einsum("ni,nj->nij", mean, mean)
    across = np.sqrt(np.maximum(np.linalg.eigvalsh(scatter)[:, 1], 0.0))
    return np.asarray(((across > PATCH_WIDTH) & (count[:, 0] >= MIN_POLE_POINTS))[member])


def _cells(xyz: Array) -> tuple[Array, IntArray]:
    """Middle (C, 3) of each occupied cell and the cell (N,) of each point; few points stay."""
    if len(xyz) <= MANY:
        return xyz, np.arange(len(xyz))
    member: IntArray = np.zeros(len(xyz), dtype=np.int64)
    for column in ((xyz - xyz.min(axis=0)) // SEARCH_ROOM).T:
        # Axis by axis: np.unique over rows would sort them as text, ten times slower.
        _, places = np.unique(column, return_inverse=True)
        _, member = np.unique(member * len(xyz) + places, return_inverse=True)
    sums = np.stack([np.bincount(member, weights=column) for column in xyz.T], axis=1)
    return sums / np.bincount(member)[:, None], member


def _labels(centre: Array, link: float) -> tuple[int, IntArray]:
    """Number of groups, and the group (C,) of each point, in the order of their first points."""
    if len(centre) > MANY:
        count, label = connected_components(_neighbours(centre, link), directed=False)
        return count, label
    # Of few points all distances, |v|² + |w|² − 2 v·w, take less time than a graph.
    offset = centre - centre.mean(axis=0)
    square = np.einsum("ni,ni->n", offset, offset)
    near = offset @ (-2 * offset.T)
    near += square
    near = near <= (link**2 - square)[:, None]
    count, label = 0, np.full(len(centre), -1)
    for k in range(len(centre)):
        if label[k] < 0:
            group, size = near[k], 1
            while np.count_nonzero(group) > size:
                size = int(np.count_nonzero(group))
                group = near[group].any(axis=0)
            label[group] = count
            count += 1
    return count, label


def _neighbours(centre: Array, radius: float) -> coo_array:
    """Graph (C, C) of the pairs of points no farther from each other than ``radius``, each pair
    once."""
    pairs = cKDTree(centre).query_pairs(radius, output_type="ndarray")
    return coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(centre),) * 2)


LITTLE, HALF, MOST = 0.25, 0.5, 0.7
"""Shares used by the rules: next to nothing, half, and most. The limits of the rules
had separate values within 0.1 of these: with these instead, the same poles except for a few
are found in 3,000 clouds (docs/evidence/detection.md, Sensitivity)."""

MAX_PROPOSING_PAIRS = 2000
"""Maximum number of pairs of points that propose a line: with `MANY` it bounds a search to 800,000
distances, about 4 ms. Sensitivity at 1400: 2 poles lost, 9 fewer false; at 2800: 1 pole lost, 6
fewer false."""

PAIRS_AT_ONCE = 128
"""So many pairs are scored at once: their distances take 0.4 MB."""

PROPOSALS = 6
"""Number of distinct lines that one search proposes. If none of them is a pole, the search of that
group ends, and the group has the failure of the first. Sensitivity at 4: 4 poles lost, 8 fewer
false; at 8: 6 more false."""

MIN_LINE_POINTS = 3
"""Two points always lie in line; the third is the first that supports it. At least this many rings
hit a pole, and a candidate has this many returns. Sensitivity of the rings at 2: no effect; at 4: 1
pole lost."""

TUBE = 0.10
"""Room about the pole's radius in which its returns lie, metres. With a radius of 2 cm the tube has
0.12 m. It contains the returns of a post of 9 cm radius, whose edges are 1.27 radii from their
line, and of a pole seen with the ±3 cm that the manuals of VLP-16 and C16 state. Sensitivity at
0.07: 10 recorded posts lost, 4 more found, 25 more false; at 0.14: 15 poles lost, 1 of them a
recorded post, 2 more found, 14 fewer false."""

SEARCH_ROOM = 0.04
"""The same in which a proposed line has its points, metres: 4 σ of 10 mm, the range noise of most
sensors of the table. Points this far from an object are separate from it. Sensitivity at 0.028: 6
poles lost, 13 fewer false; at 0.056: 3 more found, 6 more false."""

FIT_ROUNDS = 4
"""Maximum number of rounds of a fit; it ends earlier if a round keeps the points of the previous
one. A fit that has not ended is tested as it is: the rules use its points and their scatter.
Sensitivity at 3: 9 more false; at 6: 13 fewer false."""

FIT_SIGMAS = 2.5
"""Distance from the line to which points are kept, in standard deviations: 98.8 % of a normal
distribution on either side. Sensitivity at 1.75: 7 more false; at 3.5: 8 fewer false."""

FIT_ROOM = 0.02
"""Smallest room about the pole's radius, however little its points scatter, metres: 2 σ of the
sensors' range noise, 10 mm for most of the table of sensors. Sensitivity at 0.014: no effect; at
0.028: 5 fewer false."""

WIDTH_IN_RMS = 4.0
"""Width of a line over its scatter: ±2 standard deviations. Sensitivity at 2.8: 1 more found, 8
more false; at 5.6: 10 recorded posts lost, 2 fewer false."""

RING_GAP = 0.015
"""Returns whose positions along a line differ by less are from one ring, metres: the finest ring
spacing of the table of sensors, Pandar64 with 1/6°, is 0.0145 m at 5 m. Sensitivity at 0.0105: 3
poles lost, 2 of them recorded posts; at 0.021: 1 more found, 1 fewer false."""


Guess = tuple[Array, Array]
"""Point (3,) and unit direction (3,) of a line."""


@dataclass(frozen=True, eq=False)
class Line:
    """A line fitted to some points of a cloud.

    Attributes
    ----------
    index
        (N,) index of the points in their cloud.
    along
        (N,) their positions along the line from its point, metres.
    point, direction
        (3,) centroid, and unit vector of either sign.
    length, rms
        Extent of the points along the line, and their root mean square distance from it, metres.
    rings
        Number of rings of the LiDAR that hit it.
    tube
        Radius about the line in which its points lie, metres.
    beam_scatter
        Addition to the scatter of the returns by beams wider than ordinary ones, metres.
    thicker
        Addition to it by a radius above the usual one, metres.
    """

    index: IntArray
    along: Array
    point: Array
    direction: Array
    length: float
    rms: float
    rings: int
    tube: float
    beam_scatter: float = 0.0
    thicker: float = 0.0

    def with_beams(self, limit: float) -> float:
        """Give the largest scatter, metres, that a limit allows with beams of this width.

        Limits are those of a pole of `DEFAULT_RADIUS`.
        """
        return float(np.hypot(limit + self.thicker, self.beam_scatter))

    @property
    def step(self) -> float:
        """Mean distance of neighbouring rings along the line, metres."""
        return self.length / max(self.rings - 1, 1)

    @property
    def low(self) -> float:
        """Begin of its points along it, metres."""
        return float(self.along.min())

    @property
    def high(self) -> float:
        """End of its points along it, metres."""
        return float(self.along.max())

    @property
    def width(self) -> float:
        """Extent of its points across it, metres."""
        return WIDTH_IN_RMS * self.rms


def in_canonical_order(xyz: Array, index: IntArray) -> IntArray:
    """Sort points by their distance from their centroid: the same after any motion or shuffle."""
    distance = np.linalg.norm(xyz[index] - xyz[index].mean(axis=0), axis=1)
    return index[np.argsort(distance, kind="stable")]


def propose_lines(
    xyz: Array,
    shortest: float,
    longest: float,
    tube: float,
    shell: tuple[float, float],
    most: int = PROPOSALS,
) -> list[Guess]:
    """Propose lines through pairs of points, the best first and each only once.

    A line's score is the number of points within ``tube`` of it less the number in the ``shell``
    about it, so that a line across a plate or over bright ground scores nothing.

    Parameters
    ----------
    xyz
        (N, 3) points, metres, in canonical order.
    shortest, longest
        Least and largest distance of the two points of a pair, metres.
    tube
        Radius about a line, metres.
    shell
        Inner and outer radius about a line, metres.
    most
        Maximum number of lines that are proposed.

    Returns
    -------
    list
        A point (3,) and a unit direction (3,) for each line; none where all points are near each
        other.
    """
    # About their centroid: squares of map coordinates, millions of metres, would lose the
    # centimetres.
    centroid = xyz.mean(axis=0)
    points = xyz[:: 1 + (len(xyz) - 1) // MANY] - centroid
    lengths_between = pdist(points)
    usable = np.flatnonzero((lengths_between >= shortest) & (lengths_between <= longest))
    if len(usable) == 0:
        return []
    usable = usable[:: 1 + (len(usable) - 1) // MAX_PROPOSING_PAIRS]
    # Pairs are in order of their first points, then of their second ones.
    first = np.r_[0, np.cumsum(np.arange(len(points) - 1, 0, -1))]
    i = np.searchsorted(first, usable, side="right") - 1
    start = points[i]
    direction = (points[usable - first[i] + i + 1] - start) / lengths_between[usable, None]
    inside = np.empty((len(usable), len(points)), dtype=np.float32)
    score = np.empty(len(usable))
    square = np.einsum("ni,ni->n", points, points)
    for k in range(0, len(usable), PAIRS_AT_ONCE):
        # Squared distance of every point from every line: |v|² − (v·n)², expanded to matrix
        # products. In place, and of as many lines as stay in a processor's cache.
        part = slice(k, k + PAIRS_AT_ONCE)
        along = direction[part] @ points.T
        along -= np.einsum("pi,pi->p", direction[part], start[part])[:, None]
        along *= along
        across = 2 * start[part] @ points.T
        np.subtract(square, across, out=across)
        across += np.einsum("pi,pi->p", start[part], start[part])[:, None]
        across -= along
        inside[part] = across <= tube**2
        in_shell = (across > shell[0] ** 2) & (across < shell[1] ** 2)
        score[part] = -np.count_nonzero(in_shell, axis=1)
    size = np.count_nonzero(inside, axis=1)
    score += size
    lines = []
    for _ in range(most):
        best = int(np.argmax(score))
        if score[best] == -np.inf or size[best] < MIN_LINE_POINTS:
            break
        lines.append((start[best] + centroid, direction[best]))
        score[inside @ inside[best] >= MOST * size] = -np.inf
    return lines


class LineCoordinates(NamedTuple):
    """Distances (N,) of points from a line, and their positions (N,) along it, metres."""

    distances: Array
    places: Array


def line_coordinates(xyz: Array, point: Array, direction: Array) -> LineCoordinates:
    """Measure points (N, 3) from a line through ``point`` (3,) with a unit direction (3,)."""
    offset = xyz - point
    along = offset @ direction
    square = np.einsum("ni,ni->n", offset, offset) - along * along
    return LineCoordinates(np.sqrt(np.maximum(square, 0.0)), along)


class PrincipalLine(NamedTuple):
    """Centroid (3,) of points, and unit direction (3,) of the line nearest to them."""

    point: Array
    direction: Array


def principal_line(xyz: Array) -> PrincipalLine:
    """Find the line with the least squared distance to points (N, 3)."""
    centre, axes = principal_axes(xyz)
    return PrincipalLine(centre, axes[:, 2])


def to_nearest(places: Array, candidates: Array) -> Array:
    """Distance (K,) of candidates (K,) from the nearest of some places (N,), two or more."""
    places = np.sort(places)
    after = np.clip(np.searchsorted(places, candidates), 1, len(places) - 1)
    return np.minimum(np.abs(places[after] - candidates), np.abs(candidates - places[after - 1]))


def fit_line(
    cloud: PointCloud,
    candidates: IntArray,
    point: Array,
    direction: Array,
    radius: float,
    beams: Beams = UNKNOWN,
    room: float = TUBE,
) -> Line:
    """Fit a line from one first guess, a point (3,) and a unit direction (3,); see `fit_lines`."""
    return fit_lines(cloud, candidates, [(point, direction)], radius, beams, room)[0]


def fit_lines(
    cloud: PointCloud,
    candidates: IntArray,
    guesses: Sequence[Guess],
    radius: float,
    beams: Beams = UNKNOWN,
    room: float = TUBE,
) -> list[Line]:
    """Fit lines to those of some candidate points that are about each first guess, all at once.

    Points farther off than the scatter of the others are left out, and so are those separated from
    most of them by a gap longer than `LINK`.

    Parameters
    ----------
    cloud
        The cloud of the points.
    candidates
        (N,) index of the points that may lie on a line.
    guesses
        Point (3,) and unit direction (3,) of each.
    radius
        Of the pole, metres.
    beams
        That hit it.
    room
        About the pole's radius, in which its points may lie, metres.

    Returns
    -------
    list of Line
        One for each guess, without points where none is near it.
    """
    if not guesses:
        return []
    xyz = cloud.xyz[candidates]
    points, directions = (np.array(each, dtype=float) for each in zip(*guesses, strict=True))
    tubes = np.full(len(points), radius + room)
    before = np.zeros((len(points), len(xyz)), dtype=bool)
    left = np.arange(len(points))
    for _ in range(FIT_ROUNDS):
        distance, along = _distances_and_places(xyz, points[left], directions[left])
        inside = _in_one_piece(distance <= tubes[left, None], along)
        moves = (inside != before[left]).any(axis=1)
        moves &= np.count_nonzero(inside, axis=1) >= MIN_LINE_POINTS
        left, inside, distance = left[moves], inside[moves], distance[moves]
        if not len(left):
            break
        before[left] = inside
        # Neighbours that touch the pole are many near it but few along it: the median is robust.
        sigma = MAD_TO_SIGMA * _medians(distance, inside)
        tubes[left] = radius + np.minimum(room, FIT_ROOM + FIT_SIGMAS * sigma)
        points[left], directions[left] = _principal_lines(xyz, inside)
    distance, along = _distances_and_places(xyz, points, directions)
    inside = _in_one_piece(distance <= tubes[:, None], along)
    return [
        _line_of(cloud, candidates[on], one[on], off[on], guess, float(tube), radius, beams)
        for on, one, off, *guess, tube in zip(
            inside, along, distance, points, directions, tubes, strict=True
        )
    ]


def _line_of(
    cloud: PointCloud,
    index: IntArray,
    along: Array,
    distance: Array,
    axis: Sequence[Array],
    tube: float,
    radius: float,
    beams: Beams,
) -> Line:
    """Measure the points of a line about its axis, a point (3,) and a direction (3,)."""
    point, direction = axis
    if len(index) == 0:
        return Line(index, along, point, direction, 0.0, 0.0, 0, tube)
    away = float(np.linalg.norm(point - cloud.origin))
    return Line(
        index,
        along,
        point,
        direction,
        float(np.ptp(along)),
        float(np.sqrt(np.mean(distance**2))),
        _rings_hit(cloud, index, along),
        tube,
        beam_scatter=beam_scatter(away, radius, beams),
        thicker=RMS_PER_RADIUS * max(radius - DEFAULT_RADIUS, 0.0),
    )


def _distances_and_places(xyz: Array, points: Array, directions: Array) -> tuple[Array, Array]:
    """(G, N) each of points (N, 3) from lines through points (G, 3) with directions (G, 3)."""
    square, along = np.zeros((2, len(points), len(xyz)))
    for column, at, way in zip(xyz.T, points.T, directions.T, strict=True):
        offset = column - at[:, None]
        along += offset * way[:, None]
        square += np.square(offset, out=offset)
    square -= along * along
    return np.sqrt(np.maximum(square, 0.0, out=square), out=square), along


def _in_one_piece(inside: BoolArray, along: Array) -> BoolArray:
    """Keep of each row (G, N) the piece with most of the points inside, where gaps longer than
    `LINK` separate them."""
    row, column = np.nonzero(inside)
    if not len(row):
        return inside
    places = along[row, column]
    order = np.lexsort((places, row))
    row, column, places = row[order], column[order], places[order]
    begins = np.r_[True, (row[1:] != row[:-1]) | (places[1:] - places[:-1] > LINK)]
    if np.count_nonzero(begins) == np.count_nonzero(np.diff(row)) + 1:
        return inside
    piece = np.cumsum(begins) - 1
    size, of = np.bincount(piece), row[begins]
    # The first of the largest pieces of each row.
    ranked = np.lexsort((-size, of))
    largest = np.zeros(len(size), dtype=bool)
    largest[ranked[np.r_[True, np.diff(of[ranked]) > 0]]] = True
    kept = np.zeros_like(inside)
    taken = largest[piece]
    kept[row[taken], column[taken]] = True
    return kept


def _medians(values: Array, inside: BoolArray) -> Array:
    """(G,) median of those values of each row (G, N) that are inside; at least one is."""
    row, column = np.nonzero(inside)
    ordered = values[row, column]
    ordered = ordered[np.lexsort((ordered, row))]
    count = np.count_nonzero(inside, axis=1)
    first, half = np.cumsum(count) - count, count // 2
    return np.asarray(ordered[first + half] + ordered[first + count - half - 1]) / 2.0


def _principal_lines(xyz: Array, inside: BoolArray) -> tuple[Array, Array]:
    """`principal_line` of those points (N, 3) that are inside, for each row (G, N)."""
    row, column = np.nonzero(inside)
    count = np.count_nonzero(inside, axis=1)
    first, points = np.cumsum(count) - count, xyz[column]
    centres = np.add.reduceat(points, first) / count[:, None]
    offset = points - centres[row]
    scatter = np.add.reduceat(offset[:, :, None] * offset[:, None, :], first)
    return centres, np.linalg.eigh(scatter)[1][:, :, 2]


def _ends_of_pieces(places: Array, gap: float) -> IntArray:
    """(P + 1,) begin of the pieces of sorted positions between longer gaps, and end of the last."""
    cuts = np.flatnonzero(places[1:] - places[:-1] > gap) + 1
    return np.concatenate([[0], cuts, [len(places)]])


def _rings_hit(cloud: PointCloud, index: IntArray, along: Array) -> int:
    """Number of rings that hit a line: counted if the cloud has rings, else by gaps along the
    line."""
    if cloud.ring is not None:
        return len(np.unique(cloud.ring[index]))
    places = np.sort(along)
    ends = _ends_of_pieces(places, RING_GAP)
    # Rings nearer than that leave no gaps, but fill a length that no single ring has.
    rings = (places[ends[1:] - 1] - places[ends[:-1]]) / RING_GAP
    return int(np.maximum(rings.astype(np.int64), 1).sum())
