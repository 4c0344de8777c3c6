"""Prior knowledge of the pose from the user: used to choose a hypothesis, never required."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Match
from ..base.errors import Refusal, UsageError
from ..base.uncertainty import SIGMAS


@dataclass(frozen=True, eq=False)
class PosePrior:
    """Prior knowledge of the pose of the source in the target's frame.

    Attributes
    ----------
    rotation
        (3, 3) the expected rotation; None if only the tilt is expected, to be zero: both LiDARs
        are upright.
    sigma
        1 σ of the angle, rad; infinite if no rotation is expected.
    distance_sigma
        1 σ of the distance of the source from the target's origin, metres: that of a map is the
        rough position of the LiDAR.
    """

    rotation: Array | None = None
    sigma: float = np.inf
    distance_sigma: float = np.inf

    def misfits(self, T: Array) -> tuple[float, float]:
        """Distances of rotation and position of a pose (4, 4) from the prior, in 1 σ."""
        if self.rotation is None:
            angle = float(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))
        else:
            angle = se3.rotation_angle(T[:3, :3] @ self.rotation.T)
        return angle / self.sigma, float(np.linalg.norm(T[:3, 3])) / self.distance_sigma

    def misfit(self, T: Array) -> float:
        """Distance of a pose (4, 4) from the prior, in 1 σ."""
        return max(self.misfits(T))

    def allows(self, T: Array) -> bool:
        """Whether a pose (4, 4) agrees with the prior."""
        return self.misfit(T) <= SIGMAS


def pose_prior(
    up: bool,
    rpy_deg: Sequence[float] | None,
    sigma_deg: float,
    distance_sigma: float | None = None,
) -> PosePrior | None:
    """Make the prior from the options of a user: upright, or roll, pitch and yaw in degrees, or
    neither.

    And the distance of the source from the target's origin, 1 σ in metres, if that is known.

    Raises
    ------
    UsageError
        If both are given.
    """
    if up and rpy_deg is not None:
        raise UsageError("up and prior_rpy_deg (--up, --prior-rpy-deg) exclude each other")
    if not up and rpy_deg is None and distance_sigma is None:
        return None
    rotation = None if rpy_deg is None else se3.rotation_from_rpy(np.radians(rpy_deg))
    sigma = float(np.radians(sigma_deg)) if up or rpy_deg is not None else np.inf
    return PosePrior(rotation, sigma, np.inf if distance_sigma is None else distance_sigma)


def agreeing_with_prior(matches: Sequence[Match], prior: PosePrior | None) -> list[Match]:
    """Keep the matches that agree with the prior.

    Only those whose poles fit exactly can be the answer, and only they are treated as agreeing.

    Raises
    ------
    Refusal
        ``prior_contradicted`` if some fit exactly and none of these agrees.
    """
    if prior is None:
        return list(matches)
    kept = [match for match in matches if prior.allows(match.T_target_source)]
    misfits = [prior.misfits(match.T_target_source) for match in matches if match.exact]
    if misfits and not any(match.exact for match in kept):
        angle, distance = min(misfits, key=max)
        least, count = max(angle, distance), len(misfits)
        gap, of, check = f"{np.degrees(angle * prior.sigma):.0f}°", "rotation", "sign and order"
        if distance > angle:
            gap, of, check = f"{distance * prior.distance_sigma:.1f} m", "place", "coordinates"
        raise Refusal(
            "prior_contradicted",
            f"of {count} {'hypothesis' if count == 1 else 'hypotheses'} that fit the poles none "
            f"agrees with the given {of}: the nearest is {gap} away, {least:.1f} times its sigma;"
            f" check its {check}, or leave it out",
            {"sigmas": least, "allowed": SIGMAS, "hypotheses": count},
        )
    return kept
