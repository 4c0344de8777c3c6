"""A room to scan, from its middle, and how far its points are from where they should be."""

from __future__ import annotations

import numpy as np

from retropole.base.datatypes import Array
from retropole.base.sensors import find_sensor
from retropole.simulation import (
    Device,
    LabelledScan,
    Material,
    NoiseModel,
    Rectangle,
    Surface,
    scan,
)

X, Y, Z = np.eye(3)
HALF = 8.0
"""Distance of the four walls from the sensor, metres."""


def walls(material: Material | None = None) -> list[Surface]:
    """Four walls around the origin."""
    material = Material(0.5) if material is None else material
    return [
        Rectangle(HALF * sign * along, across, Z, (HALF, HALF), material)
        for sign in (-1, 1)
        for along, across in ((X, Y), (Y, X))
    ]


def scan_room(
    noise: NoiseModel,
    surfaces: list[Surface] | None = None,
    *,
    sensor: str = "VLP-16",
    seed: int = 3,
    device: Device | None = None,
) -> LabelledScan:
    """Scan walls, or other surfaces, from the origin; one seed sends the same beams."""
    rng = np.random.default_rng(seed)
    surfaces = walls() if surfaces is None else surfaces
    return scan(surfaces, find_sensor(sensor), np.eye(4), rng, noise, device=device)


def ranges_and_rays(xyz: Array) -> tuple[Array, Array]:
    """Range (N,) and unit direction (N, 3) of points (N, 3)."""
    ranges = np.linalg.norm(xyz, axis=1)
    return ranges, xyz / ranges[:, None]
