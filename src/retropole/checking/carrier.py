"""What a carrier that moves between two recordings makes of the pose between their LiDARs.

A vehicle reported as stationary may creep. Where its LiDARs recorded at different times, it was
at another pose, and the pose between them is off by its motion: that is not a movement of the
rig. The sweeps of a recording show the motion (`surfaces.sway.velocity_of`), and it is removed. A
single sweep shows none; then only the assumed speed of a stationary carrier bounds it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from ..base import se3
from ..base.datatypes import Array, PointCloud
from ..base.errors import Reason
from ..base.quantities import error, value_and_error
from ..io.recordings import time_of_recording
from ..surfaces.static import MAX_TURN
from ..surfaces.sway import velocity_of, without_velocity
from .movement import FALSE_ALARM, ROTATION, TRANSLATION, least_certain

CREEP = 0.07
"""1 σ of the speed, along each axis, of a carrier that is assumed stationary, m/s. Vehicles of 13
recordings that were assumed stationary crept at up to 0.24 m/s; the test
explains 4.1 σ, 0.29 m/s, less the noise of the poses."""

FASTEST = 0.5
"""A carrier that moves faster drives, m/s: such a recording cannot be used for a check."""

LEVER = 10.0
"""A carrier that creeps turns as about a point at this distance, metres, 1 σ."""

SWEEP = 0.2
"""Recordings whose middles differ in time by more than a sweep of the slowest LiDARs takes, s,
and than either recording took, are not of one moment: a motion between them is unknown."""


@dataclass(frozen=True, eq=False)
class CarrierMotion:
    """How a carrier moved from the middle of the target's recording to that of the source's.

    Attributes
    ----------
    apart
        Seconds from the one to the other, negative where the source's was first.
    velocity
        (6,) its turn and the shift of the source's origin per second, rad/s and m/s, target axes.
    covariance
        (6, 6) of what it adds to the pose, over ``[φ, δ]``, rad and m.
    is_seen
        Whether the sweeps show it, beyond their noise.
    """

    apart: float
    velocity: Array
    covariance: Array
    is_seen: bool

    @property
    def step(self) -> Array:
        """(6,) ``[φ, δ]`` that it adds to the pose, rad and m, target axes."""
        return self.velocity * self.apart

    def without_motion(
        self, T: Array, target: PointCloud, source: PointCloud
    ) -> tuple[PointCloud, PointCloud]:
        """Bring both recordings to the middle of the target's."""
        clouds, later = (target, source), (0.0, self.apart)
        of_each = zip(clouds, _of_origins(T, *clouds), later, strict=True)
        first, second = (without_velocity(cloud, J @ self.velocity, t) for cloud, J, t in of_each)
        return first, second

    @property
    def seen(self) -> Reason:
        """Report that the carrier moved, and that its motion is removed."""
        speed = float(np.linalg.norm(self.velocity[TRANSLATION]))
        sigma = least_certain(self.covariance, TRANSLATION).sigma / abs(self.apart)
        rate, turned = value_and_error(speed, sigma), self._turned
        return Reason(
            "carrier_moved",
            f"the carrier of the LiDARs moved while they recorded, by {rate} each second as their "
            f"sweeps show, and the recordings differ by {1e3 * abs(self.apart):.0f} ms: the "
            f"{error(self._moved)} and {turned} that this adds to the pose are removed",
            self._values,
        )

    def explains(self, step: Array) -> Reason:
        """Report that the creep of a carrier may have caused a step (6,) of the pose."""
        moved = float(np.linalg.norm(step[TRANSLATION]))
        return Reason(
            "carrier_moved",
            f"the timestamps of the recordings differ by {1e3 * abs(self.apart):.0f} ms: a "
            f"carrier that creeps at {moved / abs(self.apart):.2f} m/s gives such a pose "
            "although the LiDARs did not move on it, and single sweeps do not show whether the "
            "carrier moved; record some seconds, or while it is at rest",
            {"apart_s": self.apart, "speed_m_s": moved / abs(self.apart)},
        )

    @property
    def _moved(self) -> float:
        return float(np.linalg.norm(self.step[TRANSLATION]))

    @property
    def _turned(self) -> str:
        return error(float(np.linalg.norm(self.step[ROTATION])), "rad")

    @property
    def _values(self) -> dict[str, float | int | str]:
        return {
            "apart_s": self.apart,
            "speed_m_s": float(np.linalg.norm(self.velocity[TRANSLATION])),
            "moved_m": self._moved,
            "turned_rad": float(np.linalg.norm(self.step[ROTATION])),
        }


def carrier_motion(T: Array, target: PointCloud, source: PointCloud) -> CarrierMotion | None:
    """Estimate how the carrier of two LiDARs moved between their recordings.

    Parameters
    ----------
    T
        (4, 4) the pose of the source in the target's frame, as it was.
    target, source
        Recordings of both, each in the frame of its LiDAR.

    Returns
    -------
    CarrierMotion or None
        None if the times are unknown or equal, if the recordings are not of one moment, or if the
        carrier drives or turned by more than the limit for a LiDAR that records.
    """
    when = time_of_recording(target), time_of_recording(source)
    if when[0] is None or when[1] is None:
        return None
    seconds = sum(when[1]) / 2 - sum(when[0]) / 2
    lengths = [last - first for first, last in (when[0], when[1])]
    if seconds == 0.0 or abs(seconds) > max(SWEEP, *lengths):
        return None
    prior = np.diag(np.repeat([CREEP / LEVER, CREEP], 3) ** 2)
    seen, pull = np.zeros((6, 6)), np.zeros(6)
    for cloud, J in zip((target, source), _of_origins(T, target, source), strict=True):
        found = velocity_of(cloud, prior)
        if found is not None:
            seen += J.T @ found.information @ J
            pull += J.T @ found.pull
    covariance = np.asarray(np.linalg.inv(seen + np.linalg.inv(prior)))
    velocity = covariance @ pull
    speed, rate = (float(np.linalg.norm(velocity[part])) for part in (TRANSLATION, ROTATION))
    if speed > FASTEST or rate * max(lengths) > MAX_TURN:
        return None
    is_seen = bool(velocity @ seen @ velocity > chdtri(6, FALSE_ALARM))
    return CarrierMotion(seconds, velocity, covariance * seconds**2, is_seen)


def _of_origins(T: Array, target: PointCloud, source: PointCloud) -> Iterator[Array]:
    """Give (6, 6) that takes `CarrierMotion.velocity` to that of each LiDAR's beam origin.

    Each in its LiDAR's axes: a point at x from another of a body that turns by ω moves by ω × x
    more than that one.
    """
    of_target, of_source, R = np.eye(6), np.zeros((6, 6)), T[:3, :3].T
    of_target[3:, :3] = se3.hat(T[:3, 3] - target.origin)
    of_source[:3, :3] = of_source[3:, 3:] = R
    of_source[3:, :3] = -se3.hat(source.origin) @ R
    yield of_target
    yield of_source
