"""Which returns are of the ground: one surface without steps, below the LiDARs.

A plane that most returns lie on gives rough axes. In squares of `CELL` that are flat, neighbours
without a step between them make pieces; pieces on one smooth surface make a level. A road and the
pavement behind its kerb are two levels; the roofs of cars are others. The ground is the level that
fills most of the view near the LiDARs: its area counts by the inverse square of the distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.errors import Refusal
from ..base.systematic import Sizes
from ..surfaces.averaging import averaged
from ..surfaces.consistency import DEPTH_TOLERANCE, MAX_TILT, VOXEL, ground_plane
from ..surfaces.registration import voxel_downsample

CELL = 0.5
"""Side of a square of the ground, metres."""

LOW, HIGH = 0.1, 0.9
"""Quantiles of the heights in a cell that count as its bottom and its top: single returns err."""

FLAT = 0.06
"""Bottom and top of a square of ground are no farther apart, metres: less than the least kerb,
0.08 m, and as much as noise of 1 cm on a slope of 6 % makes."""

STEP, SLOPE = 0.03, 0.04
"""Between squares of one piece the height changes by no more than this, metres, and by this part
of their distance, to 0.07 m a metre away: less than a kerb, more than a road's camber."""

REACH = 2
"""Squares so far apart along both axes are neighbours: between two rings some are empty."""

MIN_PIECE = 4
"""Pieces of fewer squares are left out: 1 m²."""

SAME_LEVEL = 0.06
"""A piece is of a level where the middle of its heights is so near its surface, metres."""

BEND = 0.004
"""1 σ of half the curvature of a level, 1/m, in each of three ways: camber of 4 % over 5 m."""

MOST_LEVELS = 6
"""So many of the largest pieces are tried for a beginning of the ground."""

MIN_CLEAR = 0.1
"""LiDARs are at least so high above the ground, metres."""

OTHER_SIDE = 3.0
"""A plane on the side of the LiDAR's −z axis is the ground, unless there are so many times as
many places on one on the other side: a floor has a ceiling over it, a LiDAR may hang head down."""


UPRIGHT = 0.1
"""Sine of the angle to the ground's normal below which an axis has no direction along it."""


@dataclass(frozen=True, eq=False)
class Viewer:
    """One LiDAR that sees the ground.

    Attributes
    ----------
    name, cloud, sizes
        What it is called, what it recorded in its own frame, and what its errors may be.
    T
        (4, 4) its pose in the frame of all.
    """

    name: str
    cloud: PointCloud
    T: Array
    sizes: Sizes

    @property
    def origin(self) -> Array:
        """(3,) where its beams start, in the frame of all."""
        return se3.apply(self.T, self.cloud.origin[None])[0]


@dataclass(frozen=True)
class Level:
    """Another surface beside the ground.

    Attributes
    ----------
    height
        Above the ground, median, metres.
    area
        Of what is seen of it, m².
    """

    height: float
    area: float


@dataclass(frozen=True, eq=False)
class Ground:
    """The ground that LiDARs see.

    Attributes
    ----------
    T_rough_frame
        (4, 4) rough axes: z up, the origin on the ground in the middle below the LiDARs.
    points
        Of each LiDAR the index of its returns on the ground.
    radius
        Of the disc that the plane is for, metres.
    area
        Of the squares of ground that are seen within twice the radius, m².
    spread
        Least root mean square distance of these from a line through their middle, metres.
    others
        Levels beside it, the largest first.
    ceiling
        Height of a plane above the LiDAR that was taken for no ground, metres; None without.
    """

    T_rough_frame: Array
    points: tuple[IntArray, ...]
    radius: float
    area: float
    spread: float
    others: tuple[Level, ...]
    ceiling: float | None


def find_ground(viewers: Sequence[Viewer], radius: float) -> Ground:
    """Find the ground below LiDARs.

    Parameters
    ----------
    viewers
        The LiDARs, in one frame; their clouds are averages of sweeps (`averaged`).
    radius
        Of the disc below each that is of interest, metres.

    Raises
    ------
    Refusal
        ``too_little_ground`` where nothing level is seen below them.
    """
    origins = np.stack([viewer.origin for viewer in viewers])
    rough, ceiling = _rough_axes(viewers)
    feet = se3.apply(rough, origins)
    rough[:2, 3] -= feet[:, :2].mean(axis=0)
    feet = se3.apply(rough, origins)
    radius += float(np.linalg.norm(feet[:, :2], axis=1).max())
    points = [se3.apply(rough @ viewer.T, viewer.cloud.xyz) for viewer in viewers]
    near = [np.flatnonzero(np.hypot(p[:, 0], p[:, 1]) < 2 * radius) for p in points]
    everything = np.concatenate([p[k] for p, k in zip(points, near, strict=True)])
    below = everything[:, 2] < feet[:, 2].min() - MIN_CLEAR
    if not below.any():
        raise little(0.0, 0.0, radius)
    low, high, _, corner = cells_of(everything[below], CELL)
    with np.errstate(invalid="ignore"):
        middle, flat = (low + high) / 2, high - low < FLAT
    rows = np.stack(np.nonzero(flat), axis=1)
    at = np.c_[corner + (rows + 0.5) * CELL, middle[flat]]
    pieces = _pieces(flat, middle)
    on, others = _levels(at, pieces, radius)
    if not on.any():
        raise little(0.0, 0.0, radius)
    mask = np.zeros_like(flat)
    mask[tuple(rows[on].T)] = True
    kept = tuple(
        k[_on_cells(p[k], mask, middle, corner)] for p, k in zip(points, near, strict=True)
    )
    ground = at[on]
    spread = np.sqrt(np.linalg.eigvalsh(np.atleast_2d(np.cov(ground[:, :2].T)))[0])
    area = float(np.count_nonzero(on)) * CELL**2
    return Ground(rough, kept, radius, area, float(spread), others, ceiling)


def little(area: float, spread: float, radius: float) -> Refusal:
    """Say that too little ground is seen: m², metres."""
    return Refusal(
        "too_little_ground",
        f"{area:.1f} m² of ground are seen within {2 * radius:.0f} m, {spread:.1f} m wide (root "
        "mean square across the narrowest direction)",
        {"area_m2": area, "spread_m": spread, "radius_m": radius},
    )


def _rough_axes(viewers: Sequence[Viewer]) -> tuple[Array, float | None]:
    """(4, 4) rough axes on the plane that most is on, and how high a ceiling is, or None."""
    first = viewers[0]
    axis = first.T[:3, :3] @ first.cloud.axis
    points = np.concatenate([se3.apply(v.T, voxel_downsample(v.cloud.xyz, VOXEL)) for v in viewers])
    side = (points - first.origin) @ axis
    found = []
    for part in (points[side < 0], points[side > 0]):
        if len(part) < 3:
            found.append((0, 0.0, np.eye(4)))
            continue
        # Fixed: equal recordings give equal answers.
        rng = np.random.default_rng(0)
        ranges = se3.lengths(part - first.origin)
        middle, up = ground_plane(part, ranges, axis, rng)
        up = up if (first.origin - middle) @ up > 0 else -up
        votes = int(np.count_nonzero(np.abs((part - middle) @ up) < DEPTH_TOLERANCE))
        votes *= bool(abs(up @ axis) > np.cos(MAX_TILT))
        R = level_axes(up)
        found.append((votes, float((first.origin - middle) @ up), se3.from_rt(R, -R @ middle)))
    (below, _, usual), (above, height, turned) = found
    if not below and not above:
        raise Refusal(
            "too_little_ground",
            f"no plane is within {np.degrees(MAX_TILT):.0f}° of level to the LiDAR {first.name}",
            {"area_m2": 0.0},
        )
    if above > OTHER_SIDE * below:
        return turned, None
    return usual, height if OTHER_SIDE * above > below else None


def level_axes(up: Array) -> Array:
    """(3, 3) rows x, y, z, in a frame: z up (3,), and x the frame's own x laid along the ground.

    Where that stands upright, what is at right angles to the frame's y is taken for it.
    """
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    if np.linalg.norm(x) < UPRIGHT:
        x = np.cross([0.0, 1.0, 0.0], up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def cells_of(points: Array, side: float) -> tuple[Array, Array, IntArray, Array]:
    """Bottom and top of what was recorded in each cell, how much, and the corner (2,) of all.

    Bottom and top are quantiles of the heights of points (N, 3); infinite in empty cells.
    """
    corner = np.floor(points[:, :2].min(axis=0) / side) * side
    at = ((points[:, :2] - corner) / side).astype(np.int64)
    shape = tuple(at.max(axis=0) + 1)
    cell = np.ravel_multi_index((at[:, 0], at[:, 1]), shape)
    order = np.lexsort((points[:, 2], cell))
    found, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    heights = points[order, 2]
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    low.flat[found] = heights[first + (LOW * (count - 1)).astype(np.int64)]
    high.flat[found] = heights[first + np.ceil(HIGH * (count - 1)).astype(np.int64)]
    counts = np.zeros(shape, dtype=np.int64)
    counts.flat[found] = count
    return low, high, counts, corner


def _pieces(flat: BoolArray, middle: Array) -> IntArray:
    """Number of the piece that each flat cell is of, in the order of `np.nonzero`."""
    number = np.full(flat.shape, -1)
    number[flat] = np.arange(np.count_nonzero(flat))
    steps = [
        (i, j) for i in range(REACH + 1) for j in range(-REACH, REACH + 1) if i > 0 or j > 0
    ]
    links = []
    for i, j in steps:
        n, m = flat.shape
        a = (slice(0, max(n - i, 0)), slice(max(-j, 0), m - max(j, 0)))
        b = (slice(i, n), slice(max(j, 0), m - max(-j, 0)))
        limit = STEP + SLOPE * CELL * np.hypot(i, j)
        with np.errstate(invalid="ignore"):
            near = flat[a] & flat[b] & (np.abs(middle[a] - middle[b]) < limit)
        links.append(np.stack([number[a][near], number[b][near]]))
    pairs, count = np.concatenate(links, axis=1), int(np.count_nonzero(flat))
    graph = coo_matrix((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _levels(at: Array, pieces: IntArray, radius: float) -> tuple[BoolArray, tuple[Level, ...]]:
    """Which flat cells (N, 3) are ground, and the levels beside it."""
    size = np.bincount(pieces, minlength=1)
    weight = 1 / (np.sum(at[:, :2] ** 2, axis=1) + (radius / 4) ** 2)
    heavy = np.bincount(pieces, weight, minlength=1) * (size >= MIN_PIECE)
    best, total, surface = np.zeros(len(at), dtype=bool), 0.0, np.zeros(len(at))
    for begin in np.argsort(-heavy)[:MOST_LEVELS]:
        if not heavy[begin]:
            break
        on, heights = _grown(at, pieces, int(begin), size)
        if weight[on].sum() > total:
            best, total, surface = on, weight[on].sum(), heights
    rest = np.flatnonzero(~best & (size[pieces] >= MIN_PIECE))
    off = at[rest, 2] - surface[rest]
    # Of what is a step high or a few: what stands there has tops of all heights.
    others = []
    for number in np.unique(pieces[rest]):
        own = pieces[rest] == number
        others.append(Level(float(np.median(off[own])), float(np.count_nonzero(own)) * CELL**2))
    return best, tuple(sorted(others, key=lambda level: -level.area))


def _grown(at: Array, pieces: IntArray, begin: int, size: IntArray) -> tuple[BoolArray, Array]:
    """Which cells are of the level that a piece is of, and its heights everywhere."""
    x, y, z = at.T
    table = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    prior = FLAT / np.array([1e3, 1e3, 1e3, BEND, BEND, BEND])
    on = pieces == begin
    for _ in range(3):
        rows = table[on]
        fit = np.linalg.solve(rows.T @ rows + np.diag(prior**2), rows.T @ z[on])
        off = z - table @ fit
        order = np.lexsort((off, pieces))
        first = np.searchsorted(pieces[order], np.arange(len(size)))
        median = off[order][first + size // 2]
        own = (np.abs(median) < SAME_LEVEL) & (size >= MIN_PIECE)
        own[begin] = True
        on = own[pieces]
    return on, table @ fit


def _on_cells(points: Array, mask: BoolArray, middle: Array, corner: Array) -> BoolArray:
    """Which points (N, 3) lie in cells of ground, near its height there."""
    at = np.floor((points[:, :2] - corner) / CELL).astype(np.int64)
    inside = np.all((at >= 0) & (at < mask.shape), axis=1)
    on = np.zeros(len(points), dtype=bool)
    i, j = at[inside].T
    on[inside] = mask[i, j] & (np.abs(points[inside, 2] - middle[i, j]) < FLAT)
    return on


def viewer_of(name: str, cloud: PointCloud, T: Array, sizes: Sizes) -> Viewer:
    """Take a LiDAR with the averages of its sweeps."""
    return Viewer(name, averaged(cloud), T, sizes)
