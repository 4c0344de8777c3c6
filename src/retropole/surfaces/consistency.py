"""Whether the objects in a scene agree with a pose: depth consistency, voxel by voxel.

Flat ground agrees with any pose that keeps it level, so it is left out. A voxel is a cube of the
rest. Under the pose, a point of it agrees where the other cloud has a point as near as the depth
tolerance; it is in the way where the other LiDAR looked through it; else it is hidden, or out
of view, and gives no information. A voxel has the same weight however many points it has.

A scene may fit at other poses as well, which a correlation over shifts shows. Poles that were
carried along a corridor or a street leave walls on walls: hardly anything is contradicted. The
objects between the walls are then displaced, and fit better where they were. All shifts are
compared at once, as the cross-correlation of the occupied cells, layer by layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.spatial import cKDTree

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PointCloud, every_nth
from ..base.uncertainty.confirmation import Confirmation
from ..extraction.lines import FIT_ROUNDS, clusters
from .averaging import DEPTH_TOLERANCE, averaged
from .patch_pairs import labels_of
from .registration import SAMPLE, voxel_downsample
from .visibility import (
    OVERLAP_DISTANCE,
    OWN_VEHICLE,
    RANGE_CELL,
    SCORING_VOXEL,
    RangeImage,
    cells_of,
    range_image,
    tree_of,
)

VOXEL, VOXEL_SIDE = 0.2, 1.0
"""Clouds are compared at one point per cube of the first side, counted by cubes of the second,
metres. Depths agree within no more than the second."""

RELATIVE_TOLERANCE = 0.02
"""Depths agree within `DEPTH_TOLERANCE` and this part of the range."""

BLOCK = 5.0
"""Side of a cube whose voxels may all be of one thing, metres."""

PER_PLACE = 2
"""Points of a voxel that speak for it where many poses are compared."""

EXPECTED = 0.3
"""At least this share of the voxels above the ground should agree, of those of the cloud that has
fewer. At the reference of 16 real pairs (benchmarks/semireal.py) 0.67 and more did, in 100
simulated recordings that were answered right 0.8 and more, in 8 wrong ones at most 0.02
(benchmarks/deception.py, seeds 100 to 115)."""

CLEARANCE = 0.3
"""What lies within this distance of the ground, metres, belongs to it, and `RELATIVE_TOLERANCE` of
its range more: it is cambered. What is as near to a pole is left out: poles agree with any pose
that they give."""

GROUND_TRIALS = 300
"""Planes through three points that are tried for the ground, of one for each of the points that
vote."""

MAX_TILT, LEVEL_VOTES = np.radians(45.0), 0.25
"""LiDARs are tilted by less, as a rule, rad; of a steeper plane every vote counts this much."""

OTHER_GROUND = np.radians(10.0)
"""Planes tilted against each other by more than this are not one ground, rad."""

MOVABLE = 2.5
"""What is no higher above the ground may have driven off since a map was made, metres: a van."""


SHARP = VOXEL_SIDE / RANGE_CELL
"""What of a map is farther does not speak against a pose, metres: in a cell of directions wider
than its cube a LiDAR looks past it. With it, the far front of a square, which is seen along itself,
spoke against 3 of 29 true poses there by more than `hypotheses.by_place.MAX_CONTRADICTED`
(benchmarks/mapped.py, seeds 0 to 99)."""


class Line(Protocol):
    """Where a pole is: all that is needed to leave it out."""

    @property
    def point(self) -> Array:
        """(3,) its middle, metres."""

    @property
    def direction(self) -> Array:
        """(3,) unit vector along it."""

    @property
    def length(self) -> float:
        """Metres."""


@dataclass(frozen=True, eq=False)
class SceneObjects:
    """Objects in the scene of one LiDAR, and what the LiDAR saw.

    Attributes
    ----------
    points
        (S, 3) off the ground and off the vehicle of the LiDAR, in its frame, metres.
    voxel
        (S,) number of the cube that each lies in.
    tree
        Of the whole downsampled cloud.
    image
        Of all returns.
    ground, up
        (3,) a point of the ground, metres, and its normal.
    """

    points: Array
    voxel: IntArray
    tree: cKDTree
    image: RangeImage
    ground: Array
    up: Array

    @property
    def voxels(self) -> int:
        """How many cubes hold anything."""
        return len(np.unique(self.voxel))

    def downsampled(self) -> SceneObjects:
        """Keep `PER_PLACE` points of each cube, or one more, spread over it."""
        order = np.argsort(self.voxel, kind="stable")
        _, first, size = np.unique(self.voxel[order], return_index=True, return_counts=True)
        rank = np.arange(len(order)) - np.repeat(first, size)
        step = np.repeat(np.maximum(size // PER_PLACE, 1), size)
        kept = order[rank % step == 0]
        return replace(self, points=self.points[kept], voxel=self.voxel[kept])


def objects_in(
    cloud: PointCloud,
    rng: np.random.Generator,
    poles: Sequence[Line] = (),
    *,
    max_tilt: float = MAX_TILT,
) -> SceneObjects:
    """Prepare a cloud without its poles, and a map without objects that may have driven off.

    The random numbers choose the planes that are tried for the ground. Those tilted by less than
    `max_tilt` against the LiDAR, rad, go before the others.
    """
    cloud = averaged(cloud)
    points = voxel_downsample(cloud.xyz, VOXEL)
    ranges = se3.lengths(points - cloud.origin)
    on_ground, ground, up = _ground(points, ranges, cloud.axis, rng, max_tilt)
    if cloud.is_map:
        kept = on_ground | ~_is_movable(points, ground, up)
        points, ranges, on_ground = points[kept], ranges[kept], on_ground[kept]
    counts = (ranges > OWN_VEHICLE) & ~on_ground & (ranges < (SHARP if cloud.is_map else np.inf))
    standing = points[counts]
    for pole in poles:
        standing = standing[~_is_near(standing, pole)]
    voxel = labels_of(np.floor(standing / VOXEL_SIDE)) if len(standing) else np.zeros(0, np.int64)
    image = range_image(cloud)
    return SceneObjects(standing, voxel, tree_of(points), image, ground, up)


def _is_movable(points: Array, ground: Array, up: Array) -> BoolArray:
    """Which points (N, 3) have nothing higher than `MOVABLE` in their column of `VOXEL_SIDE`."""
    away = points - ground
    height = np.abs(away @ up)
    column = labels_of(np.floor(away @ np.linalg.svd(up[None])[2][1:].T / VOXEL_SIDE))
    tallest = np.zeros(int(column.max(initial=-1)) + 1)
    np.maximum.at(tallest, column, height)
    return np.asarray(tallest[column] < MOVABLE)


def movable_objects(cloud: PointCloud, points: Array) -> IntArray:
    """Number what may have driven off since a map was made, object by object.

    Parameters
    ----------
    cloud
        The map.
    points
        (N, 3) on surfaces, in its frame, metres.

    Returns
    -------
    (N,)
        From 1 on; 0 for the ground, and where there is something high in the map or in the points.
    """
    # The same map gives the same.
    standing = objects_in(cloud, np.random.default_rng(0))
    both = np.concatenate([cloud.xyz, points])
    movable = _is_movable(both, standing.ground, standing.up)[len(cloud) :]
    height = np.abs((points - standing.ground) @ standing.up)
    stands = height > CLEARANCE + RELATIVE_TOLERANCE * se3.lengths(points - cloud.origin)
    own = np.flatnonzero(movable & stands)
    found = np.zeros(len(points), dtype=np.int64)
    for k, members in enumerate(clusters(points[own], VOXEL_SIDE), 1):
        found[own[members]] = k
    # Its foot is as near the ground as ground is.
    foot = np.flatnonzero(movable & ~stands)
    if len(own) and len(foot):
        near = tree_of(points[own]).query(points[foot], distance_upper_bound=VOXEL_SIDE)[1]
        found[foot] = np.r_[found[own], 0][near]
    return found


def grounds_in(
    cloud: PointCloud, rng: np.random.Generator, poles: Sequence[Line] = ()
) -> tuple[SceneObjects, ...]:
    """Prepare a cloud for each plane that may be the ground: as usual, and off the largest."""
    usual = objects_in(cloud, rng, poles)
    largest = objects_in(cloud, rng, poles, max_tilt=np.pi)
    return (usual,) if _is_one_plane(usual.up, largest.up) else (usual, largest)


def is_ground_on_ground(target: SceneObjects, source: SceneObjects, T: Array) -> bool:
    """Whether a pose (4, 4) lays the ground of one LiDAR along that of the other."""
    return _is_one_plane(target.up, T[:3, :3] @ source.up)


def _is_one_plane(normal: Array, other: Array) -> bool:
    return bool(abs(normal @ other) > np.cos(OTHER_GROUND))


def ground_normal(cloud: PointCloud, rng: np.random.Generator) -> Array:
    """Find the normal (3,) of the plane that most of a cloud's points off walls lie on."""
    points = voxel_downsample(averaged(cloud).xyz, VOXEL)
    return _ground(points, se3.lengths(points - cloud.origin), cloud.axis, rng, MAX_TILT)[2]


def ground_plane(
    points: Array, ranges: Array, axis: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Find a point (3,) and the normal (3,) of the plane that most points (N, 3) lie on.

    `ranges` (N,) are theirs, metres; planes across the axis (3,) go before walls.
    """
    return _ground(points, ranges, axis, rng, MAX_TILT)[1:]


def _is_near(points: Array, pole: Line) -> BoolArray:
    """Which points (N, 3) are the pole's, or lie next to it."""
    away = points - pole.point
    along = away @ pole.direction
    across = se3.lengths(away - along[:, None] * pole.direction)
    beyond = np.abs(along) - pole.length / 2
    return np.asarray((across < CLEARANCE) & (beyond < CLEARANCE))


def _ground(
    points: Array, ranges: Array, axis: Array, rng: np.random.Generator, max_tilt: float
) -> tuple[BoolArray, Array, Array]:
    """Which points lie on the plane that most of a sample lies on, its middle and normal (3,).

    Along a street or a corridor more may lie on a wall: a plane across the LiDAR's axis, which is
    seldom tilted by more than `MAX_TILT`, goes before the others.
    """
    sample = every_nth(points, SAMPLE)
    if len(sample) < 3:
        return np.zeros(len(points), dtype=bool), np.zeros(3), axis
    a, b, c = (sample[rng.integers(len(sample), size=SAMPLE)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    area = se3.lengths(normals)
    normals /= np.maximum(area, VOXEL**2)[:, None]
    is_level = np.abs(normals @ axis) > np.cos(max_tilt)
    tried = np.argsort(~(is_level & (area > VOXEL**2)), kind="stable")[:GROUND_TRIALS]
    a, normals, area, is_level = (each[tried] for each in (a, normals, area, is_level))
    # In single precision, which is exact to a hundredth of a millimetre, in half the time.
    level, across = sample.astype(np.float32), normals.astype(np.float32)
    height = level @ across.T - np.einsum("ij,ij->i", a, normals).astype(np.float32)
    votes = np.count_nonzero(np.abs(height) < DEPTH_TOLERANCE, axis=0)
    votes = np.where(area > VOXEL**2, votes, -1)
    best = int(np.argmax(np.where(is_level, votes, LEVEL_VOTES * votes)))
    middle, up = a[best], normals[best]
    for _ in range(FIT_ROUNDS):
        near = sample[np.abs((sample - middle) @ up) < DEPTH_TOLERANCE]
        if len(near) < 3:
            break
        middle = near.mean(axis=0)
        up = np.linalg.svd((near - middle).T @ (near - middle))[0][:, 2]
    height = np.abs((points - middle) @ up)
    return np.asarray(height < CLEARANCE + RELATIVE_TOLERANCE * ranges), middle, up


def consistency(target: SceneObjects, source: SceneObjects, T: Array) -> Confirmation:
    """Count the voxels of both clouds that agree with a pose (4, 4), target from source."""
    found = verdicts(target, source, T)
    agreeing = int(np.count_nonzero(found > 0))
    expected = EXPECTED * min(target.voxels, source.voxels)
    missing = max(round(expected) - agreeing, 0)
    return Confirmation(
        agreeing=agreeing, contradicting=int(np.count_nonzero(found < 0)), missing=missing
    )


def verdicts(target: SceneObjects, source: SceneObjects, T: Array) -> IntArray:
    """State for each voxel, of the source and then of the target, what the other LiDAR saw there.

    1 where it agrees with a pose (4, 4), -1 where it is in the way, and 0 where nothing is known.
    """
    return np.concatenate([_votes(target, source, T), _votes(source, target, se3.inverse(T))])


def blocks(target: SceneObjects, source: SceneObjects, T: Array) -> IntArray:
    """Number the cubes of `BLOCK` that each voxel lies in, in the order of `verdicts`."""
    at = []
    for each, pose in ((source, T), (target, np.eye(4))):
        own = np.zeros((int(each.voxel.max(initial=-1)) + 1, 3))
        own[each.voxel] = np.floor(se3.apply(pose, each.points) / BLOCK)
        at.append(own)
    cells = np.concatenate(at)
    return labels_of(cells) if len(cells) else np.zeros(0, np.int64)


def contradicting_points(
    target: SceneObjects, source: SceneObjects, T: Array
) -> tuple[Array, Array]:
    """Find the points at which the other LiDAR looked through, in conflicting voxels.

    Parameters
    ----------
    target, source
        The objects in the scene of each.
    T
        (4, 4) target from source.

    Returns
    -------
    tuple of Array
        (N, 3) of the target and (M, 3) of the source, each in the frame of its LiDAR, metres.
    """
    found = []
    for seer, other, pose in ((source, target, se3.inverse(T)), (target, source, T)):
        in_the_way, yes, no = _judged(seer, other, pose)
        found.append(other.points[in_the_way & (no > yes)[other.voxel]])
    return found[0], found[1]


def coincides(points: Array, seer: SceneObjects, T: Array) -> bool:
    """Whether most points (N, 3) of the other cloud, moved by ``T`` (4, 4), lie on its points."""
    moved = se3.apply(T, points)
    return bool(np.median(_agrees(seer, moved, se3.lengths(moved - seer.image.origin))))


def _agrees(seer: SceneObjects, moved: Array, ranges: Array) -> BoolArray:
    """Which points (N, 3), at `ranges` from the seer, have one of its points within tolerance."""
    near = seer.tree.query(moved, distance_upper_bound=VOXEL_SIDE)[0]
    return np.asarray(near < _tolerance(ranges))


def _tolerance(ranges: Array) -> Array:
    """Largest difference of depths that agree, metres."""
    return np.minimum(DEPTH_TOLERANCE + RELATIVE_TOLERANCE * ranges, VOXEL_SIDE)


class _Judged(NamedTuple):
    """Which points are in the way, and how many of each voxel agree and are in the way."""

    in_the_way: BoolArray
    yes: IntArray
    no: IntArray


def _judged(seer: SceneObjects, other: SceneObjects, T: Array) -> _Judged:
    """Hold the points of the other cloud against what the seer saw."""
    moved = se3.apply(T, other.points)
    rays = moved - seer.image.origin
    ranges = se3.lengths(rays)
    agrees = _agrees(seer, moved, ranges)
    cells = cells_of(rays)
    nearest = seer.image.nearest
    is_before = nearest.ranges[cells] > ranges + _tolerance(ranges)
    in_the_way = ~agrees & nearest.seen[cells] & is_before
    count = int(other.voxel.max()) + 1 if len(other.voxel) else 0
    yes = np.bincount(other.voxel[agrees], minlength=count)
    no = np.bincount(other.voxel[in_the_way], minlength=count)
    return _Judged(in_the_way, yes, no)


def _votes(seer: SceneObjects, other: SceneObjects, T: Array) -> IntArray:
    """Say of each voxel of the other cloud whether what the seer saw agrees, or sees through it."""
    _, yes, no = _judged(seer, other, T)
    return np.where(no > yes, -1, np.where(yes > 0, 1, 0))


LAYER = 0.75
"""Side and height of a cell, metres; where heights are compared, the height and the side."""

LARGEST_SHIFT = 6.0
"""Shifts that are tried, metres."""

PEAKS = 4
"""Number of shifts that are found, farther from each other than `OVERLAP_DISTANCE`: the shift with
most coinciding cells need not be that with most agreement of the scene."""

HALF_SIDE = 30.0
"""Cells within this distance of the middle of the source's points are compared, metres."""


@dataclass(frozen=True, eq=False)
class Shift:
    """The best shift away from a pose.

    Attributes
    ----------
    step
        (3,) of the source in the target's frame, metres.
    gain
        How many more cells coincide there than at the pose, or points with cells, as a ratio.
    """

    step: Array
    gain: float


def best_shifts(target: Array, source: Array, up: Array, T: Array) -> list[Shift]:
    """Find the shifts along the ground at which most cells coincide.

    Parameters
    ----------
    target, source
        (N, 3) and (M, 3) points off the ground, each in the frame of its LiDAR, metres.
    up
        (3,) normal of the ground, target's frame.
    T
        (4, 4) target from source.

    Returns
    -------
    list of Shift
        At most `PEAKS`, the best first; none where the clouds have nothing to compare.
    """
    if not len(target) or not len(source):
        return []
    axes, cells, shape = _cells(target, source, up, T, np.array([*[SCORING_VOXEL] * 2, LAYER]))
    fast = [fft.next_fast_len(int(n), real=True) for n in shape[:2]]
    spectrum = np.zeros((fast[0], fast[1] // 2 + 1), dtype=np.complex64)
    for layer in range(int(shape[2])):
        grids = [_occupied(one, layer, fast) for one in cells]
        if all(grid.any() for grid in grids):
            # A cell's neighbours count half: surfaces are sampled at other points.
            grids[0] += _with_neighbours(grids[0].copy())
            spectrum += fft.rfft2(grids[0] / 2) * np.conj(fft.rfft2(grids[1]))
    total = fft.irfft2(spectrum, s=fast)
    # The shifts about the pose as it is, from one end to the other.
    reach = int(LARGEST_SHIFT / SCORING_VOXEL)
    total = np.roll(total, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    return _peaks(total, axes[:2])


def best_lifts(target: Array, source: Array, up: Array, T: Array) -> list[Shift]:
    """Find the shifts along the ground's normal at which most points lie in cells of the target.

    Poles that were swapped may lift a pose by metres: walls agree with it all the same, and the
    ground is left out of the points. Arguments and result are those of `best_shifts`.
    """
    if not len(target) or not len(source):
        return []
    axes, (a, b), shape = _cells(target, source, up, T, np.array([LAYER, LAYER, SCORING_VOXEL]))
    reach = int(LARGEST_SHIFT / SCORING_VOXEL)
    # Room above and below for what is lifted.
    occupied = np.zeros((*shape[:2], shape[2] + 2 * reach), dtype=bool)
    occupied[a[:, 0], a[:, 1], a[:, 2] + reach] = True
    lifts = np.arange(2 * reach + 1)
    met = occupied[b[:, None, 0], b[:, None, 1], b[:, None, 2] + lifts]
    return _peaks(np.count_nonzero(met, axis=0).astype(np.float32), axes[2:])


def _cells(
    target: Array, source: Array, up: Array, T: Array, size: Array
) -> tuple[Array, list[IntArray], IntArray]:
    """Cells of a size (3,) that both clouds lie in under a pose, about the middle of the source.

    Gives the axes of the cells as rows, the last along the ground's normal, the cell (N, 3) and
    (M, 3) of every point that is not too far away, and how many there are along each axis.
    """
    level = np.linalg.svd(up[None, :])[2]
    axes = np.concatenate([level[1:], up[None, :]])
    a, b = target @ axes.T, se3.apply(T, source) @ axes.T
    middle = np.median(b, axis=0)
    low = np.maximum(np.minimum(a.min(axis=0), b.min(axis=0)), middle - HALF_SIDE) - LARGEST_SHIFT
    high = np.minimum(np.maximum(a.max(axis=0), b.max(axis=0)), middle + HALF_SIDE) + LARGEST_SHIFT
    shape = np.ceil((high - low) / size).astype(np.int64)
    cells = [np.floor((one - low) / size).astype(np.int64) for one in (a, b)]
    cells = [one[np.all((one >= 0) & (one < shape), axis=1)] for one in cells]
    return axes, cells, shape


def _peaks(total: NDArray[np.float32], axes: Array) -> list[Shift]:
    """The best shifts along some axes (rows), of the cells that coincide at each."""
    place = (
        np.moveaxis(np.indices(total.shape), 0, -1) - int(LARGEST_SHIFT / SCORING_VOXEL)
    ) * SCORING_VOXEL
    apart = np.abs(place).max(axis=-1)
    here = max(float(total[apart <= SCORING_VOXEL].max()), 1.0)
    left = np.where(apart > OVERLAP_DISTANCE, total, -1.0)
    found = []
    for _ in range(PEAKS):
        best = np.unravel_index(int(np.argmax(left)), left.shape)
        if left[best] <= 0:
            break
        at = place[best] + SCORING_VOXEL * _beside_peak(total, best)
        found.append(Shift(at @ axes, float(left[best]) / here))
        left[np.abs(place - place[best]).max(axis=-1) <= OVERLAP_DISTANCE] = -1.0
    return found


def _beside_peak(values: NDArray[np.float32], best: tuple[np.intp, ...]) -> Array:
    """Where between the cells a peak lies, in cells: the top of a parabola along each axis."""
    found = np.zeros(values.ndim)
    for k in range(values.ndim):
        if not 0 < best[k] < values.shape[k] - 1:
            continue
        before, at, after = (
            float(values[tuple(i + step * (j == k) for j, i in enumerate(best))])
            for step in (-1, 0, 1)
        )
        bend = before - 2 * at + after
        found[k] = 0.0 if bend >= 0 else np.clip((before - after) / (2 * bend), -0.5, 0.5)
    return found


def _occupied(cells: IntArray, layer: int, fast: list[int]) -> NDArray[np.float32]:
    """Grid of one layer, 1 where a point lies; single precision counts thousands exactly."""
    within = cells[cells[:, 2] == layer]
    grid = np.zeros(fast, dtype=np.float32)
    grid[within[:, 0], within[:, 1]] = 1.0
    return grid


def _with_neighbours(grid: NDArray[np.float32]) -> NDArray[np.float32]:
    """The largest of each cell and the eight about it.

    `scipy.ndimage` has the same, and takes longer to import than a calibration in all its calls.
    """
    for one in (grid, grid.T):
        before = one.copy()
        np.maximum(one[1:], before[:-1], out=one[1:])
        np.maximum(one[:-1], before[1:], out=one[:-1])
    return grid
