"""Has an installed LiDAR moved? New recordings against a stored calibration.

The pose is estimated again, with poles if there are any, otherwise by the scene alone.
Only the new clouds are registered to each other, so the surroundings may have changed since.
Whether the new pose is the stored one is tested by `movement`.

If target and source were given in reverse order, the inverse of the stored
pose fits (`swapped_clouds`). A swap looks like a movement by metres or by half a turn. No movement
ends by chance at the inverse pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from msgspec import structs
from scipy.special import chdtri
from threadpoolctl import threadpool_limits

from ..adjustment.masts import on_one_mast
from ..adjustment.refinement import refine
from ..base import se3
from ..base.datatypes import Array, Calibration, Placement, PointCloud, PoseEstimate
from ..base.errors import Reason, Refusal, UsageError
from ..base.quantities import error
from ..base.sensors import Sensor
from ..base.systematic import ErrorModel
from ..base.uncertainty import Uncertainty
from ..base.uncertainty.confirmation import Confirmation
from ..extraction.sensor_pattern import check_sensor, error_sizes
from ..hypotheses.choice import MIN_OVERLAP
from ..hypotheses.evidence import MAX_CONFLICTING, MIN_TOTAL, count, is_in_conflict, scenes_of
from ..hypotheses.placements import remaining_sway_in
from ..hypotheses.prior import PosePrior
from ..pipeline import NO_OPTIONS, Options, calibrate
from ..surfaces.consistency import SceneObjects
from ..surfaces.registration import MIN_CLOUD_POINTS
from ..surfaces.visibility import OVERLAP_DISTANCE, SCORING_VOXEL, View, compare_views, view_of
from ..verdict.preference import preferences
from .carrier import CarrierMotion, carrier_motion
from .movement import FALSE_ALARM, ROTATION, TRANSLATION, CheckResult, Method, compare_poses
from .tolerance import NO_REQUEST, RequestedTolerance

PARTS = ROTATION, TRANSLATION

NOT_TRUSTED = ("poles_and_scene_disagree", "several_minima")
"""Warnings of a new calibration by poles after which only the scene is used."""

SEARCH_ROTATION, SEARCH_TRANSLATION = float(np.radians(1.0)), 0.1
"""1 σ about the stored pose from which the scene starts, rad and m: wide compared with what the
scene constrains, so that the answer is not drawn back to the stored pose, and too wide for *same*
in directions that it does not constrain. Surfaces correspond over three times this distance, and
more."""

NEAR_STORED_ROTATION = float(np.radians(10.0))
"""1 σ of the rotation that decides between hypotheses if the surroundings do not, rad."""

MAX_FREE_SPACE_VIOLATION = 0.05
"""Largest share of points, under the new pose, where the other LiDAR looked through. The
right pose has up to a share of 0.02, at the edges of objects; wrong ones that fit the ground only
have 0.02 and more, but are then as uncertain as the search was wide (benchmarks/check.py)."""


@dataclass(frozen=True, eq=False)
class NewPose:
    """A pose found again, or None, and remarks on it.

    `is_uncertain`: it must be treated neither as a movement nor as none.
    """

    pose: PoseEstimate | None
    uncertainty: Uncertainty | None = None
    reasons: tuple[Reason, ...] = ()
    is_uncertain: bool = False


@dataclass(frozen=True, eq=False)
class Clouds:
    """The new recordings, without moving objects, and both views if they are requested.

    `left` is the remaining sway of both LiDARs.
    """

    target: PointCloud
    source: PointCloud
    left: tuple[Array, ...] = ()

    @cached_property
    def views(self) -> tuple[View, View]:
        """Both clouds, prepared to be compared."""
        return view_of(self.target, SCORING_VOXEL), view_of(self.source, SCORING_VOXEL)


def by_poles(
    stored: PoseEstimate,
    clouds: Clouds,
    again: Calibration,
    options: Options,
) -> NewPose:
    """Calibrate again, from all hypotheses: a LiDAR that was turned by 180° must not seem unmoved.

    Only if the surroundings do not decide between them, those near the stored pose are
    preferred: a loose LiDAR does not end half a turn away in a place of exactly that symmetry.
    """
    answer = again
    if is_ambiguous(answer):
        near = PosePrior(stored.T_target_source[:3, :3], NEAR_STORED_ROTATION)
        answer = calibrate(clouds.target, clouds.source, options=replace(options, prior=near))
    pose = answer.refined or answer.poles
    if pose is None or pose.covariance is None or answer.T_target_source is None:
        return NewPose(None, reasons=tuple(r.prefixed("poles") for r in answer.reasons))
    misfit = _misfit(clouds, pose.T_target_source)
    wrong = [misfit] if misfit is not None else []
    wrong += [r for r in answer.reasons if r.code in NOT_TRUSTED]
    if wrong:
        warnings = [Reason("poles_not_trusted", r.message, r.values) for r in wrong]
        return NewPose(None, reasons=tuple(warnings))
    warnings = [r for r in answer.reasons if r.code == "not_converged"]
    return NewPose(pose, answer.uncertainty, tuple(warnings))


def is_ambiguous(answer: Calibration) -> bool:
    """Whether the surroundings do not decide between hypotheses from the poles."""
    return [reason.code for reason in answer.reasons] == ["ambiguous"]


def by_scene(stored: PoseEstimate, clouds: Clouds, model: ErrorModel) -> NewPose:
    """Align the surfaces of both clouds, starting about the stored pose."""
    start = PoseEstimate(stored.T_target_source, search_covariance(), stored.rms)
    with threadpool_limits(1, user_api="blas"):
        refined = refine(clouds.target, clouds.source, start, model=model)
    if refined is None:
        reason = Reason(
            "no_common_surfaces",
            "near the stored pose the clouds have no surfaces in common: a LiDAR was moved by more "
            "than a few degrees or decimetres, these are other LiDARs or swapped, or the place "
            "has no such surfaces; calibrate again",
            {},
        )
        return NewPose(None, reasons=(reason,))
    misfit = _misfit(clouds, refined.pose.T_target_source)
    if misfit is not None:
        return NewPose(None, reasons=(misfit,))
    reasons: list[Reason] = []
    if not refined.converged:
        message = f"the registration of the scene still moved after {refined.iterations} iterations"
        reasons.append(
            Reason("not_converged", message, {"stage": "scene", "iterations": refined.iterations})
        )
    if refined.other_minima:
        furthest = max(refined.other_minima, key=lambda one: float(np.linalg.norm(one[3:])))
        radians, metres = (float(np.linalg.norm(furthest[part])) for part in PARTS)
        reasons.append(
            Reason(
                "several_minima",
                "the surfaces of the new clouds fit each other at more than one pose near the "
                f"stored one, {error(metres)} and {error(radians, 'rad')} from each other; set up "
                "the poles",
                {"apart_m": metres, "apart_rad": radians, "starts": 1 + len(refined.other_minima)},
            )
        )
    return NewPose(refined.pose, refined.uncertainty, tuple(reasons), bool(refined.other_minima))


def search_covariance() -> Array:
    """(6, 6) about the stored pose: the range of the search by the scene alone."""
    return np.diag(np.repeat([SEARCH_ROTATION, SEARCH_TRANSLATION], 3) ** 2)


def _misfit(clouds: Clouds, T: Array) -> Reason | None:
    """Give the refusal of clouds that do not fit together under a pose; None if they fit."""
    views = clouds.views
    sizes = {"target": views[0].size, "source": views[1].size}
    if min(sizes.values()) < MIN_CLOUD_POINTS:
        return Reason("too_few_points", "a cloud has too few points to compare", sizes)
    found = compare_views(*views, T, within=OVERLAP_DISTANCE)
    if found.overlap >= MIN_OVERLAP and found.free_space_violation <= MAX_FREE_SPACE_VIOLATION:
        return None
    return Reason(
        "clouds_do_not_fit",
        f"the clouds do not fit together at or near the stored pose: {found.overlap:.0%} of the "
        f"points have a neighbour in the other cloud ({MIN_OVERLAP:.0%} are needed), "
        f"{found.free_space_violation:.1%} are in space that the other LiDAR saw to be empty "
        f"({MAX_FREE_SPACE_VIOLATION:.0%} are allowed): a LiDAR was moved far, these are other "
        "LiDARs, or they recorded at different times; calibrate again",
        {"overlap": found.overlap, "contradiction": found.free_space_violation},
    )


NEAR_ROTATION, NEAR_TRANSLATION = float(np.radians(2.0)), 0.2
"""A pose is treated as the inverse of the stored one if it differs by less, rad and m. Twice the
range over which `drift` searches about the stored pose."""

MORE = 3.0
"""Factor by which more voxels must agree with the inverse of the stored pose than with the stored
one. In six simulated scenes, swapped, it was 10 and more."""

SEPARATION = 3.0
"""The stored pose and its inverse must be this many times farther from each other. If they are not,
as for two LiDARs back to back at the same height, either order gives the same answer."""


def swapped_sensors(
    placement: Placement, sensors: tuple[Sensor | None, Sensor | None]
) -> Reason | None:
    """Report that each cloud is of the other's sensor; None if that is not the case."""
    if sensors[0] is None or sensors[1] is None:
        return None
    try:
        check_sensor(placement.target.cloud, sensors[1])
        check_sensor(placement.source.cloud, sensors[0])
    except Refusal:
        return None
    return swap(
        f"TARGET's rings are not those of the {sensors[0].name} that is the target of the "
        f"result, or SOURCE's not those of the {sensors[1].name}, and swapped they fit",
        {"told_by": "sensors"},
    )


def swapped_clouds(
    T_stored: Array,
    T_found: Array | None,
    scenes: Sequence[tuple[SceneObjects, SceneObjects]],
    found: Confirmation,
) -> Reason | None:
    """Report that the inverse of the stored pose fits and the stored pose does not; None if that is
    not the case.

    Parameters
    ----------
    T_stored, T_found
        (4, 4) the stored pose and the one that poles gave, target from source; None if none did.
    scenes
        Objects in the target's and in the source's scene.
    found
        Conclusion about the stored pose.
    """
    reverse = se3.inverse(T_stored)
    rotation, translation = _step_size(T_stored, reverse)
    if rotation < SEPARATION * NEAR_ROTATION and translation < SEPARATION * NEAR_TRANSLATION:
        return None
    there = count(scenes, reverse)
    agrees = (
        there.total >= MIN_TOTAL
        and not is_in_conflict(there)
        and found.contradicted > MAX_CONFLICTING
        and there.agreeing >= MORE * found.agreeing
    )
    if T_found is not None:
        # Poles that give another pose are stronger evidence than voxels that happen to agree.
        rotation, translation = _step_size(T_found, reverse)
        agrees = rotation < NEAR_ROTATION and translation < NEAR_TRANSLATION
    if not agrees:
        return None
    return swap(
        f"under the stored pose reversed {there.agreeing} of {there.total} patches off the ground "
        f"agree, under the stored pose {found.agreeing} of {found.total}",
        {
            "told_by": "scene",
            "agreeing": found.agreeing,
            "total": found.total,
            "agreeing_reversed": there.agreeing,
            "total_reversed": there.total,
        },
    )


def swap(why: str, values: dict[str, float | int | str]) -> Reason:
    """Report that target and source are swapped, with advice."""
    return Reason("swapped", f"TARGET and SOURCE are swapped: {why}; exchange them", values)


def _step_size(T: Array, other: Array) -> tuple[float, float]:
    step = se3.local(T, other)
    return float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))


NO_RECORDINGS = ("far_from_lidar", "same_recording", "wrong_unit", "wrong_sensor")
"""Refusals of a new calibration after which the scene cannot be used either."""

PREFERRED = 2.0
"""A movement is reported only if the surfaces fit this many σ better under the new pose than under
the stored one. The new pose is fitted to them: chance alone makes up to ½ √16.8 = 2.05 σ, once
in a hundred times (docs/check.md). Of 52 simulated recordings moved by the tolerance all have 2.8
and more, corridors of few places least (seeds 0 to 12)."""


@dataclass(frozen=True, eq=False)
class _Question:
    """The stored calibration, its devices, and the smallest movement that must be detected."""

    stored: PoseEstimate
    uncertainty: Uncertainty | None
    tolerance: RequestedTolerance
    sensors: tuple[Sensor | None, Sensor | None]
    carrier: CarrierMotion | None


def check(
    stored: PoseEstimate,
    target: PointCloud,
    source: PointCloud,
    *,
    options: Options = NO_OPTIONS,
    uncertainty: Uncertainty | None = None,
    tolerance: RequestedTolerance = NO_REQUEST,
) -> CheckResult:
    """Estimate the pose again and test it against the stored one.

    Parameters
    ----------
    stored
        The calibration of the site, with its covariance.
    target, source
        New recordings of the same two LiDARs, each in the frame of its LiDAR. Poles are used if
        both see them, and may be at other positions; without poles or intensities, the scene
        is used.
    options
        Options of both, as for `pipeline.calibrate`.
    uncertainty
        The two parts of the stored covariance, if these LiDARs were calibrated by this program;
        with None, as for a pose from another source, no errors are shared with the new one.
    tolerance
        The movement that matters, or the smallest that these data can show.

    Raises
    ------
    UsageError
        If the stored pose has no covariance.
    Refusal
        Of `NO_RECORDINGS`, such as ``same_recording``: no two recordings of these two LiDARs.
    """
    if stored.covariance is None:
        raise UsageError("the stored pose has no covariance: its uncertainty is unknown")
    carrier = carrier_motion(stored.T_target_source, target, source)
    if carrier is not None and carrier.is_seen:
        target, source = carrier.without_motion(stored.T_target_source, target, source)
    question = _Question(stored, uncertainty, tolerance, options.sensors, carrier)
    # Surfaces about the stored pose are more informative than candidate poles, in a thirtieth of
    # the time.
    confirmed = replace(options, candidates=False)
    answer = _answered(question, calibrate(target, source, options=confirmed), confirmed)
    if _is_off(answer):
        again = calibrate(target, source, options=options)
        # The result of the surfaces without a pose from the poles was just found.
        if again.T_target_source is not None or is_ambiguous(again):
            answer = _answered(question, again, options)
    return _with_carrier(answer, carrier)


def _with_carrier(answer: CheckResult, carrier: CarrierMotion | None) -> CheckResult:
    """Report that the carrier moved; withdraw a movement that its motion explains, as far as known.

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
        return answer.withdrawn(reason)
    return replace(answer, reasons=(*answer.reasons, reason))


def _answered(question: _Question, again: Calibration, options: Options) -> CheckResult:
    """Test a calibration of the new recordings against the stored pose."""
    sensors, T_stored = question.sensors, question.stored.T_target_source
    recorded = again.placements[0]
    for reason in again.reasons:
        swapped = swapped_sensors(recorded, sensors) if reason.code == "wrong_sensor" else None
        if swapped is not None:
            return CheckResult("cannot_tell", (swapped,))
        if reason.code in NO_RECORDINGS:
            raise Refusal(reason.code, reason.message, reason.values)
    (recorded,) = on_one_mast([recorded], T_stored)
    left = remaining_sway_in([recorded])
    clouds = Clouds(recorded.target.cloud, recorded.source.cloud, left)
    new = by_poles(question.stored, clouds, again, options)
    answer = _tested(question, clouds, new)
    scenes = scenes_of(again.placements, np.random.default_rng(0))
    found = count(scenes, T_stored)
    T_poles = answer.T_target_source if answer.used == "poles" else None
    if answer.status != "same":
        swapped = swapped_clouds(T_stored, T_poles, scenes, found)
        if swapped is not None:
            return CheckResult("cannot_tell", (swapped,), confirmation=found)
    return _checked_against_scene(replace(answer, confirmation=found), found)


def _is_off(answer: CheckResult) -> bool:
    """Whether nothing fits near the stored pose: a LiDAR was moved, or they are swapped.

    Then only poles may show the new pose.
    """
    codes = [reason.code for reason in answer.reasons]
    if answer.status != "cannot_tell" or "swapped" in codes or answer.confirmation is None:
        return False
    return answer.T_target_source is None or is_in_conflict(answer.confirmation)


def _tested(question: _Question, clouds: Clouds, new: NewPose) -> CheckResult:
    """Test the pose from the poles, otherwise that from the scene, against the stored one."""
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
        return answer.withdrawn(doubt.reason)
    return answer.withdrawn() if found.is_uncertain else answer


def _checked_against_scene(answer: CheckResult, found: Confirmation) -> CheckResult:
    """Withdraw the answer *same* if the scene conflicts with the stored pose."""
    if answer.status != "same" or not is_in_conflict(found):
        return answer
    contradicted = Reason(
        "scene_denies_stored",
        f"under the stored pose, of the patches above the ground {found.counts} "
        f"({found.contradicted:.0%} contradict it; {MAX_CONFLICTING:.0%} are allowed). Were both "
        "clouds recorded at the same time, by the LiDARs of the stored result?",
        {
            "agreeing": found.agreeing,
            "contradicting": found.contradicting,
            "missing": found.missing,
            "allowed": MAX_CONFLICTING,
        },
    )
    return answer.withdrawn(contradicted)


def _compared(
    question: _Question, new: NewPose, used: Method, reasons: tuple[Reason, ...]
) -> CheckResult:
    assert new.pose is not None
    pose, uncertainty, carrier = new.pose, new.uncertainty, question.carrier
    if carrier is not None and carrier.is_seen:
        # The motion that was removed is not known better than this.
        assert pose.covariance is not None
        pose = structs.replace(pose, covariance=pose.covariance + carrier.covariance)
        if uncertainty is not None:
            more = uncertainty.random + carrier.covariance
            uncertainty = structs.replace(uncertainty, random=more)
    both = question.uncertainty, uncertainty
    return compare_poses(question.stored, pose, used, question.tolerance, reasons, both)


class _Doubt(NamedTuple):
    """Why a movement may not be real, and whether the surfaces could show it at all."""

    reason: Reason
    seen: bool


def _doubt(stored: PoseEstimate, clouds: Clouds, answer: CheckResult) -> _Doubt | None:
    """Give the reason for doubt about a movement under which the surfaces fit no better; None
    without doubt.

    They could have shown it if one of the same size in the opposite direction makes them fit worse.
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
    """Whether the surfaces alone, starting near the stored pose, conflict with a pose from the
    poles.

    Poles that were moved together between the recordings pull the surfaces into a minimum that
    does not exist without them. A direction constrained only by the range of the search is no
    conflict.
    """
    if found.pose is None or found.is_uncertain:
        return False
    assert found.pose.covariance is not None
    gained = np.linalg.inv(found.pose.covariance) - np.linalg.inv(search_covariance())
    values, vectors = np.linalg.eigh(gained)
    difference = vectors.T @ se3.local(found.pose.T_target_source, pose.T_target_source)
    return bool(np.maximum(values, 0.0) @ difference**2 > chdtri(6, FALSE_ALARM))
