"""Is an installed site still where it was? New recordings against a stored calibration.

The pose is found again, with the poles where they are there, by the scene alone where they are not.
Only the new clouds are laid on each other, so the place itself may have changed since. Whether the
new pose is the stored one is tested by `movement`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from threadpoolctl import threadpool_limits

from .. import se3
from ..datatypes import DEFAULT_RADIUS, Array, Calibration, PointCloud, PoseEstimate
from ..errors import Reason, Refusal, UsageError
from ..matching.prior import RotationPrior
from ..pipeline import calibrate
from ..quantities import error
from ..reasons import prefixed
from ..scene.choice import MIN_OVERLAP
from ..scene.confirmation import DENIED, count, is_denied, scenes_of
from ..scene.disambiguation import SCORING_VOXEL
from ..scene.refinement import refine
from ..scene.registration import MIN_CLOUD_POINTS
from ..scene.visibility import OVERLAP_DISTANCE, View, compare_views, view_of
from ..sensors import Sensor
from ..systematic import ErrorModel, sizes_of
from ..uncertainty import Confirmation, Uncertainty
from .fit import preferences
from .movement import (
    ROTATION,
    TRANSLATION,
    CheckResult,
    Method,
    compare_poses,
)
from .swapped import swapped_clouds, swapped_sensors
from .tolerance import DEFAULT_TOLERANCE, Tolerance

PARTS = ROTATION, TRANSLATION

NOT_TRUSTED = ("poles_and_scene_disagree", "several_minima")
"""Warnings of a new calibration by poles that leave the scene alone to answer."""

NO_RECORDINGS = ("far_from_lidar", "same_recording", "wrong_unit", "wrong_sensor")
"""Refusals of a new calibration that leave the scene nothing to answer by either."""

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


PREFERRED = 2.0
"""So many σ better the surfaces must fit under the new pose than under the stored one before it has
moved. The new pose is fitted to them: chance alone makes up to ½ √16.8 = 2.05 of it, once in a
hundred times (docs/check.md). Of 52 simulated recordings moved by the tolerance all have 2.8 and
more, corridors of few places least (seeds 0 to 12)."""


@dataclass(frozen=True, eq=False)
class _NewPose:
    """A pose found again, or None, and what there is to say of it.

    `unsure` says that it must not be taken for a movement, nor for none.
    """

    pose: PoseEstimate | None
    uncertainty: Uncertainty | None = None
    reasons: tuple[Reason, ...] = ()
    unsure: bool = False


@dataclass(frozen=True, eq=False)
class _Clouds:
    """The new recordings, without what moved, and both views where they are asked for."""

    target: PointCloud
    source: PointCloud

    @cached_property
    def views(self) -> tuple[View, View]:
        """Both clouds, prepared to be compared."""
        return view_of(self.target, SCORING_VOXEL), view_of(self.source, SCORING_VOXEL)


def check(
    stored: PoseEstimate,
    target: PointCloud,
    source: PointCloud,
    *,
    uncertainty: Uncertainty | None = None,
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
    uncertainty
        The stored covariance in its two kinds, where these LiDARs were calibrated by this program;
        None, as of a pose from elsewhere, shares no errors with the new one.
    tolerance
        The movement that matters.
    radius, radius_sigma, sensors, thresholds
        As for `pipeline.calibrate`.

    Raises
    ------
    UsageError
        Where the stored pose has no covariance.
    Refusal
        Of `NO_RECORDINGS`, such as ``same_recording``: no two recordings of these two LiDARs.
    """
    if stored.covariance is None:
        raise UsageError("the stored pose has no covariance: nothing tells how certain it is")
    calibrate_again = partial(
        calibrate,
        radius=radius,
        radius_sigma=radius_sigma,
        sensors=sensors,
        thresholds=thresholds,
    )
    again = calibrate_again(target, source)
    for reason in again.reasons:
        swapped = (
            swapped_sensors(again.placements[0], sensors) if reason.code == "wrong_sensor" else None
        )
        if swapped is not None:
            return CheckResult("cannot_tell", (swapped,))
        if reason.code in NO_RECORDINGS:
            raise Refusal(reason.code, reason.message, reason.values)
    clouds = _Clouds(again.placements[0].target.cloud, again.placements[0].source.cloud)
    by_poles = _by_poles(stored, clouds, again, calibrate_again)
    answer = _tested(stored, uncertainty, clouds, by_poles, tolerance, sensors)
    scenes = scenes_of(again.placements, np.random.default_rng(0))
    found = count(scenes, stored.T_target_source)
    T_poles = answer.T_target_source if answer.used == "poles" else None
    told = (stored.T_target_source, T_poles, scenes, found)
    swapped = None if answer.status == "same" else swapped_clouds(*told)
    if swapped is not None:
        return CheckResult("cannot_tell", (swapped,), confirmation=found)
    return _held_against_scene(replace(answer, confirmation=found), found)


def _tested(
    stored: PoseEstimate,
    uncertainty: Uncertainty | None,
    clouds: _Clouds,
    by_poles: _NewPose,
    tolerance: Tolerance,
    sensors: tuple[Sensor | None, Sensor | None],
) -> CheckResult:
    """Test the pose that the poles give, or else the scene, against the stored one."""
    reasons = by_poles.reasons
    if by_poles.pose is not None:
        answer = _compared(stored, uncertainty, by_poles, "poles", tolerance, reasons)
        denied = _denied_by_surfaces(stored, clouds, answer)
        if denied is None:
            return answer
        reasons = (Reason("poles_not_trusted", denied.message, denied.values),)
    model = ErrorModel(sizes_of(sensors[0]), sizes_of(sensors[1]))
    by_scene = _by_scene(stored, clouds, model)
    reasons += by_scene.reasons
    if by_scene.pose is None:
        return CheckResult("cannot_tell", reasons)
    answer = _compared(stored, uncertainty, by_scene, "scene", tolerance, reasons)
    denied = _denied_by_surfaces(stored, clouds, answer)
    if denied is not None:
        return replace(answer, status="cannot_tell", reasons=(*answer.reasons, denied))
    return replace(answer, status="cannot_tell") if by_scene.unsure else answer


def _held_against_scene(answer: CheckResult, found: Confirmation) -> CheckResult:
    """Take back that nothing moved where what stands in the scene denies the stored pose."""
    if answer.status != "same" or not is_denied(found):
        return answer
    denied = Reason(
        "scene_denies_stored",
        f"{found.denying} of {found.total} places off the ground deny the stored pose "
        f"({found.denied:.0%}; {DENIED:.0%} are allowed): they stand where the other LiDAR looked "
        "through, or should agree and do not. Were both clouds recorded at the same time, by the "
        "LiDARs of the stored result?",
        {
            "agreeing": found.agreeing,
            "contradicting": found.contradicting,
            "missing": found.missing,
            "allowed": DENIED,
        },
    )
    return replace(answer, status="cannot_tell", reasons=(*answer.reasons, denied))


def _compared(
    stored: PoseEstimate,
    uncertainty: Uncertainty | None,
    new: _NewPose,
    used: Method,
    tolerance: Tolerance,
    reasons: tuple[Reason, ...],
) -> CheckResult:
    assert new.pose is not None
    both = uncertainty, new.uncertainty
    return compare_poses(stored, new.pose, used, tolerance, reasons, both)


def _by_poles(
    stored: PoseEstimate,
    clouds: _Clouds,
    again: Calibration,
    calibrate_again: Callable[..., Calibration],
) -> _NewPose:
    """Calibrate again, from all hypotheses: a LiDAR that was turned round must not seem unmoved.

    Only where the surroundings do not decide between them, those near the stored pose are
    preferred: no LiDAR comes loose to end up half a turn away in a place of that symmetry.
    """
    answer = again
    if [reason.code for reason in answer.reasons] == ["ambiguous"]:
        near = RotationPrior(stored.T_target_source[:3, :3], NEAR_STORED_ROTATION)
        answer = calibrate_again(clouds.target, clouds.source, prior=near)
    pose = answer.refined or answer.poles
    if pose is None or pose.covariance is None or answer.T_target_source is None:
        reasons = (Reason(prefixed("poles", r.code), r.message, r.values) for r in answer.reasons)
        return _NewPose(None, reasons=tuple(reasons))
    misfit = _misfit(clouds, pose.T_target_source)
    wrong = [misfit] if misfit is not None else []
    wrong += [r for r in answer.reasons if r.code in NOT_TRUSTED]
    if wrong:
        reasons = (Reason("poles_not_trusted", r.message, r.values) for r in wrong)
        return _NewPose(None, reasons=tuple(reasons))
    said = tuple(r for r in answer.reasons if r.code == "not_converged")
    return _NewPose(pose, answer.uncertainty, said)


def _by_scene(stored: PoseEstimate, clouds: _Clouds, model: ErrorModel) -> _NewPose:
    """Lay the surfaces of both clouds on each other, from about the stored pose."""
    spread = np.r_[np.full(3, SEARCH_ROTATION), np.full(3, SEARCH_TRANSLATION)] ** 2
    start = PoseEstimate(stored.T_target_source, np.diag(spread), stored.rms)
    with threadpool_limits(1, user_api="blas"):
        refined = refine(clouds.target, clouds.source, start, model=model)
    if refined is None:
        reason = Reason(
            "no_common_surfaces",
            "near the stored pose the clouds have no surfaces in common: a LiDAR was moved by more "
            "than a few degrees or decimetres, these are other LiDARs (or the other way round), or "
            "the place has none; calibrate again",
            {},
        )
        return _NewPose(None, reasons=(reason,))
    misfit = _misfit(clouds, refined.pose.T_target_source)
    if misfit is not None:
        return _NewPose(None, reasons=(misfit,))
    reasons: list[Reason] = []
    if not refined.converged:
        reasons.append(
            Reason(
                "not_converged",
                f"the registration of the scene still moved after {refined.iterations} iterations",
                {"stage": "scene", "iterations": refined.iterations},
            )
        )
    if refined.other_minima:
        furthest = max(refined.other_minima, key=lambda one: float(np.linalg.norm(one[3:])))
        radians, metres = (float(np.linalg.norm(furthest[part])) for part in PARTS)
        reasons.append(
            Reason(
                "several_minima",
                "the surfaces of the new clouds fit each other at more than one pose near the "
                f"stored one, {error(metres)} and {error(radians, 'rad')} apart; set up the poles",
                {"apart_m": metres, "apart_rad": radians, "starts": 1 + len(refined.other_minima)},
            )
        )
    return _NewPose(refined.pose, refined.uncertainty, tuple(reasons), bool(refined.other_minima))


def _denied_by_surfaces(
    stored: PoseEstimate, clouds: _Clouds, answer: CheckResult
) -> Reason | None:
    """Say that the surfaces speak against a movement that was found; None where they do not.

    They speak against one that makes them fit no better than the stored pose does, if they can see
    such a movement at all: one of the same size the other way makes them fit worse. Where they
    cannot, poles may know better.
    """
    if answer.status != "moved" or answer.T_target_source is None or answer.step is None:
        return None
    T = answer.T_target_source
    beyond = se3.retract(T, answer.step)
    by_new, by_beyond = preferences(
        clouds.target, clouds.source, T, (stored.T_target_source, beyond)
    )
    seen = answer.used == "scene" or by_beyond >= PREFERRED or by_new <= -PREFERRED
    if by_new >= PREFERRED or not seen:
        return None
    return Reason(
        "stored_fits_as_well",
        "the new clouds fit each other under the stored pose as well as under the one that was "
        f"found, within their noise: the latter is better by {by_new:.1f} σ ({PREFERRED:g} are "
        "needed)",
        {"better_sigmas": by_new, "needed": PREFERRED},
    )


def _misfit(clouds: _Clouds, T: Array) -> Reason | None:
    """Say how far the clouds are from fitting together under a pose; None where they fit."""
    views = clouds.views
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
