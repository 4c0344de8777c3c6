"""How poles and LiDARs stand in a place.

The limits are chosen: those of which the text says nothing else describe what people do.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..base import se3
from ..base.datatypes import Array
from .raycast import Cylinder, Surface
from .scenes import TAPE

HALF_TURN = np.diag([-1.0, -1.0, 1.0])
"""Rotation by 180° about the vertical."""

MAX_POLE_DRAWS = 200
"""Draws of axes, and of feet, before `draw_poles` gives up a place."""

MAX_LEAN = float(np.radians(35.0))
"""Of a pole from the vertical, rad (chosen)."""

POLE_SPACING = 1.2, 6.0
"""Least and greatest distance between the feet of two poles, metres (chosen)."""

MAX_POLE_X = 3.0
"""Poles stand within this distance of the middle along x, metres, in a long place too."""

POLE_LENGTHS = 1.8, 2.5
"""Least and greatest length of the taped part, metres: what a person carries."""

FOOT_HEIGHT = 0.05
"""Height above the ground at which the tape starts, metres (chosen)."""

LIDAR_HEIGHTS = 0.5, 2.0
"""Least and greatest height of a LiDAR, metres: on a robot, on a mast."""

POLE_DISTANCES = 2.2, 8.0
"""Least and greatest horizontal distance of a LiDAR from a pole, metres (chosen around the 5 m of
Xue et al. 2019)."""

TILT_SIGMA = float(np.radians(7.0))
"""1 σ of the roll and pitch of a LiDAR, rad (chosen)."""

UPSIDE_DOWN = 1 / 6
"""Share of the LiDARs that hang upside down (chosen)."""


def draw_poles(
    rng: np.random.Generator,
    count: int,
    clear: tuple[float, float],
    angles: tuple[float, float],
    radius: float,
) -> list[Cylinder] | None:
    """Draw taped poles on the ground that lean by up to `MAX_LEAN`.

    Parameters
    ----------
    rng
        Draws them.
    count
        How many.
    clear
        Half extents of the ground on which they stand, metres.
    angles
        Least and greatest angle between any two of them, rad.
    radius
        Metres.

    Returns
    -------
    list of Cylinder or None
        None where `MAX_POLE_DRAWS` draws give no such poles.
    """
    i, j = np.triu_indices(count, 1)
    for _ in range(MAX_POLE_DRAWS):
        axes = _leaning(rng.uniform(0, MAX_LEAN, count), rng.uniform(0, 2 * np.pi, count))
        between = np.arccos(np.clip(np.abs(np.einsum("pi,pi->p", axes[i], axes[j])), 0, 1))
        if np.all((between >= angles[0]) & (between <= angles[1])):
            break
    else:
        return None
    for _ in range(MAX_POLE_DRAWS):
        feet = rng.uniform(-1, 1, (count, 2)) * (min(clear[0], MAX_POLE_X), clear[1])
        gaps = np.linalg.norm(feet[i] - feet[j], axis=1)
        if np.all((gaps >= POLE_SPACING[0]) & (gaps <= POLE_SPACING[1])):
            break
    else:
        return None
    lengths = rng.uniform(*POLE_LENGTHS, count)
    return [
        Cylinder(np.r_[foot, FOOT_HEIGHT] + axis * length / 2, axis, radius, float(length), TAPE)
        for foot, axis, length in zip(feet, axes, lengths, strict=True)
    ]


def _leaning(lean: Array | float, toward: Array | float) -> Array:
    """Axes (..., 3) that lean from the vertical by an angle towards a heading, rad."""
    level = np.sin(lean)
    return np.stack([level * np.cos(toward), level * np.sin(toward), np.cos(lean)], axis=-1)


def symmetric_poles(rng: np.random.Generator, radius: float) -> list[Cylinder]:
    """Draw two poles that a rotation by 180° about the vertical maps onto each other."""
    lean, toward = np.radians(rng.uniform(9, 20)), rng.uniform(0, 2 * np.pi)
    axis = _leaning(lean, toward)
    foot = rng.uniform(0.8, 1.5) * np.array([np.cos(toward + 1.2), np.sin(toward + 1.2)])
    first = np.r_[foot, FOOT_HEIGHT] + 1.1 * axis
    return [
        Cylinder(first, axis, radius, 2.2, TAPE),
        Cylinder(HALF_TURN @ first, HALF_TURN @ axis, radius, 2.2, TAPE),
    ]


def rotated_by_180(surfaces: list[Surface]) -> list[Surface]:
    """Rotate surfaces by 180° about the vertical through the origin."""
    placed = ("centre", "u", "v", "axes", "axis")
    return [
        replace(s, **{name: HALF_TURN @ getattr(s, name) for name in placed if hasattr(s, name)})
        for s in surfaces
    ]


def draw_lidar(
    rng: np.random.Generator, poles: list[Cylinder], clear: tuple[float, float]
) -> Array | None:
    """Draw a pose (4, 4) within `POLE_DISTANCES` of every pole; None where this draw has none."""
    place = np.r_[rng.uniform(-1, 1, 2) * clear, rng.uniform(*LIDAR_HEIGHTS)]
    distance = [float(np.linalg.norm((pole.centre - place)[:2])) for pole in poles]
    if min(distance) < POLE_DISTANCES[0] or max(distance) > POLE_DISTANCES[1]:
        return None
    return se3.from_rt(draw_rotation(rng), place)


def draw_rotation(rng: np.random.Generator) -> Array:
    """Draw the rotation (3, 3) of a LiDAR: roughly upright or upside down, at any heading."""
    tilt = np.r_[rng.normal(0, TILT_SIGMA, 2), rng.uniform(0, 2 * np.pi)]
    if rng.uniform() < UPSIDE_DOWN:
        tilt[0] += np.pi
    return np.asarray(Rotation.from_euler("xyz", tilt).as_matrix())
