"""Whether the rings of a cloud are rings: some files have a field of that name that says nothing.

Converters fill it with zeros, or with the number of the column or of the packet.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from ..base.datatypes import Array, IntArray, PointCloud
from ..base.se3 import lengths

MAX_RINGS = 256
"""No LiDAR of the table of sensors has more than 128 rings; more numbers are columns or packets."""

RING_SAMPLE = 5_000
"""Points, evenly taken, whose elevations are compared: 40 on each of 128 rings."""

MAX_RING_SPREAD = float(np.radians(0.5))
"""Half of the points of a ring lie within this of its elevation, rad, where the cloud is in its
sensor's frame."""

NEIGHBOUR_SAMPLE = 500
"""Points whose nearest neighbour is looked for where elevations do not tell."""

MIN_NEIGHBOUR_SHARE, CHANCE = 0.25, 3.0
"""Of real rings, so many of the nearest neighbours are on the same ring, and so many times more
than by chance. In simulated streets, quays and corridors 0.48 (Pandar64) to 1.0 (VLP-16) are."""


def rings_fault(cloud: PointCloud) -> str:
    """Say why the rings of a cloud are no rings; nothing where they are, or where it has none.

    A cloud that another program has moved keeps its rings: their elevations are lost, but the
    points of one ring still follow each other.

    Parameters
    ----------
    cloud
        In any frame.
    """
    if cloud.ring is None or len(cloud) == 0:
        return ""
    if np.ptp(cloud.ring) == 0:
        return f"all {len(cloud):,} points have the ring {cloud.ring[0]}"
    # Counting takes a sort; a field with few values needs none.
    values = len(np.unique(cloud.ring)) if np.ptp(cloud.ring) >= MAX_RINGS else 0
    if values > MAX_RINGS:
        return f"{values:,} different rings, more than any LiDAR has"
    spread = ring_spread(cloud)
    if spread <= MAX_RING_SPREAD or _rings_cohere(cloud.xyz, cloud.ring):
        return ""
    return (
        f"half of the points of a ring lie {np.degrees(spread):.1f}° and more from its elevation, "
        "and neighbours are on different rings"
    )


def with_trusted_rings(cloud: PointCloud) -> PointCloud:
    """Leave out rings that are none; the cloud itself where they are."""
    return replace(cloud, ring=None) if rings_fault(cloud) else cloud


def ring_spread(cloud: PointCloud) -> float:
    """How far the points of a ring typically lie from its median elevation, rad, seen from the
    cloud's origin; infinite for a cloud without rings.
    """
    if cloud.ring is None or len(cloud) == 0:
        return float("inf")
    part = slice(None, None, 1 + (len(cloud) - 1) // RING_SAMPLE)
    elevation = elevations(cloud.xyz[part] - cloud.origin, cloud.axis)
    return float(np.median(off_ring(elevation, cloud.ring[part])))


def elevations(rays: Array, axis: Array) -> Array:
    """Elevations (N,) of rays (N, 3) above the plane across a unit axis (3,), rad."""
    return np.asarray(np.arcsin(np.clip(rays @ axis / lengths(rays), -1.0, 1.0)))


def off_ring(elevation: Array, ring: IntArray) -> Array:
    """How far elevations (N,) are from the median of their rings (N,), in order of the rings."""
    order = np.lexsort((elevation, ring))
    elevation, ring = elevation[order], ring[order]
    first = np.flatnonzero(np.r_[True, ring[1:] != ring[:-1]])
    count = np.diff(np.r_[first, len(ring)])
    return np.asarray(np.abs(elevation - np.repeat(elevation[first + count // 2], count)))


def _rings_cohere(xyz: Array, ring: IntArray) -> bool:
    """Whether nearest neighbours are on one ring more often than by chance."""
    sample = np.linspace(0, len(xyz) - 1, NEIGHBOUR_SAMPLE).astype(int)
    _, nearest = cKDTree(xyz).query(xyz[sample], 2)
    share = float(np.mean(ring[nearest[:, 1]] == ring[sample]))
    _, counts = np.unique(ring, return_counts=True)
    chance = float(np.sum((counts / counts.sum()) ** 2))
    return share >= max(MIN_NEIGHBOUR_SHARE, min(CHANCE * chance, 0.9))
