"""Whether two poses, both with a covariance, are one: the test behind ``retropole check``.

With ``d`` the step from the stored pose to the new one (`se3.local`) and ``S`` its covariance,
``dᵀ S⁻¹ d`` is χ² with 6 degrees of freedom where nothing moved. What both poses have in common,
such as a range offset of the tape or of single rings, cancels in ``d`` and mostly in ``S``
(`repeated`).

A test that could not have seen a movement says nothing by not seeing one. So *same* is answered
only within a tolerance: by as much as it has not moved with a confidence of 95 % (`upper_limit`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtrc

from ..base import se3
from ..base.datatypes import Array, PoseEstimate
from ..base.errors import Reason
from ..base.uncertainty import Uncertainty
from ..base.uncertainty.confirmation import Confirmation
from .certainty import (
    FALSE_ALARM,
    MIN_POWER,
    ROTATION,
    TRANSLATION,
    Weakness,
    detection_power,
    directions_in_words,
    least_certain,
    upper_limit,
)
from .repeated import in_parts, step_covariance
from .tolerance import NOT_ASKED, WIDEST_TOLERANCE, Asked, Tolerance

BOUND_SIGMAS = 3.0
"""A movement that was found is certainly below the tolerance where so many σ more would be."""

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
        Probability that a movement of the tolerance asked for, or else of the default, would have
        been found, in the worst direction.
    tolerance
        Where nothing moved: the least that these data confirm, no less than what was asked for. By
        more it has not moved, with `CONFIDENCE`. Of *same*, what it is said within. None where
        another reason stands against any.
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

    def untold(self, *more: Reason) -> CheckResult:
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
    asked: Asked = NOT_ASKED,
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
    asked
        The movement that matters, or as small a one as these data can tell.
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
    power = detection_power(covariance, asked.least)
    said = list(reasons)
    status: Status = "moved" if p_value < FALSE_ALARM else "same"
    told: Tolerance | None = None
    least, widest = asked.least, asked.widest
    if used == "scene":
        # Beyond, the search about the stored pose would confirm itself.
        least, widest = (each.or_narrower(WIDEST_TOLERANCE) for each in (least, widest))
    limit = upper_limit(step, covariance)
    if status == "same":
        told = asked.least.or_wider(limit)
        if not limit.is_within(widest):
            status = "cannot_tell"
            said.append(Weakness(*parts, limit, asked.least).too_weak(widest))
        elif told != asked.least:
            said.append(Weakness(*parts, told, asked.least).wider_tolerance())
    elif upper_limit(step, covariance, BOUND_SIGMAS).is_within(least):
        # Real LiDARs drift by more than their noise: an alarm each night would be switched off.
        status, told = "same", asked.least
        message = "it moved, but certainly by less than the tolerance"
        said.append(Reason("within_tolerance", message, {}))
    elif power < MIN_POWER:
        words = directions_in_words(covariance)
        message = f"that it moved is certain, but not by how much: {words}"
        said.append(Reason("size_unsure", message, {}))
    T, random = new.T_target_source, parts[1].random
    return CheckResult(
        status, tuple(said), used, T, step, covariance, random, chi2, p_value, power, told
    )
