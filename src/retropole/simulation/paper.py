"""The simulated set-up of Xue et al. 2019, Sec. IV-A: two LiDARs and two poles in empty space."""

from __future__ import annotations

import numpy as np

from .. import se3
from ..datatypes import Array
from .raycast import Cylinder
from .scanning import NoiseModel
from .scenes import TAPE

PAPER_RADIUS = 0.02
PAPER_NOISE = NoiseModel(0.0, 0.006, 0.0, False, 0.0, 0.0, 0.0)
"""Zero-mean Gaussian of 6 mm in each coordinate, and nothing else."""

PAPER_POLE_LENGTH = 6.0
"""Centred on z = 0. The paper names none; with poles of 2 m, which a person carries, its estimator
comes to the error that was measured at its set-up, with 6 m it is a sixth better, with 1 m half as
bad again."""

_LIDARS = (
    (np.array([0.094, 0.079, 0.094, 0.988]), np.array([1.0, -1.0, 0.0])),
    (np.array([-0.079, -0.094, -0.079, 0.989]), np.array([1.0, 1.0, 0.0])),
)
"""Quaternions x y z w (normalised where they are used) and positions."""


def lidar_poses() -> tuple[Array, Array]:
    """Poses (4, 4) of the target and the source LiDAR in the world."""
    target, source = (se3.from_quaternion_xyzw(q, t) for q, t in _LIDARS)
    return target, source


def draw_poles(rng: np.random.Generator, radius: float = PAPER_RADIUS) -> list[Cylinder]:
    """Draw the two poles: n_z > 0.9, axis points in z = 0 with 2 ≤ ‖p‖ ≤ 3, 1.5 to 4 m apart.

    The paper also places both points in the y axis, which contradicts these distances: they are
    drawn anywhere in z = 0.
    """
    while True:
        bearing = rng.uniform(0, 2 * np.pi, 2)
        distance = np.sqrt(rng.uniform(2.0**2, 3.0**2, 2))
        points = np.stack([distance * np.cos(bearing), distance * np.sin(bearing), 0 * bearing], 1)
        if 1.5 <= np.linalg.norm(points[0] - points[1]) <= 4.0:
            break
    poles = []
    for point in points:
        axis = np.zeros(3)
        while axis[2] <= 0.9:
            axis = rng.normal(size=3)
            axis /= np.linalg.norm(axis)
        poles.append(Cylinder(point, axis, radius, PAPER_POLE_LENGTH, TAPE))
    return poles
