"""The pose of new recordings: by their poles, or by the scene alone from about the stored pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from threadpoolctl import threadpool_limits

from ..adjustment.refinement import refine
from ..base.datatypes import Array, Calibration, PointCloud, PoseEstimate
from ..base.errors import Reason
from ..base.quantities import error
from ..base.systematic import ErrorModel
from ..base.uncertainty import Uncertainty
from ..hypotheses.choice import MIN_OVERLAP
from ..hypotheses.prior import RotationPrior
from ..surfaces.disambiguation import SCORING_VOXEL
from ..surfaces.registration import MIN_CLOUD_POINTS
from ..surfaces.visibility import OVERLAP_DISTANCE, View, compare_views, view_of
from .certainty import ROTATION, TRANSLATION

PARTS = ROTATION, TRANSLATION

NOT_TRUSTED = ("poles_and_scene_disagree", "several_minima")
"""Warnings of a new calibration by poles that leave the scene alone to answer."""

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
class NewPose:
    """A pose found again, or None, and what there is to say of it.

    `unsure` says that it must not be taken for a movement, nor for none.
    """

    pose: PoseEstimate | None
    uncertainty: Uncertainty | None = None
    reasons: tuple[Reason, ...] = ()
    unsure: bool = False


@dataclass(frozen=True, eq=False)
class Clouds:
    """The new recordings, without what moved, and both views where they are asked for.

    `left` is what is left of the sway of both LiDARs.
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
    calibrate_again: Callable[..., Calibration],
) -> NewPose:
    """Calibrate again, from all hypotheses: a LiDAR that was turned round must not seem unmoved.

    Only where the surroundings do not decide between them, those near the stored pose are
    preferred: no LiDAR comes loose to end up half a turn away in a place of that symmetry.
    """
    answer = again
    if is_ambiguous(answer):
        near = RotationPrior(stored.T_target_source[:3, :3], NEAR_STORED_ROTATION)
        answer = calibrate_again(clouds.target, clouds.source, prior=near)
    pose = answer.refined or answer.poles
    if pose is None or pose.covariance is None or answer.T_target_source is None:
        return NewPose(None, reasons=tuple(r.prefixed("poles") for r in answer.reasons))
    misfit = _misfit(clouds, pose.T_target_source)
    wrong = [misfit] if misfit is not None else []
    wrong += [r for r in answer.reasons if r.code in NOT_TRUSTED]
    if wrong:
        said = [Reason("poles_not_trusted", r.message, r.values) for r in wrong]
        return NewPose(None, reasons=tuple(said))
    said = [r for r in answer.reasons if r.code == "not_converged"]
    return NewPose(pose, answer.uncertainty, tuple(said))


def is_ambiguous(answer: Calibration) -> bool:
    """Whether the surroundings do not decide between hypotheses that the poles give."""
    return [reason.code for reason in answer.reasons] == ["ambiguous"]


def by_scene(stored: PoseEstimate, clouds: Clouds, model: ErrorModel) -> NewPose:
    """Lay the surfaces of both clouds on each other, from about the stored pose."""
    start = PoseEstimate(stored.T_target_source, search_covariance(), stored.rms)
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
        return NewPose(None, reasons=(reason,))
    misfit = _misfit(clouds, refined.pose.T_target_source)
    if misfit is not None:
        return NewPose(None, reasons=(misfit,))
    reasons: list[Reason] = []
    if not refined.converged:
        words = f"the registration of the scene still moved after {refined.iterations} iterations"
        reasons.append(
            Reason("not_converged", words, {"stage": "scene", "iterations": refined.iterations})
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
    return NewPose(refined.pose, refined.uncertainty, tuple(reasons), bool(refined.other_minima))


def search_covariance() -> Array:
    """(6, 6) about the stored pose: how far from it the scene alone is searched."""
    return np.diag(np.repeat([SEARCH_ROTATION, SEARCH_TRANSLATION], 3) ** 2)


def _misfit(clouds: Clouds, T: Array) -> Reason | None:
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
