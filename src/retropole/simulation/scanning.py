"""From a scene to what a LiDAR at some pose would record of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..datatypes import Array, IntArray, PointCloud
from ..sensors import Sensor
from .raycast import Surface, cast

SWEEP_SECONDS = 0.1
GOLDEN = (np.sqrt(5.0) - 1) / 2


@dataclass(frozen=True)
class NoiseModel:
    """What makes a real scan differ from geometry; each can be switched off.

    Attributes
    ----------
    range_noise
        Scale of the sensor's own noise along the beam.
    isotropic_noise
        1 σ of noise in each coordinate, metres, on top.
    dropout
        Share of the returns that are lost.
    beam_width
        Whether beams have the sensor's divergence: thin things are hit by near misses.
    ring_bias, retro_bias
        1 σ of a range error that all returns of one beam, all retro returns of one LiDAR share.
    intensity_noise
        Relative 1 σ of the intensity.
    """

    range_noise: float = 1.0
    isotropic_noise: float = 0.0
    dropout: float = 0.02
    beam_width: bool = True
    ring_bias: float = 0.003
    retro_bias: float = 0.003
    intensity_noise: float = 0.15


TYPICAL = NoiseModel()
EXACT = NoiseModel(0.0, 0.0, 0.0, False, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Scan:
    """A simulated cloud, and which surface of the scene each of its points lies on."""

    cloud: PointCloud
    labels: IntArray


def beams(sensor: Sensor, rng: np.random.Generator) -> tuple[Array, IntArray, Array]:
    """Directions (N, 3), rings (N,) and times (N,) of one sweep in the sensor's frame.

    A spinning sensor starts at a random azimuth of its grid; a rosette goes on from a random place
    of a sequence that never repeats and covers its field of view evenly.
    """
    if sensor.pattern == "spinning":
        count = round(2 * np.pi / sensor.azimuth_step)
        start = rng.uniform(0, sensor.azimuth_step)
        azimuths = start + np.arange(count) * (2 * np.pi / count)
        azimuth = np.repeat(azimuths, len(sensor.elevations))
        elevation = np.tile(sensor.elevations, count)
        ring = np.tile(np.arange(len(sensor.elevations)), count)
        time = np.repeat(np.arange(count) * (SWEEP_SECONDS / count), len(sensor.elevations))
    else:
        number = rng.integers(0, 10**6) + np.arange(sensor.points)
        low, high = np.sin(sensor.elevation_span)
        azimuth = 2 * np.pi * ((number * GOLDEN) % 1.0)
        elevation = np.arcsin(low + (high - low) * ((number * (np.sqrt(2.0) - 1)) % 1.0))
        ring = np.zeros(sensor.points, dtype=np.int64)
        time = np.arange(sensor.points) * (SWEEP_SECONDS / sensor.points)
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    return rays, ring.astype(np.int64), time


def scan(
    surfaces: Sequence[Surface],
    sensor: Sensor,
    T_world_sensor: Array,
    rng: np.random.Generator,
    nuisances: NoiseModel = TYPICAL,
    frames: int = 1,
) -> Scan:
    """Record a standing scene.

    Parameters
    ----------
    surfaces
        The scene, in the world's frame.
    sensor
        Which LiDAR looks at it.
    T_world_sensor
        (4, 4) its pose.
    rng
        Source of all that is random: phases, noise, dropouts, intensities.
    nuisances
        How far the scan is from geometry.
    frames
        How many sweeps to record.

    Returns
    -------
    Scan
        In the sensor's frame; the intensity is on the sensor's own scale.
    """
    ring_bias = nuisances.ring_bias * rng.normal(size=max(len(sensor.elevations), 1))
    retro_bias = nuisances.retro_bias * rng.normal()
    retro = np.array([s.material.retro for s in surfaces] + [False])
    reflectance = np.array([s.material.reflectance for s in surfaces] + [0.0])
    xyz, ring, time, frame, intensity, labels = [], [], [], [], [], []
    for k in range(frames):
        rays, rings, times = beams(sensor, rng)
        hits = cast(
            T_world_sensor[:3, 3],
            rays @ T_world_sensor[:3, :3].T,
            surfaces,
            sensor.divergence if nuisances.beam_width else 0.0,
        )
        seen = (hits.ranges > sensor.min_range) & (hits.ranges < sensor.max_range)
        seen &= rng.uniform(size=len(rays)) >= nuisances.dropout
        rows = np.flatnonzero(seen)
        label = hits.surface[rows]
        ranges = hits.ranges[rows] + ring_bias[rings[rows]] + retro_bias * retro[label]
        ranges += nuisances.range_noise * sensor.range_noise * rng.normal(size=len(rows))
        points = ranges[:, None] * rays[rows]
        xyz.append(points + nuisances.isotropic_noise * rng.normal(size=points.shape))
        ring.append(rings[rows])
        time.append(times[rows] + k * SWEEP_SECONDS)
        frame.append(np.full(len(rows), k))
        intensity.append(
            _intensity(sensor, retro[label], reflectance[label], hits.cosine[rows], rng, nuisances)
        )
        labels.append(label)
    cloud = PointCloud(
        xyz=np.concatenate(xyz),
        intensity=np.concatenate(intensity),
        ring=np.concatenate(ring) if sensor.pattern == "spinning" else None,
        time=np.concatenate(time),
        frame=np.concatenate(frame).astype(np.int64) if frames > 1 else None,
    )
    return Scan(cloud, np.concatenate(labels))


def _intensity(
    sensor: Sensor,
    retro: Array,
    reflectance: Array,
    cosine: Array,
    rng: np.random.Generator,
    nuisances: NoiseModel,
) -> Array:
    """Intensities on the sensor's scale: diffuse below its threshold, tape above, both unsteady.

    Diffuse returns follow the cosine of incidence and end at 45 % of the threshold; tape returns
    lie between the threshold and the full scale, less where only the edge of a beam met it.
    """
    noise = 1 + nuisances.intensity_noise * rng.normal(size=len(cosine))
    diffuse = 0.45 * sensor.threshold * np.clip(reflectance * cosine * noise, 0.005, 1.0)
    top = min(sensor.intensity_max, 6.0 * sensor.threshold)
    unsteady = nuisances.intensity_noise * np.abs(rng.normal(size=len(cosine)))
    strength = np.clip((0.55 + 0.45 * cosine) * (1 - unsteady), 0.05, 1.0)
    bright = sensor.threshold + (top - sensor.threshold) * strength
    return np.asarray(np.round(np.where(retro, bright, diffuse)))
