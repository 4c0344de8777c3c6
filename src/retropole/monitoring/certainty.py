"""How small a movement the covariance of a step tells, and in words what it does not tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, chndtr, ndtri

from ..base.datatypes import Array
from ..base.errors import Reason
from ..base.quantities import error, percent
from ..base.reasons import Code
from ..base.uncertainty import Uncertainty
from .repeated import step_covariance
from .tolerance import Tolerance

FALSE_ALARM = 0.01
"""How often the test may find a movement where there was none."""

CONFIDENCE = 0.95
"""With which it has moved by less than the tolerance before *same* is said: of movements of the
tolerance, so many at least are not answered by *same*."""

SURE = f"with {percent(CONFIDENCE)} confidence"

MIN_POWER = 0.95
"""Probability of finding a movement of the tolerance, below which the size of one is unsure."""

ONE_SIDED = float(ndtri(CONFIDENCE))
"""So many σ beyond a normal variable its mean lies with that confidence: 1.645."""

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
    told
        By how much it has moved at most, with `CONFIDENCE`.
    asked
        The tolerance asked for, or the default.
    """

    stored: Uncertainty
    new: Uncertainty
    told: Tolerance
    asked: Tolerance

    def too_weak(self, widest: Tolerance) -> Reason:
        """Say that nothing is confirmed: what these data tell is wider than the widest they may."""
        parts = (
            (self.told.rotation > widest.rotation, widest.rotation_in_words),
            (self.told.translation > widest.translation, widest.translation_in_words),
        )
        missing = " and ".join(words for is_missing, words in parts if is_missing)
        return self._reason(
            "too_weak",
            f"no movement was found, but these data tell only, {SURE}, that it moved by no more "
            f"than {self.told.in_words} ({missing} must be told): ",
        )

    def wider_tolerance(self) -> Reason:
        """Say that *same* holds within more than the default, and why within no less."""
        return self._reason(
            "wider_tolerance",
            f"the same within {self.told.in_words}, {SURE}; the default, {self.asked.in_words}, "
            "cannot be told by these data: ",
        )

    def _reason(self, code: Code, words: str) -> Reason:
        """Say also where the step is least certain, which pose limits it, and what helps."""
        covariance, share = step_covariance(self.stored, self.new), self._stored_share()
        remedy = (
            "the stored calibration is the weaker part: calibrate again, with the scene or with "
            "more placements of the poles"
            if share > 0.5
            else "the new recordings are the weaker part: record more frames, set up the poles, or "
            "put up something flat across that direction"
        )
        return Reason(
            code,
            f"{words}{directions_in_words(covariance)}; {remedy}",
            {
                "tolerance_rad": self.told.rotation,
                "tolerance_m": self.told.translation,
                "power": detection_power(covariance, self.asked),
                "sigma_rad": least_certain(covariance, ROTATION).sigma,
                "sigma_m": least_certain(covariance, TRANSLATION).sigma,
                "stored_share": share,
            },
        )

    def _stored_share(self) -> float:
        """Share that the stored pose has in the variance of the direction that limits the step.

        What does not cancel is blamed on the poses by what they would have had alone.
        """
        told, asked = self.told, self.asked
        # Whichever part is the farther beyond its tolerance.
        by_rotation = told.rotation / asked.rotation > told.translation / asked.translation
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
