"""Averages over the sweeps of a stationary LiDAR: more sweeps, less noise.

The returns of all sweeps scatter along their beams. Where rings are far from each other, those of
one ring fill the cone of that ring with their noise, and planes through them are planes of the
cone. The mean of returns on a plane lies on that plane, whatever directions they came from: of a
LiDAR that moved, after its motion was removed, and of one that never repeats a direction.

All that looks at surfaces looks at these averages; only the returns on poles count one by one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import Array, IntArray, PointCloud, kept
from ..base.se3 import lengths
from .sweeps import order_of

AZIMUTH_CELL, ELEVATION_CELL = float(np.radians(0.2)), float(np.radians(0.1))
"""Returns of several sweeps in a cell of the beams' directions, rad, are of one place: it is as
wide as the steps of most LiDARs' azimuths, and as high as the least between rings. Rings that are
known have separate cells."""

DEPTH_TOLERANCE, GAP_BY_RANGE = 0.15, 0.01
"""Depths agree within this, metres. A gap that is larger, by more than this part of the range,
parts the returns along the beams: an edge. With twice the part, refined poses of four sweeps move
by up to 1 σ, and their σ by a quarter."""

BIN = 0.01
"""Ranges are sorted as precisely as that, metres: far less than any gap."""


def averaged(cloud: PointCloud) -> PointCloud:
    """Average the returns of all sweeps by the direction of their beams.

    Parameters
    ----------
    cloud
        Of a stationary LiDAR. A single sweep is returned as it is.

    Returns
    -------
    PointCloud
        Points and rings, in no order, with the same origin and axis.
    """
    if cloud.frame is None or not len(cloud) or cloud.frame.min() == cloud.frame.max():
        return cloud
    return _averaged(cloud)


@kept
def _averaged(cloud: PointCloud) -> PointCloud:
    order, starts = _by_place(cloud)
    count = np.diff(np.r_[starts, len(order)])
    # Column by column: all of them at once would be most of the memory of a long recording.
    xyz = np.empty((len(starts), 3))
    for column, mean in zip(cloud.xyz.T, xyz.T, strict=True):
        mean[:] = np.add.reduceat(column.take(order), starts) / count
    return PointCloud(
        xyz,
        ring=None if cloud.ring is None else cloud.ring[order[starts]],
        origin=cloud.origin,
        axis=cloud.axis,
    )


def _by_place(cloud: PointCloud) -> tuple[IntArray, IntArray]:
    """Order (N,) of the returns in which those of one place follow each other, and (M,) where the
    next begins."""
    rays = cloud.xyz - cloud.origin
    ranges = lengths(rays)
    side = np.cross([0.0, 1.0, 0.0] if abs(cloud.axis[1]) < 0.9 else [0.0, 0.0, 1.0], cloud.axis)
    column = _numbered(np.arctan2(rays @ np.cross(cloud.axis, side), rays @ side) / AZIMUTH_CELL)
    # Rings that lie at even elevations lie in the middle of cells.
    if cloud.ring is None:
        sine = rays @ cloud.axis / np.maximum(ranges, 1e-9)
        row = _numbered(np.arcsin(np.clip(sine, -1.0, 1.0)) / ELEVATION_CELL + 0.5)
    else:
        row = _numbered(cloud.ring)
    del rays
    direction = row * (column.max() + 1) + column
    depth = _numbered(ranges / BIN)
    order = order_of(direction * np.int64(depth.max() + 1) + depth)
    direction, ranges = direction[order], ranges[order]
    parted = np.diff(ranges) > DEPTH_TOLERANCE + GAP_BY_RANGE * ranges[:-1]
    return order, np.flatnonzero(np.r_[True, (np.diff(direction) != 0) | parted])


def _numbered(values: Array | IntArray) -> NDArray[np.int32]:
    """Whole numbers (N,) of values, from 0."""
    found = np.floor(values)
    return np.asarray(found - found.min()).astype(np.int32)
