"""Surfels: small flat pieces of what LiDARs see, from moments that are added up sweep by sweep.

The points of each LiDAR are summed in small cubes, and a surfel is fitted to a cube and its 26
neighbours together. So a surface is never cut where it passes through the border of a cube, which
would separate the two halves of its noise. Where two LiDARs see one surface, how far their
surfels are from each other along the normal is what the calibration, and the LiDARs, are off there.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import combinations, product
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.errors import UsageError
from ..base.quantities import counted
from ..base.se3 import lengths
from ..surfaces.consistency import ground_normal
from ..surfaces.patches import MAX_FLATNESS, MIN_ACROSS, MIN_SPREAD
from .merging import LIDARS, Grid, Points, cell_keys, cells_at, summed

DEFAULT_CELL = 0.3
"""Side of the cubes, metres: three of them are as wide as the distance between rings of most LiDARs
on a wall at 20 m. With 0.2 and 0.5 the distances are the same to a millimetre
(benchmarks/merging.py, field, seeds 0 to 4)."""

MIN_POINTS = 12
"""A surfel has at least this many points of each LiDAR: four times what makes a plane."""

MAX_SURFEL_THICKNESS = 0.05
"""RMS distance of points from the plane above which they are not a surface, metres: single returns
scatter by up to 0.03 (`sensors.toml`)."""

SAME_NORMAL = float(np.cos(np.radians(15.0)))
"""Cosine of the angle that normals of one surface may differ by."""

NEAR_LEVEL, NEAR_VERTICAL = float(np.cos(np.radians(20.0))), float(np.sin(np.radians(20.0)))
"""Of the angle to the vertical: those of ground have a larger cosine, of walls a smaller."""

Kind = Literal["ground", "walls", "other"]
KINDS: tuple[Kind, ...] = ("ground", "walls", "other")


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over the points of each cell and LiDAR, about the middle of the cell.

    Attributes
    ----------
    size, anchor
        Side of the cells, metres, and the cell (3,) in the middle of the grid.
    keys
        (M,) of `cell_keys`, ascending.
    sums
        (M, 12): the number of points, their sum (3), that of the products x², y², z², xy, xz, yz
        (6), of the intensities, and the number of these.
    """

    size: float
    anchor: IntArray
    keys: IntArray
    sums: Array


@dataclass(frozen=True, eq=False)
class Surfels:
    """Flat pieces of surfaces.

    Attributes
    ----------
    centres, normals
        (M, 3) mean of the points, metres, and unit normals, towards the LiDARs that see them.
    radius, thickness
        (M,) of a disc with the extent of the points, and their RMS distance from it, metres.
    intensity
        (M,) mean, NaN if not known.
    count
        (M,) points.
    lidars
        (M,) whose points they are: bit k for LiDAR k.
    """

    centres: Array
    normals: Array
    radius: Array
    thickness: Array
    intensity: Array
    count: IntArray
    lidars: IntArray


@dataclass(frozen=True, eq=False)
class SurfaceDistance:
    """Distances between the surfaces of two LiDARs, surfel by surfel.

    Attributes
    ----------
    lidars
        Indices of both.
    centres, normals
        (M, 3) halfway between the two, metres, and the mean of their normals.
    distances
        (M,) of the second LiDAR's surface from the first's along the normal: positive where it is
        nearer to the LiDARs, metres.
    kinds
        (M,) index in `KINDS`.
    areas
        (M,) m².
    """

    lidars: tuple[int, int]
    centres: Array
    normals: Array
    distances: Array
    kinds: IntArray
    areas: Array


class Distance(NamedTuple):
    """Of one pair of LiDARs and kind of surface: medians of the distance and of its size, metres;
    the number of surfels, and their area, m²."""

    lidars: tuple[int, int]
    kind: Kind
    median_m: float
    median_signed_m: float
    surfels: int
    area_m2: float


def moments_of(sweeps: Iterable[Points], size: float = DEFAULT_CELL) -> Moments:
    """Add up fused sweeps, taken one at a time, by cell and LiDAR.

    Parameters
    ----------
    sweeps
        Of up to 32 LiDARs.
    size
        Side of a cell, metres.

    Raises
    ------
    UsageError
        As `merging.cell_keys`, and if there are more LiDARs.
    """
    grid, anchor = Grid(summed), np.zeros(3, np.int64)
    is_first = True
    for points in sweeps:
        if not len(points):
            continue
        if points["lidar"].max() >= LIDARS:
            raise UsageError(f"surfels are made of up to {LIDARS} LiDARs, there are more")
        if is_first:
            anchor, is_first = np.floor(points["xyz"][0] / size).astype(np.int64), False
        keys = cell_keys(points["xyz"], size, anchor, points["lidar"])
        order = np.argsort(keys, kind="stable")
        keys, xyz, intensity = keys[order], points["xyz"][order], points["intensity"][order]
        x, y, z = np.ascontiguousarray((xyz - (cells_at(keys, anchor) + 0.5) * size).T)
        is_known = np.isfinite(intensity)
        known, one = np.where(is_known, intensity, 0.0), np.ones(len(x))
        columns = one, x, y, z, x * x, y * y, z * z, x * y, x * z, y * z, known, is_known
        # Sorted, column by column: three times as fast as rows of which cells are made later.
        first = np.flatnonzero(np.diff(keys, prepend=np.int64(-1)))
        added = [np.add.reduceat(each, first, dtype=np.float64) for each in columns]
        grid.add(keys[first], np.column_stack(added))
    keys, sums = grid.all()
    return Moments(size, anchor, keys, sums.reshape(len(keys), 12))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Planes through the windows of cells: number of points, means (from the middle of the cell),
    covariances, their eigenvalues and normals, mean intensity, and which are surfaces."""

    count: Array
    mean: Array
    spread: Array
    values: Array
    normal: Array
    intensity: Array
    flat: BoolArray


BLOCK = 2**15
"""Cells that are looked at at a time: 3 MB of sums for each LiDAR."""


def _windows(moments: Moments, lidars: int) -> Iterator[tuple[Array, list[Array]]]:
    """Go through all cells: their middles (C, 3), and for each LiDAR sums (C, 12) over each cell
    and its neighbours, about the middle.
    """
    every, own = np.unique(moments.keys // LIDARS * LIDARS), moments.keys % LIDARS
    parts = [(moments.keys[own == k], moments.sums[own == k]) for k in range(lidars)]
    zero = np.zeros(3, np.int64)
    for start in range(0, len(every), BLOCK):
        cells = every[start : start + BLOCK]
        windows = []
        for k, (keys, sums) in enumerate(parts):
            total = np.zeros((len(cells), 12))
            for step in product((-1, 0, 1), repeat=3) if len(keys) else ():
                # Keys are linear in the cells.
                by = cell_keys(np.array([step]), 1.0, zero) - cell_keys(np.zeros((1, 3)), 1.0, zero)
                wanted = cells + by + k
                at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
                found = np.flatnonzero(keys[at] == wanted)
                total[found] += _shifted(sums[at[found]], np.array(step) * moments.size)
            windows.append(total)
        yield np.asarray((cells_at(cells, moments.anchor) + 0.5) * moments.size), windows


def _shifted(sums: Array, d: Array) -> Array:
    """Count sums (C, 12) from a place that lies ``-d`` from where they are counted from."""
    moved, n, s = sums.copy(), sums[:, :1], sums[:, 1:4]
    i, j = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    moved[:, 1:4] += n * d
    moved[:, 4:10] += s[:, i] * d[j] + s[:, j] * d[i] + n * (d[i] * d[j])
    return moved


def _fit(sums: Array, centres: Array, origins: Array) -> _Fit:
    """Fit planes to sums (C, 12) about the middles of cells (C, 3), seen from `origins` (C, 3)."""
    count = sums[:, 0]
    n = np.maximum(count, 1.0)[:, None]
    mean = sums[:, 1:4] / n
    spread = (sums[:, [4, 7, 8, 7, 5, 9, 8, 9, 6]] / n).reshape(-1, 3, 3)
    spread = spread - mean[:, :, None] * mean[:, None, :]
    values, vectors = np.linalg.eigh(spread)
    values = np.maximum(values, 1e-12)
    rays = centres + mean - origins
    ranges = np.maximum(lengths(rays), 1e-9)
    rays = rays / ranges[:, None]
    normal = vectors[:, :, 0]
    normal = np.where((np.einsum("ci,ci->c", normal, rays) > 0)[:, None], -normal, normal)
    with np.errstate(invalid="ignore"):
        intensity = sums[:, 10] / np.where(sums[:, 11] > 0, sums[:, 11], np.nan)
    flat = (count >= MIN_POINTS) & (values[:, 0] < MAX_SURFEL_THICKNESS**2)
    flat &= (values[:, 0] < MAX_FLATNESS * values[:, 1]) & (
        values[:, 1] > MIN_SPREAD**2 * values[:, 2]
    )
    flat &= _across(spread, rays) > MIN_ACROSS * ranges
    return _Fit(count, mean, spread, values, normal, intensity, flat)


def _across(spread: Array, rays: Array) -> Array:
    """Least extent (C,) of points as the LiDAR sees them, metres: a single ring has hardly any.

    The lesser eigenvalue of the covariance across the ray.
    """
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    seen = across @ spread @ across
    trace = np.trace(seen, axis1=1, axis2=2)
    squares = np.einsum("cij,cij->c", seen, seen)
    # Of three eigenvalues one is 0; the sum of the squares of the others is this.
    product_ = np.maximum(trace**2 - squares, 0.0) / 2
    least = (trace - np.sqrt(np.maximum(trace**2 - 4.0 * product_, 0.0))) / 2
    return np.asarray(np.sqrt(np.maximum(least, 0.0)))


def _in_cell(middle: Array, size: float) -> BoolArray:
    """Whether a place (C, 3), from the middle of its cell, is in it: no surface is used twice."""
    return np.asarray((np.abs(middle) <= size / 2).all(axis=1))


def surfels_of(moments: Moments, origins: Array) -> Surfels:
    """Fit surfels: one for each cell and side.

    LiDARs that see a cell from one side, with normals that agree, have one together: a thin wall
    has one on either side. Single rings and points not on a surface have none.

    Parameters
    ----------
    moments
        Of the points of all LiDARs.
    origins
        (L, 3) where the beams of each start, in the frame of the points.
    """
    parts = [
        part
        for middles, windows in _windows(moments, len(origins))
        for part in _surfels(middles, np.array(windows), origins, moments.size)
    ]
    empty = [np.zeros((0, 3))] * 2 + [np.zeros(0)] * 3 + [np.zeros(0, np.int64)] * 2
    return Surfels(*(np.concatenate(each) for each in zip(empty, *parts, strict=True)))


def _surfels(
    middles: Array, windows: Array, origins: Array, size: float
) -> Iterator[tuple[Array | IntArray, ...]]:
    """Make surfels of windows (L, C, 12): the fields of `Surfels`, one side of the cells at a
    time."""
    full = (windows[:, :, 0] >= MIN_POINTS).any(axis=0)
    middles, windows = middles[full], windows[:, full]
    fits = [_fit(own, middles, at) for own, at in zip(windows, origins, strict=True)]
    left = np.array([fit.flat for fit in fits])
    rows = np.arange(len(middles))
    while left.any():
        # In each cell, those that agree with the one that has the most points.
        most = np.argmax(np.where(left, windows[:, :, 0], -1.0), axis=0)
        of_most = np.array([fit.normal for fit in fits])[most, rows]
        group = left & [np.einsum("ci,ci->c", f.normal, of_most) > SAME_NORMAL for f in fits]
        own = np.flatnonzero(group.any(axis=0))
        sums = np.einsum("lc,lcj->cj", group[:, own], windows[:, own])
        fit = _fit(sums, middles[own], origins[most[own]])
        bits = np.array([1 << k for k in range(len(origins))]) @ group[:, own]
        good = fit.flat & _in_cell(fit.mean, size)
        yield (
            (middles[own] + fit.mean)[good],
            fit.normal[good],
            # A uniform disc has a quarter of its squared radius as variance along each axis.
            np.sqrt(2.0 * (fit.values[:, 1] + fit.values[:, 2]))[good],
            np.sqrt(fit.values[:, 0])[good],
            fit.intensity[good],
            fit.count[good].astype(np.int64),
            bits[good],
        )
        left &= ~group


def surface_distances(moments: Moments, origins: Array, up: Array) -> Iterator[SurfaceDistance]:
    """Compare the surfaces that two LiDARs see, for each two that share any.

    Both are planes with one normal n, that of the mean of their covariances, through their means
    c₁ and c₂: the distance is ``n · (c₂ − c₁)``, as where the planes of both are compared halfway
    between. On a curved surface that chord is at right angles to n.

    Parameters
    ----------
    moments, origins
        As of `surfels_of`.
    up
        (3,) unit vector.
    """
    parts: dict[tuple[int, int], list[tuple[Array, Array, Array]]] = {}
    for middles, windows in _windows(moments, len(origins)):
        rows = [np.flatnonzero(own[:, 0] >= MIN_POINTS) for own in windows]
        fits = [
            _fit(own[at], middles[at], origin)
            for own, at, origin in zip(windows, rows, origins, strict=True)
        ]
        for i, j in combinations(range(len(origins)), 2):
            shared, a, b = np.intersect1d(rows[i], rows[j], return_indices=True)
            both = fits[i].flat[a] & fits[j].flat[b]
            first, second = _some(fits[i], a[both]), _some(fits[j], b[both])
            found = _plane_distances(middles[shared[both]], first, second, moments.size)
            if len(found[0]):
                parts.setdefault((i, j), []).append(found)
    for (i, j), blocks in sorted(parts.items()):
        centres, normals, off = (np.concatenate(each) for each in zip(*blocks, strict=True))
        kinds = _kinds(centres, normals, min(origins[i] @ up, origins[j] @ up), up)
        # One surfel for each column of cells along the axis nearest to the normal.
        areas = moments.size**2 / np.abs(normals).max(axis=1)
        yield SurfaceDistance((i, j), centres, normals, off, kinds, areas)


def _some(fit: _Fit, rows: IntArray) -> _Fit:
    return _Fit(*(getattr(fit, field.name)[rows] for field in fields(fit)))


def _plane_distances(
    middles: Array, first: _Fit, second: _Fit, size: float
) -> tuple[Array, Array, Array]:
    """Compare the planes of two LiDARs in cells (C): centres, normals and distances of those that
    are of one surface.
    """
    between, halfway = second.mean - first.mean, (first.mean + second.mean) / 2
    normal = np.linalg.eigh(first.spread + second.spread)[1][:, :, 0]
    facing = np.einsum("ci,ci->c", normal, first.normal + second.normal)
    normal = np.where((facing < 0)[:, None], -normal, normal)
    good = _in_cell(halfway, size) & (lengths(between) < 1.5 * size)
    for fit in (first, second):
        good &= np.einsum("ci,ci->c", normal, fit.normal) > SAME_NORMAL
    off = np.einsum("ci,ci->c", normal, between)
    return (middles + halfway)[good], normal[good], off[good]


def _kinds(centres: Array, normals: Array, height: float, up: Array) -> IntArray:
    """Distinguish ground, below both LiDARs, from walls and what is neither."""
    steep = normals @ up
    is_ground = (steep > NEAR_LEVEL) & (centres @ up < height)
    is_wall = np.abs(steep) < NEAR_VERTICAL
    return np.where(is_ground, 0, np.where(is_wall, 1, 2))


def up_by_ground(cloud: PointCloud, T_frame_lidar: Array) -> Array:
    """Find the vertical (3,) in the frame of the pose, by the ground that a LiDAR sees.

    The axis of the LiDAR if it sees none: most LiDARs are upright.
    """
    normal = ground_normal(cloud, np.random.default_rng(0))
    normal = normal if normal @ cloud.axis >= 0 else -normal
    return np.asarray(T_frame_lidar[:3, :3] @ normal)


def distance_at(surfels: Surfels, apart: Sequence[SurfaceDistance], reach: float) -> Array:
    """Give the distance (M,) that was found nearest to each surfel, NaN if none is in reach."""
    found = np.full(len(surfels.centres), np.nan)
    if not apart or not len(found):
        return found
    centres, normals, off = (
        np.concatenate([getattr(each, name) for each in apart])
        for name in ("centres", "normals", "distances")
    )
    away, at = cKDTree(centres).query(surfels.centres, distance_upper_bound=reach)
    known = np.flatnonzero(np.isfinite(away))
    same = np.einsum("mi,mi->m", normals[at[known]], surfels.normals[known]) > SAME_NORMAL
    found[known[same]] = off[at[known[same]]]
    return found


def distances(apart: Iterable[SurfaceDistance]) -> list[Distance]:
    """Sum up the distances of surfaces, by pair of LiDARs and kind of surface; none is left out.

    Medians: single objects that moved, or that both see otherwise, move them little.
    """
    found = []
    for each in apart:
        for k, kind in enumerate(KINDS):
            own = each.distances[each.kinds == k]
            if len(own):
                area = float(each.areas[each.kinds == k].sum())
                middle = float(np.median(np.abs(own))), float(np.median(own))
                found.append(Distance(each.lidars, kind, *middle, len(own), area))
    return found


def in_words(found: Sequence[Distance], names: Sequence[str]) -> list[str]:
    """Describe it in a line for each pair: ``front–rear: ground 3 mm apart (120 surfels, 4.1
    m²)``."""
    lines: dict[tuple[int, int], list[str]] = {}
    for each in found:
        lines.setdefault(each.lidars, []).append(
            f"{each.kind} {1000 * each.median_m:.1f} mm apart ({1000 * each.median_signed_m:+.1f} "
            f"signed; {counted(each.surfels, 'surfel')}, {each.area_m2:.1f} m²)"
        )
    return [f"{names[i]}–{names[j]}: {', '.join(distances)}" for (i, j), distances in lines.items()]
