"""Which returns are of the ground: one surface without steps, below the LiDARs.

A plane that most returns lie on gives rough axes. In squares of `CELL` that are flat, neighbours
without a step between them make pieces; pieces on one smooth surface make a level. A road and the
pavement behind its kerb are two levels; the roofs of cars are others. The ground is the level that
fills most of the view near the LiDARs: its area counts by the inverse square of the distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage
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

MIN_RETURNS = 3
"""Fewer returns show no square of ground: one may lie on the face of a kerb."""

EDGE, SIDE = 0.05, 3
"""Where the ground on both sides of a square, so many squares of each, continues to heights there
that differ by more, metres, is a step. A kerb of 0.08 m makes 0.06 m where a ring crosses it at
45°, a change of the slope by 10 %, 0.04 m."""

CLOSED = 1
"""Gaps of up to twice so many squares in the line of a step are closed: few rings show it whole.
Two kerbs 3 m apart stay two."""

APART, DIFFERENT = 4, 0.06
"""Pieces that are within so many squares of each other are different levels where their heights
there differ by more, metres, in the middle."""

SAME_LEVEL = 0.06
"""A piece is of a level where the middle of its heights is so near its surface, metres."""

RIDGE = 10.0
"""Weight with which a level is held parallel to the rough axes, cells times m²."""

PARTED, PARTING_ROUNDS = 0.2, 20
"""Two levels are told apart in one piece where both together are this thin, root mean square, as a
part of the step between them; and rounds of parting it."""

MOST_LEVELS = 6
"""So many of the largest pieces are tried for a beginning of the ground."""

KERB, PARALLEL = (0.05, 0.5), 0.04
"""A level so much higher or lower, metres, and parallel, root mean square, may be the ground as
well, a road beside a pavement,"""

KERB_AREA = 10.0
"""… where so much of it is seen, m²,"""

NEAREST, NEARER = 0.05, 0.6
"""… and the ground is not on all sides of the foot at this part of the distance of that level, of
which so much is nearer."""

REACHES = np.linspace(0.1, 2.0, 20)
"""Distances within which a level may lie on all sides of the foot, as parts of the radius."""

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
        return np.asarray(se3.apply(self.T, self.cloud.origin[None])[0])


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
    centre, radius
        (2,) of the disc that the plane is for, rough axes, and its radius, metres: about the foot
        of the LiDARs; where none sees ground on all sides of it, about the middle of what is seen.
    area
        Of the squares of ground that are seen in the disc, m².
    spread
        Least root mean square distance of these from a line through their middle, metres.
    others
        Levels beside it, the largest first.
    ceiling
        Height of a plane above the LiDAR that was taken for no ground, metres; None without.
    """

    T_rough_frame: Array
    points: tuple[IntArray, ...]
    centre: Array
    radius: float
    area: float
    spread: float
    others: tuple[Level, ...]
    ceiling: float | None


def find_ground(
    viewers: Sequence[Viewer], radius: float, axes: tuple[Array, float | None] | None = None
) -> Ground:
    """Find the ground below LiDARs.

    Parameters
    ----------
    viewers
        The LiDARs, in one frame; their clouds are averages of sweeps (`averaged`).
    radius
        Of the disc below each that is of interest, metres.
    axes
        (4, 4) rough axes and the height of a ceiling, where they are known.

    Raises
    ------
    Refusal
        ``too_little_ground`` where nothing level is seen below them; ``two_grounds`` where two
        levels are, and nothing tells which of them is below.
    """
    origins = np.stack([viewer.origin for viewer in viewers])
    rough, ceiling = _rough_axes(viewers) if axes is None else axes
    rough = rough.copy()
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
    low, high, count, corner = cells_of(everything[below], CELL)
    with np.errstate(invalid="ignore"):
        middle = np.where((high - low < FLAT) & (count >= MIN_RETURNS), (low + high) / 2, np.nan)
    middle[_at_edges(middle)] = np.nan
    rows = np.stack(np.nonzero(np.isfinite(middle)), axis=1)
    at = np.c_[corner + (rows + 0.5) * CELL, middle[np.isfinite(middle)]]
    on, others = _levels(at, middle, radius)
    if not on.any():
        raise little(0.0, 0.0, radius)
    middle[tuple(rows[~on].T)] = np.nan
    kept = tuple(k[_on_cells(p[k], middle, corner)] for p, k in zip(points, near, strict=True))
    centre = np.zeros(2) if _is_around(at[on, :2]) else at[on, :2].mean(axis=0)
    ground = at[on & (se3.lengths(at - np.r_[centre, 0.0]) < radius)]
    spread = 0.0
    if len(ground) > 1:
        spread = np.sqrt(max(np.linalg.eigvalsh(np.cov(ground[:, :2].T))[0], 0.0))
    area = len(ground) * CELL**2
    return Ground(rough, kept, centre, radius, area, float(spread), others, ceiling)


def little(area: float, spread: float, radius: float) -> Refusal:
    """Say that too little ground is seen: m², metres."""
    return Refusal(
        "too_little_ground",
        f"{area:.1f} m² of ground are seen within {radius:.0f} m, {spread:.1f} m wide (root "
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


def _shifted(grid: Array, i: int, j: int) -> Array:
    """(n, m) for each cell what is i and j cells on; NaN outside."""
    n, m = grid.shape
    out = np.full_like(grid, np.nan)
    if abs(i) < n and abs(j) < m:
        rows, columns = slice(max(-i, 0), n - max(i, 0)), slice(max(-j, 0), m - max(j, 0))
        out[rows, columns] = grid[max(i, 0) : n + min(i, 0), max(j, 0) : m + min(j, 0)]
    return out


def _at_edges(heights: Array) -> BoolArray:
    """(n, m) at which cells the ground on both sides does not continue to the same height."""
    edge = np.zeros(heights.shape, dtype=bool)
    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)):

        def beside(k: int, i: int = i, j: int = j) -> Array:
            three = np.stack(
                [_shifted(heights, k * i - across * j, k * j + across * i) for across in (-1, 0, 1)]
            )
            known = np.isfinite(three)
            total = np.where(known, three, 0.0).sum(axis=0)
            return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)

        far = SIDE if i * j == 0 else SIDE - 1
        ahead = np.stack([beside(k) for k in range(1, far + 1)])
        behind = np.stack([beside(-k) for k in range(1, far + 1)])
        slope = (ahead[-1] - ahead[0] + behind[0] - behind[-1]) / (2 * (far - 1))
        step = ahead.mean(axis=0) - behind.mean(axis=0) - slope * (far + 1)
        with np.errstate(invalid="ignore"):
            edge |= np.abs(step) > EDGE
    return np.asarray(ndimage.binary_closing(edge, np.ones((3, 3)), iterations=CLOSED))


def _pairs(heights: Array, reach: int) -> tuple[IntArray, IntArray, Array]:
    """Numbers of the two cells (K,) of each pair within a reach, and their distance, cells.

    Cells with a height are numbered in the order of `np.nonzero`.
    """
    number = np.full(heights.shape, np.nan)
    known = np.isfinite(heights)
    number[known] = np.arange(np.count_nonzero(known))
    steps = [(i, j) for i in range(reach + 1) for j in range(-reach, reach + 1) if i or j > 0]
    first, second, apart = [], [], []
    for i, j in steps:
        there = _shifted(number, i, j)
        both = known & np.isfinite(there)
        first.append(number[both].astype(np.int64))
        second.append(there[both].astype(np.int64))
        apart.append(np.full(len(first[-1]), np.hypot(i, j)))
    return np.concatenate(first), np.concatenate(second), np.concatenate(apart)


def _pieces(heights: Array) -> IntArray:
    """Number of the piece that each cell with a height is of, in the order of `np.nonzero`."""
    z = heights[np.isfinite(heights)]
    a, b, apart = _pairs(heights, REACH)
    linked = np.abs(z[a] - z[b]) < STEP + SLOPE * CELL * apart
    links = np.ones(np.count_nonzero(linked)), (a[linked], b[linked])
    graph = coo_matrix(links, shape=(len(z), len(z)))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _conflicts(heights: Array, pieces: IntArray) -> BoolArray:
    """(P, P) which pieces are beside each other with a step between them."""
    z = heights[np.isfinite(heights)]
    a, b, _ = _pairs(heights, APART)
    differ = pieces[a] != pieces[b]
    one, other = np.sort(np.stack([pieces[a], pieces[b]])[:, differ], axis=0)
    count = int(pieces.max(initial=-1)) + 1
    key, off = one * count + other, np.abs(z[a] - z[b])[differ]
    order = np.lexsort((off, key))
    found, first, size = np.unique(key[order], return_index=True, return_counts=True)
    table = np.zeros((count, count), dtype=bool)
    stepped = found[off[order][first + size // 2] > DIFFERENT]
    table[stepped // count, stepped % count] = True
    return table | table.T


class _Grown(NamedTuple):
    """A level: its cells (N,), its heights everywhere, how much view it fills, and within how many
    metres it is on all sides of the foot."""

    on: BoolArray
    heights: Array
    weight: float
    around: float


def _levels(at: Array, heights: Array, radius: float) -> tuple[BoolArray, tuple[Level, ...]]:
    """Which cells (N, 3) are ground, and the levels beside it, from their heights in a grid."""
    pieces = _pieces(heights)
    for number in np.flatnonzero(np.bincount(pieces, minlength=1) > 2 * KERB_AREA / CELL**2):
        own = np.flatnonzero(pieces == number)
        pieces[own[_parted(at[own])]] = pieces.max() + 1
    size = np.bincount(pieces, minlength=1)
    weight = 1 / (np.sum(at[:, :2] ** 2, axis=1) + (radius / 4) ** 2)
    heavy = np.asarray(np.bincount(pieces, weight, minlength=1) * (size >= MIN_PIECE), np.float64)
    # The rough axes may lean along a step.
    _, lean = _grown(at, pieces, int(np.argmax(heavy)), 0.0 * heavy, np.zeros((0, 0), dtype=bool))
    straight = heights.copy()
    straight[np.isfinite(heights)] -= lean
    conflicts, found = _conflicts(straight, pieces), list[_Grown]()
    distance = np.hypot(at[:, 0], at[:, 1])
    for begin in np.argsort(-heavy)[:MOST_LEVELS].tolist():
        if not heavy[begin] or any(level.on[pieces == begin].any() for level in found):
            continue
        on, surface = _grown(at, pieces, begin, heavy, conflicts)
        within = [r for r in REACHES * radius if _is_around(at[on & (distance < r), :2])]
        found.append(_Grown(on, surface, weight[on].sum(), min(within, default=np.inf)))
    if not found:
        return np.zeros(len(at), dtype=bool), ()
    # The ground is what lies about the foot nearest to it; else what fills most of the view.
    found.sort(key=lambda level: (level.around, -level.weight))
    best = found[0]
    others = []
    for level in found[1:]:
        beside = level.on & (~best.on if (level.on & ~best.on).any() else level.on)
        height = float(np.median(at[beside, 2] - best.heights[beside]))
        others.append(Level(height, float(np.count_nonzero(beside)) * CELL**2))
    for level, other in zip(found[1:], others, strict=True):
        reach = np.quantile(distance[level.on], NEAREST)
        doubtful = best.around > NEARER * reach
        off = (at[:, 2] - best.heights)[level.on & ~best.on]
        is_kerb = KERB[0] < abs(other.height) < KERB[1] and len(off) >= KERB_AREA / CELL**2
        if is_kerb and np.std(off) < PARALLEL and doubtful:
            raise Refusal(
                "two_grounds",
                f"two levels are seen, the other {100 * other.height:+.0f} cm higher on "
                f"{other.area:.0f} m²: which of them is below the LiDARs is not seen",
                {"height_m": other.height, "area_m2": other.area},
            )
    return best.on, tuple(sorted(others, key=lambda level: -level.area))


def _is_around(at: Array) -> bool:
    """Whether places (N, 2) lie on all sides of the middle: no gap of half a turn between them."""
    bearings = np.sort(np.arctan2(at[:, 1], at[:, 0]))
    gaps = np.diff(np.r_[bearings, bearings[:1] + 2 * np.pi])
    return len(at) > 2 and bool(gaps.max() < np.pi)


def _grown(
    at: Array, pieces: IntArray, begin: int, heavy: Array, conflicts: BoolArray
) -> tuple[BoolArray, Array]:
    """Which cells are of the level that a piece is of, and its heights everywhere."""
    table = np.c_[np.ones(len(at)), at[:, :2]]
    taken, on = [begin], pieces == begin

    def surface() -> Array:
        rows = table[on]
        ridge = np.diag([1e-6, RIDGE, RIDGE])
        return np.asarray(table @ np.linalg.solve(rows.T @ rows + ridge, rows.T @ at[on, 2]))

    for number in [int(k) for k in np.argsort(-heavy) if heavy[k] and k != begin]:
        if conflicts[number, taken].any():
            continue
        own = pieces == number
        if abs(np.median(at[own, 2] - surface()[own])) < SAME_LEVEL:
            taken.append(number)
            on = on | own
    return on, surface()


def _parted(at: Array) -> BoolArray:
    """Which cells (N, 3) are the upper of two parallel levels; none where they are not two.

    Where rings are far apart, one that climbs along the face of a kerb links road and pavement.
    """
    table, upper = np.c_[np.ones(len(at)), at[:, :2]], at[:, 2] > np.median(at[:, 2])
    if len(at) < 2 * KERB_AREA / CELL**2:
        return np.zeros(len(at), dtype=bool)
    for _ in range(PARTING_ROUNDS):
        fit = np.linalg.lstsq(np.c_[table, upper], at[:, 2], rcond=None)[0]
        over = at[:, 2] - table @ fit[:3]
        found = np.abs(over - fit[3]) < np.abs(over)
        if (found == upper).all():
            break
        upper = found
    thick = np.sqrt(np.mean((over - fit[3] * upper) ** 2))
    if abs(fit[3]) < SAME_LEVEL or thick > PARTED * abs(fit[3]) or not 0.1 < upper.mean() < 0.9:
        return np.zeros(len(at), dtype=bool)
    return upper


def _on_cells(points: Array, heights: Array, corner: Array) -> BoolArray:
    """Which points (N, 3) lie on ground of heights (n, m), or beside a cell of it, near its height.

    Noise along the beams puts returns into the next cell: without them the others would be biased.
    """
    near = np.stack([_shifted(heights, i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    known = np.isfinite(near)
    total = np.where(known, near, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    wide = np.where(np.isfinite(heights), heights, np.where(known.any(axis=0), total, np.nan))
    at = np.floor((points[:, :2] - corner) / CELL).astype(np.int64)
    inside = np.all((at >= 0) & (at < wide.shape), axis=1)
    on = np.zeros(len(points), dtype=bool)
    with np.errstate(invalid="ignore"):
        on[inside] = np.abs(points[inside, 2] - wide[tuple(at[inside].T)]) < FLAT
    return on


def viewer_of(name: str, cloud: PointCloud, T: Array, sizes: Sizes) -> Viewer:
    """Take a LiDAR with the averages of its sweeps."""
    return Viewer(name, averaged(cloud), T, sizes)
