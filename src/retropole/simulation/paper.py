"""The simulated set-up of Xue et al. 2019, Sec. IV-A: two LiDARs and two poles in empty space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from .devices import EXACT
from .raycast import Cylinder
from .scenes import TAPE

PAPER_RADIUS = 0.02
"""Of the paper's poles, metres."""

PAPER_NOISE = replace(EXACT, isotropic_noise=0.006)
"""Zero-mean Gaussian noise with σ = 6 mm in each coordinate, and nothing else."""

PAPER_POLE_LENGTH = 6.0
"""Centred on z = 0, metres. The paper states none. With poles of 2 m, which a person can carry, its
estimator ends with the error that was measured at its set-up; with 6 m the error is a tenth
smaller, with 1 m half as large again (`python -m studies.paper`)."""

PAPER_DISTANCES = 2.0, 3.0
"""Least and greatest ‖p‖ of the axis points, metres."""

PAPER_SPACING = 1.5, 4.0
"""Least and greatest ‖p_a − p_b‖, metres."""

PAPER_MIN_UPRIGHT = 0.9
"""n_z of each axis is greater than this."""

PAPER_CLEAR = 4.0, 4.0
"""Half extents in x and y in which things move, if any does, metres (the paper has none)."""

_LIDARS = (
    (np.array([0.094, 0.079, 0.094, 0.988]), np.array([1.0, -1.0, 0.0])),
    (np.array([-0.079, -0.094, -0.079, 0.989]), np.array([1.0, 1.0, 0.0])),
)
"""Quaternions x y z w (normalised where they are used) and positions."""


def lidar_poses() -> tuple[Array, Array]:
    """Poses (4, 4) of the target and the source LiDAR in the world frame."""
    target, source = (se3.from_quaternion_xyzw(q, t) for q, t in _LIDARS)
    return target, source


def draw_poles(rng: np.random.Generator, radius: float = PAPER_RADIUS) -> list[Cylinder]:
    """Draw the two poles: n_z > 0.9, axis points in z = 0 with 2 ≤ ‖p‖ ≤ 3, 1.5 to 4 m apart.

    The paper also places both points on the y axis, which contradicts these distances. Here they
    are drawn anywhere in z = 0. Both loops repeat until a draw fits: two in five pairs of points
    and one axis in twenty do.
    """
    near, far = PAPER_DISTANCES
    closest, farthest = PAPER_SPACING
    while True:
        bearing = rng.uniform(0, 2 * np.pi, 2)
        distance = np.sqrt(rng.uniform(near**2, far**2, 2))
        points = np.stack([distance * np.cos(bearing), distance * np.sin(bearing), 0 * bearing], 1)
        if closest <= np.linalg.norm(points[0] - points[1]) <= farthest:
            break
    poles = []
    for point in points:
        axis = np.zeros(3)
        while axis[2] <= PAPER_MIN_UPRIGHT:
            axis = rng.normal(size=3)
            axis /= np.linalg.norm(axis)
        poles.append(Cylinder(point, axis, radius, PAPER_POLE_LENGTH, TAPE))
    return poles
