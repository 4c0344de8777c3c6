"""Sweeps of several LiDARs in one frame: fused, cropped, and thinned to one point a voxel.

A sweep is taken as recorded at one moment: where the LiDARs move, nothing is corrected for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.errors import UsageError
from ..surfaces.static import keys_of, usual_ranges
from ..surfaces.visibility import cells_of, nearest_around, range_margin

POINT = np.dtype(
    [
        *(("xyz", np.float64, 3), ("time", np.float64), ("intensity", np.float32)),
        *(("ring", np.uint16), ("lidar", np.uint16)),
    ]
)
"""A point of a fused cloud: place, metres; time, s, and intensity, NaN if not known; ring; index
of its LiDAR."""

NO_RING = 2**16 - 1
"""Number of a ring that is not known."""

Points = NDArray[np.void]
"""Fused points (N,), of `POINT`."""

Rows = NDArray[Any]
"""One row for each cell."""


def fused(cloud: PointCloud, T_frame_lidar: Array, lidar: int = 0) -> Points:
    """Bring a sweep of one LiDAR to the frame of all: ``p_frame = T_frame_lidar p_lidar``.

    Parameters
    ----------
    cloud
        In the frame of the LiDAR.
    T_frame_lidar
        (4, 4) pose of the LiDAR.
    lidar
        Its index.

    Returns
    -------
    Points
        (N,) in the order of the cloud.
    """
    points = np.empty(len(cloud), POINT)
    rotation, place = T_frame_lidar[:3, :3], T_frame_lidar[:3, 3]
    for axis in range(3):
        points["xyz"][:, axis] = cloud.xyz @ rotation[axis] + place[axis]
    points["time"] = np.nan if cloud.time is None else cloud.time
    points["intensity"] = np.nan if cloud.intensity is None else cloud.intensity
    points["ring"] = NO_RING
    if cloud.ring is not None:
        is_ring = (cloud.ring >= 0) & (cloud.ring < NO_RING)
        points["ring"][is_ring] = cloud.ring[is_ring]
    points["lidar"] = lidar
    return points


def joined_points(parts: Sequence[Points]) -> Points:
    """Join fused points (N,): as bytes, which is ten times as fast as field by field."""
    return np.concatenate([part.view(np.uint8) for part in parts]).view(POINT)


def inside(xyz: Array, box: Array) -> BoolArray:
    """Find the points (N,) within a box (2, 3), its lower and its upper corner included."""
    return np.asarray(((xyz >= box[0]) & (xyz <= box[1])).all(axis=1))


def usual_view(sweeps: Iterable[PointCloud]) -> Array:
    """Find how far a LiDAR at rest usually sees in each direction, (E, A) metres.

    By half of the sweeps that saw anything there; infinite where none did. See `is_static`.
    """
    views = [
        nearest_around(cells_of(rays), se3.lengths(rays)).ranges
        for rays in (cloud.xyz - cloud.origin for cloud in sweeps)
    ]
    return usual_ranges(np.stack(views))


def is_static(cloud: PointCloud, usual: Array) -> BoolArray:
    """Find the returns (N,) that are no nearer than the LiDAR usually sees in their direction.

    The test of `surfaces.static`, with what is usual taken from sweeps of before and after.
    """
    rays = cloud.xyz - cloud.origin
    ranges = se3.lengths(rays)
    beyond = usual[cells_of(rays)]
    return np.asarray((beyond <= ranges + range_margin(ranges)) | np.isinf(beyond))


HALF = 2**18
"""Cells that a grid has from its middle to either end, along each axis."""

LIDARS = 2**5
"""Number of LiDARs that may have separate cells in a grid: as many as bits of a number in
PLY."""


def cell_keys(xyz: Array, size: float, anchor: IntArray, lidar: IntArray | int = 0) -> IntArray:
    """Number (N,) the cubes that points lie in, of a side of `size` metres.

    Parameters
    ----------
    xyz, size
        (N, 3) and the side, metres.
    anchor
        (3,) cell in the middle of the grid: the cube from ``anchor · size`` on.
    lidar
        (N,) index of the LiDAR of each, to give each LiDAR separate cells.

    Raises
    ------
    UsageError
        If a point is farther than `HALF` cells from the middle.
    """
    cells = np.floor(xyz / size).astype(np.int64) - anchor
    if len(cells) and np.abs(cells).max() >= HALF:
        raise UsageError(
            f"a point lies {np.abs(cells).max() * size:,.0f} m from the first ones, with cells of "
            f"{size:g} m at most {HALF * size:,.0f} m are possible: use larger ones, or --crop"
        )
    key = np.zeros(len(cells), np.int64)
    for axis in range(3):
        key = key * (2 * HALF) + (cells[:, axis] + HALF)
    return np.asarray(key * LIDARS + lidar)


def cells_at(keys: IntArray, anchor: IntArray) -> IntArray:
    """Undo `cell_keys`: the cells (N, 3)."""
    found, rest = np.empty((len(keys), 3), np.int64), keys // LIDARS
    for axis in (2, 1, 0):
        found[:, axis] = rest % (2 * HALF) - HALF
        rest = rest // (2 * HALF)
    return found + anchor


class Kept(NamedTuple):
    """Keys (M,), ascending, and a row for each."""

    keys: IntArray
    rows: Rows


Combine = Callable[[IntArray, Rows], Kept]
"""From keys in any order, with a row each, to one row a key."""

BUFFER = 2**19
"""Rows that wait at least before they are combined with all: 20 MB of points."""


class Grid:
    """One row for each cell over a stream of any length: memory follows the cells.

    Parameters
    ----------
    combine
        Makes one row of those of a cell. It must not matter in which order and groups.
    """

    def __init__(self, combine: Combine) -> None:
        self.combine = combine
        self._parts: list[Kept] = []

    def add(self, keys: IntArray, rows: Rows) -> None:
        """Add rows, one for each key."""
        self._parts.append(self.combine(keys, rows))
        first, *rest = (len(part.keys) for part in self._parts)
        # What waits is as much as is there, so that the work for each row is logarithmic.
        if sum(rest) > max(BUFFER, first // 2):
            self.all()

    def all(self) -> Kept:
        """Give all cells; none where nothing was added."""
        if not self._parts:
            return Kept(np.zeros(0, np.int64), np.zeros(0))
        if len(self._parts) > 1:
            keys, rows = zip(*self._parts, strict=True)
            self._parts = []
            self._parts = [self.combine(np.concatenate(keys), np.concatenate(rows))]
        return self._parts[0]


def one_of_each(keys: IntArray, points: Rows) -> Kept:
    """Keep one of the points of each cell: that of the least hash, whatever their order.

    Each has the same chance, so that it is biased towards no side of the cell; and it is a point
    that was measured, with its time, ring and intensity.
    """
    by = np.column_stack([points["xyz"], points["time"], points["lidar"].astype(np.float64)])
    order = np.lexsort((keys_of(by), keys))
    first = order[np.flatnonzero(np.diff(keys[order], prepend=np.int64(-1)))]
    return Kept(keys[first], points[first])


def summed(keys: IntArray, rows: Rows) -> Kept:
    """Add up the rows of each cell."""
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.diff(keys, prepend=np.int64(-1)))
    return Kept(keys[starts], np.add.reduceat(rows[order], starts, axis=0) if len(keys) else rows)


def voxels(sweeps: Iterable[Points], size: float) -> Points:
    """Thin fused sweeps to one point a voxel (`one_of_each`), by the order of the voxels.

    Parameters
    ----------
    sweeps
        Taken one at a time.
    size
        Side of a voxel, metres; their corners are multiples of it.

    Raises
    ------
    UsageError
        As `cell_keys`.
    """
    grid, anchor = Grid(one_of_each), None
    for points in sweeps:
        if len(points):
            xyz = points["xyz"]
            anchor = np.floor(xyz[0] / size).astype(np.int64) if anchor is None else anchor
            grid.add(cell_keys(xyz, size, anchor), points)
    return np.zeros(0, POINT) if anchor is None else grid.all().rows
