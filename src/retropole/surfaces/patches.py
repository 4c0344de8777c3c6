"""Small flat pieces of a cloud's surfaces, and how certain their place and their normal are."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import small_gicp

from ..alignment.certainty import chi2_limit
from ..alignment.solver import ROUNDING
from ..base.datatypes import Array, BoolArray, IntArray, PointCloud, every_nth
from ..base.se3 import lengths
from ..base.systematic import DEVICE, RING, band_of, by_error
from .averaging import averaged
from .registration import SAMPLE, voxel_downsample
from .visibility import tree_of

PATCH_VOXELS = (0.15, 0.3, 0.6)
"""Patches are fitted to clouds downsampled to one point per cube of these sides, metres: small ones
where points are dense, wide ones that span the rings on ground seen at a slant. With 1.2 and 2.4 m
besides, errors of 48 streets, corridors and harbors were 17 % larger (benchmarks/coverage.py,
pointing noise and people walking, seeds 0 to 23), and of 41 squares and roads no smaller."""

PATCH_NEIGHBOURS = (16, 8)
"""Downsampled points that a patch is fitted to; the fewer where no patch of more is near: between
sparse beams, off the ground, few points lie on one surface. From the reference of pjlab_0003 left,
with a wide prior, the refinement ends 0.14° and 6.4 cm away with 16 alone, 0.12° and 2.9 cm with
both (tuning)."""

FINER_REACH = 2.0
"""Within this many of its voxels a patch is left to finer ones."""

MAX_THICKNESS = 0.03
"""RMS distance of a patch's points from its plane, metres, above which it is not a surface."""

MAX_LEVERAGE = 0.35
"""Share of a patch's lesser extent that a single point may account for."""

MAX_FLATNESS = 0.1
"""Most variance across a patch, as a part of that along its lesser extent. Without it, one of 120
pairs (benchmarks/same_answers.py) moves by half a σ, and in one no place is reported."""

MIN_THICKNESS = 0.001
"""Least RMS thickness of a patch, metres: no surface is flatter, nor any LiDAR finer. Patches whose
middles are nearer are one."""

MIN_ACROSS = float(np.radians(0.03))
"""Least RMS of the directions of a patch's points across their longer extent, and of their
elevations, rad. The returns of one ring lie on its cone whatever they come from: scattered along
their beams they make a patch of it that is flat, and carries no information on the surface. Rings
differ by 0.1° or more: two of them make 0.05°."""

MAX_GAP = 2 / 3
"""Through two rings a plane goes across any gap: the top of a wall, a kerb. Where the largest gap
between the elevations of a patch's beams is a larger part of what they span, they are two lines;
three rings with even steps have a half."""

ROUGHNESS = 0.04
"""1 σ of how far a surface is from the plane through two lines that nothing confirms, metres: a
cambered road, a kerb, the top of a wall. Before, a robot between walls was off by 13.6 cm with 3.6
stated, and now by 6.1 with 5.0 (benchmarks/sites.py, robot, seed 1008, poles placed twice)."""

SPAN = 0.5
"""Patches as far from each other along their surface may be one surface, metres, or as far as the
wider of them reaches to its side: where rings are sparse, so are the patches of both LiDARs. How
well the normal of the one predicts where the other lies is counted."""

CONFIRMING = 12
"""Number of nearest patches that may confirm a patch of two lines. One confirms it that continues
its plane, …"""

BEYOND_RINGS = float(np.radians(0.1))
"""… where its beams reach higher or lower by this angle, rad: other rings, …"""

CONFIRMING_ANGLE, CONFIRMING_OFF = float(np.radians(10.0)), (0.02, 0.03)
"""… its normal agrees within this angle, rad, and both middles lie in each other's planes, metres
and as a part of their distance."""

MIN_SPREAD = 0.15
"""Least ratio of a patch's two extents: below it the points are one ring, whose plane is free."""

POINTING_NOISE = float(np.radians(0.02))
"""1 σ of the direction of single beams, rad, where there is no information on it: LiDARs' manuals
name 0.01 to 0.1° as angular accuracy."""


@dataclass(frozen=True, eq=False)
class Patches:
    """Small flat pieces of a cloud's surfaces.

    Attributes
    ----------
    centres
        (M, 3) mean of the points of each patch, metres.
    normals
        (M, 3) unit normals, towards the sensor.
    rays
        (M, 3) unit vectors from the beam origin to the centres.
    tilt
        (M,) variance of the normals, rad².
    variance
        (M,) of the centre across the patch, m².
    extent
        (M,) half of its lesser width, metres: across the rings, where these are far from each
        other.
    lean
        (M, 3) how far it leans towards the beams for the noise of their pointing: a slope, rad,
        along the surface away from the LiDAR.
    bands
        (M, 16) the band of elevation that each point of the patch came from; those of few points
        are repeated.
    by_error
        (M, 3, 12) how the errors of its LiDAR move the centre, metres by the unit of each: those of
        the whole LiDAR, and those of its rings (`systematic.by_error`).
    gap
        (M,) largest gap between the elevations of its beams, as a part of what they span.
    elevations
        (M, 2) the least and the largest elevation of its beams, rad.
    """

    centres: Array
    normals: Array
    rays: Array
    tilt: Array
    variance: Array
    extent: Array
    lean: Array
    bands: IntArray
    by_error: Array
    gap: Array
    elevations: Array


def surface_patches(cloud: PointCloud) -> Patches:
    """Fit planes to the neighbourhoods of the downsampled cloud and keep the flat ones.

    At each place the finest are kept that the density of the cloud carries: a wide patch on a road
    that is cambered leans, and a plane through a corner is none.
    """
    points = averaged(cloud).xyz
    clouds = []
    for voxel in PATCH_VOXELS:
        # From fine to coarse, each starts from the one before: there are fewer points then.
        points = voxel_downsample(points, voxel)
        clouds.append((voxel, points, small_gicp.KdTree(points) if len(points) else None))
    parts: list[Patches] = []
    for count in PATCH_NEIGHBOURS:
        for voxel, points, tree in clouds:
            at = every_nth(points, SAMPLE)
            finer = [part.centres for part in parts if len(part.centres)]
            if finer:
                near = tree_of(np.concatenate(finer))
                at = at[np.isinf(near.query(at, distance_upper_bound=FINER_REACH * voxel)[0])]
            parts.append(_patches_of(points, tree, at, cloud.origin, cloud.axis, count))
    every = Patches(
        *(
            np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(Patches)
        )
    )
    every = _doubted(every)
    # Where points are few, coarse neighbourhoods are those of finer ones again.
    first = np.unique(np.round(every.centres / MIN_THICKNESS), axis=0, return_index=True)[1]
    return selected(every, np.sort(first))


def selected(patches: Patches, kept: BoolArray | IntArray | slice) -> Patches:
    """Give some of the patches."""
    return Patches(*(getattr(patches, field.name)[kept] for field in fields(Patches)))


def _patches_of(
    points: Array, tree: small_gicp.KdTree | None, at: Array, origin: Array, axis: Array, count: int
) -> Patches:
    """Fit patches about some (K, 3) of the points, which have a tree."""
    if tree is None or len(points) < count or not len(at):
        none, nothing = np.zeros((0, 3)), np.zeros(0)
        bands = np.zeros((0, PATCH_NEIGHBOURS[0]), dtype=np.int64)
        return Patches(
            none,
            none,
            none,
            nothing,
            nothing,
            nothing,
            none,
            bands,
            np.zeros((0, 3, DEVICE + RING)),
            nothing,
            np.zeros((0, 2)),
        )
    index, _ = tree.batch_knn_search(at, count)
    index = np.asarray(index, dtype=np.intp)
    neighbours = points.take(index, axis=0)
    centres = _middle(neighbours)
    centred = neighbours - centres[:, None]
    spread = np.matmul(centred.transpose(0, 2, 1), centred) / count
    values, vectors = np.linalg.eigh(spread)
    values = np.maximum(values, ROUNDING * values[:, 2:])
    flat = (values[:, 0] < MAX_THICKNESS**2) & (values[:, 1] > MIN_SPREAD**2 * values[:, 2])
    flat &= values[:, 0] < MAX_FLATNESS * values[:, 1]
    # The plane of one ring and a point next to it goes through that point, whatever its error.
    aside = np.einsum("mki,mi->mk", centred, vectors[:, :, 1]) ** 2
    flat &= aside.max(axis=1) < MAX_LEVERAGE * aside.sum(axis=1)
    beams = points - origin
    beams /= lengths(beams)[:, None]
    flat = np.flatnonzero(flat)
    across, heights = _directions(beams, axis, index[flat])
    flat, heights = flat[across > MIN_ACROSS], heights[across > MIN_ACROSS]
    centres, normals = centres[flat], vectors[flat, :, 0]
    lean = _lean(centres - origin, normals, spread[flat])
    ranges = lengths(centres - origin)
    rays = (centres - origin) / ranges[:, None]
    cosine = np.einsum("mi,mi->m", normals, rays)
    # A plane goes through a point that lies away from the others, whatever its error: a patch is
    # not taken for thinner than most are.
    span = np.maximum(heights[:, -1] - heights[:, 0], 1e-12)
    gap = np.diff(heights, axis=1).max(axis=1) / span
    sure = values[flat[gap <= MAX_GAP], 0]
    if not len(sure):
        sure = values[flat, 0]
    usual = np.median(sure) if len(sure) else 0.0
    thickness = np.maximum(values[flat, 0], usual)
    # Noise averages out over the points; the shape of what is not flat does not. Three of them
    # make the plane.
    unusual = chi2_limit(count - 3) / (count - 3) * usual
    variance = thickness / count + np.maximum(thickness - unusual, 0.0)
    tilt = variance / values[flat, 1]
    normals = np.where((cosine > 0)[:, None], -normals, normals)
    tangent = np.sqrt(1.0 - np.minimum(cosine**2, 1.0)) / np.maximum(np.abs(cosine), 1e-3)
    around = np.cross(axis, rays)
    level = np.maximum(np.linalg.norm(around, axis=1), 1e-9)
    by_azimuth = ranges[:, None] * around
    by_elevation = (ranges / level)[:, None] * np.cross(rays, around)
    device, ring = by_error(rays, by_azimuth, by_elevation, rays, axis, ranges, tangent, tape=False)
    ray = points - origin
    band = band_of(ray / lengths(ray)[:, None], axis)
    return Patches(
        centres,
        normals,
        rays,
        tilt,
        np.maximum(variance, MIN_THICKNESS**2 / count),
        # A uniform strip is as wide to either side.
        np.sqrt(3.0 * values[flat, 1]),
        lean,
        np.tile(band[index[flat]], PATCH_NEIGHBOURS[0] // count),
        np.concatenate([device, ring], axis=2),
        gap,
        heights[:, [0, -1]],
    )


def _directions(beams: Array, axis: Array, index: IntArray) -> tuple[Array, Array]:
    """Say how the directions of the beams of patches spread, seen from where they start.

    Parameters
    ----------
    beams
        (N, 3) unit vectors from where they start to the points.
    axis
        (3,) of the LiDAR.
    index
        (M, K) the points of each patch.

    Returns
    -------
    (M,), (M, K)
        RMS across their longer extent, or of their elevations where that is less, rad; and the
        elevations, sorted.
    """
    elevation = np.arcsin(np.clip(beams @ axis, -1.0, 1.0))
    elevations = np.sort(elevation.take(index), axis=1)
    aside = beams.take(index, axis=0)
    mean = _middle(aside)
    aside -= mean[:, None]
    square = np.matmul(aside.transpose(0, 2, 1), aside) / index.shape[1]
    # What lies along the beams themselves is left out.
    mean /= lengths(mean)[:, None]
    along = np.einsum("mij,mj->mi", square, mean)
    twice = np.einsum("mi,mi->m", along, mean)
    trace = np.trace(square, axis1=1, axis2=2) - twice
    squares = np.einsum("mij,mij->m", square, square) + twice**2
    squares -= 2.0 * np.einsum("mi,mi->m", along, along)
    # Of the three eigenvalues one is 0: the other two have this sum and this product.
    product = (trace**2 - squares) / 2
    least = (trace - np.sqrt(np.maximum(trace**2 - 4.0 * product, 0.0))) / 2
    across = np.minimum(np.sqrt(np.maximum(least, 0.0)), np.std(elevations, axis=1))
    return np.asarray(across), elevations


def _middle(points: Array) -> Array:
    """(M, 3) mean of each K of points (M, K, 3), in a quarter of the time of np.mean."""
    share = np.full(points.shape[1], 1.0 / points.shape[1])
    return np.asarray(share @ points)


def _doubted(patches: Patches) -> Patches:
    """Let patches of two lines be as uncertain as surfaces are rough, unless a neighbour, of other
    rings, continues their plane.
    """
    doubtful = np.flatnonzero(patches.gap > MAX_GAP)
    if not len(doubtful):
        return patches
    count = min(CONFIRMING, len(patches.centres))
    distance, near = tree_of(patches.centres).query(patches.centres[doubtful], k=count)
    between = patches.centres[near] - patches.centres[doubtful][:, None]
    own, other = patches.normals[doubtful], patches.normals[near]
    off = np.maximum(
        np.abs(np.einsum("mi,mki->mk", own, between)),
        np.abs(np.einsum("mki,mki->mk", other, between)),
    )
    parallel = np.abs(np.einsum("mi,mki->mk", own, other)) > np.cos(CONFIRMING_ANGLE)
    beyond = (patches.elevations[near] - patches.elevations[doubtful][:, None]) * [-1.0, 1.0]
    reach = np.maximum(2.0 * patches.extent[doubtful], SPAN)[:, None]
    confirms = (distance < reach) & parallel & (beyond > BEYOND_RINGS).any(axis=2)
    confirms &= off < CONFIRMING_OFF[0] + CONFIRMING_OFF[1] * distance
    doubtful = doubtful[~confirms.any(axis=1)]
    variance, tilt = patches.variance.copy(), patches.tilt.copy()
    variance[doubtful] += ROUGHNESS**2
    tilt[doubtful] += (ROUGHNESS / patches.extent[doubtful]) ** 2
    return replace(patches, variance=variance, tilt=tilt)


def _lean(rays: Array, normals: Array, spread: Array) -> Array:
    """How far planes lean towards the beams for the noise of their pointing: slopes (M, 3), rad.

    A beam that points ε off hits the plane ``ρ ε tan(i)`` farther or nearer, i the incidence, and
    its return is recorded on the nominal beam. That scatter along the ray goes ``sin(i) cos(i)`` of
    itself squared into the covariance of height and distance, which over the variance of the
    distance is a slope.

    Parameters
    ----------
    rays, normals, spread
        (M, 3) from the beam origin to the centres, metres, (M, 3) unit normals, and (M, 3, 3)
        covariance of the points.
    """
    ranges = lengths(rays)
    away = np.abs(np.einsum("mi,mi->m", rays, normals)) / ranges
    across = rays / ranges[:, None]
    across -= np.einsum("mi,mi->m", across, normals)[:, None] * normals
    sine = lengths(across)
    across /= np.maximum(sine, 1e-9)[:, None]
    variance = np.einsum("mi,mij,mj->m", across, spread, across)
    scatter = (ranges * POINTING_NOISE) ** 2 * sine**3 / np.maximum(away, 1e-3)
    return np.asarray(across * (scatter / np.maximum(variance, 1e-12))[:, None])
