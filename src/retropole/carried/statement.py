"""The answer of a walk as that of two LiDARs: with its parts of uncertainty and its key figures."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..alignment.certainty import FLOOR, part_of, root_of, uncertainty_of_pair
from ..base import se3
from ..base.carried import CarriedWalk
from ..base.datatypes import Array, Calibration, Placement, PoseEstimate, every_nth
from ..base.uncertainty import floor, predicted_error, weakest_direction
from .adjustment import Adjusted
from .verdict import extent_of
from .walk import WalkCalibration

MOST_PLACES = 400
"""So many places of the pole show its way."""

FEWEST_AXES = 20
"""So many places of the pole, evenly taken, stand for where it was."""

NO_POSE = np.zeros((6, 6))
"""What is not known of the pose of the target: it is the frame."""


def state_walk(
    found: WalkCalibration, placement: Placement, seconds: Mapping[str, float]
) -> Calibration:
    """State the answer of a walk.

    Parameters
    ----------
    found
        The answer.
    placement
        What both LiDARs recorded, without what moved.
    seconds
        Time of each step.
    """
    points, directions = axes_in_target(found.adjusted)
    scatter = root_of(found.adjusted.random)
    parts = [
        *found.adjusted.parts,
        part_of("scatter of the poles' returns", np.vstack([0 * scatter, scatter]), is_random=True),
        part_of(FLOOR, np.vstack([NO_POSE, root_of(floor())])),
    ]
    some = slice(None, None, max(1, len(points) // FEWEST_AXES))
    T, covariance = found.T_target_source, found.covariance
    return Calibration(
        status="ok",
        reasons=(),
        T_target_source=T,
        covariance=covariance,
        poles=PoseEstimate(T, covariance, rms_of(found.adjusted)),
        predicted_error=predicted_error(covariance),
        weakest=weakest_direction(T, covariance, points[some], directions[some]),
        placements=(placement,),
        seconds=seconds,
        uncertainty=uncertainty_of_pair(parts),
        walk=_figures(found, points, directions),
    )


def axes_in_target(adjusted: Adjusted) -> tuple[Array, Array]:
    """Where the pole was, (S, 3) metres, and where it pointed, (S, 3), in the target's frame."""
    x, y, u, v = adjusted.axes.T
    T = se3.inverse(adjusted.T_walk_target)
    along = np.stack([u, v, np.ones_like(u)], axis=1) @ T[:3, :3].T
    points = se3.apply(T, np.stack([x, y, 0 * x], axis=1))
    return points, along / np.linalg.norm(along, axis=1, keepdims=True)


def rms_of(adjusted: Adjusted) -> float:
    """Root mean square of how far returns are off the pole along their beams, metres."""
    off, weights = adjusted.off_along, adjusted.weights[:, 0]
    return float(np.sqrt(np.sum(weights * off**2) / max(weights.sum(), 1.0)))


def _figures(found: WalkCalibration, points: Array, directions: Array) -> CarriedWalk:
    adjusted, (target, source) = found.adjusted, found.tracks
    along, across, lean = extent_of(adjusted)
    first, last = adjusted.times.min(), adjusted.times.max()
    inside = (adjusted.at >= first) & (adjusted.at <= last)
    path = np.column_stack([adjusted.at - first, points])[inside]
    scale, jitter = adjusted.spread.T
    # A direction has no sign: most LiDARs have their z axis upwards.
    up = directions.mean(axis=0)
    up *= np.sign(up[2] + (found.T_target_source[:3, 2] @ up)) or 1.0
    return CarriedWalk(
        clock_offset_s=-found.offset,
        clock_sigma_s=found.offset_sigma,
        clock_drift=-found.drift,
        middle_s=found.middle,
        seconds=float(last - first),
        sweeps=(target.sweeps, source.sweeps),
        found=(len(target.times), len(source.times)),
        along_m=along,
        across_m=across,
        lean_rad=lean,
        left_out=adjusted.left_out,
        range_scale=(float(scale[0]), float(scale[1])),
        edge_jitter_rad=(float(jitter[0]), float(jitter[1])),
        clock_windows=(adjusted.clock_windows * [1, -1, 1]).tolist(),
        up=up / np.linalg.norm(up),
        path=every_nth(path, MOST_PLACES).tolist(),
    )
