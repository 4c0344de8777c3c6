"""One pole that both LiDARs see, or seem to, and a place that may say the wrong thing of the rest.

For `deception_scenes`; every function draws as those of `deception_poles` do.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from deception_poles import Drawn, anywhere, carry
from deception_sites import Site, about_vertical, foot_of, on_foot
from retropole.base.datatypes import Array
from retropole.simulation import Box, Cylinder, Surface
from retropole.simulation.scenes import METAL, SURROUNDINGS, UP, Surroundings

POSTS_APART, POSTS, ROWS = 3.0, 15, (-4.5, 4.5)
"""Equal posts stand so far apart in a row, metres, so many, in two rows at these distances."""


def upright_in_the_middle(rng: np.random.Generator, clear: tuple[float, float]) -> list[Cylinder]:
    """One upright pole in the middle of the place: a half turn about it may change nothing."""
    return [on_foot(np.zeros(2), UP, float(rng.uniform(1.5, 2.0)))]


def another_pole(site: Site, rng: np.random.Generator) -> Drawn | None:
    """The source sees another pole, set up elsewhere when the first was gone."""
    drawn = carry(site, anywhere(site, rng))
    if drawn is None:
        return None
    (pole,) = drawn.shots[0][1].poles
    foot, bearing = foot_of(pole), rng.uniform(0, 2 * np.pi)
    lean = float(rng.uniform(0, 0.35))
    axis = np.r_[np.sin(lean) * np.array([np.cos(bearing), np.sin(bearing)]), np.cos(lean)]
    other = on_foot(foot, axis, float(rng.uniform(1.5, 2.0)))
    return replace(drawn, shots=((site.shot(0), replace(site.shot(1), poles=[other])),))


def turned_about_foot(site: Site, rng: np.random.Generator) -> Drawn | None:
    """The pole leans another way when the source records."""
    angle = float(np.radians(rng.uniform(20, 340)))
    return carry(site, about_vertical(angle, foot_of(site.poles[0]), np.zeros(2)))


def two_rows_of_posts(scene: str, rng: np.random.Generator) -> Surroundings:
    """A place whose only tall things are equal posts, equally far apart."""
    place = SURROUNDINGS["bare"](rng)
    along = POSTS_APART * (np.arange(POSTS) - POSTS // 2 + 0.5)
    posts: list[Surface] = [
        Cylinder(np.array([x, y, 0.6]), UP, 0.08, 1.2, METAL) for x in along for y in ROWS
    ]
    return replace(place, surfaces=[*place.surfaces, *posts])


def carried_from_post_to_post(site: Site, rng: np.random.Generator) -> Drawn | None:
    """The pole is carried along the rows by as much as one to three posts are apart."""
    steps = int(rng.integers(1, 4)) * int(rng.choice([-1, 1]))
    return carry(site, about_vertical(0.0, np.zeros(3), np.r_[steps * POSTS_APART, 0.0]))


def container_shoved(site: Site, rng: np.random.Generator) -> Drawn | None:
    """What stands highest near the pole was shoved by 0.3 to 1.5 m between the recordings."""
    half = np.array([3.0, 1.2, 1.3])
    at = np.r_[rng.uniform(-1, 1, 2) * np.array([8.0, 6.0]), half[2]]
    bearing = rng.uniform(0, 2 * np.pi)
    axes = about_vertical(bearing, np.zeros(3), np.zeros(2))[:3, :3]
    far, way = rng.uniform(0.3, 1.5), rng.uniform(0, 2 * np.pi)
    there = at + far * np.array([np.cos(way), np.sin(way), 0.0])
    near: list[Array] = [foot_of(pole) for pole in site.poles]
    near += [pose[:3, 3] for pose in site.poses]
    for spot in (at, there):
        if any(np.all(np.abs((each - spot) @ axes)[:2] < half[:2] + 0.8) for each in near):
            return None
    shots = [
        site.shot(k).with_things(Box(spot, axes, half, METAL)) for k, spot in enumerate((at, there))
    ]
    return Drawn(((shots[0], shots[1]),), (site.truth,))
