"""What a check could not tell, in words: how much it could, in which direction, what limits it."""

from __future__ import annotations

from ..base.datatypes import Array
from ..base.errors import Reason
from ..base.quantities import error, percent
from ..base.uncertainty import Uncertainty
from .certainty import CONFIDENCE, ROTATION, TRANSLATION, detection_power, least_certain
from .repeated import step_covariance
from .tolerance import Tolerance

SURE = f"with {percent(CONFIDENCE)} confidence"


def too_weak(
    stored: Uncertainty, new: Uncertainty, told: Tolerance, asked: Tolerance, widest: Tolerance
) -> Reason:
    """Say that nothing is confirmed: what these data tell is wider than what they must.

    Parameters
    ----------
    stored, new
        Both poses' uncertainties.
    told
        By how much it has moved at most, with `CONFIDENCE`.
    asked, widest
        The tolerance asked for, or the default, and the widest to be confirmed in its place.
    """
    missing = [
        words
        for has, allowed, words in (
            (told.rotation, widest.rotation, widest.rotation_in_words),
            (told.translation, widest.translation, widest.translation_in_words),
        )
        if has > allowed
    ]
    return Reason(
        "too_weak",
        f"no movement was found, but these data tell only, {SURE}, that it moved by no more than "
        f"{told.in_words} ({' and '.join(missing)} must be told): "
        + _limited_by(stored, new, told, asked),
        _figures(stored, new, told, asked),
    )


def wider_tolerance(
    stored: Uncertainty, new: Uncertainty, told: Tolerance, asked: Tolerance
) -> Reason:
    """Say that *same* holds within more than the default, and why within no less."""
    return Reason(
        "wider_tolerance",
        f"the same within {told.in_words}, {SURE}; the default, {asked.in_words}, cannot be told "
        "by these data: " + _limited_by(stored, new, told, asked),
        _figures(stored, new, told, asked),
    )


def directions_in_words(covariance: Array) -> str:
    """Write 1 σ of both parts of a step, and the directions in which they are so large."""
    rotation, translation = (
        least_certain(covariance, ROTATION),
        least_certain(covariance, TRANSLATION),
    )
    return (
        f"1 σ of the difference is {error(rotation.sigma, 'rad')} about "
        "({:+.2f} {:+.2f} {:+.2f}) ".format(*rotation.direction)
        + f"and {error(translation.sigma)} along "
        + "({:+.2f} {:+.2f} {:+.2f}) of the target (the worst directions)".format(
            *translation.direction
        )
    )


def _limited_by(stored: Uncertainty, new: Uncertainty, told: Tolerance, asked: Tolerance) -> str:
    """Say in which direction the step is least certain, which pose limits it, and what helps."""
    remedy = (
        "the stored calibration is the weaker part: calibrate again, with the scene or with more "
        "placements of the poles"
        if _stored_share(stored, new, told, asked) > 0.5
        else "the new recordings are the weaker part: record more frames, set up the poles, or "
        "put up something flat across that direction"
    )
    return f"{directions_in_words(step_covariance(stored, new))}; {remedy}"


def _figures(
    stored: Uncertainty, new: Uncertainty, told: Tolerance, asked: Tolerance
) -> dict[str, float | int | str]:
    covariance = step_covariance(stored, new)
    return {
        "tolerance_rad": told.rotation,
        "tolerance_m": told.translation,
        "power": detection_power(covariance, asked),
        "sigma_rad": least_certain(covariance, ROTATION).sigma,
        "sigma_m": least_certain(covariance, TRANSLATION).sigma,
        "stored_share": _stored_share(stored, new, told, asked),
    }


def _stored_share(
    stored: Uncertainty, new: Uncertainty, told: Tolerance, asked: Tolerance
) -> float:
    """Share that the stored pose has in the variance of the direction that limits the step.

    What does not cancel is blamed on the poses by what they would have had alone.
    """
    # Whichever part is the farther beyond its tolerance.
    by_rotation = told.rotation / asked.rotation > told.translation / asked.translation
    part = ROTATION if by_rotation else TRANSLATION
    worst = least_certain(step_covariance(stored, new), part).direction
    alone = [float(worst @ one.covariance[part, part] @ worst) for one in (stored, new)]
    return alone[0] / sum(alone)
