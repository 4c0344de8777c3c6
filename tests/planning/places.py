"""A yard that is drawn: two LiDARs, walls on two sides, and a box in the middle."""

from functools import cache

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.sensors import find_sensor
from retropole.planning.place import Area, Station
from retropole.planning.planner import Planned, plan
from retropole.planning.stations import place_drawn_lidars
from retropole.simulation.raycast import Box, Material
from retropole.simulation.scenes import box

CONCRETE = Material(0.4)


def pose(x: float, y: float, z: float, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> Array:
    R = se3.rotation_from_rpy(np.radians([0.0, pitch_deg, yaw_deg]))
    return se3.from_rt(R, np.array([x, y, z]))


BOXES: tuple[Box, ...] = (
    box(np.array([0.0, 8.0, 1.5]), np.array([12.0, 0.2, 1.5]), 0.0, CONCRETE),
    box(np.array([-9.0, 0.0, 1.5]), np.array([0.2, 8.0, 1.5]), 0.0, CONCRETE),
    box(np.array([5.0, 1.0, 0.75]), np.array([0.5, 0.5, 0.75]), 0.3, CONCRETE),
)
POSES = pose(0.0, -1.0, 1.2), pose(0.5, 2.0, 1.6, 120.0)
AREAS = (
    Area(np.array([4.6, -2.4]), np.array([4.9, -2.1])),
    Area(np.array([4.6, -0.2]), np.array([4.9, 0.1])),
    Area(np.array([6.2, -1.4]), np.array([6.5, -1.1])),
)
"""Where poles may stand: so few places that a plan takes no time."""


@cache
def stations(sensor: str = "VLP-16") -> tuple[Station, ...]:
    sensors = [find_sensor(sensor)] * 2
    return tuple(place_drawn_lidars(("front", "rear"), sensors, POSES, BOXES))


@cache
def planned() -> Planned:
    """A plan for two poles."""
    return plan(stations(), allowed=AREAS)
