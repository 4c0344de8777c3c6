"""Intensities on a sensor's own scale: diffuse surfaces, and tape above its threshold."""

from __future__ import annotations

import numpy as np

from ..base.datatypes import Array, BoolArray
from ..base.sensors import Sensor
from .noise import NoiseModel

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
