"""What a site does to a recording: things that move, wet ground, and a mast that sways."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base.datatypes import Array
from .raycast import Box, Cylinder, Rectangle, Surface
from .scenes import BARK, UP

WALK = 0.8, 1.6
"""Least and greatest speed of a person, m/s: walking."""

DRIFT = 0.05, 0.3
"""The same of a plant in the wind, m/s (chosen)."""

DELAY = 1.0, 5.0
"""Least and greatest time between the target's recording and the source's, s (chosen)."""

KEPT_FREE = 1.0
"""Nothing comes closer to a LiDAR than this, metres: it would be all that the LiDAR sees."""

MAX_PATHS = 200
"""Draws of a path before a mover stays away."""

WET_BRIGHTNESS = 0.2
"""Reflectance times cosine of incidence from which a wet ground loses no returns: asphalt at normal
incidence (chosen)."""


@dataclass(frozen=True, eq=False)
class Mover:
    """A surface that moves in a straight line.

    Attributes
    ----------
    surface
        Where it is at time 0.
    velocity
        (3,) m/s.
    """

    surface: Box | Cylinder
    velocity: Array

    def at(self, time: float) -> Surface:
        """Give the surface at a time, s."""
        return replace(self.surface, centre=self.surface.centre + time * self.velocity)


def draw_movers(
    count: int,
    reach: tuple[float, float],
    lidars: Sequence[Array],
    until: float,
    rng: np.random.Generator,
) -> list[Mover]:
    """Draw people who walk and plants that the wind moves.

    Parameters
    ----------
    count
        How many.
    reach
        Half extents in x and y in which they start, metres.
    lidars
        (3,) positions to keep away from, metres.
    until
        Time to which they keep away, s.
    rng
        Source of the draws.
    """
    movers = []
    times = np.arange(0.0, until, 0.2)
    for _ in range(count):
        person = rng.uniform() < 0.5
        for _ in range(MAX_PATHS):
            start = rng.uniform(-1, 1, 2) * reach
            heading, speed = rng.uniform(0, 2 * np.pi), rng.uniform(*(WALK if person else DRIFT))
            velocity = speed * np.array([np.cos(heading), np.sin(heading), 0.0])
            path = start + times[:, None] * velocity[:2]
            if all(np.linalg.norm(path - at[:2], axis=1).min() > KEPT_FREE for at in lidars):
                height, radius = rng.uniform(0.8, 1.9), rng.uniform(0.15, 0.35)
                centre = np.r_[start, height / 2]
                body: Box | Cylinder = Cylinder(centre, UP, radius, height, BARK)
                if person:
                    along, side = velocity / speed, np.cross(UP, velocity / speed)
                    half = np.array([0.12, 0.22, 0.85])
                    body = Box(
                        np.r_[start, half[2]], np.stack([along, side, UP], axis=1), half, BARK
                    )
                movers.append(Mover(body, velocity))
                break
    return movers


def is_ground(surface: Surface, origin: Array) -> bool:
    """Whether a surface is level ground below a LiDAR at an origin (3,)."""
    return (
        isinstance(surface, Rectangle)
        and not surface.material.retro
        and abs(float(np.cross(surface.u, surface.v) @ UP)) > 1 - 1e-9
        and float((origin - surface.centre) @ UP) > 0
    )


def wet_loss(wet: float, reflectance: Array, cosine: Array) -> Array:
    """Chance (N,) that a return from wet ground is lost: the share `wet` where it is dark."""
    return wet * np.clip(1 - reflectance * cosine / WET_BRIGHTNESS, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Sway:
    """Oscillation of a mast about a level axis; over whole periods its mean is the pose itself.

    Attributes
    ----------
    axis
        (3,) unit vector in the world.
    amplitude
        Rad.
    phase
        At time 0, rad.
    frequency
        Hz.
    foot
        (3,) where the axis is, in the world, metres; None where it goes through the LiDAR.
    """

    axis: Array
    amplitude: float
    phase: float
    frequency: float = 1.0
    foot: Array | None = None

    def origin(self, rest: Array, time: float) -> Array:
        """(3,) where the beams of a LiDAR that rests at a point (3,) start at a time, s."""
        if self.foot is None:
            return rest
        return np.asarray(self.foot + self.turn((rest - self.foot)[None], np.array([time]))[0])

    def turn(self, rays: Array, times: Array) -> Array:
        """Turn rays (N, 3) of the world as the mast stands at times (N,), s."""
        phase = 2 * np.pi * self.frequency * times + self.phase
        angle = self.amplitude * np.sin(phase)[:, None]
        along = (rays @ self.axis)[:, None] * self.axis
        return np.asarray(
            along + np.cos(angle) * (rays - along) + np.sin(angle) * np.cross(self.axis, rays)
        )


def draw_sway(amplitude: float, rng: np.random.Generator) -> Sway:
    """Draw the level axis and the phase of a mast's oscillation of an amplitude in rad."""
    heading, phase = rng.uniform(0, 2 * np.pi, 2)
    return Sway(np.array([np.cos(heading), np.sin(heading), 0.0]), amplitude, float(phase))
