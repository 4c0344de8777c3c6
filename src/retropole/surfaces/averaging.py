"""Averages over the sweeps of a stationary LiDAR: more sweeps, less noise.

The returns of all sweeps scatter along their beams. Where rings are far from each other, those of
one ring fill the cone of that ring with their noise, and planes through them are planes of the
cone. The mean of returns on a plane lies on that plane, whatever directions they came from: of a
LiDAR that moved, after its motion was taken out, and of one that never repeats a direction.

All that looks at surfaces looks at these averages; only the returns on poles count one by one.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from ..base.datatypes import Array, IntArray, PointCloud
from ..base.se3 import lengths
from .sweeps import order_of

AZIMUTH_CELL, ELEVATION_CELL = float(np.radians(0.2)), float(np.radians(0.1))
"""Returns of several sweeps in a cell of the beams' directions, rad, are of one place: it is as
wide as the steps of most LiDARs' azimuths, and as high as the least between rings. Rings that are
known have cells of their own."""

GAP, GAP_BY_RANGE = 0.15, 0.01
"""… unless a gap parts them along the beams, metres and as a part of the range: an edge."""

BIN = 0.01
"""Ranges are sorted as precisely as that, metres: far less than any gap."""


_averages: WeakKeyDictionary[PointCloud, PointCloud] = WeakKeyDictionary()
"""Of clouds that are in use: every step asks for them."""


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
    if cloud not in _averages:
        _averages[cloud] = _averaged(cloud)
    return _averages[cloud]


def _averaged(cloud: PointCloud) -> PointCloud:
    order, starts = _by_place(cloud)
    count = np.diff(np.r_[starts, len(order)])
    columns = [np.add.reduceat(column[order], starts) / count for column in cloud.xyz.T]
    return PointCloud(
        np.stack(columns, axis=1),
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
    azimuth = np.arctan2(rays @ np.cross(cloud.axis, side), rays @ side)
    elevation = np.arcsin(np.clip(rays @ cloud.axis / np.maximum(ranges, 1e-9), -1.0, 1.0))
    # Rings that lie at even elevations lie in the middle of cells.
    row = _numbered(elevation / ELEVATION_CELL + 0.5 if cloud.ring is None else cloud.ring)
    column, depth = _numbered(azimuth / AZIMUTH_CELL), _numbered(ranges / BIN)
    direction = row * (int(column.max()) + 1) + column
    order = order_of(direction * (int(depth.max()) + 1) + depth)
    direction, ranges = direction[order], ranges[order]
    parted = np.diff(ranges) > GAP + GAP_BY_RANGE * ranges[:-1]
    return order, np.flatnonzero(np.r_[True, (np.diff(direction) != 0) | parted])


def _numbered(values: Array | IntArray) -> IntArray:
    """Whole numbers (N,) of values, from 0."""
    found = np.floor(values).astype(np.int64)
    return np.asarray(found - found.min())
