"""Whether two poses, both with a covariance, are the same: the test of ``retropole check``.

With ``d`` the step from the stored pose to the new one (`se3.local`) and ``S`` its covariance,
``dᵀ S⁻¹ d`` is χ² with 6 degrees of freedom if nothing moved. What both poses have in common,
such as a range offset of the tape or of single rings, cancels in ``d`` and mostly in ``S``
(`step_covariance`).

A test that could not have detected a movement gives no information if it detects none. So *same*
is answered only within a tolerance: the upper limit of the movement with a confidence of 95 %
(`upper_limit`).

The errors of both poses from scatter are independent and add up. The errors of the instruments are
the same in both, and cancel in the step as far as both poses were found in the same way: by poles
at the same positions, for example. With poles at other positions, or by the scene alone, the same
errors have another effect on the pose. The effect of each error on each pose is not stored, only
that of all errors together; but along a direction in which both are equally uncertain they were
probably found in the same way, and an uncertainty of only one of them cannot be common to both. So
with variances a and b along each of the directions in which both systematic parts are uncorrelated
(their generalised eigenvectors), the step keeps

    a + b − 2 ρ √(a b),

the variance of the difference of two errors of correlation ρ. See docs/check.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import eigh
from scipy.special import chdtrc, chdtri, chndtr, ndtri

from ..base import se3
from ..base.datatypes import Array, PoseEstimate
from ..base.errors import Reason
from ..base.quantities import error, percent
from ..base.reasons import Code
from ..base.uncertainty import Uncertainty, floor
from ..base.uncertainty.confirmation import Confirmation
from .tolerance import NO_REQUEST, WIDEST_TOLERANCE, RequestedTolerance, Tolerance

REPEATED = 0.9
"""Correlation ρ of the errors of the same devices in two recordings: the rest is due to
temperature, warm-up and age. With it and the floor, the 95 % quantile of χ² of unmoved simulated
recordings is at most 5 with the poles where they were, 10 with poles at other positions and 8
without (field and typical noise, 188 sites, seeds below 1000), where 12.6 is expected: the
simulator's devices repeat all of their errors."""


def step_covariance(stored: Uncertainty, new: Uncertainty) -> Array:
    """(6, 6) of the step from the stored pose to the new one, over ``[φ, δ]``, rad and m.

    A pose without a systematic part has no common errors: then the whole of both is used.
    """
    return np.asarray(stored.random + new.random + kept(stored.systematic, new.systematic))


def kept(stored: Array, new: Array) -> Array:
    """Part of the systematic errors (6, 6) of two poses that does not cancel in their difference.

    Unmodelled errors need not repeat: they are added for both recordings.
    """
    both = np.asarray(stored + new)
    if not (stored.any() and new.any()):
        return both
    share, vectors = eigh(stored, both)
    share = np.clip(share, 0.0, 1.0)
    common = 2.0 * REPEATED * np.sqrt(share * (1.0 - share))
    axes = both @ vectors
    return np.asarray((axes * (1.0 - common)) @ axes.T + 2.0 * floor())


def in_parts(pose: PoseEstimate, uncertainty: Uncertainty | None) -> Uncertainty:
    """Give the parts of a pose's covariance; if they are not known, all of it is random."""
    assert pose.covariance is not None
    if uncertainty is not None:
        return uncertainty
    return Uncertainty(pose.covariance, np.zeros_like(pose.covariance))


FALSE_ALARM = 0.01
"""Probability of a false alarm of the test."""

CONFIDENCE = 0.95
"""Confidence that the movement is less than the tolerance, required for *same*: at least this
share of movements of the size of the tolerance is not answered by *same*."""

CONFIDENTLY = f"with {percent(CONFIDENCE)} confidence"

MIN_POWER = 0.95
"""Probability of finding a movement of the tolerance, below which its size is uncertain."""

ONE_SIDED = float(ndtri(CONFIDENCE))
"""Number of σ from a normal variable to its mean with that confidence: 1.645."""

MAX_NONCENTRALITY = 1000.0
"""Beyond, the power is 1 to all digits and SciPy's noncentral χ² is not reliable."""

ROTATION, TRANSLATION = slice(0, 3), slice(3, 6)
"""Parts of a step."""


@dataclass(frozen=True, eq=False)
class LeastCertain:
    """1 σ of a part of the step in the direction where it is largest, and that direction (3,)."""

    sigma: float
    direction: Array


def least_certain(covariance: Array, part: slice) -> LeastCertain:
    """Find the direction of a part of the step in which its covariance (6, 6) is largest."""
    values, vectors = np.linalg.eigh(covariance[part, part])
    return LeastCertain(float(np.sqrt(values[-1])), np.asarray(vectors[:, -1]))


def upper_limit(step: Array, covariance: Array, sigmas: float = ONE_SIDED) -> Tolerance:
    """Upper limit of the movement: ``|d| + z σ`` of each part, σ in its worst direction.

    With ``z = Φ⁻¹(0.95)`` an upper limit with a confidence of 95 %: after a movement m of that
    size along the unit vector u, ``u · d`` is normal about ``|m|`` with a variance of ``λ_max``
    at most, and ``|d| ≥ u · d`` lies below ``|m| − z σ`` in one of twenty cases at most.

    Parameters
    ----------
    step, covariance
        (6,) from the stored pose to the new one, and (6, 6) of it.
    sigmas
        z.
    """
    rotation, translation = (
        float(np.linalg.norm(step[part])) + sigmas * least_certain(covariance, part).sigma
        for part in (ROTATION, TRANSLATION)
    )
    return Tolerance(rotation, translation)


def detection_power(covariance: Array, tolerance: Tolerance) -> float:
    """Probability that the test finds a movement of the tolerance, in the worst of all directions.

    Under a movement m the statistic is noncentral χ² with 6 degrees of freedom and noncentrality
    ``mᵀ S⁻¹ m``. Of all m that rotate by the tolerance, with whatever translation, the least of
    these is ``tol² / λ_max(S_φφ)``; of all that translate by it, with whatever rotation,
    ``tol² / λ_max(S_δδ)``.

    Parameters
    ----------
    covariance
        (6, 6) of the step.
    tolerance
        The movement that matters.
    """
    least = min(
        (tolerance.rotation / least_certain(covariance, ROTATION).sigma) ** 2,
        (tolerance.translation / least_certain(covariance, TRANSLATION).sigma) ** 2,
    )
    return float(1.0 - chndtr(chdtri(6, FALSE_ALARM), 6, min(least, MAX_NONCENTRALITY)))


@dataclass(frozen=True, eq=False)
class Weakness:
    """The limits of a check.

    Attributes
    ----------
    stored, new
        Both poses' uncertainties.
    reported
        Upper limit of the movement, with `CONFIDENCE`.
    requested
        The tolerance requested, or the default.
    """

    stored: Uncertainty
    new: Uncertainty
    reported: Tolerance
    requested: Tolerance

    def too_weak(self, widest: Tolerance) -> Reason:
        """Report that nothing is confirmed: the bound by these data is wider than allowed."""
        parts = (
            (self.reported.rotation > widest.rotation, widest.rotation_in_words),
            (self.reported.translation > widest.translation, widest.translation_in_words),
        )
        missing = " and ".join(what for is_missing, what in parts if is_missing)
        return self._reason(
            "too_weak",
            f"no movement was found, but these data show only, {CONFIDENTLY}, that any movement "
            f"is no more than {self.reported.in_words} ({missing} must be detectable): ",
        )

    def wider_tolerance(self) -> Reason:
        """Report that *same* applies within a wider tolerance than the default, and why not within
        a narrower one."""
        return self._reason(
            "wider_tolerance",
            f"the same within {self.reported.in_words}, {CONFIDENTLY}; the default, "
            f"{self.requested.in_words}, cannot be determined by these data: ",
        )

    def _reason(self, code: Code, finding: str) -> Reason:
        """Add the direction in which the step is least certain, the pose that limits it, and
        advice."""
        covariance, share = step_covariance(self.stored, self.new), self._stored_share()
        remedy = (
            "the stored calibration is the less accurate part: calibrate again, with the scene "
            "or with more placements of the poles"
            if share > 0.5
            else "the new recordings are the less accurate part: record more frames, set up the "
            "poles, or put up something flat across that direction"
        )
        return Reason(
            code,
            f"{finding}{directions_in_words(covariance)}; {remedy}",
            {
                "tolerance_rad": self.reported.rotation,
                "tolerance_m": self.reported.translation,
                "power": detection_power(covariance, self.requested),
                "sigma_rad": least_certain(covariance, ROTATION).sigma,
                "sigma_m": least_certain(covariance, TRANSLATION).sigma,
                "stored_share": share,
            },
        )

    def _stored_share(self) -> float:
        """Share that the stored pose has in the variance of the direction that limits the step.

        What does not cancel is blamed on the poses by what they would have had alone.
        """
        reported, requested = self.reported, self.requested
        # The part that exceeds its tolerance more.
        by_rotation = (
            reported.rotation / requested.rotation > reported.translation / requested.translation
        )
        part = ROTATION if by_rotation else TRANSLATION
        worst = least_certain(step_covariance(self.stored, self.new), part).direction
        alone = [
            float(worst @ each.covariance[part, part] @ worst) for each in (self.stored, self.new)
        ]
        return alone[0] / sum(alone)


def directions_in_words(covariance: Array) -> str:
    """Write 1 σ of both parts of a step, and the directions in which they are so large."""
    rotation = least_certain(covariance, ROTATION)
    translation = least_certain(covariance, TRANSLATION)
    about, along = (
        "({:+.2f} {:+.2f} {:+.2f})".format(*part.direction) for part in (rotation, translation)
    )
    return (
        f"1 σ of the difference is {error(rotation.sigma, 'rad')} about {about} and "
        f"{error(translation.sigma)} along {along} of the target (the worst directions)"
    )


BOUND_SIGMAS = 3.0
"""A movement is certainly below the tolerance if it still is when increased by this many σ."""

Status = Literal["same", "moved", "cannot_tell"]
Method = Literal["poles", "scene"]


@dataclass(frozen=True)
class Movement:
    """Length of a part of the step, and 1 σ in its least certain direction; rad or m."""

    length: float
    sigma: float


@dataclass(frozen=True, eq=False)
class CheckResult:
    """Whether the source has moved relative to the target.

    Attributes
    ----------
    status
        ``same``, ``moved`` or ``cannot_tell``.
    reasons
        Why it is undecided, and the causes that prevented a better answer.
    used
        Data used for the new pose: ``poles`` (and the scene), ``scene`` alone, or None.
    T_target_source
        (4, 4) the new pose; None if none is reliable.
    step
        (6,) ``[φ, δ]`` from the stored pose to the new one, rad and m, target axes; δ is the
        translation of the source's origin.
    covariance
        (6, 6) of the step: the part of both poses' errors that does not cancel.
    random
        (6, 6) the part of that which is independent in each new check; the rest is the same in all
        checks that use the same method.
    chi2, p_value
        The test, and the probability of at least this value if nothing moved.
    power
        Probability that a movement of the tolerance requested, or else of the default, would have
        been found, in the worst direction.
    tolerance
        If nothing moved: the smallest tolerance that these data confirm, no less than the
        requested one. The movement is not larger, with `CONFIDENCE`. For *same*, the reported
        bound. None if another reason prevents it.
    confirmation
        The scene check of the stored pose by the new recordings; None if there are none.
    """

    status: Status
    reasons: tuple[Reason, ...]
    used: Method | None = None
    T_target_source: Array | None = None
    step: Array | None = None
    covariance: Array | None = None
    random: Array | None = None
    chi2: float | None = None
    p_value: float | None = None
    power: float | None = None
    tolerance: Tolerance | None = None
    confirmation: Confirmation | None = None

    @property
    def rotation(self) -> Movement | None:
        """How far it was rotated, rad."""
        return self._part(ROTATION)

    @property
    def translation(self) -> Movement | None:
        """How far it was translated, metres."""
        return self._part(TRANSLATION)

    def withdrawn(self, *more: Reason) -> CheckResult:
        """The same answer, withdrawn: for some reason it must not confirm anything."""
        reasons = *self.reasons, *more
        return replace(self, status="cannot_tell", reasons=reasons, tolerance=None)

    def _part(self, part: slice) -> Movement | None:
        if self.step is None or self.covariance is None:
            return None
        length = float(np.linalg.norm(self.step[part]))
        return Movement(length, least_certain(self.covariance, part).sigma)


def compare_poses(
    stored: PoseEstimate,
    new: PoseEstimate,
    used: Method,
    requested: RequestedTolerance = NO_REQUEST,
    reasons: Sequence[Reason] = (),
    uncertainties: tuple[Uncertainty | None, Uncertainty | None] = (None, None),
) -> CheckResult:
    """Test whether two poses are the same.

    Parameters
    ----------
    stored, new
        The poses, both with a covariance.
    used
        Data used for the new one.
    requested
        The movement that matters, or the smallest that these data can resolve.
    reasons
        Further reasons to report.
    uncertainties
        The two parts of both covariances, if the same devices were used: their systematic
        parts mostly cancel. With None, as for a pose from another source, nothing cancels.
    """
    parts = in_parts(stored, uncertainties[0]), in_parts(new, uncertainties[1])
    step = se3.local(stored.T_target_source, new.T_target_source)
    covariance = step_covariance(*parts)
    chi2 = float(step @ np.linalg.solve(covariance, step))
    p_value = float(chdtrc(6, chi2))
    power = detection_power(covariance, requested.least)
    listed = list(reasons)
    status: Status = "moved" if p_value < FALSE_ALARM else "same"
    reported: Tolerance | None = None
    least, widest = requested.least, requested.widest
    if used == "scene":
        # Beyond, the prior about the stored pose would confirm itself.
        least, widest = (each.or_narrower(WIDEST_TOLERANCE) for each in (least, widest))
    limit = upper_limit(step, covariance)
    if status == "same":
        reported = requested.least.or_wider(limit)
        if not limit.is_within(widest):
            status = "cannot_tell"
            listed.append(Weakness(*parts, limit, requested.least).too_weak(widest))
        elif reported != requested.least:
            listed.append(Weakness(*parts, reported, requested.least).wider_tolerance())
    elif upper_limit(step, covariance, BOUND_SIGMAS).is_within(least):
        # Real LiDARs drift by more than their noise: an alarm every night would be ignored.
        status, reported = "same", requested.least
        message = "it moved, but certainly by less than the tolerance"
        listed.append(Reason("within_tolerance", message, {}))
    elif power < MIN_POWER:
        directions = directions_in_words(covariance)
        message = f"it is certain that it moved, but not by how much: {directions}"
        listed.append(Reason("size_unsure", message, {}))
    T, random = new.T_target_source, parts[1].random
    return CheckResult(
        status, tuple(listed), used, T, step, covariance, random, chi2, p_value, power, reported
    )
