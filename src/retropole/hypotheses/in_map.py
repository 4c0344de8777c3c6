"""A LiDAR registered to a map: to objects that cannot have driven off, and how certain that is.

Flat surfaces leave some directions undetermined, such as the position along a street. There,
trunks, posts and corners determine it, but one of them may have been moved. So the registration is
repeated from either side of the pose along these directions, each time without a quarter of the
surroundings by bearing. If the rest does not bring it back, a single object decides; the scatter of
the poses found is the delete-d jackknife (Shao and Wu 1989).
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from ..base import se3
from ..base.datatypes import Array, Placement, PointCloud
from ..surfaces.averaging import averaged
from ..surfaces.consistency import movable_objects
from ..surfaces.registration import MIN_CLOUD_POINTS, Surface, surface_of, voxel_downsample
from ..surfaces.visibility import SCORING_VOXEL, tree_of
from .icp_refinement import registered
from .one_pole import SETTLES

EIGHTHS, LEFT_OUT = 8, 2
"""Sectors by bearing, and how many next to each other are left out at once: a front of 15 m that is
10 m away is mostly within a quarter. Of benchmarks/mapped.py, seeds 2400 to 2444, three of eight
refused poses of the right place are answered so, 10 to 37 mm off at 30 m; of three of another place
none."""

START_ASIDE = 1.5
"""How far from the pose the registration starts again, in the 1 σ that surroundings are taken to
give (`alignment.adjustment.SURROUNDINGS_SIGMA`): 3° and 0.3 m, within `one_pole.SETTLES`. Where
nothing brings it back, its scatter is far above what is of use."""


def registered_in_map(placement: Placement, T: Array) -> Array:
    """Register a LiDAR from a pose (4, 4) to objects that cannot have driven off since a map was
    made.

    Cars near the former positions of others bias a registration to all surfaces. If
    too little is left, the pose is returned unchanged.
    """
    target, source = (averaged(scan.cloud) for scan in placement.scans)
    surface, tree = _without_movable(target)
    if surface is None:
        return T
    found = registered(surface, tree, voxel_downsample(source.xyz, SCORING_VOXEL), T, near=SETTLES)
    return T if found is None else found


def _without_movable(target: PointCloud) -> tuple[Surface | None, cKDTree]:
    points = voxel_downsample(target.xyz, SCORING_VOXEL)
    points = points[movable_objects(target, points) == 0]
    surface = surface_of(points) if len(points) >= MIN_CLOUD_POINTS else None
    return surface, tree_of(points)


def scatter_without_parts(
    target: PointCloud, source: PointCloud, T: Array, ways: Array, unit: Array, most: float
) -> Array | None:
    """Register without each part of the surroundings, from either side along some directions.

    Parameters
    ----------
    target, source
        The map, and what the LiDAR recorded.
    T
        (4, 4) the pose that all of it registered.
    ways, unit
        (6, N) orthonormal directions of steps from there (`se3.retract`), in units (6,), rad and m.
    most
        Largest 1 σ of use, in these units.

    Returns
    -------
    Array or None
        (N, N) covariance of T along them; None above `most`.
    """
    surface, tree = _without_movable(target)
    if surface is None:
        return None
    points = voxel_downsample(source.xyz, SCORING_VOXEL)
    x, y = (se3.apply(T, points) - T[:3, 3])[:, :2].T
    sector = np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * EIGHTHS).astype(np.int64)
    sides = product(ways.T, (-START_ASIDE, START_ASIDE))
    starts = [se3.retract(T, side * unit * way) for way, side in sides]
    # Each of the sectors is left out with its neighbour, from each start.
    weight = (EIGHTHS - LEFT_OUT) / LEFT_OUT / (EIGHTHS * len(starts))
    covariance = np.zeros((ways.shape[1], ways.shape[1]))
    for k, start in product(range(EIGHTHS), starts):
        rest = points[(sector - k) % EIGHTHS >= LEFT_OUT]
        end = registered(surface, tree, rest, start, near=SETTLES)
        if end is None:
            return None
        off = (se3.local(T, end) / unit) @ ways
        covariance += weight * np.outer(off, off)
        if np.linalg.eigvalsh(covariance)[-1] > most**2:
            return None
    return covariance
