"""Scenes to calibrate in: their surfaces, and the arrangement of poles and LiDARs.

The numbers inside the functions describe what is drawn, in metres and radians: sizes of things and
where they are. They are chosen by eye after real corridors, streets and quays, and no law
depends on them. Limits of the arrangement of poles and LiDARs are those of what people do. The last
part is the set-up of Xue et al. 2019, Sec. IV-A: two LiDARs and two poles in empty space.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..base import se3
from ..base.datatypes import Array
from .devices import EXACT
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
        All objects, the ground included.
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
    """Give flat ground only."""
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
    """Trunks, a parked car and a sign next to a road."""
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


HALF_TURN = np.diag([-1.0, -1.0, 1.0])
"""Rotation by 180° about the vertical."""

MAX_POLE_DRAWS = 200
"""Draws of axes, and of feet, before `draw_poles` gives up a place."""

MAX_LEAN = float(np.radians(35.0))
"""Of a pole from the vertical, rad (chosen)."""

POLE_SPACING = 1.2, 6.0
"""Least and greatest distance between the feet of two poles, metres (chosen)."""

MAX_POLE_X = 3.0
"""Poles are within this distance of the middle along x, metres, in a long scene too."""

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
"""Share of the LiDARs that are mounted upside down (chosen)."""


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
        Half extents of the ground below them, metres.
    angles
        Least and greatest angle between any two poles, rad.
    radius
        Metres.

    Returns
    -------
    list of Cylinder or None
        None if `MAX_POLE_DRAWS` draws give no such poles.
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
    """Draw a pose (4, 4) within `POLE_DISTANCES` of every pole; None if this draw has none."""
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


PAPER_RADIUS = 0.02
"""Of the paper's poles, metres."""

PAPER_NOISE = replace(EXACT, isotropic_noise=0.006)
"""Zero-mean Gaussian noise with σ = 6 mm in each coordinate, and no other error."""

PAPER_POLE_LENGTH = 6.0
"""Centred on z = 0, metres. The paper states none. With poles of 2 m, which a person can carry, its
estimator ends with the error that was measured at its set-up; with 6 m the error is a tenth
smaller, with 1 m half as large again (`python -m studies.paper`)."""

PAPER_CLEAR = 4.0, 4.0
"""Half extents in x and y in which things move, if any does, metres (the paper has none)."""

PAPER_LIDARS = (
    (np.array([0.094, 0.079, 0.094, 0.988]), np.array([1.0, -1.0, 0.0])),
    (np.array([-0.079, -0.094, -0.079, 0.989]), np.array([1.0, 1.0, 0.0])),
)
"""Quaternions x y z w (normalised where they are used) and positions."""


def paper_lidar_poses() -> tuple[Array, Array]:
    """Poses (4, 4) of the target and the source LiDAR in the world frame."""
    target, source = (se3.from_quaternion_xyzw(q, t) for q, t in PAPER_LIDARS)
    return target, source


def draw_paper_poles(rng: np.random.Generator, radius: float = PAPER_RADIUS) -> list[Cylinder]:
    """Draw the two poles: n_z > 0.9, axis points in z = 0 with 2 ≤ ‖p‖ ≤ 3, distance 1.5 to 4 m.

    The paper also places both points on the y axis, which contradicts these distances. Here they
    are drawn anywhere in z = 0. Both loops repeat until a draw fits: two in five pairs of points
    and one axis in twenty do.
    """
    near, far = 2.0, 3.0
    closest, farthest = 1.5, 4.0
    while True:
        bearing = rng.uniform(0, 2 * np.pi, 2)
        distance = np.sqrt(rng.uniform(near**2, far**2, 2))
        points = np.stack([distance * np.cos(bearing), distance * np.sin(bearing), 0 * bearing], 1)
        if closest <= np.linalg.norm(points[0] - points[1]) <= farthest:
            break
    poles = []
    for point in points:
        axis = np.zeros(3)
        while axis[2] <= 0.9:
            axis = rng.normal(size=3)
            axis /= np.linalg.norm(axis)
        poles.append(Cylinder(point, axis, radius, PAPER_POLE_LENGTH, TAPE))
    return poles
