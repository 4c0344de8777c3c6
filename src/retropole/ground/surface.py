"""The returns of the ground: one surface without steps, below the LiDARs.

A plane that most returns lie on gives rough axes. In squares of `CELL` that are flat, heights are
known; `steps` finds the squares of one level, and the ground is formed by the returns near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.errors import Refusal
from ..base.systematic import Sizes
from ..surfaces.averaging import DEPTH_TOLERANCE, averaged
from ..surfaces.consistency import MAX_TILT, VOXEL, ground_plane
from ..surfaces.registration import voxel_downsample
from .steps import CELL, Level, at_steps, is_around, levels, plane_of_cells

LOW, HIGH = 0.1, 0.9
"""Quantiles of the heights in a cell that are treated as its bottom and its top: single returns
err."""

FLAT = 0.06
"""Bottom and top of a square of ground differ by no more, metres: less than the least
kerb, 0.08 m, and as much as noise of 1 cm on a slope of 6 % makes."""

MIN_RETURNS = 3
"""Minimum number of returns in a square of ground: single ones may be on the face of a kerb."""

MARGIN = 2
"""Squares this near to those of another level are left out: returns may be on the face of a
kerb."""

MIN_CLEAR = 0.1
"""Minimum height of LiDARs above the ground, metres."""

OTHER_SIDE = 3.0
"""A plane on the side of the LiDAR's −z axis is the ground, unless there are this many times as
many places on one on the other side: a floor has a ceiling over it, a LiDAR may be mounted upside
down."""


UPRIGHT = 0.1
"""Sine of the angle to the ground's normal below which an axis has no direction along it."""


@dataclass(frozen=True, eq=False)
class Viewer:
    """One LiDAR that sees the ground.

    Attributes
    ----------
    name, cloud, sizes
        Its name, its recording in its own frame, and the sizes of its errors.
    T
        (4, 4) its pose in the frame of all.
    """

    name: str
    cloud: PointCloud
    T: Array
    sizes: Sizes

    @property
    def origin(self) -> Array:
        """(3,) beam origin, in the frame of all."""
        return np.asarray(se3.apply(self.T, self.cloud.origin[None])[0])


@dataclass(frozen=True, eq=False)
class Ground:
    """The ground that LiDARs see.

    Attributes
    ----------
    T_rough_frame
        (4, 4) rough axes: z up, the origin on the ground in the middle below the LiDARs.
    points
        For each LiDAR the index of its returns on the ground.
    centre, radius
        (2,) of the disc to which the plane is fitted, rough axes, and its radius, metres: about the
        foot of the LiDARs; if none sees ground on all sides of it, about the middle of the visible
        ground.
    area
        Of the squares of ground that are seen in the disc, m².
    spread
        Least root mean square distance of these from a line through their middle, metres.
    beside
        (n, 2) middles of the squares of the level that is a step higher or lower, rough axes.
    others
        Levels next to it, the largest first.
    ceiling
        Height of a plane above the LiDAR that was not treated as ground, metres; None without.
    """

    T_rough_frame: Array
    points: tuple[IntArray, ...]
    centre: Array
    radius: float
    area: float
    spread: float
    beside: Array
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
        Of the disc of interest below each, metres.
    axes
        (4, 4) rough axes and the height of a ceiling, where they are known.

    Raises
    ------
    Refusal
        ``too_little_ground`` where nothing level is seen below them; ``two_grounds`` where two
        levels are, and no observation shows which of them is below.
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
    middle[at_steps(middle)] = np.nan
    rows = np.stack(np.nonzero(np.isfinite(middle)), axis=1)
    at = np.c_[corner + (rows + 0.5) * CELL, middle[np.isfinite(middle)]]
    on, other_level, others = levels(at, radius)
    if not on.any():
        raise little(0.0, 0.0, radius)
    off = at[other_level, 2] - plane_of_cells(at, on)[other_level]
    thick = min(FLAT, abs(float(np.median(off))) / 2) if other_level.any() else FLAT
    middle[tuple(rows[~on].T)] = np.nan
    level = _wide(middle, tuple(rows[other_level].T))
    kept = tuple(k[_is_near(p[k], level, corner, thick)] for p, k in zip(points, near, strict=True))
    centre = np.zeros(2) if is_around(at[on, :2]) else at[on, :2].mean(axis=0)
    ground = at[on & (se3.lengths(at - np.r_[centre, 0.0]) < radius)]
    spread = 0.0
    if len(ground) > 1:
        spread = np.sqrt(max(np.linalg.eigvalsh(np.cov(ground[:, :2].T))[0], 0.0))
    area = len(ground) * CELL**2
    return Ground(
        rough, kept, centre, radius, area, float(spread), at[other_level, :2], others, ceiling
    )


def little(area: float, spread: float, radius: float) -> Refusal:
    """Report that too little ground is seen: m², metres."""
    return Refusal(
        "too_little_ground",
        f"{area:.1f} m² of ground are seen within {radius:.0f} m, {spread:.1f} m wide (root "
        "mean square across the narrowest direction)",
        {"area_m2": area, "spread_m": spread, "radius_m": radius},
    )


def _rough_axes(viewers: Sequence[Viewer]) -> tuple[Array, float | None]:
    """(4, 4) rough axes on the plane with most returns, and the height of a ceiling, or None."""
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
            f"no plane is within {np.degrees(MAX_TILT):.0f}° of level for the LiDAR {first.name}",
            {"area_m2": 0.0},
        )
    if above > OTHER_SIDE * below:
        return turned, None
    return usual, height if OTHER_SIDE * above > below else None


def level_axes(up: Array) -> Array:
    """(3, 3) rows x, y, z, in a frame: z up (3,), and x that of the frame projected to the ground.

    If that is vertical, the direction at right angles to the frame's y is used.
    """
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    if np.linalg.norm(x) < UPRIGHT:
        x = np.cross([0.0, 1.0, 0.0], up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def cells_of(points: Array, side: float) -> tuple[Array, Array, IntArray, Array]:
    """Bottom and top of the returns in each cell, their number, and the corner (2,) of all.

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


def _wide(heights: Array, beside: tuple[IntArray, ...]) -> Array:
    """(n, m) heights of the ground, continued by a cell; cells of another level are at `beside`.

    Noise along the beams puts returns into the next cell: without them the others would be biased.
    At a step the returns on its face would be included: there it is not continued, but ends
    before it.
    """
    known, square = np.isfinite(heights), np.ones((3, 3))
    count = ndimage.convolve(known.astype(np.int64), square, mode="constant")
    total = ndimage.convolve(np.where(known, heights, 0.0), square, mode="constant")
    with np.errstate(invalid="ignore"):
        total /= count
    wide, other = np.where(known, heights, total), np.zeros(heights.shape, dtype=bool)
    if len(beside[0]):
        other[beside] = True
        closed = ndimage.binary_closing(known, square)
        wide[~closed | ndimage.binary_dilation(other, square, iterations=MARGIN)] = np.nan
    return np.asarray(wide)


def _is_near(points: Array, heights: Array, corner: Array, thick: float) -> BoolArray:
    """Which points (N, 3) are near the heights (n, m) of their cells."""
    at = np.floor((points[:, :2] - corner) / CELL).astype(np.int64)
    inside = np.all((at >= 0) & (at < heights.shape), axis=1)
    on = np.zeros(len(points), dtype=bool)
    with np.errstate(invalid="ignore"):
        on[inside] = np.abs(points[inside, 2] - heights[tuple(at[inside].T)]) < thick
    return on


def viewer_of(name: str, cloud: PointCloud, T: Array, sizes: Sizes) -> Viewer:
    """Make a viewer from the averages of a LiDAR's sweeps."""
    return Viewer(name, averaged(cloud), T, sizes)
