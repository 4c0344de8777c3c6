"""The answer of a walk as that of two LiDARs: with its parts of uncertainty and its key figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..adjustment.agreement import (
    check_agreement,
    check_contradiction,
    check_decisive,
    check_minima,
)
from ..adjustment.refinement import Refinement, refine
from ..alignment.certainty import FLOOR, POLES, part_of, root_of, uncertainty_of_pair
from ..alignment.origins import beam_origins
from ..base import se3
from ..base.carried import CarriedWalk
from ..base.datatypes import Array, Calibration, Placement, PoseEstimate, every_nth
from ..base.errors import warnings_and_notes
from ..base.systematic import ErrorModel
from ..base.uncertainty import Uncertainty, floor, predicted_error, weakest_direction
from ..extraction.sensor_pattern import error_sizes
from ..hypotheses.evidence import check_confirmation, count, is_in_conflict, scenes_of
from ..hypotheses.placements import remaining_sway_in
from ..surfaces.averaging import averaged
from ..surfaces.consistency import SceneObjects
from ..verdict import check_sensor, check_sway
from .adjustment import Adjusted, in_recordings
from .verdict import extent_of
from .walk import WalkCalibration

MOST_PLACES = 400
"""So many places of the pole show its way."""

FEWEST_AXES = 20
"""Number of places of the pole, evenly taken, that represent where it was."""

CARRIER = 0.9
"""The person who carries the pole is no further from it, level, metres: an arm that is half bent,
and half a person (simulated people are within 0.6 m)."""

NO_POSE = np.zeros((6, 6))
"""What is not known of the pose of the target: it is the frame."""


def state_walk(
    found: WalkCalibration, placement: Placement, seconds: Mapping[str, float], *, scene: bool
) -> Calibration:
    """State the answer of a walk, refined by the surfaces around where they are known.

    Parameters
    ----------
    found
        The answer.
    placement
        What both LiDARs recorded, without what moved.
    seconds
        Time of each step.
    scene
        Whether the surfaces may refine it.

    Raises
    ------
    Refusal
        If a LiDAR moved, or if the surroundings conflict with the answer.
    """
    for scan in placement.scans:
        if scan.refusal is not None:
            raise scan.refusal
    points, directions = axes_in_target(found.adjusted)
    origins = beam_origins([placement])
    (about,) = origins.about([placement])
    shifts = [se3.from_rt(np.eye(3), -each) for each in (origins.target, origins.source)]
    adjusted = in_recordings(found.adjusted, shifts[0], shifts[1])
    walk = PoseEstimate(
        adjusted.T_target_source, adjusted.covariance[:6, :6] + floor(), rms_of(adjusted)
    )
    refined = _refined(walk, about) if scene else None
    pose = walk if refined is None else refined.pose
    assert pose.covariance is not None
    check_contradiction(refined)
    way = points - origins.target
    ways = way, se3.apply(se3.inverse(pose.T_target_source), way)
    confirmation = count([scene_beside(about, ways)], pose.T_target_source)
    if is_in_conflict(confirmation):
        check_confirmation(confirmation)
    some = slice(None, None, max(1, len(points) // FEWEST_AXES))
    axes = way[some], directions[some]
    reasons, notes = warnings_and_notes(
        [
            *check_sensor("target", placement.target),
            *check_sensor("source", placement.source),
            *check_sway("target", [placement.target]),
            *check_sway("source", [placement.source]),
            *check_agreement(refined),
            *check_minima(refined),
            *check_decisive(refined),
        ]
    )
    answer = Calibration(
        status="warn" if reasons else "ok",
        reasons=reasons,
        notes=notes,
        T_target_source=pose.T_target_source,
        covariance=pose.covariance,
        poles=walk,
        refined=None if refined is None else refined.pose,
        predicted_error=predicted_error(pose.covariance),
        weakest=weakest_direction(pose.T_target_source, pose.covariance, *axes),
        placements=(about,),
        seconds=seconds,
        uncertainty=_uncertainty(adjusted) if refined is None else refined.uncertainty,
        confirmation=confirmation,
        walk=_walk(found, points, directions),
    )
    return origins.moved_back(answer)


def scene_beside(
    placement: Placement, ways: tuple[Array, Array]
) -> tuple[SceneObjects, SceneObjects]:
    """Prepare both clouds, without what is near the way of the pole.

    A LiDAR whose beams hit nothing twice does not show that it is a person who walks there.

    Parameters
    ----------
    placement
        About the beam origins.
    ways
        (S, 3) where the pole was, in the frame of each.
    """
    target, source = scenes_of([placement], np.random.default_rng(0))[0]
    return _beside(target, ways[0]), _beside(source, ways[1])


def _beside(objects: SceneObjects, way: Array) -> SceneObjects:
    level = np.eye(3) - np.outer(objects.up, objects.up)
    away, _ = cKDTree(way @ level).query(objects.points @ level)
    far = away > CARRIER
    return replace(objects, points=objects.points[far], voxel=objects.voxel[far])


def _refined(walk: PoseEstimate, placement: Placement) -> Refinement | None:
    """Refine a walk's pose by the surfaces of both; None if they are few, or it does not end."""
    target, source = placement.scans
    first, second = (error_sizes(scan.cloud, scan.sensor) for scan in placement.scans)
    model = ErrorModel((first, second), 0.0, remaining_sway_in([placement]))
    refined = refine(averaged(target.cloud), averaged(source.cloud), walk, model=model)
    return refined if refined is not None and refined.converged else None


def _uncertainty(adjusted: Adjusted) -> Uncertainty:
    """How certain a walk alone is, in its two kinds, and what makes it so."""
    scatter = root_of(adjusted.random)
    parts = [
        *adjusted.parts,
        part_of(POLES, np.vstack([0 * scatter, scatter]), is_random=True),
        part_of(FLOOR, np.vstack([NO_POSE, root_of(floor())])),
    ]
    return uncertainty_of_pair(parts)


def axes_in_target(adjusted: Adjusted) -> tuple[Array, Array]:
    """Where the pole was, (S, 3) metres, and its direction, (S, 3), in the target's frame."""
    x, y, u, v = adjusted.axes.T
    T = se3.inverse(adjusted.T_walk_target)
    along = np.stack([u, v, np.ones_like(u)], axis=1) @ T[:3, :3].T
    points = se3.apply(T, np.stack([x, y, 0 * x], axis=1))
    return points, along / np.linalg.norm(along, axis=1, keepdims=True)


def rms_of(adjusted: Adjusted) -> float:
    """Root mean square of how far returns are off the pole along their beams, metres."""
    off, weights = adjusted.off_along, adjusted.weights[:, 0]
    return float(np.sqrt(np.sum(weights * off**2) / max(weights.sum(), 1.0)))


def figures_of(adjusted: Adjusted, points: Array, directions: Array) -> dict[str, Any]:
    """Say how the pole was carried, by the names of `CarriedWalk` and `SiteWalk`.

    Parameters
    ----------
    adjusted
        The answer.
    points, directions
        As of `axes_in_target`.
    """
    along, across, lean = extent_of(adjusted)
    first, last = adjusted.times.min(), adjusted.times.max()
    inside = (adjusted.at >= first) & (adjusted.at <= last)
    path = np.column_stack([adjusted.at - first, points])[inside]
    # A direction has no sign: most LiDARs have their z axis upwards.
    up = directions.mean(axis=0)
    up *= np.sign(np.sum(adjusted.T[:, :3, 2] @ up)) or 1.0
    return {
        "seconds": float(last - first),
        "along_m": along,
        "across_m": across,
        "lean_rad": lean,
        "left_out": adjusted.left_out,
        "up": up / np.linalg.norm(up),
        "path": every_nth(path, MOST_PLACES).tolist(),
    }


def _walk(found: WalkCalibration, points: Array, directions: Array) -> CarriedWalk:
    adjusted, (target, source) = found.adjusted, found.tracks
    scale, jitter = adjusted.spread.T
    return CarriedWalk(
        clock_offset_s=-found.offset,
        clock_sigma_s=found.offset_sigma,
        clock_drift=-found.drift,
        middle_s=found.middle,
        sweeps=(target.sweeps, source.sweeps),
        found=(len(target.times), len(source.times)),
        range_scale=(float(scale[0]), float(scale[1])),
        edge_jitter_rad=(float(jitter[0]), float(jitter[1])),
        clock_windows=(adjusted.clock_windows[1] * [1, -1, 1]).tolist(),
        **figures_of(adjusted, points, directions),
    )
