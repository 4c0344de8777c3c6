"""The large planes of a cloud, by RANSAC over batches of hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from retropole.base.datatypes import Array, IntArray, PointCloud
from retropole.base.se3 import principal_axes
from retropole.surfaces.registration import voxel_downsample

PLANE_VOXEL = 0.15
"""Clouds are downsampled to one point per cube of this side, metres, so that support means area."""

MAX_PLANE_POINTS = 20_000
"""Downsampled points that planes are searched in; a random part of more."""

THICKNESS = 0.05
"""A point within this distance of a plane lies on it, metres (chosen for range noise and rough
walls)."""

MAX_PLANES = 8
"""Triples grow with the cube of this, and pairs of triples with its sixth power."""

MAX_ROUNDS = 2 * MAX_PLANES
"""Each round finds a plane or a strip; with more strips than planes the search is given up."""

MIN_PLANE_SUPPORT = 60
"""Downsampled points of a plane (chosen: about 1 m² fully seen)."""

MIN_EXTENT = 0.8
"""Of a plane along its narrower side, metres (four standard deviations): a strip leaves the
direction across it to the noise."""

HYPOTHESES = 300
"""Triples of points drawn for every plane at each of the scales."""

SCALES = (32, 256, 2048)
"""The second and third point of a triple are drawn among so many nearest neighbours of the first:
close ones are likelier to share a plane, distant ones determine its direction better."""

COLLINEAR = 1e-6
"""Three points whose cross product, relative to their range, is smaller lie on a line: rounding."""

SCORED_POINTS = 4000
"""Points that hypotheses are scored on."""

MIN_INDEPENDENCE = 0.3
"""Least singular value of the normals of three planes that determine a pose: 0.3 is where each
leans out of the plane of the other two by some 20°."""

POLISHED = 5
"""Hypotheses of each round that are fitted to their inliers before the best is chosen."""

POLISH_TOLERANCES = (2.0, 1.5, 1.0, 1.0)
"""Inliers of each successive fit lie within so many times `THICKNESS`: wide first, since three
points give a rough plane."""


class PlaneEquation(NamedTuple):
    """A plane ``normal · x + offset = 0``: unit normal (3,), and offset in metres."""

    normal: Array
    offset: float

    def distances(self, xyz: Array) -> Array:
        """Distance (N,) of points (N, 3) from the plane, metres."""
        return np.abs(xyz @ self.normal + self.offset)


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane ``normal · x + offset = 0`` and the downsampled points that lie on it.

    Attributes
    ----------
    normal
        (3,) unit vector towards the beam origin: both LiDARs see the same side of a wall.
    offset
        Metres.
    xyz
        (N, 3) points on it, in the cloud's frame.
    support
        How many points it was found on.
    """

    normal: Array
    offset: float
    xyz: Array
    support: int

    def sampled(self, count: int) -> Plane:
        """Keep every n-th point, so that at most so many are left."""
        return replace(self, xyz=self.xyz[:: -(-len(self.xyz) // count)])


@dataclass(frozen=True, eq=False)
class PlaneSearch:
    """The planes of a cloud.

    Attributes
    ----------
    planes
        At most `MAX_PLANES`, in the cloud's frame; empty where the cloud holds none.
    complete
        False where `MAX_ROUNDS` ran out, most of them with strips, so that planes may be left.
    """

    planes: tuple[Plane, ...]
    complete: bool


def fit_plane(xyz: Array) -> PlaneEquation:
    """Fit a plane to (N, 3) points by least squares."""
    centre, axes = principal_axes(xyz)
    return PlaneEquation(axes[:, 0], float(-axes[:, 0] @ centre))


def extract_planes(cloud: PointCloud, rng: np.random.Generator) -> PlaneSearch:
    """Find the planes of a cloud, one after the other, the best supported first.

    Each round draws triples of points, keeps the plane that most of the remaining points lie on,
    fits it to them and removes them.

    Parameters
    ----------
    cloud
        Points in the sensor's frame; `PointCloud.origin` tells to which side planes face.
    rng
        Draws the triples.
    """
    points = voxel_downsample(cloud.xyz, PLANE_VOXEL)
    if len(points) > MAX_PLANE_POINTS:
        points = points[rng.choice(len(points), MAX_PLANE_POINTS, replace=False)]
    planes: list[Plane] = []
    for _ in range(MAX_ROUNDS):
        if len(points) < MIN_PLANE_SUPPORT or len(planes) == MAX_PLANES:
            break
        best = _best_plane(points, rng)
        if best is None:
            break
        on_it = best.distances(points) < THICKNESS
        if np.count_nonzero(on_it) < MIN_PLANE_SUPPORT:
            break
        # A strip, too narrow for a plane, is removed like one, or every round would find it again.
        inliers, points = points[on_it], points[~on_it]
        spread = np.linalg.eigvalsh(np.cov(inliers.T))
        if 4 * np.sqrt(spread[1]) < MIN_EXTENT:
            continue
        sign = -1.0 if best.normal @ cloud.origin + best.offset < 0 else 1.0
        planes.append(Plane(sign * best.normal, sign * best.offset, inliers, len(inliers)))
    else:
        complete = len(points) < MIN_PLANE_SUPPORT or len(planes) == MAX_PLANES
        return PlaneSearch(tuple(planes), complete)
    return PlaneSearch(tuple(planes), complete=True)


def _best_plane(points: Array, rng: np.random.Generator) -> PlaneEquation | None:
    """Draw triples, score their planes on a sample, and polish the best on all points.

    Of the polished planes, each fitted as often as `POLISH_TOLERANCES` says, the one with the most
    points is taken. None where all triples lie on lines.
    """
    first = rng.integers(len(points), size=HYPOTHESES * len(SCALES))
    others = []
    tree = cKDTree(points)
    for k, scale in enumerate(SCALES):
        among = min(scale, len(points))
        near = first[k * HYPOTHESES : (k + 1) * HYPOTHESES]
        rank = rng.integers(1, among, size=(HYPOTHESES, 2))
        if among == len(points):
            others.append(rank)
        else:
            found = tree.query(points[near], k=among)[1]
            others.append(np.take_along_axis(found, rank, axis=1))
    a, b, c = points[first], *points[np.concatenate(others).T]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    good = lengths > COLLINEAR * (1 + np.linalg.norm(a, axis=1))
    if not good.any():
        return None
    normals = normals[good] / lengths[good, None]
    offsets = -np.einsum("hi,hi->h", normals, a[good])
    sample = points
    if len(points) > SCORED_POINTS:
        sample = points[rng.choice(len(points), SCORED_POINTS, replace=False)]
    # Single precision: 900 planes against 4000 points, where an error of micrometres changes no
    # vote that matters.
    heights = normals.astype(np.float32) @ sample.T.astype(np.float32)
    heights += offsets.astype(np.float32)[:, None]
    votes = np.count_nonzero(np.abs(heights, out=heights) < THICKNESS, axis=1)
    polished = [
        _polished(points, PlaneEquation(normals[k], float(offsets[k])))
        for k in np.argsort(-votes, kind="stable")[:POLISHED]
    ]
    return max(polished, key=lambda p: np.count_nonzero(p.distances(points) < THICKNESS))


def _polished(points: Array, plane: PlaneEquation) -> PlaneEquation:
    """Fit a plane to its inliers again and again; it stays where fewer than three are left."""
    for tolerance in POLISH_TOLERANCES:
        on_it = plane.distances(points) < tolerance * THICKNESS
        if np.count_nonzero(on_it) < 3:
            break
        plane = fit_plane(points[on_it])
    return plane


def independence(normals: Array) -> Array:
    """How far unit normals (..., N, 3) are from linear dependence.

    Their least singular value: 1 for three perpendicular ones, 0 where they all lie in a plane.
    """
    return np.asarray(np.linalg.svd(normals, compute_uv=False)[..., -1])


def triples(planes: Sequence[Plane]) -> IntArray:
    """Index (K, 3) of all sets of three planes that are linearly independent."""
    index = np.array(list(combinations(range(len(planes)), 3)), dtype=np.int64).reshape(-1, 3)
    normals = np.array([plane.normal for plane in planes]).reshape(-1, 3)
    return index[independence(normals[index]) >= MIN_INDEPENDENCE]
