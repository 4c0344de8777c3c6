"""What a check could not tell, in words: how much it could, in which direction, what limits it."""

from __future__ import annotations

from dataclasses import dataclass

from ..base.datatypes import Array
from ..base.errors import Reason
from ..base.quantities import error, percent
from ..base.reasons import Code
from ..base.uncertainty import Uncertainty
from .certainty import CONFIDENCE, ROTATION, TRANSLATION, detection_power, least_certain
from .repeated import step_covariance
from .tolerance import Tolerance

SURE = f"with {percent(CONFIDENCE)} confidence"


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
