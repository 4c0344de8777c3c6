"""Which hypothesis is right: the poles cannot say, the scene around them can.

Three witnesses are heard for every hypothesis, and all are reported:

- the paper's (Xue et al. 2019, Tab. III): run ICP from the hypothesis and see how far it moves,
  ``e_r = ‖log(R_icp)^∨‖`` and ``e_t = ‖t_icp‖``; the one that moves least is right,
- overlap: the share of one cloud's points with a neighbour in the other,
- free space: a return of one LiDAR on a ray that the other saw pass through contradicts the
  hypothesis, whatever overlaps elsewhere.

The score is overlap minus contradiction, both as shares of the thinned points and the mean of both
directions. It needs no ICP. Thinning to one point per voxel keeps the dense ground near the
sensors from outvoting the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .. import se3
from ..datatypes import Array, BoolArray, Hypothesis, Match, PointCloud
from ..errors import Refusal
from .registration import CORES, MIN_CLOUD_POINTS, Surface, as_surface, register, voxel_downsample

IntpArray = NDArray[np.intp]

SCORING_VOXEL = 0.25
"""Clouds are thinned to one point per cube of this side, metres, before they are compared."""

OVERLAP_DISTANCE = 0.5
"""A point with a neighbour of the other cloud within this distance overlaps it, metres."""

ICP_CORRESPONDENCE_DISTANCE = 1.0
"""Correspondence distance of the paper's ICP, metres."""

ICP_POINTS = 2500
"""ICP takes every n-th thinned point so that about so many are left: it is reported, not relied
on, and it is run for every hypothesis."""

SCORING_SAMPLE = 6000
"""Overlap and free space take every n-th thinned point so that about so many are left: a share of
them has a standard error of less than 0.7 %."""

CELL = np.radians(1.0)
"""Side of a cell of the range image that tells how far a LiDAR saw in each direction."""

SEE_THROUGH = 0.5
"""A return must be this far, metres, and a tenth of its range, in front of what the other LiDAR
saw in its direction to contradict it: poles leave up to a degree of error in the pose."""


@dataclass(frozen=True, eq=False)
class RangeImage:
    """How far a LiDAR saw in each direction.

    Attributes
    ----------
    origin
        (3,) where the beams start, in the cloud's frame.
    nearest
        (E, A) least range in each cell of elevation and azimuth and its neighbours, metres;
        infinite where a cell holds no return, so that nothing is known there.
    seen
        (E, A) whether the cell itself holds a return.
    """

    origin: Array
    nearest: Array
    seen: BoolArray


def _cells(directions: Array, shape: tuple[int, int]) -> tuple[IntpArray, IntpArray]:
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    elevation = np.arctan2(directions[:, 2], np.hypot(directions[:, 0], directions[:, 1]))
    row = np.clip(((elevation + np.pi / 2) / np.pi * shape[0]).astype(np.intp), 0, shape[0] - 1)
    column = ((azimuth + np.pi) / (2 * np.pi) * shape[1]).astype(np.intp) % shape[1]
    return row, column


def range_image(cloud: PointCloud) -> RangeImage:
    """Sort a cloud's ranges into cells of direction about its beam origin."""
    shape = (int(np.pi / CELL), int(2 * np.pi / CELL))
    rays = cloud.xyz - cloud.origin
    row, column = _cells(rays, shape)
    image = np.full(shape, np.inf)
    np.minimum.at(image, (row, column), np.linalg.norm(rays, axis=1))
    # A point beside an edge may fall into the cell of what lies behind: take the nearest around.
    rows = np.pad(image, ((1, 1), (0, 0)), constant_values=np.inf)
    nearest = np.minimum(np.minimum(rows[:-2], rows[1:-1]), rows[2:])
    nearest = np.minimum(np.minimum(np.roll(nearest, 1, 1), nearest), np.roll(nearest, -1, 1))
    return RangeImage(cloud.origin, nearest, np.isfinite(image))


def free_space_violation(image: RangeImage, points: Array) -> float:
    """Share of points that lie where the LiDAR of ``image`` looked through.

    Parameters
    ----------
    image
        What the one LiDAR saw.
    points
        (N, 3) returns of the other, in the frame of the first.

    Notes
    -----
    A file that was moved into another frame keeps no word of where its sensor was. Seen from a
    wrong origin the witness is weaker, but it does not turn: a point that lies on a surface which
    the other LiDAR measured has that surface in its direction from wherever one looks, so the
    right hypothesis is not contradicted.
    """
    rays = points - image.origin
    ranges = np.linalg.norm(rays, axis=1)
    row, column = _cells(rays, image.nearest.shape)
    margin = np.maximum(SEE_THROUGH, 0.1 * ranges)
    behind = image.nearest[row, column] > ranges + margin
    return float(np.mean(behind & image.seen[row, column]))


def judge(
    target: PointCloud, source: PointCloud, matches: Sequence[Match]
) -> tuple[Hypothesis, ...]:
    """Hear the scene on every match of the poles.

    Parameters
    ----------
    target, source
        The whole clouds, each in its own frame.
    matches
        Candidate poses from `correspondence.match_poles`.

    Returns
    -------
    tuple of Hypothesis
        The best score first; matches whose poles do not fit exactly come after those that do.

    Raises
    ------
    Refusal
        ``too_few_points`` where a cloud is too small to compare.
    """
    points = (
        voxel_downsample(target.xyz, SCORING_VOXEL),
        voxel_downsample(source.xyz, SCORING_VOXEL),
    )
    for name, left in zip(("target", "source"), points, strict=True):
        if len(left) < MIN_CLOUD_POINTS:
            raise Refusal(
                "too_few_points",
                f"the {name} cloud thinned to {SCORING_VOXEL:g} m has {len(left)} points, {MIN_CLOUD_POINTS} are "
                "needed to tell the hypotheses apart; record a scene with more in it",
                {"lidar": name, "points": len(left), "needed": MIN_CLOUD_POINTS},
            )
    surface = as_surface(points[0])
    trees = cKDTree(points[0]), cKDTree(points[1])
    images = range_image(target), range_image(source)
    sampled = tuple(left[:: 1 + len(left) // SCORING_SAMPLE] for left in points)
    hypotheses = []
    for match in matches:
        T = match.T_target_source
        moved = se3.apply(T, sampled[1]), se3.apply(se3.inverse(T), sampled[0])
        distances = [
            tree.query(xyz, distance_upper_bound=ICP_CORRESPONDENCE_DISTANCE, workers=CORES)[0]
            for tree, xyz in zip(trees, moved, strict=True)
        ]
        overlap = float(np.mean([np.mean(d <= OVERLAP_DISTANCE) for d in distances]))
        free_space = float(np.mean([free_space_violation(images[k], moved[k]) for k in (0, 1)]))
        e_r, e_t = icp_motion(surface, sampled[1][distances[0] <= ICP_CORRESPONDENCE_DISTANCE], T)
        score = overlap - free_space
        hypotheses.append(Hypothesis(match, e_r, e_t, overlap, free_space, score))
    return tuple(sorted(hypotheses, key=lambda h: (not h.match.exact, -h.score)))


def icp_motion(target: Surface, points: Array, T: Array) -> tuple[float | None, float | None]:
    """How far ICP moves from a hypothesis: e_r (rad) and e_t (m) of the paper's Tab. III.

    Parameters
    ----------
    target
        The prepared target cloud.
    points
        (N, 3) source points with a target neighbour within `ICP_CORRESPONDENCE_DISTANCE` under ``T``: ICP uses no
        others, and looking for the neighbours of far ones is what takes its time.
    T
        (4, 4) the hypothesis, target from source.

    Returns
    -------
    e_r, e_t
        None where so few points lie near that ICP has nothing to go by: that it then stays where
        it is says nothing for the hypothesis.
    """
    points = points[:: 1 + len(points) // ICP_POINTS]
    if len(points) < MIN_CLOUD_POINTS:
        return None, None
    moved_by = register(
        target, as_surface(points), T, method="ICP", reach=ICP_CORRESPONDENCE_DISTANCE
    ).T_target_source @ se3.inverse(T)
    return se3.rotation_angle(moved_by[:3, :3]), float(np.linalg.norm(moved_by[:3, 3]))
