"""Places to calibrate in: their surfaces, without poles and LiDARs.

The numbers inside the functions describe what is drawn, in metres and radians: sizes of things and
where they stand. They are chosen by eye after real corridors, streets and quays, and no law
depends on them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..base.datatypes import Array
from .raycast import Box, Cylinder, Material, Rectangle, Surface

TAPE = Material(0.9, retro=True)
PLASTER, ASPHALT, METAL, BARK = Material(0.7), Material(0.2), Material(0.5), Material(0.3)
X, Y, UP = np.eye(3)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A place without poles.

    Attributes
    ----------
    surfaces
        Everything that stands there, the ground included.
    clear
        (2,) half extents in x and y, metres, of the middle that is kept clear for poles and LiDARs.
    """

    surfaces: list[Surface]
    clear: tuple[float, float]


def ground(material: Material) -> Rectangle:
    """Level ground, far on all sides."""
    return Rectangle(np.zeros(3), X, Y, (120, 120), material)


def _wall(centre: Array, along: Array, half: tuple[float, float], material: Material) -> Rectangle:
    return Rectangle(np.asarray(centre), np.asarray(along), UP, half, material)


def box(centre: Array, half: Array, yaw: float, material: Material) -> Box:
    """A box turned about the vertical, by a yaw in rad."""
    axes = Rotation.from_euler("z", yaw).as_matrix()
    return Box(np.asarray(centre), axes, np.asarray(half), material)


def post(at: Array, height: float, radius: float, material: Material) -> Cylinder:
    """An upright cylinder on the ground at a place (2,)."""
    return Cylinder(np.array([at[0], at[1], height / 2]), UP, radius, height, material)


def _sign(at: Array, yaw: float) -> list[Surface]:
    """A retro-reflective plate on a bare post."""
    along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    plate = np.array([at[0], at[1], 2.2]) + 0.06 * np.cross(along, UP)
    return [post(at, 2.5, 0.03, METAL), _wall(plate, along, (0.3, 0.3), TAPE)]


def _vest(at: Array, yaw: float) -> list[Surface]:
    """A person with two retro-reflective bands around the body."""
    bands = [
        box(np.array([at[0], at[1], z]), np.array([0.24, 0.14, 0.025]), yaw, TAPE)
        for z in (1.05, 1.3)
    ]
    return [box(np.array([at[0], at[1], 0.85]), np.array([0.22, 0.12, 0.85]), yaw, BARK), *bands]


def _cone(at: Array) -> list[Surface]:
    """A traffic cone: a slim body with one retro-reflective band."""
    band = Cylinder(np.array([at[0], at[1], 0.4]), UP, 0.11, 0.15, TAPE)
    return [post(at, 0.7, 0.1, METAL), band]


def _car(at: Array, yaw: float) -> list[Surface]:
    """A parked car with a number plate at its rear."""
    along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    centre = np.array([at[0], at[1], 0.0])
    return [
        box(centre + 0.55 * UP, np.array([2.2, 0.9, 0.4]), yaw, METAL),
        box(centre + 1.15 * UP - 0.2 * along, np.array([1.2, 0.8, 0.3]), yaw, METAL),
        _wall(centre + 0.5 * UP - 2.21 * along, across, (0.26, 0.055), TAPE),
    ]


def corridor(rng: np.random.Generator) -> Surroundings:
    """Draw a corridor: two walls, two ends, a ceiling, door niches, pillars and boxes."""
    half_width, half_length = rng.uniform(1.6, 2.6), rng.uniform(7, 13)
    height, middle = rng.uniform(2.5, 3.2), rng.uniform(-3, 3)
    surfaces: list[Surface] = [ground(PLASTER)]
    surfaces.append(Rectangle(np.array([0, 0, height]), X, Y, (60, 60), PLASTER))
    for side in (-1, 1):
        wall = np.array([middle, side * half_width, height / 2])
        surfaces.append(_wall(wall, X, (half_length, height / 2), PLASTER))
        end = np.array([middle + side * half_length, 0, height / 2])
        surfaces.append(_wall(end, Y, (half_width, height / 2), PLASTER))
    for _ in range(rng.integers(5, 10)):
        side, at = rng.choice([-1, 1]), middle + rng.uniform(-0.95, 0.95) * half_length
        depth, width, tall = rng.uniform(0.05, 0.3), rng.uniform(0.2, 0.9), rng.uniform(0.4, height)
        centre = np.array([at, side * (half_width - depth), tall / 2])
        surfaces.append(box(centre, np.array([width, depth, tall / 2]), 0.0, METAL))
    return Surroundings(surfaces, (half_length - abs(middle) - 0.5, half_width - 0.75))


def street(rng: np.random.Generator) -> Surroundings:
    """Draw a street: fronts, trunks, parked cars, a sign, a person in a vest and a cone."""
    surfaces: list[Surface] = [ground(ASPHALT)]
    for side in (-1, 1):
        at, front = rng.uniform(-30, -10), side * rng.uniform(8, 12)
        for _ in range(3):
            half, height = rng.uniform(4, 9), rng.uniform(4, 12)
            middle = np.array([at + half, front + side * rng.uniform(0, 2), height / 2])
            surfaces.append(_wall(middle, X, (half, height / 2), PLASTER))
            at += 2 * half + rng.uniform(0.5, 4)
        for _ in range(rng.integers(1, 4)):
            place = np.array([rng.uniform(-25, 25), side * rng.uniform(6.2, 7.2)])
            surfaces.append(post(place, rng.uniform(4, 8), rng.uniform(0.1, 0.3), BARK))
        for _ in range(rng.integers(1, 4)):
            place = np.array([rng.uniform(-25, 25), side * rng.uniform(4.8, 5.2)])
            surfaces += _car(place, rng.choice([0, np.pi]) + rng.normal() * 0.05)
    side = rng.choice([-1, 1])
    surfaces += _sign(np.array([rng.uniform(-15, 15), side * 6.0]), rng.uniform(0, np.pi))
    surfaces += _vest(np.array([rng.uniform(-8, 8), -side * 4.0]), rng.uniform(0, np.pi))
    surfaces += _cone(np.array([rng.uniform(-8, 8), side * 3.7]))
    return Surroundings(surfaces, (6.0, 3.2))


def harbor(rng: np.random.Generator) -> Surroundings:
    """Draw a quay: open ground, containers, bollards, masts and the legs of a crane."""
    surfaces: list[Surface] = [ground(ASPHALT)]
    for _ in range(rng.integers(4, 9)):
        bearing, distance = rng.uniform(0, 2 * np.pi), rng.uniform(14, 45)
        stacked = rng.integers(1, 3)
        centre = np.array(
            [distance * np.cos(bearing), distance * np.sin(bearing), 1.3 * float(stacked)]
        )
        half = np.array([rng.choice([3.0, 6.1]), 1.22, 1.3 * float(stacked)])
        surfaces.append(box(centre, half, rng.choice([0.1, 1.67]) + 0.05 * rng.normal(), METAL))
    for _ in range(rng.integers(3, 7)):
        place = np.array([rng.uniform(-25, 25), rng.choice([-1, 1]) * rng.uniform(7, 9)])
        surfaces.append(post(place, rng.uniform(0.5, 0.9), 0.25, METAL))
    for _ in range(rng.integers(1, 4)):
        place = np.array([rng.uniform(-25, 25), rng.choice([-1, 1]) * rng.uniform(9, 20)])
        surfaces.append(post(place, rng.uniform(6, 12), rng.uniform(0.08, 0.2), METAL))
    leg = np.array([rng.uniform(8, 14), rng.uniform(8, 14)]) * rng.choice([-1, 1], 2)
    for step in (0.0, 8.0):
        surfaces.append(
            box(np.array([leg[0] + step, leg[1], 5]), np.array([0.5, 0.5, 5]), 0, METAL)
        )
    return Surroundings(surfaces, (6.0, 5.0))


def bare(rng: np.random.Generator) -> Surroundings:
    """Give flat ground and nothing else."""
    return Surroundings([ground(ASPHALT)], (6.0, 5.0))


def square(rng: np.random.Generator) -> Surroundings:
    """Draw an open square: little near, and one tall front far away that is seen along itself."""
    surfaces: list[Surface] = [ground(ASPHALT)]
    bearing, aside = rng.uniform(0, 2 * np.pi), rng.choice([-1, 1]) * rng.uniform(3, 9)
    along = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    height, half = rng.uniform(15, 25), rng.uniform(6, 15)
    front = (rng.uniform(55, 75) + half) * along + aside * np.cross(UP, along)
    surfaces.append(_wall(front + 0.5 * height * UP, along, (half, height / 2), PLASTER))
    for _ in range(rng.integers(4, 8)):
        turned, distance = rng.uniform(0, 2 * np.pi), rng.uniform(9, 28)
        place = distance * np.array([np.cos(turned), np.sin(turned)])
        surfaces.append(post(place, rng.uniform(3, 8), rng.uniform(0.1, 0.25), BARK))
    for _ in range(rng.integers(2, 5)):
        turned, distance = rng.uniform(0, 2 * np.pi), rng.uniform(10, 30)
        half_sides = rng.uniform(0.3, 1.2, 3)
        place = np.r_[distance * np.cos(turned), distance * np.sin(turned), half_sides[2]]
        surfaces.append(box(place, half_sides, rng.uniform(0, np.pi), METAL))
    return Surroundings(surfaces, (6.0, 5.0))


def _sloping(side: int, near: Array, far: Array, material: Material) -> Rectangle:
    """A strip along x whose cross-section runs between two points (2,) of distance and height."""
    across = far - near
    width = float(np.linalg.norm(across))
    middle = (near + far) / 2
    return Rectangle(
        np.array([0.0, side * middle[0], middle[1]]),
        X,
        np.array([0.0, side * across[0], across[1]]) / width,
        (120.0, width / 2),
        material,
    )


def _roadside(rng: np.random.Generator, nearest: float) -> list[Surface]:
    """Trunks, a parked car and a sign beside a road."""
    found: list[Surface] = []
    for side in (-1, 1):
        for _ in range(rng.integers(2, 5)):
            place = np.array([rng.uniform(-30, 30), side * (nearest + rng.uniform(0.5, 6))])
            found.append(post(place, rng.uniform(4, 8), rng.uniform(0.1, 0.3), BARK))
    side = rng.choice([-1, 1])
    car = np.array([rng.uniform(-20, 20), side * (nearest + 2.0)])
    found += _car(car, rng.normal() * 0.05)
    return found + _sign(np.array([rng.uniform(-15, 15), -side * nearest]), rng.uniform(0, np.pi))


def camber(rng: np.random.Generator) -> Surroundings:
    """Draw a country road: it falls to both sides, and verges fall on or rise."""
    surfaces: list[Surface] = []
    half, fall = rng.uniform(3.5, 6), rng.uniform(0.02, 0.04)
    edge = np.array([half, -fall * half])
    for side in (-1, 1):
        surfaces.append(_sloping(side, np.zeros(2), edge, ASPHALT))
        verge = edge + 50.0 * np.array([1.0, rng.uniform(-0.06, 0.06)])
        surfaces.append(_sloping(side, edge, verge, BARK))
    return Surroundings([*surfaces, *_roadside(rng, half + 1.0)], (6.0, 3.2))


def kerb(rng: np.random.Generator) -> Surroundings:
    """Draw a road between kerbs, and a front set back from it on one side."""
    half, step = rng.uniform(3.5, 6), rng.uniform(0.08, 0.16)
    surfaces: list[Surface] = []
    for side in (-1, 1):
        foot, top = np.array([half, 0.0]), np.array([half, step])
        surfaces.append(_sloping(side, np.zeros(2), foot, ASPHALT))
        surfaces.append(_sloping(side, foot, top, PLASTER))
        surfaces.append(_sloping(side, top, np.array([60.0, step]), PLASTER))
    front = np.array([rng.uniform(-10, 10), rng.choice([-1, 1]) * rng.uniform(14, 25), 4.0])
    surfaces.append(_wall(front, X, (rng.uniform(5, 15), 4.0), PLASTER))
    return Surroundings([*surfaces, *_roadside(rng, half + 1.0)], (6.0, 3.2))


SURROUNDINGS: dict[str, Callable[[np.random.Generator], Surroundings]] = {
    draw.__name__: draw for draw in (corridor, street, harbor, bare, square, camber, kerb)
}
"""Places by name: each takes a generator."""
