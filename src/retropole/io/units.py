"""Units that the coordinates of a file may have; inside, all are metres."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from ..base.datatypes import PointCloud
from ..base.errors import UsageError

Unit = Literal["m", "cm", "mm", "ft", "in"]

METRES: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
"""Length of each unit, metres; the foot is the international one, 2 ppm from that of US surveys."""

SMALL: tuple[Unit, ...] = ("cm", "mm", "in")
"""Units in which ranges are so large that they cannot be metres; feet can."""

NAMES: dict[Unit, str] = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
NAMES |= {"ft": "feet", "in": "inches"}


def unit_named(name: str) -> Unit:
    """Take the name of a unit.

    Raises
    ------
    UsageError
        For any other than ``m``, ``cm``, ``mm``, ``ft`` and ``in``.
    """
    if name not in METRES:
        raise UsageError(f"unit is {name!r}, expected {', '.join(METRES)}")
    return name


def in_metres(cloud: PointCloud, unit: Unit) -> PointCloud:
    """Bring a cloud whose coordinates and origin are in a unit to metres."""
    if unit == "m":
        return cloud
    return replace(cloud, xyz=cloud.xyz * METRES[unit], origin=cloud.origin * METRES[unit])
