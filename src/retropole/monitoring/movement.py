"""Whether two poses, both with a covariance, are one: the test behind ``retropole check``.

With ``d`` the step from the stored pose to the new one (`se3.local`) and ``S`` its covariance,
``dᵀ S⁻¹ d`` is χ² with 6 degrees of freedom where nothing moved. What both poses have in common,
such as a range offset of the tape or of single rings, cancels in ``d`` and mostly in ``S``
(`repeated`).

A test that could not have seen a movement says nothing by not seeing one. So *same* is answered
only where a movement of the size that matters would almost certainly have been found, about
whatever axis, in whatever direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtrc, chdtri, chndtr

from .. import se3
from ..datatypes import Array, PoseEstimate
from ..errors import Reason
from ..quantities import error
from ..uncertainty import Confirmation, Uncertainty
from .repeated import in_parts, step_covariance
from .tolerance import DEFAULT_TOLERANCE, Tolerance

FALSE_ALARM = 0.01
"""How often the test may find a movement where there was none."""

MIN_POWER = 0.95
"""Probability with which a movement of the tolerance must be found before *same* is said."""

BOUND_SIGMAS = 3.0
"""A movement is certainly below the tolerance where so many σ more would be."""

MAX_NONCENTRALITY = 1000.0
"""Beyond, the power is 1 to all digits and SciPy's noncentral χ² is not reliable."""

ROTATION, TRANSLATION = slice(0, 3), slice(3, 6)
"""Parts of a step."""

Status = Literal["same", "moved", "cannot_tell"]
Method = Literal["poles", "scene"]


@dataclass(frozen=True)
class Movement:
    """Length of a part of the step, and 1 σ in its least certain direction; rad or m."""

    length: float
    sigma: float


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
        (6,) ``[φ, δ]`` from the stored pose to the new one, rad and m, target axes; δ is the
        translation of the source's origin.
    covariance
        (6, 6) of the step: what of both poses' errors does not cancel.
    random
        (6, 6) of that what each new check draws anew; the rest is the same in all checks that find
        the pose the same way.
    chi2, p_value
        The test, and how often so much comes about where nothing moved.
    power
        Probability that a movement of the tolerance would have been found, in the worst direction.
    confirmation
        What stands in the new recordings says of the stored pose; None where there are none.
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
    confirmation: Confirmation | None = None

    @property
    def rotation(self) -> Movement | None:
        """How far it was rotated, rad."""
        return self._part(ROTATION)

    @property
    def translation(self) -> Movement | None:
        """How far it was translated, metres."""
        return self._part(TRANSLATION)

    def _part(self, part: slice) -> Movement | None:
        if self.step is None or self.covariance is None:
            return None
        length = float(np.linalg.norm(self.step[part]))
        return Movement(length, least_certain(self.covariance, part).sigma)


@dataclass(frozen=True, eq=False)
class LeastCertain:
    """1 σ of a part of the step in the direction where it is largest, and that direction (3,)."""

    sigma: float
    direction: Array


def least_certain(covariance: Array, part: slice) -> LeastCertain:
    """Find the direction of a part of the step in which its covariance (6, 6) is largest."""
    values, vectors = np.linalg.eigh(covariance[part, part])
    return LeastCertain(float(np.sqrt(values[-1])), np.asarray(vectors[:, -1]))


def compare_poses(
    stored: PoseEstimate,
    new: PoseEstimate,
    used: Method,
    tolerance: Tolerance = DEFAULT_TOLERANCE,
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
    tolerance
        The movement that matters.
    reasons
        What is to be said beside.
    uncertainties
        Both covariances in their two kinds, where the same devices were used: their systematic
        parts mostly cancel. None, as of a pose that something else found, cancels nothing.
    """
    parts = in_parts(stored, uncertainties[0]), in_parts(new, uncertainties[1])
    step = se3.local(stored.T_target_source, new.T_target_source)
    covariance = step_covariance(*parts)
    chi2 = float(step @ np.linalg.solve(covariance, step))
    p_value = float(chdtrc(6, chi2))
    power = detection_power(covariance, tolerance)
    said = list(reasons)
    status: Status = "moved" if p_value < FALSE_ALARM else "same"
    if status == "same" and power < MIN_POWER:
        status = "cannot_tell"
        said.append(_too_weak(*parts, tolerance, power))
    elif status == "moved" and _certainly_below(step, covariance, tolerance):
        # Real LiDARs drift by more than their noise: an alarm each night would be switched off.
        status = "same"
        message = "it moved, but certainly by less than the tolerance"
        said.append(Reason("within_tolerance", message, {}))
    elif status == "moved" and power < MIN_POWER:
        message = "that it moved is certain, but not by how much: " + _in_words(covariance)
        said.append(Reason("size_unsure", message, {}))
    return CheckResult(
        status,
        tuple(said),
        used,
        new.T_target_source,
        step,
        covariance,
        parts[1].random,
        chi2,
        p_value,
        power,
    )


def _certainly_below(step: Array, covariance: Array, tolerance: Tolerance) -> bool:
    return all(
        np.linalg.norm(step[part]) + BOUND_SIGMAS * least_certain(covariance, part).sigma < limit
        for part, limit in (
            (ROTATION, tolerance.rotation),
            (TRANSLATION, tolerance.translation),
        )
    )


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


def _too_weak(stored: Uncertainty, new: Uncertainty, tolerance: Tolerance, power: float) -> Reason:
    """Say in which direction the step is least certain, and which of the two poses limits it."""
    covariance = step_covariance(stored, new)
    rotation, translation = (
        least_certain(covariance, ROTATION),
        least_certain(covariance, TRANSLATION),
    )
    # Whichever is weaker beside its tolerance is what the power is lost by.
    by_rotation = rotation.sigma / tolerance.rotation > translation.sigma / tolerance.translation
    part, worst = (
        (ROTATION, rotation.direction) if by_rotation else (TRANSLATION, translation.direction)
    )
    # What does not cancel is blamed on the poses by what they would have had alone.
    alone = [float(worst @ one.covariance[part, part] @ worst) for one in (stored, new)]
    share = alone[0] / sum(alone)
    remedy = (
        "the stored calibration is the weaker part: calibrate again, with the scene or with more "
        "placements of the poles"
        if share > 0.5
        else "the new recordings are the weaker part: record more frames, set up the poles, or "
        "put up something flat across that direction"
    )
    return Reason(
        "too_weak",
        f"no movement was found, but one of {np.degrees(tolerance.rotation):.2g}° or "
        f"{100 * tolerance.translation:.2g} cm would be found with a probability of {power:.0%} "
        f"only ({MIN_POWER:.0%} are needed): {_in_words(covariance)}; {remedy}",
        {
            "power": power,
            "sigma_rad": rotation.sigma,
            "sigma_m": translation.sigma,
            "stored_share": share,
        },
    )


def _in_words(covariance: Array) -> str:
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
