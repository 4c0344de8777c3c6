"""What is estimated from the poles of a site: poses, range offsets, the radius, axes and points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base import se3
from ..base.datatypes import Array, IntArray
from .posterior import State
from .unknowns import POSE


@dataclass(frozen=True, eq=False)
class JointState:
    """What is estimated from the poles.

    Attributes
    ----------
    T
        (L, 4, 4) site from LiDAR, about its beam origin.
    offsets
        (L,) range offset of all retro-reflective returns of each, metres.
    radius
        Of the poles, metres.
    points, directions
        (K, 3) the axes in the frame of the site.
    control
        (Q, 3) control points there.
    """

    T: Array
    offsets: Array
    radius: float
    points: Array
    directions: Array
    control: Array

    @property
    def size(self) -> int:
        """How many parameters a step has."""
        return self.first_axis + 4 * len(self.points) + 3 * len(self.control)

    @property
    def first_axis(self) -> int:
        """Where the parameters of the axes start: after poses, offsets and the radius."""
        return (POSE + 1) * len(self.T) + 1

    def axes(self, own: IntArray) -> IntArray:
        """(4 N,) where the parameters of some axes stand."""
        return np.asarray((self.first_axis + 4 * own[:, None] + np.arange(4)).reshape(-1))

    def control_points(self) -> slice:
        """Where the parameters of the control points stand."""
        return slice(self.first_axis + 4 * len(self.points), self.size)

    def of(self, lidar: int, own: IntArray) -> State:
        """What one LiDAR sees of some axes, as the source of a pair whose target is the site."""
        return State(
            self.T[lidar],
            np.array([0.0, self.offsets[lidar]]),
            self.radius,
            self.points[own],
            self.directions[own],
        )

    def moved(self, step: Array) -> JointState:
        """Move by a step: poses (6 each), offsets, radius, axes (4 each), control points (3)."""
        count = len(self.T)
        steps = step[: POSE * count].reshape(-1, POSE)
        whole = State(np.eye(4), np.zeros(2), self.radius, self.points, self.directions)
        axes = step[self.first_axis : self.first_axis + 4 * len(self.points)]
        moved = whole.moved(np.r_[np.zeros(8), step[self.first_axis - 1], axes])
        return JointState(
            np.stack([se3.retract(T, one) for T, one in zip(self.T, steps, strict=True)]),
            self.offsets + step[POSE * count : (POSE + 1) * count],
            moved.radius,
            moved.points,
            moved.directions,
            self.control + step[self.control_points()].reshape(-1, 3),
        )
