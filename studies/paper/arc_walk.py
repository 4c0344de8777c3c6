"""Equations 3 and 4: the arc that a ring draws on the pole, walked as written and cast exactly.

The pole stands on the z axis and the LiDAR at (x_p, 0, 0). The paper takes the beams of a ring for
a plane, writes a point of the arc by its angle θ about the axis (eq. 3), and finds the step
dθ to the next point from the angle between the two as seen by the LiDAR (eq. 4), which has no
closed form. The beams of a ring off the middle form a cone; casting them is exact and closed.
"""

from __future__ import annotations

from math import acos, atan2, cos, hypot, sin
from typing import NamedTuple

import numpy as np

from retropole.base.datatypes import Array
from retropole.simulation.raycast import Cylinder, Material, cast

ENDLESS_POLE = 100.0
"""Length of the pole, metres: the field of view ends the line, as in the paper."""

SOLVER_TOLERANCE = 1e-14
"""Relative, of θ, and the largest residual of eq. 4 that counts as solved, rad."""


class MiddleBeam(NamedTuple):
    """The beam of a ring towards the pole's axis.

    Attributes
    ----------
    azimuth
        In the LiDAR's frame, rad.
    ray
        (3,) unit vector, in the plane y = 0.
    sideways
        (3,) unit vector in which the ray turns as the azimuth grows.
    """

    azimuth: float
    ray: Array
    sideways: Array


def rays_of(rotation: Array, elevation: float, azimuth: Array) -> Array:
    """Rays (N, 3) of a ring with an elevation at azimuths (N,), rad, turned by (3, 3)."""
    level = np.cos(elevation)
    height = np.full(len(azimuth), np.sin(elevation))
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=1)
    return np.asarray(rays @ rotation.T)


def middle_beam(rotation: Array, elevation: float) -> MiddleBeam | None:
    """Find the beam of a ring in the plane y = 0 that points towards −x.

    Parameters
    ----------
    rotation
        (3, 3) of the LiDAR.
    elevation
        Of the ring, rad.

    Returns
    -------
    MiddleBeam or None
        The flattest where there are two; None where the ring does not reach the axis.
    """
    across = float(np.hypot(rotation[1, 0], rotation[1, 1]))
    wanted = -np.tan(elevation) * rotation[1, 2]
    if abs(wanted) > across:
        return None
    turn = np.arctan2(rotation[1, 1], rotation[1, 0])
    azimuth = turn + np.arccos(wanted / across) * np.array([-1.0, 1.0])
    rays = rays_of(rotation, elevation, azimuth)
    best = int(np.argmin(rays[:, 0]))
    if rays[best, 0] >= 0:
        return None
    angle = float(azimuth[best])
    sideways = rotation @ np.array([-np.sin(angle), np.cos(angle), 0.0])
    return MiddleBeam(angle, rays[best], np.asarray(sideways))


def cast_cone(
    distance: float,
    radius: float,
    rotation: Array,
    elevation: float,
    step: float,
) -> Array:
    """Where the beams of a ring hit the pole, one of them at θ = 0: (N, 3), metres.

    The beams lie on a cone about the LiDAR's axis, with equal steps of azimuth.

    Parameters
    ----------
    distance, radius
        Metres.
    rotation
        (3, 3) of the LiDAR at (distance, 0, 0).
    elevation, step
        Of the ring, and of its azimuth, rad.
    """
    middle = middle_beam(rotation, elevation)
    if middle is None:
        return np.zeros((0, 3))
    azimuth = middle.azimuth + step * _counts(step)
    return _hits(distance, radius, rays_of(rotation, elevation, azimuth))


def cast_plane(distance: float, radius: float, middle: MiddleBeam, step: float) -> Array:
    """Where beams of the plane of eq. 3 hit the pole, one of them at θ = 0: (N, 3), metres.

    The beams lie in the plane of the middle beam and the direction in which it turns, which is the
    tangent plane of the cone, with equal angles (rad) between neighbours.
    """
    angle = step * _counts(step)
    rays = np.outer(np.cos(angle), middle.ray) + np.outer(np.sin(angle), middle.sideways)
    return _hits(distance, radius, rays)


def walk_arc(distance: float, radius: float, middle: MiddleBeam, step: float) -> Array:
    """Walk along the arc from θ = 0 to both of its ends, as in eq. 3 and 4: (N, 3), metres.

    Parameters
    ----------
    distance, radius
        Metres.
    middle
        Its ray and the direction in which it turns span the plane of eq. 3.
    step
        Angle between neighbours as seen by the LiDAR, rad.

    Raises
    ------
    ValueError
        Where the plane is upright, so that the angle θ does not give its points.
    """
    normal = np.cross(middle.ray, middle.sideways)
    if abs(normal[2]) < 1e-9:
        raise ValueError("the plane of the beams is upright: the angle about the pole gives no arc")
    ends = []
    for side in (-1.0, 1.0):
        theta = [0.0]
        while (
            following := next_angle(theta[-1], side, distance, radius, normal, step)
        ) is not None:
            theta.append(following)
        ends.append(theta)
    return arc_point(np.array([*ends[0][:0:-1], *ends[1]]), distance, radius, normal)


def arc_point(theta: Array, distance: float, radius: float, normal: Array) -> Array:
    """Points (N, 3) of the arc at angles (N,) about the pole, in a plane (eq. 3).

    The plane goes through the LiDAR at (distance, 0, 0); ``normal`` (3,) is not level.
    """
    x, y = radius * np.cos(theta), radius * np.sin(theta)
    return np.stack([x, y, -(normal[0] * (x - distance) + normal[1] * y) / normal[2]], axis=1)


def next_angle(
    theta: float, side: float, distance: float, radius: float, normal: Array, step: float
) -> float | None:
    """Solve eq. 4 for the next angle about the pole, with a trust-region (dogleg) method.

    Eq. 5 asks that the LiDAR sees the points at θ and θ + dθ an angle ``step`` apart.

    Parameters
    ----------
    theta
        Angle of the last point, rad.
    side
        1 or −1, the sign of dθ.
    distance, radius, normal
        As in `arc_point`.
    step
        Rad.

    Returns
    -------
    float or None
        None where the arc ends first, at ± arccos(r/x_p).
    """
    from scipy.optimize import root

    tilt = (float(normal[0] / normal[2]), float(normal[1] / normal[2]))

    def seen_at(angle: float) -> tuple[float, float, float]:
        x, y = radius * cos(angle) - distance, radius * sin(angle)
        return x, y, -(tilt[0] * x + tilt[1] * y)

    x, y, z = seen_at(theta)

    def too_wide(angle: Array) -> float:
        # Plain numbers: a thousand small arrays would take longer than all else.
        u, v, w = seen_at(float(angle[0]))
        across = hypot(y * w - z * v, z * u - x * w, x * v - y * u)
        return atan2(across, x * u + y * v + z * w) - step

    end = side * acos(radius / distance)
    if too_wide(np.array([end])) < 0:
        return None
    # Seen from the LiDAR, equal steps of θ become narrower towards the end of the arc: a step of
    # Newton's falls short of the solution and never passes the end.
    square = distance**2 + radius**2 - 2 * distance * radius * cos(theta)
    rate = radius * (distance * cos(theta) - radius) / square
    start = theta + side * min(step / rate, 0.5 * abs(end - theta))
    found = root(too_wide, start, method="hybr", options={"xtol": SOLVER_TOLERANCE})
    angle = float(found.x[0])
    if abs(too_wide(np.array([angle]))) > SOLVER_TOLERANCE or not side * (angle - theta) > 0:
        raise ArithmeticError(f"eq. 4 has no solution near θ = {theta:.6f} rad: {found.message}")
    return angle


def _counts(step: float) -> Array:
    """Whole numbers of steps that cover half a turn."""
    most = int(0.5 * np.pi / step)
    return np.arange(-most, most + 1).astype(float)


def _hits(distance: float, radius: float, rays: Array) -> Array:
    """Points (N, 3) at which rays from (distance, 0, 0) hit the pole, in their order along y."""
    pole = Cylinder(np.zeros(3), np.array([0.0, 0.0, 1.0]), radius, ENDLESS_POLE, Material())
    sensor = np.array([distance, 0.0, 0.0])
    ranges = cast(sensor, rays, [pole]).ranges
    hit = np.isfinite(ranges)
    points = sensor + ranges[hit, None] * rays[hit]
    return np.asarray(points[np.argsort(points[:, 1])])
