"""The rings of a cloud that has lost them, and where its beams start, from its points alone.

Many programs write nothing but points. Returns of one ring still follow each other more closely
than those of two: chains of nearest neighbours are pieces of rings, whose cones have their apex and
their axis in common. About these the elevations of all points lie on as many levels as the LiDAR
has rings. A wrong apex gives no levels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..base.datatypes import Array, IntArray, PointCloud, every_nth, kept
from ..base.se3 import lengths
from ..base.sensors import Sensor
from .beams import (
    CONE_SPREAD,
    MAX_RINGS,
    MIN_RING_POINTS,
    MOST,
    Cones,
    densest,
    elevations,
    fit_cones,
)

CHAIN_SAMPLE = 600
"""Points of chains that the cones are fitted to: a fit takes 10 ms then."""

START_DISTANCE = 3.0
"""One distance from the middle of the points at which the apex is looked for, metres."""

LEVEL_SPREAD, LEVEL_GAP = float(np.radians(0.002)), float(np.radians(0.02))
"""Points of one level lie within the first of its middle, rad, and levels farther from each other
than the second. Drivers compute points from the angles of the beams: 0.0004° on a Pandar64; the
rings of the densest LiDARs of the table of sensors differ by 0.1°. About a wrong apex, on the axis
of the circles on a floor, range noise leaves 0.008° and more (staged clouds of
benchmarks/detection.py, seeds 1 and 2)."""

MAX_LEVEL_SHARE, FARTHER = 0.5, 1.5
"""Of the points, at most this many are on one ring, and some are this many times as far away as
others: from close to a plane, or from far away, all have one elevation. Points within 4 m of a
place that is 3 to 8 m away have 1.7 of the second."""


def with_rings(cloud: PointCloud, sensor: Sensor | None) -> PointCloud:
    """Give a cloud the rings that its points alone show, unless the named sensor has none."""
    return with_rings_shown(cloud) if sensor is None or sensor.rings else cloud


@kept
def with_rings_shown(cloud: PointCloud) -> PointCloud:
    """Give a cloud without rings those that its points show, and the origin and axis of its beams.

    Parameters
    ----------
    cloud
        In any frame.

    Returns
    -------
    PointCloud
        With rings numbered from the lowest elevation that was seen, about the axis. The cloud
        itself if it has rings, or if its points show none: those of a LiDAR that does not repeat
        its pattern, of one that moved, or of several.
    """
    if cloud.ring is not None or len(cloud) < MIN_RING_POINTS:
        return cloud
    ring = levels(cloud.xyz, Cones(cloud.origin, cloud.axis, 0.0))
    if ring is not None:
        return replace(cloud, ring=ring)
    xyz = cloud.xyz if cloud.frame is None else cloud.xyz[cloud.frame == cloud.frame[0]]
    chain = chains(xyz)
    some = every_nth(np.flatnonzero(chain >= 0), CHAIN_SAMPLE)
    if len(some) < MIN_RING_POINTS:
        return cloud
    points, piece = xyz[some], np.unique(chain[some], return_inverse=True)[1]
    for start in _starts(points, cloud.origin):
        found = fit_cones(points, piece, start)
        ring = levels(cloud.xyz, found) if found.spread <= CONE_SPREAD else None
        if ring is not None:
            return replace(cloud, ring=ring, origin=found.apex, axis=found.axis)
    return cloud


def chains(xyz: Array) -> IntArray:
    """Number (N,) the chains in which points (N, 3) follow each other; -1 in short ones.

    Two points follow each other where each is among the two nearest neighbours of the other.
    """
    near = cKDTree(xyz).query(xyz, 3)[1][:, 1:]
    pairs = np.repeat(np.arange(len(xyz)), 2), near.ravel()
    links = coo_matrix((np.ones(2 * len(xyz)), pairs), shape=(len(xyz), len(xyz))).tocsr()
    label = connected_components(links.minimum(links.T), directed=False)[1]
    return np.where(np.bincount(label)[label] >= MIN_RING_POINTS, label, -1)


def levels(xyz: Array, cones: Cones) -> IntArray | None:
    """Number (N,) the levels on which the elevations of points (N, 3) lie; None if they do not.

    Seen from far away, or from close to a plane, most points have one elevation: that is not a
    level.
    """
    ray = xyz - cones.apex
    near, far = np.quantile(lengths(ray), [0.05, 0.95])
    if far < FARTHER * near:
        return None
    elevation = elevations(ray, cones.axis)
    order = np.argsort(elevation, kind="stable")
    level = np.empty(len(xyz), dtype=np.int64)
    level[order] = np.cumsum(np.r_[False, np.diff(elevation[order]) > LEVEL_GAP])
    first = np.searchsorted(level[order], np.arange(level.max() + 2))
    middle = elevation[order][(first[:-1] + first[1:]) // 2]
    is_near = np.abs(elevation - middle[level]) <= LEVEL_SPREAD
    is_spread = first[1:].size < MAX_RINGS and np.diff(first).max() <= MAX_LEVEL_SHARE * len(xyz)
    return level if is_spread and np.mean(is_near) >= MOST else None


def _starts(points: Array, origin: Array) -> Iterator[Array]:
    """Places (3,) where the apex may be: most points are near a LiDAR, or all to one side."""
    yield origin
    yield densest(points)
    middle = np.median(points, axis=0)
    for way in np.array([*product((-1.0, 0.0, 1.0), repeat=3)]):
        yield middle + START_DISTANCE * way / (np.linalg.norm(way) or 1.0)
