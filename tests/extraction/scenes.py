"""Poles, and bright things that are not poles, as a LiDAR at the origin sees them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from retropole.base.datatypes import Array, Detection, IntArray, PointCloud
from retropole.base.sensors import find_sensor
from retropole.simulation import Box, Cylinder, Material, Rectangle, Surface, scan

TAPE, PAINT = Material(0.9, retro=True), Material(0.5)
X, Y, Z = np.eye(3)
GROUND = Rectangle(np.array([0, 0, -1.2]), X, Y, (30, 30), Material(0.2))


def pole(
    foot: tuple[float, float], lean: Array | None = None, radius: float = 0.02, length: float = 2.0
) -> Cylinder:
    axis = Z + (np.zeros(3) if lean is None else lean)
    axis = axis / np.linalg.norm(axis)
    return Cylinder(np.array([*foot, -1.15]) + axis * length / 2, axis, radius, length, TAPE)


def seen(
    surfaces: list[Surface], sensor: str = "XT32", seed: int = 0, frames: int = 1
) -> tuple[PointCloud, IntArray]:
    """Scan a few surfaces from the origin; give the cloud, and the surface of each point."""
    rng = np.random.default_rng(seed)
    scanned = scan([GROUND, *surfaces], find_sensor(sensor), np.eye(4), rng, frames=frames)
    return scanned.cloud, scanned.labels - 1


def labels_of(detection: Detection, labels: IntArray) -> list[int]:
    """Surface that most points of each detected pole lie on."""
    return [int(np.bincount(labels[pole.index] + 1).argmax()) - 1 for pole in detection.poles]


def without_rings(cloud: PointCloud) -> PointCloud:
    return replace(cloud, ring=None)


def across(yaw: float) -> Array:
    return np.array([np.cos(yaw), np.sin(yaw), 0.0])


NO_POLES: dict[str, list[Surface]] = {
    "sign": [
        Cylinder(np.array([6, 0, 0]), Z, 0.03, 2.4, PAINT),
        Rectangle(np.array([5.9, 0, 0.8]), Y, Z, (0.3, 0.3), TAPE),
    ],
    "sign seen obliquely": [Rectangle(np.array([5, 0, 0]), across(0.4), Z, (0.35, 0.35), TAPE)],
    "stripe on a wall": [
        Rectangle(np.array([5, 0, 0]), Y, Z, (4, 2), PAINT),
        Rectangle(np.array([4.99, 0, 0]), Y, Z, (0.025, 0.9), TAPE),
    ],
    "marked corner of a box": [
        Box(np.array([5, 0, 0]), np.stack([across(0.8), across(0.8 + np.pi / 2), Z], 1),
            np.array([0.7, 0.7, 1.2]), PAINT),
        Box(np.array([5 - 0.99, 0, 0]), np.eye(3), np.array([0.03, 0.03, 0.9]), TAPE),
    ],
    "lane mark": [Rectangle(np.array([5, 0.5, -1.19]), X, Y, (1.5, 0.07), TAPE)],
    "number plate": [
        Box(np.array([6, 0, -0.6]), np.eye(3), np.array([2.0, 0.9, 0.5]), PAINT),
        Rectangle(np.array([3.98, 0, -0.6]), Y, Z, (0.26, 0.055), TAPE),
    ],
    "lamps": [
        Box(np.array([6, 0, -0.6]), np.eye(3), np.array([2.0, 0.9, 0.5]), PAINT),
        *(Rectangle(np.array([3.98, y, -0.5]), Y, Z, (0.1, 0.2), TAPE) for y in (-0.8, 0.8)),
    ],
    "cone": [
        Cylinder(np.array([4, 0, -0.85]), Z, 0.1, 0.7, PAINT),
        Cylinder(np.array([4, 0, -0.8]), Z, 0.11, 0.15, TAPE),
    ],
    "vest": [
        Box(np.array([4, 0, -0.35]), np.eye(3), np.array([0.12, 0.22, 0.85]), PAINT),
        *(
            Box(np.array([4, 0, z]), np.eye(3), np.array([0.14, 0.24, 0.025]), TAPE)
            for z in (-0.15, 0.1)
        ),
    ],
    "bright ground": [Rectangle(np.array([4, 0, -1.19]), X, Y, (2.5, 2.5), TAPE)],
    "thick bare post": [Cylinder(np.array([5, 0, 0]), Z, 0.3, 2.4, TAPE)],
}  # fmt: skip
