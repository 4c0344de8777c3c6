"""Intensities on a sensor's own scale: diffuse surfaces, and tape above its threshold.

The glow around tape is false bright returns in beams that pass close beside it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from ..base.datatypes import Array, BoolArray, IntArray
from ..base.sensors import Sensor
from .devices import NoiseModel

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

FALLOFF_FROM = 5.0
"""Range at which a diffuse surface has the intensity that it has without falloff, metres: the
thresholds of `sensors` are for about 5 m."""

RAW_FALLOFF, CALIBRATED_FALLOFF = 2.0, 0.5
"""Power of the range by which intensity falls: the inverse square where a sensor states raw signal,
and what is left of it where it states a reflectivity that it has compensated (chosen)."""

BYTE = 255.0
"""Full scale of sensors that state a compensated reflectivity; wider scales are raw signal."""

NEAR_GAIN = 2.0
"""How much brighter than at `FALLOFF_FROM` a near diffuse surface is at most (chosen: the optics
lose light at short range)."""

TAPE_REACH = 12.0
"""Range to which tape at normal incidence saturates a sensor, metres. Chosen so that tape at 3 to
8 m normally stays above the threshold, and far or grazing tape may not."""

TAPE_ANGLES = float(np.cos(np.radians(45.0))), float(np.cos(np.radians(80.0)))
"""Cosine of incidence to which tape keeps its strength, and that at which next to nothing is left:
retro-reflective sheeting is specified to entrance angles of 30° to 40° and is dark at grazing
incidence (the angles are chosen)."""

TAPE_GRAZING = 0.03
"""Strength of tape at grazing incidence under falloff, a part of that at normal incidence."""


def saturation(sensor: Sensor) -> float:
    """Intensity of the brightest tape on a sensor's scale."""
    return min(sensor.intensity_max, RETRO_SATURATION * sensor.threshold)


def tape_strength(cosine: Array) -> Array:
    """Strength of tape (N,) under falloff, from the cosine of incidence (N,): 1 at normal."""
    full, dark = TAPE_ANGLES
    return np.clip((cosine - dark) / (full - dark), TAPE_GRAZING, 1.0)


def intensities(
    sensor: Sensor,
    retro: BoolArray,
    reflectance: Array,
    cosine: Array,
    ranges: Array,
    share: Array,
    rng: np.random.Generator,
    noise: NoiseModel,
) -> Array:
    """Intensities (N,) on the sensor's scale: diffuse below its threshold, tape above it.

    Diffuse returns follow the cosine of incidence. Tape lies between the threshold and saturation,
    lower where only the edge of a beam hit it. With falloff, both fall with the range and nothing
    holds them on their side of the threshold.

    Parameters
    ----------
    sensor
        The LiDAR.
    retro, reflectance
        (N,) of the surface of each return.
    cosine
        (N,) of the angle of incidence.
    ranges
        (N,) metres.
    share
        (N,) part of the beam that meets the surface.
    rng, noise
        Relative noise, and whether there is falloff.
    """
    gain = 1 + noise.intensity_noise * rng.normal(size=len(cosine))
    brightness = np.clip(reflectance * cosine * share * gain, *DIFFUSE_RANGE)
    diffuse = DIFFUSE_SHARE * sensor.threshold * brightness
    full = saturation(sensor)
    loss = noise.intensity_noise * np.abs(rng.normal(size=len(cosine)))
    if noise.intensity_falloff:
        power = CALIBRATED_FALLOFF if sensor.intensity_max <= BYTE else RAW_FALLOFF
        diffuse *= np.minimum((FALLOFF_FROM / ranges) ** power, NEAR_GAIN)
        strength = tape_strength(cosine) * share * (1 - loss) * (TAPE_REACH / ranges) ** 2
        bright = full * np.clip(strength, 0.0, 1.0)
    else:
        strength = (RETRO_GRAZING + RETRO_INCIDENCE * cosine) * share * (1 - loss)
        bright = sensor.threshold + (full - sensor.threshold) * np.clip(strength, *RETRO_RANGE)
    return np.asarray(np.round(np.where(retro, bright, diffuse)))


BLOOM_NOISE = 0.02
"""1 σ of the range of a false return beside tape, metres (chosen)."""

BLOOM_STRENGTH = 0.5
"""The brightest false return, where 0 is the threshold and 1 saturation (chosen)."""


CELL = 1 / 64
"""Least size of the cells in which beams beside tape are looked for, rad."""


class Echoes(NamedTuple):
    """Range, m, intensity, surface and beam (N,) of each return; beams in ascending order."""

    ranges: Array
    intensity: Array
    surface: IntArray
    beam: IntArray


def bloom(
    rays: Array, on_tape: BoolArray, half_width: float, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Draw the beams that return falsely because they pass close beside tape.

    The chance falls linearly from 1 at the beam on tape to 0 at the half width of the glow.

    Parameters
    ----------
    rays
        (N, 3) unit directions.
    on_tape
        (N,) whether a beam's own return is of tape.
    half_width
        Of the glow, rad.
    rng
        Source of the draws.

    Returns
    -------
    false, beside : ndarray
        (M,) index of the beams with a false return, and of the beam on tape next to each.
    """
    bright, dark = np.flatnonzero(on_tape), np.flatnonzero(~on_tape)
    if len(bright) == 0:
        return bright, bright
    dark = dark[_in_cells_beside(rays[dark], rays[bright], max(half_width, CELL))]
    apart, nearest = KDTree(rays[bright]).query(rays[dark], distance_upper_bound=half_width)
    glows = np.flatnonzero(rng.uniform(size=len(dark)) < 1 - apart / half_width)
    return dark[glows], bright[nearest[glows]]


def _in_cells_beside(rays: Array, others: Array, size: float) -> IntArray:
    """Index of rays (N, 3) in the same cubic cell as one of others (M, 3), or in one next to it.

    It leaves out most beams before distances are computed.
    """
    count = int(np.ceil(2 / size)) + 3
    steps = np.array([count * count, count, 1])
    shift = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3) @ steps
    occupied = np.zeros(count**3, dtype=bool)
    cells = np.unique(((others + 1) / size + 1).astype(np.int64) @ steps)
    occupied[(cells[:, None] + shift).ravel()] = True
    return np.flatnonzero(occupied[((rays + 1) / size + 1).astype(np.int64) @ steps])


def with_glow(
    echoes: Echoes,
    on_tape: BoolArray,
    rays: Array,
    half_width: float,
    sensor: Sensor,
    nothing: int,
    rng: np.random.Generator,
) -> Echoes:
    """Add false returns beside tape, at the tape's range, in place of what their beams met.

    Parameters
    ----------
    echoes
        True returns.
    on_tape
        (N,) whether each is of tape.
    rays
        (B, 3) unit directions of all beams.
    half_width
        Of the glow, rad.
    sensor
        Its scale of intensity.
    nothing
        Label of the false returns.
    rng
        Source of the draws.
    """
    tape = np.zeros(len(rays), dtype=bool)
    tape[echoes.beam[on_tape]] = True
    false, beside = bloom(rays, tape, half_width, rng)
    own = np.zeros(len(rays), dtype=np.int64)
    own[echoes.beam] = np.arange(len(echoes.beam))
    ranges = echoes.ranges[own[beside]] + BLOOM_NOISE * rng.normal(size=len(false))
    strength = BLOOM_STRENGTH * rng.uniform(size=len(false))
    bright = sensor.threshold + (saturation(sensor) - sensor.threshold) * strength
    added = Echoes(ranges, np.round(bright), np.full(len(false), nothing), false)
    kept = ~np.isin(echoes.beam, false)
    order = np.argsort(np.concatenate([echoes.beam[kept], false]), kind="stable")
    return Echoes(
        *(np.concatenate([old[kept], new])[order] for old, new in zip(echoes, added, strict=True))
    )
