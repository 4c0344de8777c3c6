"""Registration of whole clouds from a start: ICP and GICP, by small_gicp.

small_gicp answers the identity where it is handed empty or badly shaped arrays, so every entry
here checks first. Its threads do not survive a `fork`: run processes spawned.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

import numpy as np
import small_gicp

from ..base.datatypes import Array
from ..base.errors import Refusal
from ..base.quantities import counted
from .sweeps import order_of

CORES = min(4, os.cpu_count() or 1)
"""Threads for large clouds. Those of the method are small: there one thread is as fast, and
several, which wait by spinning, are many times slower where the machine has other work.
"""

MIN_CLOUD_POINTS = 50
"""Least points of a downsampled cloud that anything can be registered to: fewer fit anywhere."""

NORMAL_NEIGHBOURS = 10
"""Points that a surface normal is estimated from (small_gicp's default when it prepares clouds)."""

SAMPLE = 4000
"""Where some of a cloud will do, no more points of it, or patches of one size, are used: a share
of that number has a standard error of less than 1.2 %."""

MAX_CELLS = 2**20 - 1
"""Cubes that small_gicp numbers on each side of the origin: 100 km of 0.1 m. What is beyond, it
leaves out too, and prints a line for each point."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A downsampled cloud prepared for registration.

    Attributes
    ----------
    xyz
        (M, 3) one point per occupied voxel, metres.
    cloud, tree
        In the types of small_gicp.
    """

    xyz: Array
    cloud: small_gicp.PointCloud
    tree: small_gicp.KdTree


@dataclass(frozen=True, eq=False)
class Registration:
    """What a registration ended with.

    Attributes
    ----------
    T_target_source
        (4, 4) pose at the end.
    inliers
        Source points that had a target neighbour within the correspondence distance.
    converged
        Whether the step fell below the tolerance before the iterations ran out.
    """

    T_target_source: Array
    inliers: int
    converged: bool


def voxel_downsample(xyz: Array, voxel: float) -> Array:
    """Keep the mean of the points in each cube of side ``voxel`` metres: (N, 3) to (M, 3).

    Points more than `MAX_CELLS` cubes from the origin are left out.
    """
    reach = voxel * MAX_CELLS
    if len(xyz) and max(xyz.max(), -xyz.min()) > reach:
        xyz = xyz[np.abs(xyz).max(axis=1) <= reach]
    if len(xyz) == 0:
        return np.zeros((0, 3))
    columns = np.array(xyz.T, dtype=float, order="C")
    # One number for each cube, the last axis first: fewer than (2 MAX_CELLS)³, which fits in an
    # int64.
    key, size = np.zeros(len(xyz), dtype=np.int64), 1
    for column in columns:
        cell = np.floor(column * (1.0 / voxel)).astype(np.int64)
        cell -= cell.min()
        key += size * cell
        size *= int(cell.max()) + 1
    order = order_of(key)
    key = key[order]
    is_next = np.concatenate([[0], key[1:] != key[:-1]])
    place = np.empty(len(key), dtype=np.intp)
    place[order] = np.cumsum(is_next)
    count = np.bincount(place)
    return np.stack([np.bincount(place, column) / count for column in columns], axis=1)


def prepare(xyz: Array, voxel: float, *, threads: int = 1) -> Surface:
    """Downsample a cloud and estimate its local surfaces.

    Raises
    ------
    Refusal
        ``too_few_points`` where fewer than `MIN_CLOUD_POINTS` are left.
    """
    points = voxel_downsample(xyz, voxel)
    if len(points) < MIN_CLOUD_POINTS:
        raise Refusal(
            "too_few_points",
            f"{counted(len(points), 'point is', 'points are')} left of a cloud downsampled to "
            f"{voxel:g} m, "
            f"{MIN_CLOUD_POINTS} are needed; record a scene with more in it",
            {"points": len(points), "needed": MIN_CLOUD_POINTS},
        )
    return surface_of(points, threads=threads)


def surface_of(points: Array, *, threads: int = 1) -> Surface:
    """Estimate the local surfaces of points (M, 3) that are downsampled already."""
    surface = as_surface(points, threads=threads)
    small_gicp.estimate_normals_covariances(
        surface.cloud, surface.tree, num_neighbors=NORMAL_NEIGHBOURS, num_threads=threads
    )
    return surface


def as_surface(points: Array, *, threads: int = 1) -> Surface:
    """Hand points (M, 3) to small_gicp as they are, without covariances: enough for ICP."""
    cloud = small_gicp.PointCloud(points)
    return Surface(points, cloud, small_gicp.KdTree(cloud, num_threads=threads))


def register(
    target: Surface,
    source: Surface,
    T_start: Array,
    *,
    method: Literal["ICP", "PLANE_ICP", "GICP"],
    max_correspondence_distance: float,
    max_iterations: int = 30,
    threads: int = 1,
) -> Registration:
    """Register two prepared clouds from a start.

    Parameters
    ----------
    target, source
        Prepared clouds, each in the frame of its LiDAR.
    T_start
        (4, 4) start, target from source.
    method
        ``ICP`` is point to point, ``PLANE_ICP`` point to plane, ``GICP`` plane to plane.
    max_correspondence_distance
        Largest distance of corresponding points, metres.
    max_iterations
        Largest number of steps.
    threads
        Of small_gicp.

    Raises
    ------
    Refusal
        ``registration_failed`` where the result is not a finite rigid transform.
    """
    result = small_gicp.align(
        target.cloud,
        source.cloud,
        target.tree,
        np.ascontiguousarray(T_start, dtype=float),
        registration_type=method,
        max_correspondence_distance=max_correspondence_distance,
        num_threads=threads,
        max_iterations=max_iterations,
    )
    T = np.array(result.T_target_source)
    if not np.all(np.isfinite(T)):
        raise Refusal("registration_failed", f"{method} left the finite numbers", {})
    return Registration(T, int(result.num_inliers), bool(result.converged))
