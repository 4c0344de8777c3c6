"""The large planes of a cloud, by RANSAC over batches of hypotheses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from ...datatypes import Array, IntArray, PointCloud
from ...scene.registration import voxel_downsample

PLANE_VOXEL = 0.15
"""Clouds are thinned to one point per cube of this side, metres, so that support means area."""

MAX_PLANE_POINTS = 20_000
"""Thinned points that planes are looked for in; a random part of more."""

THICKNESS = 0.05
"""A point within this distance of a plane lies on it, metres."""

MAX_PLANES = 8
"""Triples grow with the cube of this, and pairs of triples with its sixth power."""

MIN_PLANE_POINTS = 60
"""Thinned points of a plane."""

MIN_EXTENT = 0.8
"""Of a plane along its narrower side, metres (four standard deviations): a strip leaves the
direction across it to the noise."""

HYPOTHESES = 300
"""Triples of points drawn for every plane at each of the scales."""

SCALES = (32, 256, 2048)
"""The second and third point of a triple are drawn among so many nearest to the first: close
ones are likelier to share a plane, distant ones hold its direction better."""

SCORED = 4000
"""Points that hypotheses are scored on."""

MIN_INDEPENDENCE = 0.3
"""Least singular value of the normals of three planes that hold a pose: 0.3 is where each leans out
of the plane of the other two by some 20°."""

POLISHED = 5
"""Hypotheses of each round that are fitted to their inliers before the best is chosen."""


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane ``normal · x + offset = 0`` and the thinned points that lie on it.

    Attributes
    ----------
    normal
        (3,) unit vector, turned to the beam origin: both LiDARs see the same side of a wall.
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

    def thinned(self, count: int) -> Plane:
        """Keep every n-th point, so that at most so many are left."""
        return replace(self, xyz=self.xyz[:: -(-len(self.xyz) // count)])


def fit(xyz: Array) -> tuple[Array, float]:
    """Fit a plane to (N, 3) points by least squares: its unit normal (3,) and its offset."""
    centre = xyz.mean(axis=0)
    centred = xyz - centre
    normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    return normal, float(-normal @ centre)


def extract_planes(cloud: PointCloud, rng: np.random.Generator) -> list[Plane]:
    """Find the planes of a cloud, one after the other, the best supported first.

    Each round draws triples of points, keeps the plane that most of the points left lie on, fits
    it to them and takes them away.

    Parameters
    ----------
    cloud
        Points in the sensor's frame; `PointCloud.origin` tells to which side planes face.
    rng
        Draws the triples.

    Returns
    -------
    list of Plane
        At most `MAX_PLANES`, in the cloud's frame; empty where the cloud holds none.
    """
    points = voxel_downsample(cloud.xyz, PLANE_VOXEL)
    if len(points) > MAX_PLANE_POINTS:
        points = points[rng.choice(len(points), MAX_PLANE_POINTS, replace=False)]
    planes: list[Plane] = []
    # A strip, too narrow for a plane, is taken away like one, or every round would find it again.
    for _ in range(2 * MAX_PLANES):
        if len(points) < MIN_PLANE_POINTS or len(planes) == MAX_PLANES:
            break
        normal, offset = _best_plane(points, rng)
        on_it = np.abs(points @ normal + offset) < THICKNESS
        if np.count_nonzero(on_it) < MIN_PLANE_POINTS:
            break
        inliers, points = points[on_it], points[~on_it]
        spread = np.linalg.eigvalsh(np.cov(inliers.T))
        if 4 * np.sqrt(spread[1]) < MIN_EXTENT:
            continue
        if normal @ cloud.origin + offset < 0:
            normal, offset = -normal, -offset
        planes.append(Plane(normal, offset, inliers, len(inliers)))
    return planes


def _best_plane(points: Array, rng: np.random.Generator) -> tuple[Array, float]:
    """Draw triples, score their planes on a sample, and polish the best on all points."""
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
    good = lengths > 1e-6 * (1 + np.linalg.norm(a, axis=1))
    if not good.any():
        return np.array([0.0, 0.0, 1.0]), np.inf
    normals = normals[good] / lengths[good, None]
    offsets = -np.einsum("hi,hi->h", normals, a[good])
    sample = points
    if len(points) > SCORED:
        sample = points[rng.choice(len(points), SCORED, replace=False)]
    # Single precision: 900 planes against 4000 points, and a vote bears an error of micrometres.
    heights = normals.astype(np.float32) @ sample.T.astype(np.float32)
    heights += offsets.astype(np.float32)[:, None]
    votes = np.count_nonzero(np.abs(heights, out=heights) < THICKNESS, axis=1)
    best: tuple[int, Array, float] = (-1, normals[0], offsets[0])
    for k in np.argsort(-votes, kind="stable")[:POLISHED]:
        normal, offset = normals[k], float(offsets[k])
        for tolerance in (2.0, 1.5, 1.0, 1.0):
            on_it = np.abs(points @ normal + offset) < tolerance * THICKNESS
            if np.count_nonzero(on_it) < 3:
                break
            normal, offset = fit(points[on_it])
        count = int(np.count_nonzero(np.abs(points @ normal + offset) < THICKNESS))
        if count > best[0]:
            best = (count, normal, offset)
    return best[1], best[2]


def independence(normals: Array) -> Array:
    """Tell how far unit normals (..., N, 3) are from dependent.

    Their least singular value: 1 for three perpendicular ones, 0 where they all lie in a plane.
    """
    return np.asarray(np.linalg.svd(normals, compute_uv=False)[..., -1])


def triples(planes: list[Plane]) -> IntArray:
    """Index (K, 3) of all sets of three planes that are linearly independent."""
    index = np.array(list(combinations(range(len(planes)), 3)), dtype=np.int64).reshape(-1, 3)
    normals = np.array([plane.normal for plane in planes]).reshape(-1, 3)
    return index[independence(normals[index]) >= MIN_INDEPENDENCE]
