"""Planes and boxes whose every side is known."""

from collections.abc import Sequence

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from studies.planes.extraction import Plane


def square(normal: Array, centre: Array, rng: np.random.Generator, count: int = 200) -> Plane:
    """Make a plane of 4 m by 4 m that faces the origin."""
    n = np.asarray(normal, float) / np.linalg.norm(normal)
    along = np.linalg.svd(n[None])[2][1:]
    xyz = centre + rng.uniform(-2, 2, (count, 2)) @ along
    offset = -float(n @ centre)
    return Plane(n, offset, xyz, count) if offset > 0 else Plane(-n, -offset, xyz, count)


def walls() -> list[Plane]:
    """Make four planes of which every three are independent and no two triples alike."""
    rng = np.random.default_rng(0)
    normals = [[0, 0, 1.0], [1, 0.1, 0], [0.3, 1, 0.1], [0.7, -0.8, 0.8]]
    centres = [[0, 0, -1.5], [-6, 0, 0], [0, -4, 0.5], [-5, 6, -4.0]]
    return [square(n, c, rng) for n, c in zip(np.array(normals), np.array(centres), strict=True)]


def transformed(planes: Sequence[Plane], T: Array) -> list[Plane]:
    """Express planes in another frame, by a rigid transform or a reflection (4, 4)."""
    R, t = T[:3, :3], T[:3, 3]
    return [
        Plane(R @ p.normal, p.offset - float(R @ p.normal @ t), se3.apply(T, p.xyz), p.support)
        for p in planes
    ]


def box(rng: np.random.Generator, sides: tuple[float, float, float], faces: str) -> PointCloud:
    """Scan faces of a box from its middle: x and y for a pair of walls, z for floor and ceiling."""
    half = np.array(sides) / 2
    parts = []
    for axis in ("xyz".index(face) for face in faces):
        for side in (-1, 1):
            xyz = rng.uniform(-1, 1, (6000, 3)) * half
            xyz[:, axis] = side * half[axis]
            parts.append(xyz)
    xyz = np.concatenate(parts)
    return PointCloud(xyz + rng.normal(0, 0.005, xyz.shape))


ROOM = 8.0, 5.0, 3.0
"""Sides of a box, metres."""


def assert_close(T: Array, T_true: Array, degrees: float, metres: float) -> None:
    """Check that a pose lies near the truth."""
    error = se3.difference(T, T_true)
    assert np.degrees(error.rotation) < degrees
    assert error.translation < metres
