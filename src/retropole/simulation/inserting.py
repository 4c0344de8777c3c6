"""Taped poles in recordings, met by the recordings' own beams.

Surroundings, other bright things and the pattern of the beams stay as they were recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..base import se3
from ..base.datatypes import PER_POINT, Array, IntArray, PointCloud
from ..base.sensors import Sensor
from .intensity import RETRO_GRAZING, RETRO_INCIDENCE, saturation
from .raycast import Cylinder
from .recorded import RecordedBeams, met_by

RANGE_NOISE, DIVERGENCE = 0.010, 0.003
"""1 σ of the range, metres, and full angle of the beam, rad, where the sensor is not known: those
of most of the table of sensors."""

LEAST_OF_FULL_SCALE = 0.8
"""The weakest tape as a share of the top of the cloud's intensities, where the sensor is not known:
8-bit sensors have it at 200 of 255 (Xue et al. 2019, Table I)."""

FULL_SCALE = 255.0
"""Of a cloud without intensity, whose own returns then get 0."""

FLUCTUATION = 0.15
"""1 σ of the fluctuation of the strength of tape, of 1 (as `NoiseModel.intensity_noise`)."""


def range_noise(sensor: Sensor | None) -> float:
    """1 σ of a LiDAR's ranges, metres."""
    return RANGE_NOISE if sensor is None else sensor.range_noise


def in_sensor_frame(poles: Sequence[Cylinder], T_target_cloud: Array) -> list[Cylinder]:
    """Express poles of the target's frame in a cloud's, by its pose (4, 4)."""
    T = se3.inverse(T_target_cloud)
    return [
        replace(pole, centre=se3.apply(T, pole.centre[None])[0], axis=T[:3, :3] @ pole.axis)
        for pole in poles
    ]


def with_poles(
    cloud: PointCloud,
    beams: RecordedBeams,
    poles: Sequence[Cylinder],
    width: float,
    sensor: Sensor | None,
    rng: np.random.Generator,
    biases: Array,
) -> tuple[PointCloud, IntArray]:
    """Replace what the poles hide by returns on them; the labels (N',) are their index or −1.

    The biases are those of ranges to tape, metres: of each ring, and last where none is known.
    """
    hits, met = met_by(beams, poles, width)
    ranges = hits.ranges[met] + biases[beams.rings[met]]
    ranges += range_noise(sensor) * rng.normal(size=len(met))
    points = beams.origin + ranges[:, None] * beams.directions[met]
    # Returns stay in their places in the file; beams that had none come last.
    count = len(cloud)
    rows = np.concatenate([np.arange(count), beams.like[met[met >= count]]])
    place = np.where(met < count, met, 0)
    place[met >= count] = np.arange(count, len(rows))
    arrays: dict[str, Any] = {"xyz": cloud.xyz[rows]}
    for name in PER_POINT:
        value = getattr(cloud, name)
        arrays[name] = None if value is None else value[rows]
    if cloud.intensity is None:
        arrays["intensity"] = np.zeros(len(rows))
    labels = np.full(len(rows), -1, dtype=np.int64)
    arrays["xyz"][place] = points
    arrays["intensity"][place] = _tape(cloud.intensity, sensor, hits.cosine[met], rng)
    labels[place] = hits.surface[met]
    if cloud.ring is not None and np.array_equal(cloud.ring, beams.rings[:count]):
        # A beam that the sensor sends has no return beside it on a ring that met nothing.
        arrays["ring"][place] = beams.rings[met]
    return replace(cloud, **arrays), labels


def _tape(
    recorded: Array | None, sensor: Sensor | None, cosine: Array, rng: np.random.Generator
) -> Array:
    """Intensities of tape on the scale of the recording, saturated at normal incidence."""
    top = FULL_SCALE if recorded is None else float(recorded.max(initial=0.0))
    if sensor is None:
        least = LEAST_OF_FULL_SCALE * top
    else:
        scale = 1.0
        if recorded is not None and top <= 1.0 < sensor.threshold:
            scale = 1.0 / sensor.intensity_max
        least = scale * sensor.threshold
        top = scale * saturation(sensor)
    loss = FLUCTUATION * np.abs(rng.normal(size=len(cosine)))
    strength = np.clip((RETRO_GRAZING + RETRO_INCIDENCE * cosine) * (1 - loss), 0, 1)
    bright = least + (top - least) * strength
    return np.asarray(np.round(bright) if top > 1.0 else bright)
