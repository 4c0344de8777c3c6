"""Group bright points, propose the lines that some of them may lie on, and fit these.

Only distances between points count here: a cloud gives the same groups and lines after any rigid
motion, and in whatever order its points come.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..datatypes import Array, BoolArray, IntArray, PointCloud

LINK = 1.2
"""Points nearer than this are one cluster, metres. The beams of a 16-beam sensor are 2° apart:
0.35 m at 10 m, twice that where one is lost."""

MANY = 600
"""Of more points than this, one for each `CLUSTER_CELL` stands for all: surfaces have millions of pairs."""

CLUSTER_CELL = 0.04
"""Side of a cell that is smaller than anything told apart here, metres."""

PATCH = 0.3
"""Radius of the neighbourhood that tells a surface from a line, metres."""

PATCH_WIDTH = 0.09
"""Standard deviation across a neighbourhood from which it is a surface, metres: a patch of ground
has 0.15, the half of one at the edge of a sign 0.08 to 0.15, a pole 0.06 at most."""

PATCH_POINTS = 8
"""A neighbourhood with fewer points tells nothing: beams can be farther apart than it is wide."""

MAX_PROPOSING_PAIRS, MAX_PROPOSING_POINTS = 2000, 400
"""Pairs of points that propose a line, and points that these are tried on."""

PROPOSALS = 6
"""Distinct lines that one search proposes."""

SAME_LINE = 0.7
"""A line that shares so much of its points with a better one is that line again."""

TUBE = 0.10
"""Room about the radius in which returns of a pole lie, metres: wide enough for a thick post and
for a sensor with 3 cm of noise."""

GAP = 1.2
"""Points beyond such a gap along the line belong to something else, metres."""

RING_GAP = 0.015
"""Returns whose places along the line differ by less come from one row, metres."""


@dataclass(frozen=True, eq=False)
class Line:
    """A line fitted to some points of a cloud.

    Attributes
    ----------
    rows
        (N,) index of the points in their cloud.
    along
        (N,) their places along the line from its point, metres.
    point, direction
        (3,) centroid, and unit vector of either sign.
    length, rms
        Extent of the points along the line, and their root mean square distance from it, metres.
    rings
        How many beams hit it.
    tube
        Radius about the line in which its points lie, metres.
    """

    rows: IntArray
    along: Array
    point: Array
    direction: Array
    length: float
    rms: float
    rings: int
    tube: float

    @property
    def step(self) -> float:
        """Mean distance of neighbouring rows along the line, metres."""
        return self.length / max(self.rings - 1, 1)


def clusters(xyz: Array, link: float = LINK) -> list[IntArray]:
    """Group points (N, 3) that chains of steps no longer than ``link`` connect, largest first."""
    if len(xyz) == 0:
        return []
    centre, member = _cells(xyz)
    pairs = cKDTree(centre).query_pairs(link, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(centre),) * 2)
    count, label = connected_components(graph, directed=False)
    label = label[member]
    order = np.argsort(label, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])
    return sorted(groups, key=len, reverse=True)


def _cells(xyz: Array) -> tuple[Array, IntArray]:
    """Middle (C, 3) of each occupied cell and the cell (N,) of each point; few points stay."""
    if len(xyz) <= MANY:
        return xyz, np.arange(len(xyz))
    # One number a cell: np.unique over rows would sort them as text, ten times slower.
    key = np.floor((xyz - xyz.min(axis=0)) / CLUSTER_CELL).astype(np.int64)
    _, member = np.unique((key[:, 0] << 42) + (key[:, 1] << 21) + key[:, 2], return_inverse=True)
    member = member.reshape(-1)
    sums = np.stack([np.bincount(member, weights=column) for column in xyz.T], axis=1)
    return sums / np.bincount(member)[:, None], member


def on_surface(xyz: Array) -> BoolArray:
    """Tell which points (N, 3) lie inside a bright surface: wide both ways about each of them.

    Saturated ground and large signs are thousands of points, in which chance lines abound; what is
    left without them is where lines are worth looking for.
    """
    centre, member = _cells(xyz)
    tree = cKDTree(centre)
    pairs = tree.query_pairs(PATCH, output_type="ndarray")
    near = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(centre),) * 2)
    near = (near + near.T).tocsr()
    local = centre - centre.mean(axis=0)
    second = np.einsum("ni,nj->nij", local, local).reshape(-1, 9)
    sums = near @ np.hstack([np.ones((len(local), 1)), local, second])
    sums += np.hstack([np.ones((len(local), 1)), local, second])
    count = sums[:, :1]
    mean = sums[:, 1:4] / count
    scatter = (sums[:, 4:] / count).reshape(-1, 3, 3) - np.einsum("ni,nj->nij", mean, mean)
    across = np.sqrt(np.maximum(np.linalg.eigvalsh(scatter)[:, 1], 0.0))
    return np.asarray(((across > PATCH_WIDTH) & (count[:, 0] >= PATCH_POINTS))[member])


def in_canonical_order(xyz: Array, index: IntArray) -> IntArray:
    """Sort points by their distance from their middle: the same after any motion or shuffle."""
    distance = np.linalg.norm(xyz[index] - xyz[index].mean(axis=0), axis=1)
    return index[np.argsort(distance, kind="stable")]


def propose_lines(
    xyz: Array, shortest: float, longest: float, tube: float, shell: tuple[float, float]
) -> list[tuple[Array, Array]]:
    """Propose lines through pairs of points, the best first and each only once.

    A line's score is the number of points within ``tube`` of it less the number in the ``shell``
    about it, so that a line across a plate or over bright ground scores nothing.

    Parameters
    ----------
    xyz
        (N, 3) points, metres, in canonical order.
    shortest, longest
        How far apart the two points of a pair may be, metres.
    tube
        Radius about a line, metres.
    shell
        Inner and outer radius about a line, metres.

    Returns
    -------
    list
        A point (3,) and a unit direction (3,) for each line; none where all points are near each
        other.
    """
    # About their middle: squares of map coordinates, millions of metres, leave no room for more.
    middle = xyz.mean(axis=0)
    points = xyz[:: 1 + (len(xyz) - 1) // MAX_PROPOSING_POINTS] - middle
    i, j = np.triu_indices(len(points), 1)
    apart = np.linalg.norm(points[i] - points[j], axis=1)
    usable = np.flatnonzero((apart >= shortest) & (apart <= longest))
    if len(usable) == 0:
        return []
    usable = usable[:: 1 + (len(usable) - 1) // MAX_PROPOSING_PAIRS]
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
    inside = across <= tube**2
    beside = (across > shell[0] ** 2) & (across < shell[1] ** 2)
    size = np.count_nonzero(inside, axis=1)
    score = (size - np.count_nonzero(beside, axis=1)).astype(float)
    inside = inside.astype(np.float32)
    lines = []
    for _ in range(PROPOSALS):
        best = int(np.argmax(score))
        if score[best] == -np.inf or size[best] < 3:
            break
        lines.append((start[best] + middle, direction[best]))
        score[inside @ inside[best] >= SAME_LINE * size] = -np.inf
    return lines


def distance_and_place(xyz: Array, point: Array, direction: Array) -> tuple[Array, Array]:
    """Distances (N,) of points from a line, and their places (N,) along it, metres."""
    offset = xyz - point
    along = offset @ direction
    square = np.einsum("ni,ni->n", offset, offset) - along * along
    return np.sqrt(np.maximum(square, 0.0)), along


def principal_line(xyz: Array) -> tuple[Array, Array]:
    """Centroid (3,) and direction (3,) of the line with the least squared distance to points."""
    centre = xyz.mean(axis=0)
    offset = xyz - centre
    return centre, np.asarray(np.linalg.eigh(offset.T @ offset)[1][:, 2])


def fit_line(
    cloud: PointCloud, left: IntArray, point: Array, direction: Array, radius: float
) -> Line:
    """Fit a line to those of the points ``left`` that are about a first guess.

    Points farther off than the others scatter are left out, and so is what a `GAP` parts from
    most of them.
    """
    xyz = cloud.xyz[left]
    tube = radius + TUBE
    inside = np.zeros(len(left), dtype=bool)
    for _ in range(4):
        distance, along = distance_and_place(xyz, point, direction)
        before, inside = inside, _in_one_piece(distance <= tube, along)
        if np.count_nonzero(inside) < 3 or np.array_equal(before, inside):
            break
        # Neighbours that touch the pole are many near it but few along it: the median holds.
        scale = 1.4826 * float(np.median(distance[inside]))
        tube = min(radius + TUBE, radius + 0.02 + 2.5 * scale)
        point, direction = principal_line(xyz[inside])
    distance, along = distance_and_place(xyz, point, direction)
    inside = _in_one_piece(distance <= tube, along)
    rows, along, distance = left[inside], along[inside], distance[inside]
    if len(rows) == 0:
        return Line(rows, along, point, direction, 0.0, 0.0, 0, tube)
    rms = float(np.sqrt(np.mean(distance**2)))
    rings = _rings_hit(cloud, rows, along)
    return Line(rows, along, point, direction, float(np.ptp(along)), rms, rings, tube)


def _in_one_piece(inside: BoolArray, along: Array) -> BoolArray:
    """Keep of the points inside the piece with the most points, where a `GAP` parts them."""
    index = np.flatnonzero(inside)
    if len(index) < 2 or np.ptp(along[index]) <= GAP:
        return inside
    order = index[np.argsort(along[index], kind="stable")]
    cuts = np.flatnonzero(np.diff(along[order]) > GAP) + 1
    kept = np.zeros_like(inside)
    kept[max(np.split(order, cuts), key=len)] = True
    return kept


def _rings_hit(cloud: PointCloud, rows: IntArray, along: Array) -> int:
    """How many beams hit a line: by ring where the cloud has rings, else by gaps along it."""
    if cloud.ring is not None:
        return len(np.unique(cloud.ring[rows]))
    places = np.sort(along)
    pieces = np.split(places, np.flatnonzero(np.diff(places) > RING_GAP) + 1)
    # Rows nearer than that leave no gaps, but fill a length that no single row has.
    return sum(max(1, int(np.ptp(piece) / (2 * RING_GAP))) for piece in pieces)
