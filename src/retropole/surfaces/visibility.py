"""What one LiDAR saw, and whether the other's points agree with it: overlap and free space.

Overlap is the share of points with a neighbour in the other cloud. Free space is violated by a
point at which the other LiDAR looked through. Everything that uses either of these calls
this: the choice of the hypothesis, the check of a site, the score of a transform, other methods.

Which hypothesis is right the scene decides, since the poles cannot. Three measures are taken of
every hypothesis, and all are reported:

- the paper's (Xue et al. 2019, Tab. III): run ICP from the hypothesis and see how far it moves,
  ``e_r = ‖log(R_icp)^∨‖`` and ``e_t = ‖t_icp‖``; the one that moves least is right,
- overlap: the share of one cloud's points with a neighbour in the other,
- free-space violation: the share of one LiDAR's returns at which the other looked through.

The score is overlap less free-space violation, both as shares of the downsampled points and the
mean of both directions (`visibility`). It needs no ICP. See docs/method.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..base import se3
from ..base.datatypes import (
    Array,
    BoolArray,
    Hypothesis,
    IntArray,
    Match,
    PointCloud,
    every_nth,
    kept,
)
from ..base.errors import Refusal
from ..base.quantities import counted
from .averaging import averaged
from .registration import (
    MIN_CLOUD_POINTS,
    SAMPLE,
    Surface,
    as_surface,
    register,
    voxel_downsample,
)

RANGE_CELL = np.radians(1.0)
"""Side of a cell of the range image, rad: about the spacing of 32 rings. Between sparser rings
cells stay empty, and give no information."""

OVERLAP_DISTANCE = 0.5
"""A point with a neighbour of the other cloud within this distance overlaps it, metres: the poles'
pose may be off by as much at the far end of a scan."""

RELATIVE_MARGIN = 0.1
"""A point must be that far, and this part of its range, in front of what the other LiDAR saw in its
direction to violate free space: poles leave up to a degree of error in the pose."""

OWN_VEHICLE = 1.5
"""Returns nearer than this to the beam origin are on the carrier of the LiDAR, metres."""

REACH_QUANTILE = 0.99
"""A LiDAR reaches as far as this quantile of its ranges: single returns come from farther."""


class Cells(NamedTuple):
    """Cells of direction: row by elevation from below, column by azimuth from −π."""

    row: NDArray[np.int32]
    column: NDArray[np.int32]


IMAGE_SHAPE = int(np.pi / RANGE_CELL), int(2 * np.pi / RANGE_CELL)


def cells_of(rays: Array) -> Cells:
    """Sort rays (N, 3), of any length, into cells of direction."""
    rows, columns = IMAGE_SHAPE
    # Functions of whole columns take a third of the time of those of every third number.
    x, y, z = np.ascontiguousarray(rays.T)
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.sqrt(x * x + y * y))
    row = ((elevation + np.pi / 2) / np.pi * rows).astype(np.int32)
    column = ((azimuth + np.pi) / (2 * np.pi) * columns).astype(np.int32)
    return Cells(np.clip(row, 0, rows - 1), column % columns)


class Nearest(NamedTuple):
    """Ranges by cell of direction.

    Attributes
    ----------
    ranges
        (E, A) least range in each cell and its neighbours, metres; infinite where none of them
        has a return.
    seen
        (E, A) whether the cell itself has a return.
    """

    ranges: Array
    seen: BoolArray


def nearest_around(cells: Cells, ranges: Array) -> Nearest:
    """Take the least range in each cell and its neighbours.

    A point next to an edge may fall into the cell of what lies behind, hence the neighbours.
    """
    image = _least(cells, ranges, 0, 1)[0]
    return Nearest(_with_neighbours(image), np.isfinite(image))


def nearest_by_frame(cells: Cells, ranges: Array, frame: IntArray, frames: int) -> Array:
    """Take the least range of each frame in each cell and its neighbours, (frames, E, A).

    The frame (N,) of each return is given, counted from 0.
    """
    return np.stack([_with_neighbours(image) for image in _least(cells, ranges, frame, frames)])


def _least(cells: Cells, ranges: Array, frame: IntArray | int, frames: int) -> Array:
    """Least range of each frame in each cell, (frames, E, A)."""
    image = np.full((frames, *IMAGE_SHAPE), np.inf)
    # With one index instead of three, NumPy takes a fiftieth of the time.
    index = (frame * IMAGE_SHAPE[0] + cells.row) * IMAGE_SHAPE[1] + cells.column
    np.minimum.at(image.reshape(-1), index, ranges)
    return image


def _with_neighbours(image: Array) -> Array:
    """Least of each cell of an image (E, A) and its neighbours; azimuths close the circle."""
    rows = np.pad(image, ((1, 1), (0, 0)), constant_values=np.inf)
    nearest = np.minimum(np.minimum(rows[:-2], rows[1:-1]), rows[2:])
    return np.minimum(np.minimum(np.roll(nearest, 1, 1), nearest), np.roll(nearest, -1, 1))


def range_margin(ranges: Array) -> Array:
    """How far behind a point (N,) the other LiDAR must have seen to contradict it, metres."""
    return np.maximum(OVERLAP_DISTANCE, RELATIVE_MARGIN * ranges)


@dataclass(frozen=True, eq=False)
class RangeImage:
    """How far a LiDAR saw in each direction.

    Attributes
    ----------
    origin
        (3,) where the beams start, in the cloud's frame.
    nearest
        Ranges by cell of direction.
    """

    origin: Array
    nearest: Nearest


@kept
def range_image(cloud: PointCloud) -> RangeImage:
    """Sort a cloud's ranges into cells of direction about its beam origin; a map has none."""
    rays = cloud.xyz[: 0 if cloud.is_map else None] - cloud.origin
    return RangeImage(cloud.origin, nearest_around(cells_of(rays), se3.lengths(rays)))


def free_space_violation(image: RangeImage, points: Array) -> float:
    """Share of points at which the LiDAR of ``image`` looked through.

    Parameters
    ----------
    image
        What the one LiDAR saw.
    points
        (N, 3) returns of the other, in the frame of the first.

    Notes
    -----
    A file that was moved into another frame no longer shows where its sensor was. Seen from a wrong
    origin the measure is weaker, but it does not turn against the truth: a point on a surface that
    the other LiDAR measured has that surface in its direction from wherever one looks, so the right
    hypothesis is not contradicted.
    """
    return float(np.mean(_seen_by(image, points).is_in_the_way))


class _Seen(NamedTuple):
    """Points by what a LiDAR saw: their ranges from it, metres, whether they are where it looked
    through, whether it has returns in their direction, and whether these are far before them.
    """

    ranges: Array
    is_in_the_way: BoolArray
    is_in_view: BoolArray
    is_hidden: BoolArray


def _seen_by(image: RangeImage, points: Array) -> _Seen:
    rays = points - image.origin
    ranges = se3.lengths(rays)
    cells = cells_of(rays)
    nearest = image.nearest.ranges[cells]
    margin = range_margin(ranges)
    is_in_the_way = (nearest > ranges + margin) & image.nearest.seen[cells]
    return _Seen(ranges, is_in_the_way, np.isfinite(nearest), nearest < ranges - margin)


def tree_of(points: Array) -> cKDTree:
    """Tree of points (N, 3) that is queried a few thousand times: split in the middle and not at
    the median it is built in half the time, and answers the same.
    """
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


@dataclass(frozen=True, eq=False)
class View:
    """What one LiDAR saw, prepared to be compared with another's view.

    Attributes
    ----------
    points
        (S, 3) a sample of the downsampled cloud, in its LiDAR's frame, metres.
    tree
        Of the whole downsampled cloud.
    image
        Of all returns.
    reach
        How far the LiDAR sees, metres from where its beams start.
    is_map
        Whether no LiDAR sees what the points show.
    """

    points: Array
    tree: cKDTree
    image: RangeImage
    reach: float
    is_map: bool = False

    @property
    def size(self) -> int:
        """How many points the downsampled cloud has."""
        return int(self.tree.n)


def view_of(cloud: PointCloud, voxel: float, sample: int | None = None) -> View:
    """Prepare a cloud.

    Parameters
    ----------
    cloud
        In the frame of its LiDAR.
    voxel
        It is downsampled to one point per cube of this side, metres, so that the dense ground near
        the LiDAR does not outnumber the rest.
    sample
        Every n-th point is compared, so that no more are; None compares all.
    """
    cloud = averaged(cloud)
    points = voxel_downsample(cloud.xyz, voxel)
    some = points if sample is None else every_nth(points, sample)
    image = range_image(cloud)
    ranges = se3.lengths(points - image.origin)
    reach = float(np.quantile(ranges, REACH_QUANTILE)) if len(points) else 0.0
    return View(some, tree_of(points), image, reach, cloud.is_map)


@kept
def scoring_view(cloud: PointCloud) -> View:
    """Prepare a cloud as hypotheses are scored by it."""
    return view_of(cloud, SCORING_VOXEL, SCORING_SAMPLE)


@dataclass(frozen=True, eq=False)
class Agreement:
    """How two views agree under a pose.

    Attributes
    ----------
    overlap, free_space_violation
        Shares of the points, mean of both directions. With a map, the first of the LiDAR's points,
        the second of those of the map in its view.
    covisible_overlap
        Overlap of the points of both clouds that both LiDARs could see: not on the vehicle of the
        LiDAR, where the other has returns in their direction, and no farther than it reaches. Of a
        map those that nothing hides, and of its LiDAR all.
    distances
        (S,) of the source's points from the target's cloud, metres; infinite beyond the limit.
    """

    overlap: float
    free_space_violation: float
    covisible_overlap: float
    distances: Array


def compare_views(
    target: View, source: View, T: Array, *, within: float, limit: float | None = None
) -> Agreement:
    """Compare two views under a pose.

    Parameters
    ----------
    target, source
        Each in the frame of its LiDAR.
    T
        (4, 4) target from source.
    within
        A point with a neighbour of the other cloud within this distance overlaps it, metres.
    limit
        Neighbours further away are not looked for, metres; None takes ``within``.
    """
    there, back = se3.apply(T, source.points), se3.apply(se3.inverse(T), target.points)
    bound = within if limit is None else limit
    distances = [
        tree.query(points, distance_upper_bound=bound)[0]
        for tree, points in ((target.tree, there), (source.tree, back))
    ]
    seen = _seen_by(target.image, there), _seen_by(source.image, back)
    sides = (source, target, seen[0]), (target, source, seen[1])
    could_see = np.concatenate([_covisible(*each) for each in sides])
    near = np.concatenate(distances) <= within
    covisible = float(np.mean(near[could_see])) if could_see.any() else 0.0
    # Most of a map lies outside of the view, and gives no information.
    violated = [
        each.is_in_the_way[_in_reach(other, each) if view.is_map else slice(None)]
        for view, other, each in sides
        if not other.is_map
    ]
    violation = np.mean([np.mean(each) if len(each) else 0.0 for each in violated])
    of_lidars = [each for each, (view, *_) in zip(distances, sides, strict=True) if not view.is_map]
    return Agreement(overlap(of_lidars, within), float(violation), covisible, distances[0])


def _covisible(view: View, other: View, seen: _Seen) -> BoolArray:
    """Which points of a view the other LiDAR could see."""
    if view.is_map:
        return np.asarray(_in_reach(other, seen) & ~seen.is_hidden)
    is_own = se3.lengths(view.points - view.image.origin) < OWN_VEHICLE
    return np.asarray(~is_own & (_in_reach(other, seen) | other.is_map))


def _in_reach(other: View, seen: _Seen) -> BoolArray:
    return np.asarray(seen.is_in_view & (seen.ranges <= other.reach))


def overlap(distances: Sequence[Array], within: float) -> float:
    """Share of points with a neighbour within a distance, metres: mean over both clouds."""
    return float(np.mean([np.mean(each <= within) for each in distances]))


SCORING_VOXEL = 0.25
"""Clouds are downsampled to one point per cube of this side, metres, before they are compared."""

ICP_CORRESPONDENCE_DISTANCE = 1.0
"""Largest distance of corresponding points in the paper's ICP, metres. The paper names none."""

SCORING_SAMPLE = SAMPLE
"""Overlap and free space take every n-th downsampled point so that no more are left."""


def score_hypotheses(
    target: PointCloud, source: PointCloud, matches: Sequence[Match]
) -> tuple[Hypothesis, ...]:
    """Score every match of the poles by the scene.

    Parameters
    ----------
    target, source
        The whole clouds, each in the frame of its LiDAR.
    matches
        Candidate poses from `hypotheses.correspondence.match_poles`.

    Returns
    -------
    tuple of Hypothesis
        The best score first; matches whose poles do not fit exactly come after those that do.

    Raises
    ------
    Refusal
        ``too_few_points`` where a cloud is too small to compare.
    """
    views = {
        "target": scoring_view(target),
        "source": scoring_view(source),
    }
    for name, view in views.items():
        if view.size < MIN_CLOUD_POINTS:
            raise Refusal(
                "too_few_points",
                f"the {name} cloud downsampled to {SCORING_VOXEL:g} m has "
                f"{counted(view.size, 'point')}, "
                f"{MIN_CLOUD_POINTS} are needed to distinguish the hypotheses; record a scene with "
                "more in it",
                {"lidar": name, "points": view.size, "needed": MIN_CLOUD_POINTS},
            )
    surface = as_surface(np.asarray(views["target"].tree.data))
    hypotheses = []
    for match in matches:
        T = match.T_target_source
        found = compare_views(
            views["target"],
            views["source"],
            T,
            within=OVERLAP_DISTANCE,
            limit=ICP_CORRESPONDENCE_DISTANCE,
        )
        near = views["source"].points[found.distances <= ICP_CORRESPONDENCE_DISTANCE]
        e_r, e_t = icp_motion(surface, near, T)
        score = found.overlap - found.free_space_violation
        hypotheses.append(
            Hypothesis(
                match,
                e_r,
                e_t,
                found.overlap,
                found.free_space_violation,
                score,
                found.covisible_overlap,
            )
        )
    return tuple(sorted(hypotheses, key=lambda h: (not h.match.exact, -h.score)))


def icp_motion(target: Surface, points: Array, T: Array) -> tuple[float | None, float | None]:
    """How far ICP moves from a hypothesis: e_r (rad) and e_t (m) of the paper's Tab. III.

    Parameters
    ----------
    target
        The prepared target cloud.
    points
        (N, 3) source points with a target neighbour within `ICP_CORRESPONDENCE_DISTANCE` under
        ``T``: ICP uses no others, and looking for the neighbours of far ones is what takes its
        time.
    T
        (4, 4) the hypothesis, target from source.

    Returns
    -------
    e_r, e_t
        None if too few points lie near for ICP to work with: that it then stays
        where it is does not support the hypothesis.
    """
    if len(points) < MIN_CLOUD_POINTS:
        return None, None
    moved_by = register(
        target,
        as_surface(points),
        T,
        method="ICP",
        max_correspondence_distance=ICP_CORRESPONDENCE_DISTANCE,
    ).T_target_source @ se3.inverse(T)
    return se3.rotation_angle(moved_by[:3, :3]), float(np.linalg.norm(moved_by[:3, 3]))
