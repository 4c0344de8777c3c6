"""Whether two poses, both with a covariance, are one: the test behind ``retropole check``.

With ``d`` the step from the stored pose to the new one (`se3.local`) and ``S`` its covariance,
``dᵀ S⁻¹ d`` is χ² with 6 degrees of freedom where nothing moved. What both poses have in common,
such as a range offset of the tape or of single rings, cancels in ``d`` and mostly in ``S``
(`step_covariance`).

A test that could not have seen a movement gives no information by not seeing one. So *same* is
answered only within a tolerance: by as much as it has not moved with a confidence of 95 %
(`upper_limit`).

What scatter leaves in both poses is drawn anew and adds up. What the instruments err by is the same
in both, and cancels in the step as far as both poses were found the same way: by poles at the same
places, say. By poles at other positions, or by the scene alone, the same errors move the pose
another way. How an error passes into each pose is not stored, only what all errors make together;
but along a direction in which both are equally uncertain they were probably found in the same way,
and one in which only the one is uncertain is nothing they can share. So with variances a and b
along each of the directions in which both systematic parts are uncorrelated (their generalised
eigenvectors), the step keeps

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
"""Correlation ρ of what the same devices err by in two recordings: the rest is what temperature,
warm-up and age change. With it and the floor, the 95 % quantile of χ² of unmoved simulated
recordings is at most 5 with the poles where they were, 10 with poles at other positions and 8
without (field and typical noise, 188 sites, seeds below 1000), where 12.6 is expected: the
simulator's devices repeat all of their errors."""


def step_covariance(stored: Uncertainty, new: Uncertainty) -> Array:
    """(6, 6) of the step from the stored pose to the new one, over ``[φ, δ]``, rad and m.

    A pose with no systematic part shares nothing: then all of both counts.
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
    """Give the parts of a pose's covariance; where they are not known, all of it is random."""
    assert pose.covariance is not None
    if uncertainty is not None:
        return uncertainty
    return Uncertainty(pose.covariance, np.zeros_like(pose.covariance))


FALSE_ALARM = 0.01
"""How often the test may find a movement where there was none."""

CONFIDENCE = 0.95
"""With which it has moved by less than the tolerance before *same* is reported: of movements of the
tolerance, at least this share is not answered by *same*."""

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
    """By how much it has moved at most: ``|d| + z σ`` of each part, σ in its worst direction.

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
    """What limits a check.

    Attributes
    ----------
    stored, new
        Both poses' uncertainties.
    reported
        By how much it has moved at most, with `CONFIDENCE`.
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
        missing = " and ".join(words for is_missing, words in parts if is_missing)
        return self._reason(
            "too_weak",
            f"no movement was found, but these data show only, {CONFIDENTLY}, that any movement "
            f"is no more than {self.reported.in_words} ({missing} must be detectable): ",
        )

    def wider_tolerance(self) -> Reason:
        """Report that *same* applies within more than the default, and why within no less."""
        return self._reason(
            "wider_tolerance",
            f"the same within {self.reported.in_words}, {CONFIDENTLY}; the default, "
            f"{self.requested.in_words}, cannot be determined by these data: ",
        )

    def _reason(self, code: Code, words: str) -> Reason:
        """Say also where the step is least certain, which pose limits it, and what helps."""
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
            f"{words}{directions_in_words(covariance)}; {remedy}",
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
        # Whichever part is the farther beyond its tolerance.
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
"""A movement that was found is certainly below the tolerance where this many σ more would be."""

Status = Literal["same", "moved", "cannot_tell"]
Method = Literal["poles", "scene"]


@dataclass(frozen=True)
class Movement:
    """Length of a part of the step, and 1 σ in its least certain direction; rad or m."""

    length: float
    sigma: float


@dataclass(frozen=True, eq=False)
class CheckResult:
    """Whether the source is still where it was, as seen by the target.

    Attributes
    ----------
    status
        ``same``, ``moved`` or ``cannot_tell``.
    reasons
        Why it is undecided, and what prevented a better answer.
    used
        What the new pose was found by: ``poles`` (and the scene), ``scene`` alone, or None.
    T_target_source
        (4, 4) the new pose; None if there is none to believe.
    step
        (6,) ``[φ, δ]`` from the stored pose to the new one, rad and m, target axes; δ is the
        translation of the source's origin.
    covariance
        (6, 6) of the step: what of both poses' errors does not cancel.
    random
        (6, 6) of that what each new check draws anew; the rest is the same in all checks that find
        the pose the same way.
    chi2, p_value
        The test, and how often chance alone makes this much where nothing moved.
    power
        Probability that a movement of the tolerance requested, or else of the default, would have
        been found, in the worst direction.
    tolerance
        If nothing moved: the least that these data confirm, no less than what was requested. By
        more it has not moved, with `CONFIDENCE`. Of *same*, the bound that it is reported within.
        None if another reason speaks against any.
    confirmation
        What the new recordings show about the stored pose; None if there are none.
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
        """The same answer, taken back: for some reason nothing is to be confirmed by it."""
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
    """Test whether two poses are one.

    Parameters
    ----------
    stored, new
        The poses, both with a covariance.
    used
        What the new one was found by.
    requested
        The movement that matters, or as small a one as these data can resolve.
    reasons
        Further reasons to report.
    uncertainties
        Both covariances in their two kinds, where the same devices were used: their systematic
        parts mostly cancel. None, as of a pose that something else found, cancels nothing.
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
        # Beyond, the search about the stored pose would confirm itself.
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
        # Real LiDARs drift by more than their noise: an alarm each night would be switched off.
        status, reported = "same", requested.least
        message = "it moved, but certainly by less than the tolerance"
        listed.append(Reason("within_tolerance", message, {}))
    elif power < MIN_POWER:
        words = directions_in_words(covariance)
        message = f"it is certain that it moved, but not by how much: {words}"
        listed.append(Reason("size_unsure", message, {}))
    T, random = new.T_target_source, parts[1].random
    return CheckResult(
        status, tuple(listed), used, T, step, covariance, random, chi2, p_value, power, reported
    )
