"""Is an installed site still where it was? New recordings against a stored calibration.

The pose is found anew, with the poles where they are there, by the scene alone where they are not.
Only the new clouds are laid on each other, so the place itself may have changed since.
With ``d`` the step from the stored pose to the new one (`se3.local`) and ``S`` the sum of both
covariances, ``dᵀ S⁻¹ d`` is χ² with 6 degrees of freedom where nothing moved. What both have in
common, such as a range offset of the tape or of single beams, cancels in ``d`` but is counted
twice in ``S``: the test errs towards *same*.

A test that could not have seen a movement says nothing by not seeing one. So *same* is answered
only where a movement of the size that matters would have been found almost surely, about whatever
axis, in whatever direction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtrc, chdtri, chndtr
from threadpoolctl import threadpool_limits

from .. import se3
from ..datatypes import Array, Calibration, PointCloud, PoseEstimate, Reason
from ..errors import UsageError
from ..matching.prior import RotationPrior
from ..pipeline import DEFAULT_RADIUS, calibrate
from ..scene.disambiguation import (
    OVERLAP_DISTANCE,
    SCORING_VOXEL,
    free_space_violation,
    range_image,
)
from ..scene.refinement import refine
from ..scene.registration import MIN_CLOUD_POINTS, voxel_downsample
from ..scene.static import remove_dynamic_points
from ..sensors import Sensor
from ..verdict import MIN_OVERLAP

FALSE_ALARM = 0.01
"""How often the test may find a movement where there was none."""

MIN_POWER = 0.95
"""How surely a movement of the tolerance must be found before *same* is said."""

TOLERANCE_ROTATION, TOLERANCE_TRANSLATION = float(np.radians(0.3)), 0.03
"""The movement that matters, rad and m."""

SEARCH_ROTATION, SEARCH_TRANSLATION = float(np.radians(1.0)), 0.1
"""1 σ about the stored pose from which the scene starts, rad and m: wide beside whatever the scene
holds, so that the answer is not drawn back to the stored pose, and too wide for *same* in what it
does not hold. Surfaces reach for each other over three times as much, and more."""

NEAR_STORED_ROTATION = float(np.radians(10.0))
"""1 σ of the rotation that decides between hypotheses where the surroundings do not, rad."""

MAX_FREE_SPACE_VIOLATION = 0.05
"""Share of the points that may stand, under the new pose, where the other LiDAR looked through. The
right pose has up to 0.02 of them, at the edges of things; wrong ones that cling to the ground have
0.02 and more, but are then as unsure as the search was wide."""

ROTATION_AND_TRANSLATION = slice(0, 3), slice(3, 6)
"""Rotation and translation of a step."""


@dataclass(frozen=True, eq=False)
class CheckResult:
    """Whether the source still stands where it stood, as seen by the target.

    Attributes
    ----------
    status
        ``same``, ``moved`` or ``cannot_tell``.
    reasons
        Why it cannot tell, and what stood in the way of a better answer.
    used
        What the new pose was found by: ``poles`` (and the scene), ``scene`` alone, or None.
    T_target_source
        (4, 4) the new pose; None where there is none to believe.
    step
        (6,) ``[φ, δ]`` from the stored pose to the new one, rad and m, target axes; δ is the shift
        of the source's origin.
    covariance
        (6, 6) of the step: of the stored pose and of the new one together.
    chi2, p_value
        The test, and how often so much comes about where nothing moved.
    power
        How surely a movement of the tolerance would have been found, in the worst direction.
    """

    status: Literal["same", "moved", "cannot_tell"]
    reasons: tuple[Reason, ...]
    used: Literal["poles", "scene"] | None = None
    T_target_source: Array | None = None
    step: Array | None = None
    covariance: Array | None = None
    chi2: float | None = None
    p_value: float | None = None
    power: float | None = None

    @property
    def turned(self) -> tuple[float, float] | None:
        """Angle of the movement, and 1 σ in the direction that is least sure, rad."""
        if self.step is None or self.covariance is None:
            return None
        return float(np.linalg.norm(self.step[ROTATION_AND_TRANSLATION[0]])), _worst(
            self.covariance, ROTATION_AND_TRANSLATION[0]
        )[0]

    @property
    def shifted(self) -> tuple[float, float] | None:
        """Length of the movement, and 1 σ in the direction that is least sure, metres."""
        if self.step is None or self.covariance is None:
            return None
        return float(np.linalg.norm(self.step[ROTATION_AND_TRANSLATION[1]])), _worst(
            self.covariance, ROTATION_AND_TRANSLATION[1]
        )[0]


def check(
    stored: PoseEstimate,
    target: PointCloud,
    source: PointCloud,
    *,
    tolerance: tuple[float, float] = (TOLERANCE_ROTATION, TOLERANCE_TRANSLATION),
    radius: float = DEFAULT_RADIUS,
    radius_sigma: float = 0.0,
    sensors: tuple[Sensor | None, Sensor | None] = (None, None),
    thresholds: tuple[float | None, float | None] = (None, None),
) -> CheckResult:
    """Find the pose anew and test it against the stored one.

    Parameters
    ----------
    stored
        The calibration of the site, with its covariance.
    target, source
        New recordings of the same two LiDARs, each in its own frame. Poles are used where both
        see them, and need not stand where they stood; without, or without intensities, the scene
        must do.
    tolerance
        The movement that matters, rad and m.
    radius, radius_sigma, sensors, thresholds
        As for `pipeline.calibrate`.

    Raises
    ------
    UsageError
        Where the stored pose has no covariance.
    """
    if stored.covariance is None:
        raise UsageError("the stored pose has no covariance: nothing tells how sure it is")
    reasons: list[Reason] = []
    target, source = remove_dynamic_points(target), remove_dynamic_points(source)
    again = partial(
        calibrate,
        radius=radius,
        radius_sigma=radius_sigma,
        sensors=sensors,
        thresholds=thresholds,
    )
    by_poles = _by_poles(stored, target, source, again, reasons)
    if by_poles is not None:
        return compare(stored, by_poles, "poles", tolerance, reasons)
    by_scene = _by_scene(stored, target, source, reasons)
    if by_scene is not None:
        return compare(stored, by_scene, "scene", tolerance, reasons)
    return CheckResult("cannot_tell", tuple(reasons))


def _by_poles(
    stored: PoseEstimate,
    target: PointCloud,
    source: PointCloud,
    again: Callable[..., Calibration],
    reasons: list[Reason],
) -> PoseEstimate | None:
    """Calibrate anew, from all hypotheses: what was turned round must not be found as it was.

    Only where the surroundings do not decide between them, those near the stored pose are
    preferred: no LiDAR comes loose to end up half a turn away in a place of that symmetry.
    """
    answer = again(target, source)
    if [reason.code for reason in answer.reasons] == ["ambiguous"]:
        near = RotationPrior(stored.T_target_source[:3, :3], NEAR_STORED_ROTATION)
        answer = again(target, source, prior=near)
    stage = answer.refined or answer.poles
    if stage is None or stage.covariance is None:
        reasons += [Reason(f"poles_{r.code}", r.message, r.values) for r in answer.reasons]
        return None
    misfit = _misfit(target, source, stage.T_target_source)
    wrong = [misfit] if misfit is not None else []
    wrong += [r for r in answer.reasons if r.code == "poles_and_scene_disagree"]
    reasons += [Reason("poles_not_trusted", r.message, r.values) for r in wrong]
    return None if wrong else stage


def _by_scene(
    stored: PoseEstimate, target: PointCloud, source: PointCloud, reasons: list[Reason]
) -> PoseEstimate | None:
    """Lay the surfaces of both clouds on each other, from about the stored pose."""
    spread = np.r_[np.full(3, SEARCH_ROTATION), np.full(3, SEARCH_TRANSLATION)] ** 2
    start = PoseEstimate(stored.T_target_source, np.diag(spread), stored.rms)
    with threadpool_limits(1, user_api="blas"):
        refined = refine(target, source, start)
    if refined is None:
        reasons.append(
            Reason(
                "no_common_surfaces",
                "near the stored pose the clouds have no surfaces in common: a LiDAR was moved by "
                "more than a few degrees or decimetres, these are other LiDARs (or the other way "
                "round), or the place has none; calibrate anew",
                {},
            )
        )
        return None
    misfit = _misfit(target, source, refined.stage.T_target_source)
    if misfit is not None:
        reasons.append(misfit)
        return None
    return refined.stage


def _misfit(target: PointCloud, source: PointCloud, T: Array) -> Reason | None:
    """Say how far the clouds are from fitting together under a pose; None where they fit."""
    points = (
        voxel_downsample(target.xyz, SCORING_VOXEL),
        voxel_downsample(source.xyz, SCORING_VOXEL),
    )
    if min(len(points[0]), len(points[1])) < MIN_CLOUD_POINTS:
        values: dict[str, float | int | str] = {"target": len(points[0]), "source": len(points[1])}
        return Reason("too_few_points", "a cloud has too few points to compare", values)
    moved = se3.apply(se3.inverse(T), points[0]), se3.apply(T, points[1])
    near = [
        np.isfinite(
            cKDTree(points[1 - k]).query(moved[k], distance_upper_bound=OVERLAP_DISTANCE)[0]
        )
        for k in (0, 1)
    ]
    overlap = float(np.mean([np.mean(each) for each in near]))
    against = 0.5 * (
        free_space_violation(range_image(target), moved[1])
        + free_space_violation(range_image(source), moved[0])
    )
    if overlap >= MIN_OVERLAP and against <= MAX_FREE_SPACE_VIOLATION:
        return None
    return Reason(
        "clouds_do_not_fit",
        f"the clouds do not fit together at or near the stored pose: {overlap:.0%} of the points "
        f"have a neighbour in the other cloud ({MIN_OVERLAP:.0%} are needed), {against:.1%} stand "
        f"where the other LiDAR looked through ({MAX_FREE_SPACE_VIOLATION:.0%} are allowed): a LiDAR was "
        "moved far, these are other LiDARs, or they recorded at different times; calibrate anew",
        {"overlap": overlap, "contradiction": against},
    )


def compare(
    stored: PoseEstimate,
    new: PoseEstimate,
    used: Literal["poles", "scene"],
    tolerance: tuple[float, float] = (TOLERANCE_ROTATION, TOLERANCE_TRANSLATION),
    reasons: list[Reason] | None = None,
) -> CheckResult:
    """Test whether two poses, both with a covariance, are one.

    Parameters
    ----------
    stored, new
        The poses; their errors are taken as independent.
    used
        What the new one was found by.
    tolerance
        The movement that matters, rad and m.
    reasons
        What is to be said beside.
    """
    assert stored.covariance is not None
    assert new.covariance is not None
    step = se3.local(stored.T_target_source, new.T_target_source)
    covariance = np.asarray(stored.covariance + new.covariance)
    chi2 = float(step @ np.linalg.solve(covariance, step))
    p_value = float(chdtrc(6, chi2))
    power = detection_power(covariance, tolerance)
    said = list(reasons or [])
    most = [
        np.linalg.norm(step[part]) + 3 * _worst(covariance, part)[0]
        for part in ROTATION_AND_TRANSLATION
    ]
    status: Literal["same", "moved", "cannot_tell"] = "moved" if p_value < FALSE_ALARM else "same"
    if status == "same" and power < MIN_POWER:
        status = "cannot_tell"
        said.append(_too_weak(stored, covariance, tolerance, power))
    elif status == "moved" and most[0] < tolerance[0] and most[1] < tolerance[1]:
        # Real LiDARs drift by more than their noise: an alarm each night would be switched off.
        status = "same"
        message = "it moved, but surely by less than the tolerance"
        said.append(Reason("within_tolerance", message, {}))
    elif status == "moved" and power < MIN_POWER:
        message = "that it moved is sure, but not by how much: " + _worst_in_words(covariance)
        said.append(Reason("size_unsure", message, {}))
    return CheckResult(
        status, tuple(said), used, new.T_target_source, step, covariance, chi2, p_value, power
    )


def detection_power(covariance: Array, tolerance: tuple[float, float]) -> float:
    """How surely the test finds a movement of the tolerance, in the worst of all directions.

    Under a movement m the statistic is noncentral χ² with 6 degrees of freedom and noncentrality
    ``mᵀ S⁻¹ m``. Of all m that turn by the tolerance, with whatever shift, the least of these is
    ``tol² / λ_max(S_φφ)``; of all that shift by it, with whatever turn, ``tol² / λ_max(S_δδ)``.

    Parameters
    ----------
    covariance
        (6, 6) of the step.
    tolerance
        Of rotation, rad, and of translation, m.
    """
    least = min(
        (limit / _worst(covariance, part)[0]) ** 2
        for limit, part in zip(tolerance, ROTATION_AND_TRANSLATION, strict=True)
    )
    # chndtr loses its way where the outcome is 0 to all digits.
    return float(1.0 - chndtr(chdtri(6, FALSE_ALARM), 6, min(least, 1000.0)))


def _too_weak(
    stored: PoseEstimate, covariance: Array, tolerance: tuple[float, float], power: float
) -> Reason:
    """Say in which direction the step is least sure, and whose fault that is."""
    assert stored.covariance is not None
    (turn, axis), (shift, way) = (_worst(covariance, part) for part in ROTATION_AND_TRANSLATION)
    # Whichever is weaker beside its tolerance is what the power is lost by.
    part, worst = (
        (ROTATION_AND_TRANSLATION[0], axis)
        if turn / tolerance[0] > shift / tolerance[1]
        else (ROTATION_AND_TRANSLATION[1], way)
    )
    share = float(
        (worst @ stored.covariance[part, part] @ worst) / (worst @ covariance[part, part] @ worst)
    )
    remedy = (
        "the stored calibration is the weaker part: calibrate anew, with the scene or with more "
        "placements of the poles"
        if share > 0.5
        else "the new recordings are the weaker part: record more frames, set up the poles, or "
        "put up something flat across that direction"
    )
    return Reason(
        "too_weak",
        f"no movement was found, but one of {np.degrees(tolerance[0]):.2g}° or "
        f"{100 * tolerance[1]:.2g} cm would be found with a probability of {power:.0%} only "
        f"({MIN_POWER:.0%} are needed): {_worst_in_words(covariance)}; {remedy}",
        {"power": power, "sigma_rad": turn, "sigma_m": shift, "stored_share": share},
    )


def _worst(covariance: Array, part: slice) -> tuple[float, Array]:
    """1 σ of a part of the step in the direction where it is largest, and that direction."""
    values, vectors = np.linalg.eigh(covariance[part, part])
    return float(np.sqrt(values[-1])), np.asarray(vectors[:, -1])


def _worst_in_words(covariance: Array) -> str:
    (turn, axis), (shift, way) = (_worst(covariance, part) for part in ROTATION_AND_TRANSLATION)
    return (
        f"the difference is sure to {np.degrees(turn):.2f}° about "
        "({:+.2f} {:+.2f} {:+.2f}) ".format(*axis)
        + f"and to {100 * shift:.1f} cm along "
        + "({:+.2f} {:+.2f} {:+.2f}) of the target (1 σ, the worst directions)".format(*way)
    )
