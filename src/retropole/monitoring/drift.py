"""Is an installed site still where it was? New recordings against a stored calibration.

The pose is found again, with the poles where they are there, by the scene alone where they are not.
Only the new clouds are laid on each other, so the place itself may have changed since. Whether the
new pose is the stored one is tested by `movement`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from ..datatypes import DEFAULT_RADIUS, Array, Calibration, PointCloud, PoseEstimate, Reason
from ..errors import UsageError
from ..matching.prior import RotationPrior
from ..pipeline import calibrate
from ..reasons import prefixed
from ..scene.disambiguation import SCORING_VOXEL
from ..scene.refinement import refine
from ..scene.registration import MIN_CLOUD_POINTS
from ..scene.static import remove_dynamic_points
from ..scene.visibility import OVERLAP_DISTANCE, compare_views, view_of
from ..sensors import Sensor
from ..verdict import MIN_OVERLAP
from .movement import DEFAULT_TOLERANCE, CheckResult, Tolerance, compare_poses

SEARCH_ROTATION, SEARCH_TRANSLATION = float(np.radians(1.0)), 0.1
"""1 σ about the stored pose from which the scene starts, rad and m: wide beside whatever the scene
holds, so that the answer is not drawn back to the stored pose, and too wide for *same* in what it
does not hold. Surfaces correspond over three times as much, and more."""

NEAR_STORED_ROTATION = float(np.radians(10.0))
"""1 σ of the rotation that decides between hypotheses where the surroundings do not, rad."""

MAX_FREE_SPACE_VIOLATION = 0.05
"""Share of the points that may stand, under the new pose, where the other LiDAR looked through. The
right pose has up to 0.02 of them, at the edges of objects; wrong ones that cling to the ground have
0.02 and more, but are then as uncertain as the search was wide (benchmarks/check.py)."""


@dataclass(frozen=True, eq=False)
class _NewPose:
    """A pose found again, or None, and what there is to say of it."""

    pose: PoseEstimate | None
    reasons: tuple[Reason, ...] = ()


def check(
    stored: PoseEstimate,
    target: PointCloud,
    source: PointCloud,
    *,
    tolerance: Tolerance = DEFAULT_TOLERANCE,
    radius: float = DEFAULT_RADIUS,
    radius_sigma: float = 0.0,
    sensors: tuple[Sensor | None, Sensor | None] = (None, None),
    thresholds: tuple[float | None, float | None] = (None, None),
) -> CheckResult:
    """Find the pose again and test it against the stored one.

    Parameters
    ----------
    stored
        The calibration of the site, with its covariance.
    target, source
        New recordings of the same two LiDARs, each in its own frame. Poles are used where both
        see them, and need not stand where they stood; without, or without intensities, the scene
        must do.
    tolerance
        The movement that matters.
    radius, radius_sigma, sensors, thresholds
        As for `pipeline.calibrate`.

    Raises
    ------
    UsageError
        Where the stored pose has no covariance.
    """
    if stored.covariance is None:
        raise UsageError("the stored pose has no covariance: nothing tells how certain it is")
    target, source = remove_dynamic_points(target), remove_dynamic_points(source)
    calibrate_again = partial(
        calibrate,
        radius=radius,
        radius_sigma=radius_sigma,
        sensors=sensors,
        thresholds=thresholds,
    )
    by_poles = _by_poles(stored, target, source, calibrate_again)
    if by_poles.pose is not None:
        return compare_poses(stored, by_poles.pose, "poles", tolerance, by_poles.reasons)
    by_scene = _by_scene(stored, target, source)
    reasons = by_poles.reasons + by_scene.reasons
    if by_scene.pose is not None:
        return compare_poses(stored, by_scene.pose, "scene", tolerance, reasons)
    return CheckResult("cannot_tell", reasons)


def _by_poles(
    stored: PoseEstimate,
    target: PointCloud,
    source: PointCloud,
    calibrate_again: Callable[..., Calibration],
) -> _NewPose:
    """Calibrate again, from all hypotheses: a LiDAR that was turned round must not seem unmoved.

    Only where the surroundings do not decide between them, those near the stored pose are
    preferred: no LiDAR comes loose to end up half a turn away in a place of that symmetry.
    """
    answer = calibrate_again(target, source)
    if [reason.code for reason in answer.reasons] == ["ambiguous"]:
        near = RotationPrior(stored.T_target_source[:3, :3], NEAR_STORED_ROTATION)
        answer = calibrate_again(target, source, prior=near)
    pose = answer.refined or answer.poles
    if pose is None or pose.covariance is None:
        return _NewPose(
            None,
            tuple(Reason(prefixed("poles", r.code), r.message, r.values) for r in answer.reasons),
        )
    misfit = _misfit(target, source, pose.T_target_source)
    wrong = [misfit] if misfit is not None else []
    wrong += [r for r in answer.reasons if r.code == "poles_and_scene_disagree"]
    if wrong:
        return _NewPose(
            None, tuple(Reason("poles_not_trusted", r.message, r.values) for r in wrong)
        )
    return _NewPose(pose, tuple(r for r in answer.reasons if r.code == "not_converged"))


def _by_scene(stored: PoseEstimate, target: PointCloud, source: PointCloud) -> _NewPose:
    """Lay the surfaces of both clouds on each other, from about the stored pose."""
    spread = np.r_[np.full(3, SEARCH_ROTATION), np.full(3, SEARCH_TRANSLATION)] ** 2
    start = PoseEstimate(stored.T_target_source, np.diag(spread), stored.rms)
    with threadpool_limits(1, user_api="blas"):
        refined = refine(target, source, start)
    if refined is None:
        reason = Reason(
            "no_common_surfaces",
            "near the stored pose the clouds have no surfaces in common: a LiDAR was moved by more "
            "than a few degrees or decimetres, these are other LiDARs (or the other way round), or "
            "the place has none; calibrate again",
            {},
        )
        return _NewPose(None, (reason,))
    misfit = _misfit(target, source, refined.pose.T_target_source)
    if misfit is not None:
        return _NewPose(None, (misfit,))
    if not refined.converged:
        reason = Reason(
            "not_converged",
            f"the registration of the scene still moved after {refined.iterations} iterations",
            {"stage": "scene", "iterations": refined.iterations},
        )
        return _NewPose(refined.pose, (reason,))
    return _NewPose(refined.pose)


def _misfit(target: PointCloud, source: PointCloud, T: Array) -> Reason | None:
    """Say how far the clouds are from fitting together under a pose; None where they fit."""
    views = view_of(target, SCORING_VOXEL), view_of(source, SCORING_VOXEL)
    sizes = {"target": views[0].size, "source": views[1].size}
    if min(sizes.values()) < MIN_CLOUD_POINTS:
        return Reason("too_few_points", "a cloud has too few points to compare", sizes)
    found = compare_views(*views, T, within=OVERLAP_DISTANCE)
    if found.overlap >= MIN_OVERLAP and found.free_space_violation <= MAX_FREE_SPACE_VIOLATION:
        return None
    return Reason(
        "clouds_do_not_fit",
        "the clouds do not fit together at or near the stored pose: "
        f"{found.overlap:.0%} of the points have a neighbour in the other cloud "
        f"({MIN_OVERLAP:.0%} are needed), {found.free_space_violation:.1%} stand where the other "
        f"LiDAR looked through ({MAX_FREE_SPACE_VIOLATION:.0%} are allowed): a LiDAR was moved "
        "far, these are other LiDARs, or they recorded at different times; calibrate again",
        {"overlap": found.overlap, "contradiction": found.free_space_violation},
    )
