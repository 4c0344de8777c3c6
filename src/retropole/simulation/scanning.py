"""What a LiDAR at a given pose records of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..datatypes import Array, IntArray, PointCloud
from ..sensors import Sensor
from .raycast import Surface, cast

SWEEP_SECONDS = 0.1
"""Time of one sweep: LiDARs run at 10 Hz by default."""

GOLDEN = (np.sqrt(5.0) - 1) / 2
SILVER = np.sqrt(2.0) - 1
"""Steps of a rosette in azimuth and elevation, as parts of the field of view: multiples of two
independent irrational numbers never repeat and cover it evenly."""

ROSETTE_STARTS = 10**6
"""A rosette starts at a random one of so many places of its sequence (chosen: many sweeps)."""

DIFFUSE_SHARE = 0.45
"""Intensity of a white diffuse surface at normal incidence, as a share of the sensor's threshold.
Chosen; on Velodyne's scale diffuse returns end at 100 and the threshold is 230, which is 0.43."""

DIFFUSE_RANGE = 0.005, 1.0
"""Limits of reflectance times cosine with its noise: no return without intensity, and none
brighter than white (chosen)."""

RETRO_SATURATION = 6.0
"""The brightest tape, in units of the threshold, where the sensor's full scale is not less: an
Ouster with a threshold of 1000 records up to 6,268 and not the 65,535 of its full scale."""

RETRO_GRAZING, RETRO_INCIDENCE = 0.55, 0.45
"""Strength of tape at grazing incidence, and what its cosine adds up to normal incidence: 1 is
saturation (chosen: tape is bright from most angles)."""

RETRO_RANGE = 0.05, 1.0
"""Limits of the strength of tape with its noise: always above the threshold (chosen)."""


@dataclass(frozen=True)
class NoiseModel:
    """How a scan differs from exact geometry; each part can be switched off.

    Attributes
    ----------
    range_noise
        Scale of the sensor's own noise along the beam.
    isotropic_noise
        1 σ of additional noise in each coordinate, metres.
    dropout
        Share of the returns that are lost.
    beam_width
        Whether beams have the sensor's divergence, so that the edge of a beam hits thin objects.
    ring_bias
        1 σ of a range error that all returns of one ring share, metres.
    retro_bias
        1 σ of a range error that all retro-reflective returns of one LiDAR share, metres.
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
"""All errors, of ordinary size."""

EXACT = NoiseModel(
    range_noise=0.0,
    isotropic_noise=0.0,
    dropout=0.0,
    beam_width=False,
    ring_bias=0.0,
    retro_bias=0.0,
    intensity_noise=0.0,
)
"""No errors at all: every return lies on its surface."""


@dataclass(frozen=True, eq=False)
class LabelledScan:
    """A simulated cloud whose points are labelled with the surface that they lie on.

    Attributes
    ----------
    cloud
        In the sensor's frame.
    labels
        (N,) index of the surface of each point in the scene.
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
        azimuth = np.repeat(azimuths, len(sensor.elevations))
        elevation = np.tile(sensor.elevations, count)
        ring = np.tile(np.arange(len(sensor.elevations)), count)
        time = np.repeat(np.arange(count) * (SWEEP_SECONDS / count), len(sensor.elevations))
    else:
        number = rng.integers(0, ROSETTE_STARTS) + np.arange(sensor.points)
        low, high = np.sin(sensor.elevation_span)
        azimuth = 2 * np.pi * ((number * GOLDEN) % 1.0)
        elevation = np.arcsin(low + (high - low) * ((number * SILVER) % 1.0))
        ring = np.zeros(sensor.points, dtype=np.int64)
        time = np.arange(sensor.points) * (SWEEP_SECONDS / sensor.points)
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    return Sweep(rays, ring.astype(np.int64), time)


def scan(
    surfaces: Sequence[Surface],
    sensor: Sensor,
    T_world_sensor: Array,
    rng: np.random.Generator,
    noise: NoiseModel = TYPICAL,
    frames: int = 1,
) -> LabelledScan:
    """Record a static scene.

    Parameters
    ----------
    surfaces
        The scene, in the world frame.
    sensor
        The LiDAR that records it.
    T_world_sensor
        (4, 4) its pose.
    rng
        Source of all that is random: phases, noise, dropouts, intensities.
    noise
        How the scan differs from exact geometry.
    frames
        How many sweeps to record.

    Returns
    -------
    LabelledScan
        In the sensor's frame; the intensity is on the sensor's own scale.
    """
    ring_bias = noise.ring_bias * rng.normal(size=max(len(sensor.elevations), 1))
    retro_bias = noise.retro_bias * rng.normal()
    retro = np.array([s.material.retro for s in surfaces], dtype=bool)
    reflectance = np.array([s.material.reflectance for s in surfaces], dtype=float)
    xyz, ring, time, frame, intensity, labels = [], [], [], [], [], []
    for k in range(frames):
        rays, rings, times = beams(sensor, rng)
        hits = cast(
            T_world_sensor[:3, 3],
            rays @ T_world_sensor[:3, :3].T,
            surfaces,
            sensor.divergence if noise.beam_width else 0.0,
        )
        seen = (hits.ranges > sensor.min_range) & (hits.ranges < sensor.max_range)
        seen &= rng.uniform(size=len(rays)) >= noise.dropout
        index = np.flatnonzero(seen)
        label = hits.surface[index]
        ranges = hits.ranges[index] + ring_bias[rings[index]] + retro_bias * retro[label]
        ranges += noise.range_noise * sensor.range_noise * rng.normal(size=len(index))
        points = ranges[:, None] * rays[index]
        xyz.append(points + noise.isotropic_noise * rng.normal(size=points.shape))
        ring.append(rings[index])
        time.append(times[index] + k * SWEEP_SECONDS)
        frame.append(np.full(len(index), k))
        intensity.append(
            _intensity(sensor, retro[label], reflectance[label], hits.cosine[index], rng, noise)
        )
        labels.append(label)
    cloud = PointCloud(
        xyz=np.concatenate(xyz),
        intensity=np.concatenate(intensity),
        ring=np.concatenate(ring) if sensor.pattern == "spinning" else None,
        time=np.concatenate(time),
        frame=np.concatenate(frame).astype(np.int64) if frames > 1 else None,
    )
    return LabelledScan(cloud, np.concatenate(labels))


def _intensity(
    sensor: Sensor,
    retro: Array,
    reflectance: Array,
    cosine: Array,
    rng: np.random.Generator,
    noise: NoiseModel,
) -> Array:
    """Intensities on the sensor's scale: diffuse returns below its threshold, tape above it.

    Diffuse returns follow the cosine of incidence. Tape lies between the threshold and saturation,
    lower where only the edge of a beam hit it.
    """
    gain = 1 + noise.intensity_noise * rng.normal(size=len(cosine))
    diffuse = (
        DIFFUSE_SHARE * sensor.threshold * np.clip(reflectance * cosine * gain, *DIFFUSE_RANGE)
    )
    saturation = min(sensor.intensity_max, RETRO_SATURATION * sensor.threshold)
    loss = noise.intensity_noise * np.abs(rng.normal(size=len(cosine)))
    strength = np.clip((RETRO_GRAZING + RETRO_INCIDENCE * cosine) * (1 - loss), *RETRO_RANGE)
    bright = sensor.threshold + (saturation - sensor.threshold) * strength
    return np.asarray(np.round(np.where(retro, bright, diffuse)))
