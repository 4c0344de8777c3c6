"""Where the LiDARs of a site stand: on posts, at a crane, on a truck, in a ring.

As in `scenes`, the numbers inside the functions describe what is drawn, in metres and radians; they
are chosen by eye, and no law depends on them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from .arrangement import draw_rotation
from .raycast import Box, Cylinder, Rectangle, Surface
from .scenes import ASPHALT, BARK, METAL, PLASTER, UP, box, ground, harbor, post, street

KEPT_FREE = 0.3
"""Least distance of a pole and of a LiDAR from any surface but the ground, metres (chosen)."""


CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
"""Signs of x and y in the four quadrants, in turn."""


@dataclass(frozen=True, eq=False)
class SitePlace:
    """A site without poles.

    Attributes
    ----------
    surroundings
        Everything that stands there, the ground included, in the world frame.
    poses
        (4, 4) pose of each LiDAR in the world frame.
    reach
        Half extents in x and y around the world's origin in which poles stand, metres.
    """

    surroundings: list[Surface]
    poses: list[Array]
    reach: tuple[float, float]


def posts(rng: np.random.Generator, count: int) -> SitePlace:
    """Draw LiDARs on posts along a street, or at the corners and arms of a crossing."""
    heights = rng.uniform(1.8, 3.2, count)
    if rng.uniform() < 0.5:
        step = rng.uniform(4.5, 10.0)
        along = (np.arange(count) - (count - 1) / 2) * step + rng.uniform(-0.7, 0.7, count)
        side = np.where(np.arange(count) % 2, 1.0, -1.0) * rng.uniform(5.3, 5.9, count)
        places = np.stack([along, side], axis=1)
        surroundings = street(rng).surfaces
        reach = (float(np.abs(along).max()), 3.8)
    else:
        number = np.arange(count)
        corner: Array = np.asarray(np.pi / 4 + np.pi / 2 * (number % 4), dtype=np.float64)
        places = rng.uniform(5.0, 6.5, count)[:, None] * np.sqrt(2) * _level(corner)
        # Those that find no free corner stand farther out on an arm.
        outward = _level(np.asarray(corner + np.where(number // 4 % 2, np.pi / 4, -np.pi / 4)))
        places += (number // 4)[:, None] * rng.uniform(5.0, 7.0) * outward
        surroundings = _crossing(rng)
        reach = (5.0, 5.0) if count <= 4 else (9.0, 9.0)
    return SitePlace(
        surroundings,
        [_pose(rng, np.r_[at, z]) for at, z in zip(places, heights, strict=True)],
        reach,
    )


def _level(headings: Array) -> Array:
    """Unit vectors (N, 2) of headings (N,)."""
    return np.stack([np.cos(headings), np.sin(headings)], axis=1)


def _crossing(rng: np.random.Generator) -> list[Surface]:
    """Draw two streets that cross: a house at each corner, trunks, parked cars as boxes."""
    surfaces: list[Surface] = [ground(ASPHALT)]
    for sign in CORNERS:
        half = rng.uniform(4, 9, 2)
        height = rng.uniform(4, 12)
        at = sign * (rng.uniform(8.5, 11, 2) + half)
        size = np.r_[half, height / 2]
        surfaces.append(box(np.r_[at, height / 2], size, 0.05 * rng.normal(), PLASTER))
    for _ in range(rng.integers(3, 7)):
        out, side = rng.uniform(12, 30), rng.choice([-1, 1]) * rng.uniform(4.6, 6.5)
        tall, radius = rng.uniform(3, 8), rng.uniform(0.08, 0.3)
        at = np.array([out * rng.choice([-1, 1]), side])[:: rng.choice([-1, 1])]
        surfaces.append(post(at, tall, radius, BARK))
    for _ in range(rng.integers(2, 6)):
        out, side = rng.choice([-1, 1]) * rng.uniform(12, 30), rng.choice([-1, 1]) * 4.2
        turned = rng.uniform() < 0.5
        at, yaw = (np.array([side, out]), np.pi / 2) if turned else (np.array([out, side]), 0.0)
        half = np.array([2.2, 0.9, 0.6])
        surfaces.append(box(np.r_[at, 0.75], half, yaw + 0.05 * rng.normal(), METAL))
    return surfaces


def crane(rng: np.random.Generator, count: int) -> SitePlace:
    """Draw LiDARs at the legs and under the portal of a harbour crane."""
    half = np.array([rng.uniform(4.0, 6.5), rng.uniform(4.0, 6.0)])
    surroundings = list(harbor(rng).surfaces[:-2])
    corners = CORNERS * half
    size = rng.uniform(0.35, 0.6)
    surroundings += [
        Box(np.r_[corner, 5.0], np.eye(3), np.array([size, size, 5.0]), METAL) for corner in corners
    ]
    for side in (-1, 1):
        beam = np.array([0.0, side * half[1], 9.0])
        surroundings.append(Box(beam, np.eye(3), np.array([half[0], 0.5, 0.6]), METAL))
    poses = []
    for k in range(count):
        corner, level = corners[k % 4], k // 4
        if level == 2:
            # Under a beam of the portal, looking down at the quay.
            at = np.array([rng.uniform(-0.6, 0.6) * half[0], np.sign(corner[1]) * half[1], 5.5])
            poses.append(_pose(rng, at, -at[:2], np.radians(35.0)))
            continue
        # At a face of the leg: along x or y, inwards or outwards.
        axis, sign = (k + level) % 2, rng.choice([-1.0, 1.0])
        off = np.zeros(2)
        off[axis] = sign * (size + KEPT_FREE + 0.1)
        at = np.r_[corner + off, rng.uniform(1.2, 2.6)]
        poses.append(_pose(rng, at, off, np.radians(rng.uniform(0.0, 8.0))))
    return SitePlace(surroundings, poses, (float(half[0]) + 3.0, float(half[1]) + 3.0))


def truck(rng: np.random.Generator, count: int) -> SitePlace:
    """Draw LiDARs on the corners and sides of one vehicle in a yard."""
    half = np.array([rng.uniform(3.0, 5.0), 1.25])
    height = rng.uniform(2.6, 3.6)
    surroundings = [
        surface
        for surface in harbor(rng).surfaces
        if isinstance(surface, Rectangle) or np.abs(surface.centre[:2]).max() > 8.0
    ]
    body = np.r_[half, (height - 0.6) / 2]
    surroundings.append(Box(np.array([0, 0, 0.6 + body[2]]), np.eye(3), body, METAL))
    around = [(1, 1), (-1, -1), (1, -1), (-1, 1), (0, 1), (0, -1), (1, 0), (-1, 0)]
    poses = []
    for k in range(count):
        side = np.array(around[k % 8], dtype=float)
        at = side * (half + KEPT_FREE + 0.05) + rng.uniform(-0.1, 0.1, 2) * (side == 0)
        low = (k // 8 + k) % 2 == 0
        z = rng.uniform(0.7, 1.2) if low else rng.uniform(1.6, height - 0.2)
        poses.append(_pose(rng, np.r_[at, z], side, np.radians(rng.uniform(0.0, 6.0))))
    return SitePlace(surroundings, poses, (float(half[0]) + 4.5, float(half[1]) + 4.5))


def ring(rng: np.random.Generator, count: int) -> SitePlace:
    """Draw LiDARs in a ring on bare ground, where neighbours stand some 7 m apart."""
    edge = rng.uniform(6.0, 8.0)
    start = rng.uniform(0, 2 * np.pi)
    headings: Array = np.asarray(start + 2 * np.pi * np.arange(count) / count)
    radius = edge / (2 * np.sin(np.pi / count)) + rng.uniform(-0.6, 0.6, count)
    places = radius[:, None] * _level(headings)
    poses = [_pose(rng, np.r_[at, rng.uniform(1.0, 2.0)]) for at in places]
    return SitePlace([ground(ASPHALT)], poses, (float(radius.max()), float(radius.max())))


PLACES: dict[str, Callable[[np.random.Generator, int], SitePlace]] = {
    draw.__name__: draw for draw in (posts, crane, truck, ring)
}
"""Kinds of sites by name: each takes a generator and the number of LiDARs."""


def _pose(
    rng: np.random.Generator, at: Array, toward: Array | None = None, down: float = 0.0
) -> Array:
    """Draw a pose (4, 4) at a place (3,): any heading, or tilted down by `down` rad toward (2,)."""
    R = draw_rotation(rng)
    if toward is not None:
        level = np.r_[toward, 0.0] / np.linalg.norm(toward)
        R = se3.exp_so3(-down * np.cross(level, UP)) @ R
    return se3.from_rt(R, at)


def stands_free(pole: Cylinder, surroundings: list[Surface]) -> bool:
    """Whether a pole keeps `KEPT_FREE` from everything but level ground and walls."""
    steps = np.linspace(-0.5, 0.5, 6) * pole.length
    points = pole.centre + steps[:, None] * pole.axis
    return not any(_near(points, surface).any() for surface in surroundings)


def is_free(at: Array, surroundings: list[Surface]) -> bool:
    """Whether a LiDAR at a place (3,) keeps `KEPT_FREE` from everything but walls."""
    return not any(_near(at[None], surface).any() for surface in surroundings)


def _near(points: Array, surface: Surface) -> Array:
    """Which points (N, 3) are within `KEPT_FREE` of a box or a cylinder."""
    rel = points - surface.centre
    if isinstance(surface, Box):
        return np.asarray(np.all(np.abs(rel @ surface.axes) < surface.half_sides + KEPT_FREE, 1))
    if isinstance(surface, Cylinder):
        along = rel @ surface.axis
        across = np.linalg.norm(rel - along[:, None] * surface.axis, axis=1)
        near = np.abs(along) < surface.length / 2 + KEPT_FREE
        return np.asarray(near & (across < surface.radius + KEPT_FREE))
    return np.zeros(len(points), dtype=bool)
