"""What the user knows of the rotation beforehand: used to choose a hypothesis, never needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Match
from ..base.errors import Refusal, UsageError

MAX_SIGMAS = 3.0
"""A hypothesis that lies further from the prior, in 1 σ of it, is left out."""


@dataclass(frozen=True, eq=False)
class RotationPrior:
    """What is known of the rotation of the source in the target's frame.

    Attributes
    ----------
    rotation
        (3, 3) the expected rotation; None where only the tilt is expected, to be zero: both LiDARs
        stand upright.
    sigma
        1 σ of the angle, rad.
    """

    rotation: Array | None
    sigma: float

    def misfit(self, T: Array) -> float:
        """How far a pose (4, 4) lies from the prior, in 1 σ."""
        if self.rotation is None:
            angle = float(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))
        else:
            angle = se3.rotation_angle(T[:3, :3] @ self.rotation.T)
        return angle / self.sigma

    def allows(self, T: Array) -> bool:
        """Whether a pose (4, 4) agrees with the prior."""
        return self.misfit(T) <= MAX_SIGMAS


def rotation_prior(
    up: bool, rpy_deg: Sequence[float] | None, sigma_deg: float
) -> RotationPrior | None:
    """Take the prior as a user gives it: upright, or roll, pitch and yaw in degrees, or neither.

    Raises
    ------
    UsageError
        Where both are given.
    """
    if up and rpy_deg is not None:
        raise UsageError("up and prior_rpy_deg (--up, --prior-rpy-deg) exclude each other")
    sigma = float(np.radians(sigma_deg))
    if rpy_deg is not None:
        return RotationPrior(se3.rotation_from_rpy(np.radians(rpy_deg)), sigma)
    return RotationPrior(None, sigma) if up else None


def agreeing_with_prior(matches: Sequence[Match], prior: RotationPrior | None) -> list[Match]:
    """Keep the matches that agree with the prior.

    Only those whose poles fit exactly can be the answer, and only they count as agreeing.

    Raises
    ------
    Refusal
        ``prior_contradicted`` where some fit exactly and none of these agrees.
    """
    if prior is None:
        return list(matches)
    kept = [match for match in matches if prior.allows(match.T_target_source)]
    misfits = [prior.misfit(match.T_target_source) for match in matches if match.exact]
    if misfits and not any(match.exact for match in kept):
        least, count = min(misfits), len(misfits)
        raise Refusal(
            "prior_contradicted",
            f"of {count} {'hypothesis' if count == 1 else 'hypotheses'} that fit the poles none "
            f"agrees with the given rotation: the nearest is {np.degrees(least * prior.sigma):.0f}"
            f"° away, {least:.1f} times its sigma; check its sign and order, or leave it out",
            {"sigmas": least, "allowed": MAX_SIGMAS, "hypotheses": count},
        )
    return kept
