"""Levels of the ground: squares without a step between them, and the level below the LiDARs.

Neighbouring squares whose heights hardly differ make pieces; pieces on one smooth surface make a
level. A road and the pavement behind its kerb are two levels; the roofs of cars are others. The
ground is the level that surrounds the foot of the LiDARs at the smallest distance. If another is
next to it, a step higher or lower, the squares of both are split again, by two parallel planes,
and the line of the step shows on which of them the foot is: a kerb is a line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..base.datatypes import Array, BoolArray, IntArray
from ..base.errors import Refusal

CELL = 0.5
"""Side of a square of the ground, metres."""

STEP, SLOPE = 0.03, 0.04
"""Between squares of one piece the height changes by no more than this, metres, and by this part
of their distance, to 0.07 m a metre away: less than a kerb, more than a road's camber."""

REACH = 2
"""Largest distance of neighbouring squares along both axes: between two rings some are
empty."""

MIN_PIECE = 4
"""Pieces of fewer squares are left out: 1 m²."""

EDGE, SIDE = 0.05, 3
"""A square is on a step if the ground on both sides, extrapolated from this many squares
each, differs there in height by more, metres. A kerb of 0.08 m makes 0.06 m where a ring crosses
it at 45°, a change of the slope by 10 %, 0.04 m."""

CLOSED = 1
"""Gaps of up to twice this many squares in the line of a step are closed: few rings show it
completely. Two kerbs at 3 m distance stay two."""

SEPARATION, DIFFERENT = 4, 0.06
"""Pieces that are within this many squares of each other are different levels if the median
difference of their heights there is larger, metres."""

SAME_LEVEL = 0.06
"""A piece belongs to a level if the median of its heights is this near to its surface, metres."""

RIDGE = 10.0
"""Weight with which a level is kept parallel to the rough axes, cells times m²."""

SPLIT, PARTING_ROUNDS = 0.2, 20
"""Two levels are distinguished in one piece if their combined thickness, root mean square, is
below this part of the step between them; and rounds of splitting it."""

LEAST_SPLIT = 80
"""Pieces of more squares may consist of two levels: 10 m² of each."""

LEAST_SHARE = 0.05
"""Least share of the smaller of them."""

MOST_LEVELS = 6
"""Number of the largest pieces that are tried as a start of the ground."""

KERB, PARALLEL = (0.05, 0.5), 0.04
"""A level higher or lower by this much, metres, and parallel, root mean square, may be the ground
as well, a road next to a pavement,"""

KERB_AREA = 10.0
"""… and seen on this much, m², where no step is seen between them,"""

NEAREST, NEARER = 0.05, 0.6
"""… where the ground is not on all sides of the foot at this part of the distance of that level, of
which this much is nearer."""

ABRUPT, PAIRS, FARTHEST = 0.75, 20, 4.0
"""At a step, levels differ by this part of their distance in the middle of this many nearest
pairs of squares, no farther than this, metres: 0.9 at kerbs, 0.4 to 0.6 on cambers that two planes
fit (seeds 0 to 199, 3065 and 3181 of the benchmark)."""

STRIP, STRIP_TURNS = 0.5, 90
"""Width of strips along a kerb, metres, and directions of them that are tried over half a turn."""

STRAYS, ALIKE = 0.05, 0.01
"""Part of the squares that may be of the other level than the rest of their strip, and by which
directions are treated as equal."""

REACHES = np.linspace(0.1, 2.0, 20)
"""Distances within which a level may lie on all sides of the foot, as parts of the radius."""


@dataclass(frozen=True)
class Level:
    """Another surface next to the ground.

    Attributes
    ----------
    height
        Above the ground, median, metres.
    area
        Of what is seen of it, m².
    """

    height: float
    area: float


def at_steps(heights: Array) -> BoolArray:
    """(n, m) cells at which the ground on both sides does not continue to the same height."""
    edge = np.zeros(heights.shape, dtype=bool)

    def moved(grid: Array, i: int, j: int) -> Array:
        return np.asarray(ndimage.shift(grid, (-i, -j), order=0, cval=np.nan))

    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)):
        three = np.stack([moved(heights, -k * j, k * i) for k in (-1, 0, 1)])
        count = np.isfinite(three).sum(axis=0)
        mean = np.where(count > 0, np.nansum(three, axis=0) / np.maximum(count, 1), np.nan)
        far = SIDE if i * j == 0 else SIDE - 1
        ahead = np.stack([moved(mean, k * i, k * j) for k in range(1, far + 1)])
        behind = np.stack([moved(mean, -k * i, -k * j) for k in range(1, far + 1)])
        slope = (ahead[-1] - ahead[0] + behind[0] - behind[-1]) / (2 * (far - 1))
        step = ahead.mean(axis=0) - behind.mean(axis=0) - slope * (far + 1)
        with np.errstate(invalid="ignore"):
            edge |= np.abs(step) > EDGE
    return np.asarray(ndimage.binary_closing(edge, np.ones((3, 3)), iterations=CLOSED))


def _pairs(at: Array, reach: int) -> IntArray:
    """(K, 2) which cells (N, 3) are within a reach of each other along both axes, in cells."""
    cells = np.floor(at[:, :2] / CELL)
    return np.asarray(cKDTree(cells).query_pairs(reach + 0.5, np.inf, output_type="ndarray"))


def _pieces(at: Array) -> IntArray:
    """(N,) number of the piece to which each cell (N, 3) belongs."""
    pairs = _pairs(at, REACH)
    a, b = at[pairs].swapaxes(0, 1)
    a, b = pairs[np.abs(a - b)[:, 2] < STEP + SLOPE * np.hypot(*(a - b)[:, :2].T)].T
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(len(at), len(at)))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _conflicts(at: Array, z: Array, pieces: IntArray) -> BoolArray:
    """(P, P) which pieces of cells (N, 3), of heights (N,), are next to each other with a step."""
    a, b = _pairs(at, SEPARATION).T
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
    """A level: its cells (N,), its heights everywhere, the part of the view that it fills, and the
    distance, metres, within which it is on all sides of the foot."""

    on: BoolArray
    heights: Array
    weight: float
    around: float


def levels(at: Array, radius: float) -> tuple[BoolArray, BoolArray, tuple[Level, ...]]:
    """Find the cells of the ground, and the levels next to it.

    Parameters
    ----------
    at
        (N, 3) middles of the cells, the foot of the LiDARs at 0.
    radius
        Of the disc of interest, metres.

    Returns
    -------
    on, beside
        (N,) cells of the ground, and of the level that is a step higher or lower.
    others
        All levels but the ground, the largest first.

    Raises
    ------
    Refusal
        ``two_grounds``.
    """
    none, pieces = np.zeros(len(at), dtype=bool), _pieces(at)
    for number in np.flatnonzero(np.bincount(pieces, minlength=1) > LEAST_SPLIT):
        own = pieces == number
        if split := _split(at, own, [at[:, 2] > np.median(at[own, 2])]):
            pieces[own & ~split[0]] = pieces.max() + 1
    size = np.bincount(pieces, minlength=1)
    weight = 1 / (np.sum(at[:, :2] ** 2, axis=1) + (radius / 4) ** 2)
    heavy = np.asarray(np.bincount(pieces, weight, minlength=1) * (size >= MIN_PIECE), np.float64)
    # The rough axes may lean along a step.
    _, lean = _grown(at, pieces, int(np.argmax(heavy)), 0.0 * heavy, np.zeros((0, 0), dtype=bool))
    over = at[:, 2] - lean
    conflicts, found = _conflicts(at, over, pieces), list[_Grown]()
    distance = np.hypot(at[:, 0], at[:, 1])
    for begin in np.argsort(-heavy)[:MOST_LEVELS].tolist():
        if not heavy[begin] or any(level.on[pieces == begin].any() for level in found):
            continue
        on, surface = _grown(at, pieces, begin, heavy, conflicts)
        within = [r for r in REACHES * radius if is_around(at[on & (distance < r), :2])]
        found.append(_Grown(on, surface, weight[on].sum(), min(within, default=np.inf)))
    if not found:
        return none, none, ()
    # The ground is the level around the foot at the smallest distance; else the one that fills
    # most of the view.
    best, *rest = sorted(found, key=lambda level: (level.around, -level.weight))
    on, left, others = best.on, none, list[Level]()
    for level in rest:
        other_level = level.on & ~best.on
        if not other_level.any():
            continue
        other = _level(at[:, 2] - best.heights, other_level)
        touching = conflicts[
            np.ix_(np.unique(pieces[best.on]), np.unique(pieces[other_level]))
        ].any()
        if touching and not left.any() and KERB[0] < abs(other.height) < KERB[1]:
            two = _along_kerb(at, best, level, over, other)
            if two is not None:
                on, left = two
                other = _level(at[:, 2] - plane_of_cells(at, on), left)
        others.append(other)
    return on, left, tuple(sorted(others, key=lambda level: -level.area))


def _level(over: Array, on: BoolArray) -> Level:
    """Some cells as a level, by their heights (N,) over the ground."""
    return Level(float(np.median(over[on])), float(np.count_nonzero(on)) * CELL**2)


def _along_kerb(
    at: Array, best: _Grown, level: _Grown, over: Array, other: Level
) -> tuple[BoolArray, BoolArray] | None:
    """Which cells (N,) are ground, and which are of the level a step from it; None without a kerb.

    `best` and `level` are a first guess; heights (N,) are over a plane without lean.
    """
    both, other_level = best.on | level.on, level.on & ~best.on
    upper = other_level if other.height > 0 else ~other_level
    halfway = (np.median(over[best.on]) + np.median(over[other_level])) / 2
    split = _split(at, both, [upper, over > halfway])
    is_parallel = np.std((at[:, 2] - best.heights)[other_level]) < PARALLEL
    two = split or (both & ~upper, both & upper)
    is_step = _is_step(at, *two)
    if not (split and is_step) and not is_parallel:
        return None
    is_upper = _below(at[:, :2], *two) if is_step else None
    if is_upper is None:
        near = np.quantile(np.hypot(at[level.on, 0], at[level.on, 1]), NEAREST)
        if best.around > NEARER * near and (is_step or other.area > KERB_AREA):
            raise Refusal(
                "two_grounds",
                f"two levels are seen, the other {100 * other.height:+.0f} cm higher on "
                f"{other.area:.0f} m²: which of them is below the LiDARs cannot be seen",
                {"height_m": other.height, "area_m2": other.area},
            )
        if not is_step:
            return None
        is_upper = other.height < 0
    return (two[1], two[0]) if is_upper else two


def _is_step(at: Array, lower: BoolArray, upper: BoolArray) -> bool:
    """Whether two levels differ as much at their nearest squares as on average, unlike a slope."""
    away, nearest = cKDTree(at[upper, :2]).query(at[lower, :2])
    near = np.argsort(away)[:PAIRS]
    near = near[away[near] < FARTHEST]
    if len(near) < MIN_PIECE:
        return False
    rise = at[upper, 2][nearest[near]] - at[lower, 2][near]
    step = np.median((at[:, 2] - plane_of_cells(at, lower))[upper])
    return bool(step > KERB[0] and np.median(rise) > ABRUPT * step)


def _below(at: Array, lower: BoolArray, upper: BoolArray) -> bool | None:
    """Whether the upper of two levels is below the middle of places (N, 2); None if not known.

    A kerb is a line: the levels seen along it, in the strip that contains the middle, continue
    there.
    """
    mixed, here = [], []
    for turn in np.arange(STRIP_TURNS) * np.pi / STRIP_TURNS:
        strip = np.rint(at @ [-np.sin(turn), np.cos(turn)] / STRIP).astype(np.int64)
        middle, count = -int(strip.min()), int(np.ptp(strip)) + 1
        counts = np.stack(
            [np.bincount(strip[own] + middle, minlength=count) for own in (lower, upper)]
        )
        mixed.append(counts.min(axis=0).sum())
        here.append(counts[:, max(middle - 1, 0) : max(middle + 2, 0)].sum(axis=1))
    least, size = min(mixed), min(np.count_nonzero(lower), np.count_nonzero(upper))
    along = np.array(mixed) <= least + ALIKE * size
    there = np.sum(np.array(here)[along], axis=0)
    if least > STRAYS * size or max(h.sum() for h in np.array(here)[along]) < MIN_PIECE:
        return None
    return bool(there[1] > there[0]) if there.min() <= STRAYS * there.sum() else None


def is_around(at: Array) -> bool:
    """Whether places (N, 2) lie on all sides of the middle: no gap of half a turn between them."""
    bearings = np.sort(np.arctan2(at[:, 1], at[:, 0]))
    gaps = np.diff(np.r_[bearings, bearings[:1] + 2 * np.pi])
    return len(at) > 2 and bool(gaps.max() < np.pi)


def _grown(
    at: Array, pieces: IntArray, begin: int, heavy: Array, conflicts: BoolArray
) -> tuple[BoolArray, Array]:
    """Which cells belong to the level of a piece, and its heights everywhere."""
    taken, on = [begin], pieces == begin
    for number in [int(k) for k in np.argsort(-heavy) if heavy[k] and k != begin]:
        if conflicts[number, taken].any():
            continue
        own = pieces == number
        if abs(np.median((at[:, 2] - plane_of_cells(at, on))[own])) < SAME_LEVEL:
            taken.append(number)
            on = on | own
    return on, plane_of_cells(at, on)


def plane_of_cells(at: Array, on: BoolArray) -> Array:
    """(N,) heights at all cells (N, 3) of the plane of some."""
    table, ridge = np.c_[np.ones(len(at)), at[:, :2]], np.diag([1e-6, RIDGE, RIDGE])
    rows = table[on]
    return np.asarray(table @ np.linalg.solve(rows.T @ rows + ridge, rows.T @ at[on, 2]))


def _split(
    at: Array, both: BoolArray, guesses: Sequence[BoolArray]
) -> tuple[BoolArray, BoolArray] | None:
    """Which cells (N, 3) are of the lower and the upper of two parallel levels; None of one.

    If rings are far from each other, one that climbs along the face of a kerb links road
    and pavement. Cells between the levels belong to none. From the guesses (N,) of the upper the
    best is found.
    """
    own = at[both]
    table, found = np.c_[np.ones(len(own)), own[:, :2]], []
    for guess in guesses:
        upper = guess[both]
        for _ in range(PARTING_ROUNDS):
            fit = np.linalg.lstsq(np.c_[table, upper], own[:, 2], rcond=None)[0]
            over = own[:, 2] - table @ fit[:3]
            before, upper = upper, np.abs(over - fit[3]) < np.abs(over)
            if (before == upper).all():
                break
        off = over - fit[3] * upper
        found.append((np.sqrt(np.mean(off**2)), fit[3], off, upper))
    thick, step, off, upper = min(found, key=lambda each: each[0])
    share = min(upper.mean(), 1 - upper.mean())
    if abs(step) < SAME_LEVEL or thick > SPLIT * abs(step) or share < LEAST_SHARE:
        return None
    clear, levels = np.abs(off) < abs(step) / 3, np.zeros((2, len(at)), dtype=bool)
    levels[0, both], levels[1, both] = clear & (upper == (step < 0)), clear & (upper == (step > 0))
    return levels[0], levels[1]
