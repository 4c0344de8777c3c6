"""What a LiDAR at a given pose records of a scene, and what the site does to it.

Things move, ground is wet, a mast sways.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array, IntArray, PointCloud
from ..base.sensors import SWEEP_SECONDS, Sensor
from .devices import TYPICAL, Device, NoiseModel, draw_device
from .raycast import Box, Cylinder, Rectangle, Surface, cast
from .returns import Echoes, Materials, intensities, report, with_glow
from .scenes import BARK, UP

PARTS = 20
"""Of a sweep, in which a mast that turns about its foot has its LiDAR at one point each."""

GOLDEN = (np.sqrt(5.0) - 1) / 2
SILVER = np.sqrt(2.0) - 1
"""Steps of a rosette in azimuth and elevation, as parts of the field of view: multiples of two
independent irrational numbers never repeat and cover it evenly."""


@dataclass(frozen=True, eq=False)
class LabelledScan:
    """A simulated cloud whose points are labelled with the surface that they lie on.

    Attributes
    ----------
    cloud
        In the sensor's frame.
    labels
        (N,) index of the surface of each point in the scene; −1 for one that lies on none:
        on something that moves, or next to tape that blooms.
    """

    cloud: PointCloud
    labels: IntArray


class Sweep(NamedTuple):
    """Directions (N, 3), rings (N,) and times (N,), s, of the beams of one sweep, sensor frame."""

    rays: Array
    rings: IntArray
    times: Array


def sweeps(sensor: Sensor, rng: np.random.Generator, count: int) -> Iterator[Sweep]:
    """Send the beams of `count` sweeps, one after the other.

    In each, a sensor whose lines repeat starts at a random azimuth within its step. A rosette
    starts at a random place of a sequence that never repeats and covers its field of view evenly,
    and continues from sweep to sweep.
    """
    if sensor.pattern == "spinning":
        for _ in range(count):
            yield _lines(sensor, rng)
        return
    begun = int(rng.integers(0, 10**6))
    for k in range(count):
        yield _rosette(sensor, begun + k * sensor.points)


def _lines(sensor: Sensor, rng: np.random.Generator) -> Sweep:
    count = round(sensor.turn / sensor.azimuth_step)
    start = rng.uniform(0, sensor.azimuth_step)
    azimuths = sensor.azimuth_span[0] + start + np.arange(count) * (sensor.turn / count)
    elevations: Array = sensor.elevations
    if len(sensor.rise):
        elevations = elevations + sensor.risen(np.asarray(azimuths))[:, None]
    up, level = np.sin(elevations), np.cos(elevations)
    x, y = np.cos(azimuths)[:, None] * level, np.sin(azimuths)[:, None] * level
    rays = np.stack(np.broadcast_arrays(x, y, up), axis=-1).reshape(-1, 3)
    ring = np.tile(np.arange(len(sensor.elevations)), count)
    time = np.repeat(np.arange(count) * (SWEEP_SECONDS / count), len(sensor.elevations))
    return Sweep(rays, ring.astype(np.int64), time)


def _rosette(sensor: Sensor, begun: int) -> Sweep:
    number = begun + np.arange(sensor.points)
    across, along = (number * GOLDEN) % 1.0, (number * SILVER) % 1.0
    first, (lowest, highest) = sensor.azimuth_span[0], sensor.elevation_span
    if sensor.is_round:
        out, around = np.sqrt(along), 2 * np.pi * across
        azimuth = first + sensor.turn * (1 + out * np.cos(around)) / 2
        up = np.sin(lowest + (highest - lowest) * (1 + out * np.sin(around)) / 2)
    else:
        low, high = np.sin(lowest), np.sin(highest)
        azimuth = first + sensor.turn * across
        up = low + (high - low) * along
    level = np.sqrt(1 - up**2)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=1)
    time = np.arange(sensor.points) * (SWEEP_SECONDS / sensor.points)
    return Sweep(rays, np.zeros(sensor.points, dtype=np.int64), np.asarray(time))


class Sources(NamedTuple):
    """Sources of randomness by kind: what is switched off leaves the others as they were."""

    device: np.random.Generator
    phases: np.random.Generator
    directions: np.random.Generator
    losses: np.random.Generator
    returns: np.random.Generator
    glow: np.random.Generator


def scan(
    surfaces: Sequence[Surface],
    sensor: Sensor,
    T_world_sensor: Array,
    rng: np.random.Generator,
    noise: NoiseModel = TYPICAL,
    frames: int = 1,
    *,
    device: Device | None = None,
    movers: Sequence[Mover] = (),
    start: float = 0.0,
    sway: Sway | None = None,
) -> LabelledScan:
    """Record a scene.

    Parameters
    ----------
    surfaces
        The scene, in the world frame.
    sensor
        The LiDAR model that records it.
    T_world_sensor
        (4, 4) its pose; the mean one if it sways.
    rng
        Source of all that is random: phases, noise, dropouts, intensities. Equal generators send
        the same beams under every noise model.
    noise
        How the scan differs from exact geometry.
    frames
        How many sweeps to record.
    device
        The LiDAR itself with its systematic errors; None draws one of the sizes in `noise`.
    movers
        Things that move, in the world frame.
    start
        Time at which the recording starts, s: movers are where they are then.
    sway
        How the mast sways; None draws one of the size in `noise`.

    Returns
    -------
    LabelledScan
        In the sensor's frame; the intensity is on the scale of the sensor.
    """
    sources = Sources(*rng.spawn(len(Sources._fields)))
    device = draw_device(sensor, noise, sources.device) if device is None else device
    if sway is None and noise.sway:
        sway = draw_sway(noise.sway, sources.directions)
    parts = []
    for k, sweep in enumerate(sweeps(sensor, sources.phases, frames)):
        shot = device.directions(sweep.rays, sweep.rings)
        if noise.pointing_noise:
            # The part along the ray has no effect on its direction.
            shot = shot + noise.pointing_noise * sources.directions.normal(size=shot.shape)
            shot /= np.sqrt(np.einsum("ni,ni->n", shot, shot))[:, None]
        world, begun = shot @ T_world_sensor[:3, :3].T, start + k * SWEEP_SECONDS
        rest = T_world_sensor[:3, 3]
        at_once: list[tuple[IntArray, Array]] = [(np.arange(len(world)), rest)]
        if sway is not None:
            world = sway.turn(world, begun + sweep.times)
        if sway is not None and sway.foot is not None:
            # Within a part the beams start at one point, which moves by a part of a millimetre.
            part = np.searchsorted(np.linspace(0, SWEEP_SECONDS, PARTS + 1)[1:-1], sweep.times)
            at_once = [
                (
                    np.flatnonzero(part == p),
                    sway.origin(rest, begun + (p + 0.5) * SWEEP_SECONDS / PARTS),
                )
                for p in range(PARTS)
            ]
        present = [*surfaces, *(each.at(begun) for each in movers)]
        for own, origin in at_once:
            of = sweep.rings[own]
            echoes = _echoes(present, sensor, origin, world[own], of, device, noise, sources)
            beam = own[echoes.beam]
            points = echoes.ranges[:, None] * sweep.rays[beam]
            if noise.isotropic_noise:
                points += noise.isotropic_noise * sources.returns.normal(size=points.shape)
            labels = np.where(echoes.surface < len(surfaces), echoes.surface, -1)
            time = sweep.times[beam] + k * SWEEP_SECONDS
            frame = np.full(len(points), k, dtype=np.int64)
            parts.append((points, echoes.intensity, sweep.rings[beam], time, frame, labels))
    xyz, intensity, ring, time, frame, labels = map(np.concatenate, zip(*parts, strict=True))
    rings = ring if sensor.rings else None
    cloud = PointCloud(xyz, intensity, rings, time, frame if frames > 1 else None)
    return LabelledScan(cloud, labels)


def _echoes(
    surfaces: Sequence[Surface],
    sensor: Sensor,
    origin: Array,
    world: Array,
    rings: IntArray,
    device: Device,
    noise: NoiseModel,
    sources: Sources,
) -> Echoes:
    """What one sweep returns whose beams truly leave an origin (3,) along world rays (N, 3)."""
    wide = noise.beam_width or noise.footprint != "centre"
    hits = cast(origin, world, surfaces, sensor.divergence if wide else 0.0)
    share = np.ones(len(world))
    if noise.footprint != "centre":
        hits, share = report(hits, origin, world, surfaces, sensor, noise.footprint)
    materials = Materials.of(surfaces)
    seen = (hits.ranges > sensor.min_range) & (hits.ranges < sensor.max_range)
    seen &= sources.losses.uniform(size=len(world)) >= noise.dropout
    if noise.wet:
        ground = np.array([is_ground(surface, origin) for surface in surfaces])
        dark = wet_loss(noise.wet, materials.reflectance[hits.surface], hits.cosine)
        seen &= sources.losses.uniform(size=len(world)) >= dark * ground[hits.surface]
    beam = np.flatnonzero(seen)
    surface, cosine, true = hits.surface[beam], hits.cosine[beam], hits.ranges[beam]
    retro, reflectance = materials.retro[surface], materials.reflectance[surface]
    sigma = np.full(len(beam), noise.range_noise * sensor.range_noise)
    if noise.noise_growth:
        brightness = np.where(retro, 1.0, np.maximum(reflectance * cosine, 0.05))
        # Growth is stated at 10 m; a surface darker than 0.05 hardly returns.
        sigma *= np.sqrt(1 + (noise.noise_growth * true / 10.0) ** 2 / brightness)
    ranges = device.ranges(true, rings[beam], cosine, retro)
    ranges += sigma * sources.returns.normal(size=len(beam))
    intensity = intensities(
        sensor, retro, reflectance, cosine, true, share[beam], sources.returns, noise
    )
    echoes = Echoes(ranges, intensity, surface, beam)
    if noise.blooming:
        echoes = with_glow(
            echoes, retro, world, noise.blooming, sensor, len(surfaces), sources.glow
        )
    return echoes


WALK = 0.8, 1.6
"""Least and greatest speed of a person, m/s: walking."""

DELAY = 1.0, 5.0
"""Least and greatest time between the target's recording and the source's, s (chosen)."""

KEPT_FREE = 1.0
"""Nothing comes closer to a LiDAR than this, metres: it would be all that the LiDAR sees."""


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
        for _ in range(200):
            start = rng.uniform(-1, 1, 2) * reach
            # A plant in the wind drifts.
            between = WALK if person else (0.05, 0.3)
            heading, speed = rng.uniform(0, 2 * np.pi), rng.uniform(*between)
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
    # From the brightness of asphalt at normal incidence on, none are lost.
    return wet * np.clip(1 - reflectance * cosine / 0.2, 0.0, 1.0)


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
        (3,) where the axis is, in the world, metres; None if it goes through the LiDAR.
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
        """Turn rays (N, 3) of the world as the mast leans at times (N,), s."""
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
