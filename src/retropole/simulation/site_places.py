"""Positions of LiDARs and poles of a site: on posts, at a crane, on a truck, in a ring.

Poles are arranged placement by placement so that they link all LiDARs. As in `scenes`, the numbers
inside the functions describe what is drawn, in metres and radians; they are chosen by eye, and no
law depends on them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.sparse.csgraph import connected_components

from ..base import se3
from ..base.datatypes import Array
from ..base.sensors import Sensor
from .pairs import MAX_POLE_ANGLE, MIN_POLE_ANGLE, SimulationError, poles_in_view, turned_to
from .raycast import Box, Cylinder, Rectangle, Surface
from .scenes import (
    ASPHALT,
    BARK,
    METAL,
    PLASTER,
    UP,
    box,
    draw_poles,
    draw_rotation,
    ground,
    harbor,
    post,
    street,
    symmetric_poles,
)

KEPT_FREE = 0.3
"""Least distance of a pole and of a LiDAR from any surface but the ground, metres (chosen)."""


CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
"""Signs of x and y in the four quadrants, in turn."""


@dataclass(frozen=True, eq=False)
class SiteScene:
    """A site without poles.

    Attributes
    ----------
    surroundings
        All objects, the ground included, in the world frame.
    poses
        (4, 4) pose of each LiDAR in the world frame.
    reach
        Half extents in x and y around the world's origin of the area of poles, metres.
    """

    surroundings: list[Surface]
    poses: list[Array]
    reach: tuple[float, float]


def posts(rng: np.random.Generator, count: int) -> SiteScene:
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
        # Those that find no free corner are farther out on an arm.
        outward = _level(np.asarray(corner + np.where(number // 4 % 2, np.pi / 4, -np.pi / 4)))
        places += (number // 4)[:, None] * rng.uniform(5.0, 7.0) * outward
        surroundings = _crossing(rng)
        reach = (5.0, 5.0) if count <= 4 else (9.0, 9.0)
    return SiteScene(
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


def crane(rng: np.random.Generator, count: int) -> SiteScene:
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
    return SiteScene(surroundings, poses, (float(half[0]) + 3.0, float(half[1]) + 3.0))


def truck(rng: np.random.Generator, count: int) -> SiteScene:
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
    return SiteScene(surroundings, poses, (float(half[0]) + 4.5, float(half[1]) + 4.5))


def ring(rng: np.random.Generator, count: int) -> SiteScene:
    """Draw LiDARs in a ring on bare ground, at some 7 m from their neighbours."""
    edge = rng.uniform(6.0, 8.0)
    start = rng.uniform(0, 2 * np.pi)
    headings: Array = np.asarray(start + 2 * np.pi * np.arange(count) / count)
    radius = edge / (2 * np.sin(np.pi / count)) + rng.uniform(-0.6, 0.6, count)
    places = radius[:, None] * _level(headings)
    poses = [_pose(rng, np.r_[at, rng.uniform(1.0, 2.0)]) for at in places]
    return SiteScene([ground(ASPHALT)], poses, (float(radius.max()), float(radius.max())))


PLACES: dict[str, Callable[[np.random.Generator, int], SiteScene]] = {
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


def is_clear(pole: Cylinder, surroundings: list[Surface]) -> bool:
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


Seen = tuple[tuple[tuple[bool, ...], ...], ...]
"""``seen[placement][lidar][pole]``."""


def groups_of(seen: Sequence[Sequence[Sequence[bool]]], lidars: int) -> list[tuple[int, ...]]:
    """LiDARs that are linked with each other, directly or through others."""
    linked = np.zeros((lidars, lidars), dtype=bool)
    for placement in np.array(seen, dtype=np.int64) if len(seen) else ():
        # Fewer shared poles than two determine no pose.
        linked |= placement @ placement.T >= 2
    count, group = connected_components(linked, directed=False)
    return [tuple(np.flatnonzero(group == k).tolist()) for k in range(count)]


def are_linked(seen: Sequence[Sequence[Sequence[bool]]], lidars: int) -> bool:
    """Whether all LiDARs are in one group."""
    return len(groups_of(seen, lidars)) == 1


NEAREST = 2.0
"""No pole is nearer to a LiDAR, metres: it would see a piece that is too short for a line."""

FARTHEST = 12.0
"""Poles further from a LiDAR link it to no other, metres: tape is wrapped and poles are set up
where their returns are many (docs/poles.md has 2 to 8 m)."""

MAX_DRAWS = 100
"""Draws of a place before a `SimulationError`."""

MAX_SPOTS = 15
"""Draws of the positions of one placement's poles before the site is drawn anew."""

MIN_GAP = 1.0
"""By how much a ring fails to close, metres, where pairs take the other hypothesis."""


@dataclass(frozen=True, eq=False)
class Arrangement:
    """A place, the poles of each placement, who sees them, and who records."""

    place: SiteScene
    poles: list[tuple[Cylinder, ...]]
    seen: Seen
    recorded: list[tuple[int, ...]]


def arrange(
    kind: str,
    rng: np.random.Generator,
    sensors: tuple[Sensor, ...],
    placements: int,
    poles: int,
    radius: float,
) -> Arrangement:
    """Draw places until poles link all LiDARs."""
    for _ in range(MAX_DRAWS):
        place = PLACES[kind](rng, len(sensors))
        middle = np.mean([pose[:3, 3] for pose in place.poses], axis=0)
        # Those around a truck look away from it, all others toward their middle.
        outward = kind == "truck"
        poses = [
            turned_to(pose, sensor, 2 * pose[:3, 3] - middle if outward else middle, 0.0)
            for pose, sensor in zip(place.poses, sensors, strict=True)
        ]
        place = replace(place, poses=poses)
        if not all(is_free(pose[:3, 3], place.surroundings) for pose in place.poses):
            continue
        found = (
            _place_ring(place, rng, sensors, radius)
            if kind == "ring"
            else _place_poles(place, rng, sensors, placements, poles, radius)
        )
        if found is not None:
            return found
    raise SimulationError(
        f"{MAX_DRAWS} draws of {kind!r} gave no site in which {placements} placements of {poles} "
        f"poles link {len(sensors)} LiDARs: give more placements, or sensors with more rings"
    )


def _view(
    place: SiteScene,
    standing: Sequence[Cylinder],
    sensors: Sequence[Sensor],
    rng: np.random.Generator,
    who: Sequence[int],
) -> tuple[tuple[bool, ...], ...]:
    """Which LiDAR sees which pole from near; those that do not record see none."""
    none = (False,) * len(standing)
    found = []
    for k, (sensor, pose) in enumerate(zip(sensors, place.poses, strict=True)):
        near = [bool(np.linalg.norm(one.centre - pose[:3, 3]) < FARTHEST) for one in standing]
        if k not in who or not any(near):
            found.append(none)
            continue
        # Half as many returns again as a line needs, as noise takes some.
        seen_patches = poles_in_view(place.surroundings, standing, sensor, pose, rng.spawn(1)[0], 9)
        found.append(tuple(a and b for a, b in zip(seen_patches, near, strict=True)))
    return tuple(found)


def _place_poles(
    place: SiteScene,
    rng: np.random.Generator,
    sensors: tuple[Sensor, ...],
    placements: int,
    poles: int,
    radius: float,
) -> Arrangement | None:
    """Put the poles of each placement where they link LiDARs that are not linked yet."""
    at = np.array([pose[:2, 3] for pose in place.poses])
    everyone = tuple(range(len(sensors)))
    drawn: list[tuple[Cylinder, ...]] = []
    seen: list[tuple[tuple[bool, ...], ...]] = []
    for left in range(placements, 0, -1):
        groups = groups_of(seen, len(sensors))
        # This many groups may remain, that each of the other placements joins an equal share.
        may_remain = 1 + (len(groups) - 1) * (left - 1) // left
        for _ in range(MAX_SPOTS):
            # Around the middle of a LiDAR and the nearest of the other groups.
            one = int(rng.integers(len(at)))
            away = [float(np.linalg.norm(own - at[one])) for own in at]
            others = [min(group, key=away.__getitem__) for group in groups if one not in group]
            others.sort(key=away.__getitem__)
            joined = [one, *others[: max(len(groups) - may_remain, 1)]]
            middle = at[joined].mean(axis=0) + rng.normal(0, 1.5, 2)
            middle = np.clip(middle, -np.array(place.reach), place.reach)
            new = _draw_poles(rng, poles, middle, place, radius)
            if new is None:
                continue
            view = _view(place, new, sensors, rng, everyone)
            if len(groups_of([*seen, view], len(sensors))) <= may_remain:
                drawn.append(new)
                seen.append(view)
                break
        else:
            return None
    return Arrangement(place, drawn, tuple(seen), [everyone] * placements)


def _draw_poles(
    rng: np.random.Generator, count: int, middle: Array, place: SiteScene, radius: float
) -> tuple[Cylinder, ...] | None:
    """Draw poles around a place (2,); None if this draw has none with enough room."""
    drawn = draw_poles(rng, count, (3.0, 3.0), (MIN_POLE_ANGLE, MAX_POLE_ANGLE), radius)
    if drawn is None:
        return None
    moved = tuple(replace(pole, centre=pole.centre + np.r_[middle, 0.0]) for pole in drawn)
    if _too_near(moved, place) or not all(is_clear(p, place.surroundings) for p in moved):
        return None
    return moved


def _too_near(poles: Sequence[Cylinder], place: SiteScene) -> bool:
    return any(
        np.linalg.norm(pole.centre - pose[:3, 3]) < NEAREST
        for pole in poles
        for pose in place.poses
    )


def _place_ring(
    place: SiteScene, rng: np.random.Generator, sensors: tuple[Sensor, ...], radius: float
) -> Arrangement | None:
    """Put two symmetric poles between each LiDAR and the next; None if the ring is ambiguous."""
    count = len(sensors)
    recorded: list[tuple[int, ...]] = [(k, (k + 1) % count) for k in range(count)]
    at = np.array([pose[:2, 3] for pose in place.poses])
    middles, drawn, seen = [], [], []
    for pair in recorded:
        for _ in range(MAX_SPOTS):
            middle = np.r_[at[list(pair)].mean(axis=0) + rng.uniform(-1.5, 1.5, 2), 0.0]
            new = tuple(
                replace(pole, centre=pole.centre + middle) for pole in symmetric_poles(rng, radius)
            )
            view = _view(place, new, sensors, rng, pair)
            if all(all(view[k]) for k in pair) and not _too_near(new, place):
                break
        else:
            return None
        middles.append(middle[:2])
        drawn.append(new)
        seen.append(view)
    if closes_otherwise(np.array(middles)):
        return None
    return Arrangement(place, drawn, tuple(seen), recorded)


def closes_otherwise(axes: Array) -> bool:
    """Whether half turns about some vertical axes (N, 2), in turn, make no step of `MIN_GAP`.

    An odd number of half turns is one itself; an even number a step of twice the alternating sum.
    """
    for taken in product((False, True), repeat=len(axes)):
        chosen = axes[np.array(taken)]
        if len(chosen) and len(chosen) % 2 == 0:
            step = 2 * (chosen[::2] - chosen[1::2]).sum(axis=0)
            if np.linalg.norm(step) < MIN_GAP:
                return True
    return False
