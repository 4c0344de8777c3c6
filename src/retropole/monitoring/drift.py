"""Is an installed site still where it was? New recordings against a stored calibration.

The pose is found again, with the poles where they are there, by the scene alone where they are not.
Only the new clouds are laid on each other, so the place itself may have changed since. Whether the
new pose is the stored one is tested by `movement`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from msgspec import structs
from scipy.special import chdtri

from ..adjustment.masts import on_one_mast
from ..base import se3
from ..base.datatypes import DEFAULT_RADIUS, Calibration, PointCloud, PoseEstimate
from ..base.errors import Reason, Refusal, UsageError
from ..base.sensors import Sensor
from ..base.systematic import ErrorModel
from ..base.uncertainty import Uncertainty
from ..base.uncertainty.confirmation import Confirmation
from ..extraction.sensor_pattern import error_sizes
from ..hypotheses.evidence import MAX_CONFLICTING, count, is_in_conflict, scenes_of
from ..hypotheses.placements import left_in
from ..pipeline import calibrate
from ..verdict.preference import preferences
from .carrier import CarrierMotion, carrier_motion
from .certainty import FALSE_ALARM
from .movement import CheckResult, Method, compare_poses
from .new_pose import Clouds, NewPose, by_poles, by_scene, is_ambiguous, search_covariance
from .swapped import swapped_clouds, swapped_sensors
from .tolerance import NOT_ASKED, Asked

NO_RECORDINGS = ("far_from_lidar", "same_recording", "wrong_unit", "wrong_sensor")
"""Refusals of a new calibration that leave the scene nothing to answer by either."""

PREFERRED = 2.0
"""So many σ better the surfaces must fit under the new pose than under the stored one before it has
moved. The new pose is fitted to them: chance alone makes up to ½ √16.8 = 2.05 of it, once in a
hundred times (docs/check.md). Of 52 simulated recordings moved by the tolerance all have 2.8 and
more, corridors of few places least (seeds 0 to 12)."""


@dataclass(frozen=True, eq=False)
class _Question:
    """What is stored, by which devices, and how small a movement must be told."""

    stored: PoseEstimate
    uncertainty: Uncertainty | None
    tolerance: Asked
    sensors: tuple[Sensor | None, Sensor | None]
    carrier: CarrierMotion | None


def check(
    stored: PoseEstimate,
    target: PointCloud,
    source: PointCloud,
    *,
    uncertainty: Uncertainty | None = None,
    tolerance: Asked = NOT_ASKED,
    radius: float = DEFAULT_RADIUS,
    radius_sigma: float = 0.0,
    sensors: tuple[Sensor | None, Sensor | None] = (None, None),
    thresholds: tuple[float | None, float | None] = (None, None),
    mast_sway: float | None = None,
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
        The movement that matters, or as small a one as these data can tell.
    radius, radius_sigma, sensors, thresholds, mast_sway
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
    carrier = carrier_motion(stored.T_target_source, target, source)
    if carrier is not None and carrier.is_seen:
        target, source = carrier.taken_out(stored.T_target_source, target, source)
    question = _Question(stored, uncertainty, tolerance, sensors, carrier)
    calibrate_again = partial(
        calibrate,
        radius=radius,
        radius_sigma=radius_sigma,
        sensors=sensors,
        thresholds=thresholds,
        mast_sway=mast_sway,
    )
    # Surfaces about the stored pose tell more than candidate poles, in a thirtieth of the time.
    by_confirmed_poles = partial(calibrate_again, candidates=False)
    answer = _answered(question, by_confirmed_poles(target, source), by_confirmed_poles)
    if _is_off(answer):
        again = calibrate_again(target, source)
        # What the surfaces say without an answer of the poles was just found.
        if again.T_target_source is not None or is_ambiguous(again):
            answer = _answered(question, again, calibrate_again)
    return _with_carrier(answer, carrier)


def _with_carrier(answer: CheckResult, carrier: CarrierMotion | None) -> CheckResult:
    """Say that the carrier moved; take a movement back that its motion explains, as far as known.

    A movement of the rig has the same test as without, by the covariance that the motion adds.
    """
    if carrier is None:
        return answer
    if carrier.is_seen:
        return replace(answer, reasons=(carrier.seen, *answer.reasons))
    if answer.step is None or answer.covariance is None or answer.p_value is None:
        return answer
    if answer.status == "cannot_tell" or answer.p_value >= FALSE_ALARM:
        return answer
    left, covariance = answer.step - carrier.step, answer.covariance + carrier.covariance
    if left @ np.linalg.solve(covariance, left) > chdtri(6, FALSE_ALARM):
        return answer
    reason = carrier.explains(answer.step)
    if answer.status == "moved":
        return answer.untold(reason)
    return replace(answer, reasons=(*answer.reasons, reason))


def _answered(
    question: _Question, again: Calibration, calibrate_again: Callable[..., Calibration]
) -> CheckResult:
    """Hold a calibration of the new recordings against the stored pose."""
    sensors, T_stored = question.sensors, question.stored.T_target_source
    recorded = again.placements[0]
    for reason in again.reasons:
        swapped = swapped_sensors(recorded, sensors) if reason.code == "wrong_sensor" else None
        if swapped is not None:
            return CheckResult("cannot_tell", (swapped,))
        if reason.code in NO_RECORDINGS:
            raise Refusal(reason.code, reason.message, reason.values)
    (recorded,) = on_one_mast([recorded], T_stored)
    left = left_in([recorded])
    clouds = Clouds(recorded.target.cloud, recorded.source.cloud, left)
    new = by_poles(question.stored, clouds, again, calibrate_again)
    answer = _tested(question, clouds, new)
    scenes = scenes_of(again.placements, np.random.default_rng(0))
    found = count(scenes, T_stored)
    T_poles = answer.T_target_source if answer.used == "poles" else None
    if answer.status != "same":
        swapped = swapped_clouds(T_stored, T_poles, scenes, found)
        if swapped is not None:
            return CheckResult("cannot_tell", (swapped,), confirmation=found)
    return _held_against_scene(replace(answer, confirmation=found), found)


def _is_off(answer: CheckResult) -> bool:
    """Whether nothing fits about the stored pose: a LiDAR stands elsewhere, if not swapped.

    Then poles alone may say where.
    """
    codes = [reason.code for reason in answer.reasons]
    if answer.status != "cannot_tell" or "swapped" in codes or answer.confirmation is None:
        return False
    return answer.T_target_source is None or is_in_conflict(answer.confirmation)


def _tested(question: _Question, clouds: Clouds, new: NewPose) -> CheckResult:
    """Test the pose that the poles give, or else the scene, against the stored one."""
    stored, sensors = question.stored, question.sensors
    sizes = error_sizes(clouds.target, sensors[0]), error_sizes(clouds.source, sensors[1])
    model = ErrorModel(sizes, left=clouds.left)
    reasons, found = new.reasons, None
    if new.pose is not None:
        answer = _compared(question, new, "poles", reasons)
        doubt = _doubt(stored, clouds, answer)
        if doubt is None:
            return answer
        found = by_scene(stored, clouds, model)
        if not (doubt.seen or _is_contradicted_by(found, new.pose)):
            return answer
        reasons = (Reason("poles_not_trusted", doubt.reason.message, doubt.reason.values),)
    found = found or by_scene(stored, clouds, model)
    reasons += found.reasons
    if found.pose is None:
        return CheckResult("cannot_tell", reasons)
    answer = _compared(question, found, "scene", reasons)
    doubt = _doubt(stored, clouds, answer)
    if doubt is not None:
        return answer.untold(doubt.reason)
    return answer.untold() if found.unsure else answer


def _held_against_scene(answer: CheckResult, found: Confirmation) -> CheckResult:
    """Take back that nothing moved where the scene conflicts with the stored pose."""
    if answer.status != "same" or not is_in_conflict(found):
        return answer
    contradicted = Reason(
        "scene_denies_stored",
        f"under the stored pose, of the patches off the ground {found.counts} "
        f"({found.contradicted:.0%} against it; {MAX_CONFLICTING:.0%} are allowed). Were both "
        "clouds recorded at the same time, by the LiDARs of the stored result?",
        {
            "agreeing": found.agreeing,
            "contradicting": found.contradicting,
            "missing": found.missing,
            "allowed": MAX_CONFLICTING,
        },
    )
    return answer.untold(contradicted)


def _compared(
    question: _Question, new: NewPose, used: Method, reasons: tuple[Reason, ...]
) -> CheckResult:
    assert new.pose is not None
    pose, uncertainty, carrier = new.pose, new.uncertainty, question.carrier
    if carrier is not None and carrier.is_seen:
        # What was taken out is known no better.
        assert pose.covariance is not None
        pose = structs.replace(pose, covariance=pose.covariance + carrier.covariance)
        if uncertainty is not None:
            more = uncertainty.random + carrier.covariance
            uncertainty = structs.replace(uncertainty, random=more)
    both = question.uncertainty, uncertainty
    return compare_poses(question.stored, pose, used, question.tolerance, reasons, both)


class _Doubt(NamedTuple):
    """Why a movement that was found may be none, and whether the surfaces could see it at all."""

    reason: Reason
    seen: bool


def _doubt(stored: PoseEstimate, clouds: Clouds, answer: CheckResult) -> _Doubt | None:
    """Doubt a movement under which the surfaces fit no better; None where there is nothing to.

    They could have seen it where one of the same size the other way makes them fit worse.
    """
    if answer.status != "moved" or answer.T_target_source is None or answer.step is None:
        return None
    T = answer.T_target_source
    beyond = se3.retract(T, answer.step)
    others = (stored.T_target_source, beyond)
    by_new, by_beyond = preferences(clouds.target, clouds.source, T, others)
    if by_new >= PREFERRED:
        return None
    reason = Reason(
        "stored_fits_as_well",
        "the new clouds fit each other under the stored pose as well as under the one that was "
        f"found, within their noise: the latter is better by {by_new:.1f} σ ({PREFERRED:g} are "
        "needed)",
        {"better_sigmas": by_new, "needed": PREFERRED},
    )
    return _Doubt(reason, by_beyond >= PREFERRED or by_new <= -PREFERRED)


def _is_contradicted_by(found: NewPose, pose: PoseEstimate) -> bool:
    """Whether the surfaces alone, from about the stored pose, conflict with a pose of the poles.

    Poles that were carried alike between the recordings draw the surfaces along, into a minimum
    that is none without them. What the search alone would hold is no denial.
    """
    if found.pose is None or found.unsure:
        return False
    assert found.pose.covariance is not None
    held = np.linalg.inv(found.pose.covariance) - np.linalg.inv(search_covariance())
    values, vectors = np.linalg.eigh(held)
    apart = vectors.T @ se3.local(found.pose.T_target_source, pose.T_target_source)
    return bool(np.maximum(values, 0.0) @ apart**2 > chdtri(6, FALSE_ALARM))
