"""What a LiDAR at a given pose records of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array, IntArray, PointCloud
from ..base.sensors import Sensor
from .devices import TYPICAL, Device, NoiseModel, draw_device
from .environment import Mover, Sway, draw_sway, is_ground, wet_loss
from .footprint import Materials, report
from .intensity import Echoes, intensities, with_glow
from .raycast import Surface, cast

SWEEP_SECONDS = 0.1
"""Time of one sweep: LiDARs run at 10 Hz by default."""

PARTS = 20
"""Of a sweep, in which a mast that turns about its foot has its LiDAR at one point each."""

GOLDEN = (np.sqrt(5.0) - 1) / 2
SILVER = np.sqrt(2.0) - 1
"""Steps of a rosette in azimuth and elevation, as parts of the field of view: multiples of two
independent irrational numbers never repeat and cover it evenly."""

ROSETTE_STARTS = 10**6
"""A rosette starts at a random one of so many places of its sequence (chosen: many sweeps)."""


@dataclass(frozen=True, eq=False)
class LabelledScan:
    """A simulated cloud whose points are labelled with the surface that they lie on.

    Attributes
    ----------
    cloud
        In the sensor's frame.
    labels
        (N,) index of the surface of each point in the scene; −1 for one that lies on none of them:
        on something that moves, or beside tape that blooms.
    """

    cloud: PointCloud
    labels: IntArray


class Sweep(NamedTuple):
    """Directions (N, 3), rings (N,) and times (N,), s, of the beams of one sweep, sensor frame."""

    rays: Array
    rings: IntArray
    times: Array


def beams(sensor: Sensor, rng: np.random.Generator) -> Sweep:
    """Send the beams of one sweep.

    A spinning sensor starts at a random azimuth within its step. A rosette continues from a random
    place of a sequence that never repeats and covers its field of view evenly.
    """
    if sensor.pattern == "spinning":
        count = round(2 * np.pi / sensor.azimuth_step)
        start = rng.uniform(0, sensor.azimuth_step)
        azimuths = start + np.arange(count) * (2 * np.pi / count)
        up, level = np.sin(sensor.elevations), np.cos(sensor.elevations)
        x, y = np.cos(azimuths)[:, None] * level, np.sin(azimuths)[:, None] * level
        rays = np.stack(np.broadcast_arrays(x, y, up), axis=-1).reshape(-1, 3)
        ring = np.tile(np.arange(len(sensor.elevations)), count)
        time = np.repeat(np.arange(count) * (SWEEP_SECONDS / count), len(sensor.elevations))
    else:
        number = rng.integers(0, ROSETTE_STARTS) + np.arange(sensor.points)
        low, high = np.sin(sensor.elevation_span)
        azimuth = 2 * np.pi * ((number * GOLDEN) % 1.0)
        up = low + (high - low) * ((number * SILVER) % 1.0)
        level = np.sqrt(1 - up**2)
        rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=1)
        ring = np.zeros(sensor.points, dtype=np.int64)
        time = np.arange(sensor.points) * (SWEEP_SECONDS / sensor.points)
    return Sweep(rays, ring.astype(np.int64), time)


GROWTH_RANGE = 10.0
"""Range at which `NoiseModel.noise_growth` is stated, metres."""

DARKEST = 0.05
"""Least brightness that noise grows by (chosen: a darker surface hardly returns)."""


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
        In the sensor's frame; the intensity is on the sensor's own scale.
    """
    sources = Sources(*rng.spawn(len(Sources._fields)))
    device = draw_device(sensor, noise, sources.device) if device is None else device
    if sway is None and noise.sway:
        sway = draw_sway(noise.sway, sources.directions)
    parts = []
    for k in range(frames):
        sweep = beams(sensor, sources.phases)
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
    rings = ring if sensor.pattern == "spinning" else None
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
        brightness = np.where(retro, 1.0, np.maximum(reflectance * cosine, DARKEST))
        sigma *= np.sqrt(1 + (noise.noise_growth * true / GROWTH_RANGE) ** 2 / brightness)
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
