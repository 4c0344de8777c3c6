"""Section IV-A: move an arbitrary pole and LiDAR to where the LiDAR–pole model has them.

Turn the pole onto the z axis by A = 2aaᵀ − I, shift along it until the LiDAR is level with the
origin (L*), and turn the LiDAR onto the x axis by R = 2bbᵀ − I (L̂). Both are half-turns. A turns
the pole upside down and R turns it back, so that together they keep its direction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array


class PoleFrame(NamedTuple):
    """A LiDAR in the frame of the LiDAR–pole model.

    Attributes
    ----------
    L_star
        (4, 4) pose of the LiDAR once the pole is on the z axis and the LiDAR in the plane z = 0.
    L_hat
        (4, 4) pose of the LiDAR at (x_p, 0, 0).
    T_pole_world
        (4, 4) from the frame in which pole and LiDAR were given to that of `L_hat`.
    """

    L_star: Array
    L_hat: Array
    T_pole_world: Array


def half_turn(axis: Array) -> Array:
    """Rotation (3, 3) by 180° about an axis (3,) of any length but 0: 2aaᵀ − I."""
    a = axis / np.linalg.norm(axis)
    return np.asarray(2.0 * np.outer(a, a) - np.eye(3))


def turn_upright(direction: Array) -> Array:
    """A: the half-turn (3, 3) that maps a direction n (3,) of unit length to −e_z.

    A pole has no direction, so −e_z stands it upright as e_z does. Its axis is
    a = (−n_x, −n_y, 1 − n_z)/‖·‖. At n = e_z that is 0/0, and every level axis does: e_x is taken.
    """
    x, y, z = direction
    if z <= 0:
        return half_turn(np.array([-x, -y, 1.0 - z]))
    level = float(np.hypot(x, y))
    if level == 0.0:
        return half_turn(np.array([1.0, 0.0, 0.0]))
    # 1 − n_z = level²/(1 + n_z) loses all its digits near n = e_z.
    return half_turn(np.array([-x / level, -y / level, level / (1.0 + z)]))


def turn_onto_x(position: Array) -> Array:
    """R: the half-turn (3, 3) that maps a position v (3,) to (‖v‖, 0, 0).

    Its axis is b = (v_x + ‖v‖, v_y, v_z)/‖·‖. Where v is on −x that is 0/0, with the limit e_y
    for all v in the plane z = 0.

    Raises
    ------
    ValueError
        Where v is 0: the LiDAR is on the pole's axis.
    """
    length = float(np.linalg.norm(position))
    if length == 0.0:
        raise ValueError("the LiDAR is on the axis of the pole: it has no direction from it")
    x, y, z = position / length
    if x >= 0:
        return half_turn(np.array([x + 1.0, y, z]))
    across = float(np.hypot(y, z))
    if across == 0.0:
        return half_turn(np.array([0.0, 1.0, 0.0]))
    # v_x + ‖v‖, here x + 1 = across²/(1 − x), loses all its digits near −x.
    return half_turn(np.array([across / (1.0 - x), y / across, z / across]))


def in_pole_frame(T_world_lidar: Array, point: Array, direction: Array) -> PoleFrame:
    """Move a pole onto the z axis and a LiDAR onto the x axis.

    Parameters
    ----------
    T_world_lidar
        (4, 4) pose of the LiDAR.
    point, direction
        (3,) a point of the pole's axis, metres, and the axis's direction, of unit length.

    Raises
    ------
    ValueError
        Where the LiDAR is on the axis.
    """
    upright = turn_upright(direction)
    moved = se3.from_rt(upright, -upright @ point)
    level = moved @ T_world_lidar
    down = np.eye(4)
    down[2, 3] = -level[2, 3]
    L_star = down @ level
    L_star[2, 3] = 0.0
    onto_x = se3.from_rt(turn_onto_x(L_star[:3, 3]), np.zeros(3))
    return PoleFrame(L_star, onto_x @ L_star, onto_x @ down @ moved)
