"""How simulated recordings differ from exact geometry: families of errors, each of a separate size.

Single LiDARs keep systematic errors in all their recordings. What the other families do is written
in `footprint`, `intensity` and `environment`; a size of 0 (False, ``centre``) switches one off.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from ..base.datatypes import Array, BoolArray, IntArray
from ..base.sensors import Sensor

Footprint = Literal["centre", "first", "strongest"]
"""What of its footprint a beam reports: the surface at its centre, the nearest, the brightest."""


@dataclass(frozen=True)
class NoiseModel:
    """How a scan differs from exact geometry; each part can be switched off.

    Systematic errors are drawn once per LiDAR (`devices.draw_device`); their sizes here are 1 σ
    over LiDARs of a kind. The rest is drawn for each recording.

    Attributes
    ----------
    range_noise
        Scale of the noise of the sensor along the beam.
    isotropic_noise
        1 σ of additional noise in each coordinate, metres.
    dropout
        Share of the returns that are lost.
    beam_width
        Whether beams have the sensor's divergence, so that the edge of a beam hits thin objects.
    ring_bias
        Systematic: range error that all returns of one ring share, metres.
    retro_bias
        Systematic: range error that all retro-reflective returns of one LiDAR share, metres.
    intensity_noise
        Relative 1 σ of the intensity.
    zero_offset
        Systematic: range error that all returns share, metres.
    scale
        Systematic: range error as a part of the range.
    slant
        Systematic: range error as a part of range times tangent of incidence, rad.
    ring_elevation
        Systematic: error of each ring's elevation, rad.
    ring_azimuth
        Systematic: error of each ring's azimuth, rad.
    encoder
        Systematic: amplitude, in cosine and in sine, of an azimuth error of period 360°, rad.
    wobble
        Systematic: the same of an elevation error, rad.
    bend
        Systematic: the same of elevation errors of periods 180° and 120°, rad.
    elevation
        Systematic: error of the elevation of all beams, rad.
    elevation_scale
        Systematic: error of the elevation as a fraction.
    pointing_noise
        1 σ of the direction of each shot in each of two directions across it, rad.
    noise_growth
        How the noise along the beam grows where little light returns: the relative noise that is
        added, in squares, at 10 m from a white surface. It grows with the range, and with the
        inverse root of the brightness.
    footprint
        What a beam reports whose footprint hits several surfaces.
    blooming
        Half width of the glow around tape, rad: a beam within it may return as if it had hit.
    wet
        Share of the returns that are lost on ground that is dark at the angle it is seen from.
    movers
        Number of people and plants that move between the recordings and between the sweeps.
    sway
        Amplitude of a mast's oscillation at 1 Hz, rad.
    intensity_falloff
        Whether intensity falls with range, and that of tape with incidence.
    """

    range_noise: float = 1.0
    isotropic_noise: float = 0.0
    dropout: float = 0.02
    beam_width: bool = True
    ring_bias: float = 0.003
    retro_bias: float = 0.003
    intensity_noise: float = 0.15
    zero_offset: float = 0.0
    scale: float = 0.0
    slant: float = 0.0
    ring_elevation: float = 0.0
    ring_azimuth: float = 0.0
    encoder: float = 0.0
    wobble: float = 0.0
    bend: float = 0.0
    elevation: float = 0.0
    elevation_scale: float = 0.0
    pointing_noise: float = 0.0
    noise_growth: float = 0.0
    footprint: Footprint = "centre"
    blooming: float = 0.0
    wet: float = 0.0
    movers: int = 0
    sway: float = 0.0
    intensity_falloff: bool = False


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

TYPICAL = NoiseModel()
"""Noise along the beam, lost returns, wide beams, and range errors of rings and of tape."""

FIELD = NoiseModel(
    ring_bias=0.004,
    retro_bias=0.005,
    zero_offset=0.005,
    scale=2e-4,
    slant=3e-4,
    ring_elevation=float(np.radians(0.015)),
    encoder=float(np.radians(0.015)),
    wobble=float(np.radians(0.006)),
    pointing_noise=float(np.radians(0.02)),
    noise_growth=0.25,
    footprint="strongest",
    blooming=float(np.radians(0.25)),
    wet=0.3,
    movers=2,
    intensity_falloff=True,
)
"""All that a LiDAR encounters on a site where its mast does not move. The sizes are assumptions: of
the order that LiDARs' manuals allow, but measured on no instrument."""

NOISE_MODELS = {"field": FIELD, "typical": TYPICAL, "none": EXACT}
"""Noise models by name."""


MAX_SLANT = 5.0
"""Greatest tangent of incidence that a slant error grows with: that of 79° (chosen; a longer
footprint rather loses its return)."""


@dataclass(frozen=True, eq=False)
class Device:
    """The systematic errors of one LiDAR.

    It believes that its beams leave in the sensor's nominal directions. They leave in other
    directions, by its errors of elevation and azimuth, and the points that it records lie on the
    nominal beams.

    Attributes
    ----------
    ring_range
        (B,) range error of each ring, metres; one for a sensor without rings.
    ring_elevation
        (B,) elevation error of each ring, rad.
    ring_azimuth
        (B,) azimuth error of each ring, rad.
    zero_offset
        Range error of all returns, metres.
    scale
        Range error as a part of the range.
    slant
        Range error as a part of range times tangent of incidence, rad.
    encoder
        (2,) azimuth error, rad: these times cosine and sine of the azimuth.
    wobble
        (2,) elevation error, rad: the same.
    bend
        (4,) elevation error, rad: these times cosine and sine of twice and three times the azimuth.
    elevation
        Elevation error of all beams, rad.
    elevation_scale
        Elevation error as a part of the elevation.
    tape_offset
        Range error of retro-reflective returns, metres.
    """

    ring_range: Array
    ring_elevation: Array
    ring_azimuth: Array
    zero_offset: float
    scale: float
    slant: float
    encoder: Array
    wobble: Array
    bend: Array
    tape_offset: float
    elevation: float
    elevation_scale: float

    def directions(self, rays: Array, rings: IntArray) -> Array:
        """Directions (N, 3) in which beams leave that are believed to leave along rays (N, 3).

        Parameters
        ----------
        rays
            (N, 3) nominal unit directions in the sensor's frame.
        rings
            (N,) ring of each.
        """
        turning = (self.ring_elevation, self.ring_azimuth, self.encoder, self.wobble, self.bend)
        by_all = self.elevation or self.elevation_scale
        if not any(each.any() for each in turning) and not by_all:
            return rays
        level = np.maximum(np.hypot(rays[:, 0], rays[:, 1]), np.finfo(float).tiny)
        around = rays[:, :2] / level[:, None]
        azimuth = np.arctan2(rays[:, 1], rays[:, 0]) + around @ self.encoder
        azimuth += self.ring_azimuth[rings]
        elevation = (1 + self.elevation_scale) * np.arctan2(rays[:, 2], level) + self.elevation
        elevation += self.ring_elevation[rings] + around @ self.wobble
        twice, thrice = (around @ np.array([1.0, 1.0j])) ** np.array([[2], [3]])
        elevation += np.stack([twice.real, twice.imag, thrice.real, thrice.imag], 1) @ self.bend
        level = np.cos(elevation)
        return np.stack(
            [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1
        )

    def ranges(self, ranges: Array, rings: IntArray, cosine: Array, retro: BoolArray) -> Array:
        """Ranges (N,) that the LiDAR states, without random noise, metres.

        Parameters
        ----------
        ranges
            (N,) true ranges, metres.
        rings
            (N,) ring of each return.
        cosine
            (N,) of the angle of incidence.
        retro
            (N,) whether the surface is retro-reflective.
        """
        stated = ranges + self.ring_range[rings] + self.tape_offset * retro
        stated += self.zero_offset + self.scale * ranges
        if self.slant:
            floor = 1 / np.hypot(1, MAX_SLANT)
            stated += self.slant * ranges * np.sqrt(1 / np.clip(cosine, floor, 1) ** 2 - 1)
        return np.asarray(stated)

    def as_dict(self) -> dict[str, float | list[float]]:
        """Give numbers for JSON, names with their units."""
        units = {"scale": "", "ring_range": "_m", "zero_offset": "_m", "tape_offset": "_m"}
        return {
            name + units.get(name, "_rad"): np.asarray(value).tolist()
            for name, value in asdict(self).items()
        }


def draw_device(sensor: Sensor, noise: NoiseModel, rng: np.random.Generator) -> Device:
    """Draw one LiDAR of a model.

    Equal generators draw equal LiDARs up to the sizes of the families: to switch one off changes
    no other.

    Parameters
    ----------
    sensor
        The model.
    noise
        1 σ of each family of systematic errors.
    rng
        Source of the draws.
    """
    count = max(len(sensor.elevations), 1)
    per_ring = rng.normal(size=(2, count))
    zero_offset, scale, slant, tape_offset = rng.normal(size=4)
    encoder, wobble = rng.normal(size=(2, 2))
    # Last, so that LiDARs drawn without it are those of the same generator before there was it.
    ring_azimuth = rng.normal(size=count)
    bend = rng.normal(size=4)
    elevation, elevation_scale = rng.normal(size=2)
    return Device(
        ring_range=noise.ring_bias * per_ring[0],
        ring_elevation=noise.ring_elevation * per_ring[1],
        ring_azimuth=noise.ring_azimuth * ring_azimuth,
        zero_offset=float(noise.zero_offset * zero_offset),
        scale=float(noise.scale * scale),
        slant=float(noise.slant * slant),
        encoder=noise.encoder * encoder,
        wobble=noise.wobble * wobble,
        bend=noise.bend * bend,
        tape_offset=float(noise.retro_bias * tape_offset),
        elevation=float(noise.elevation * elevation),
        elevation_scale=float(noise.elevation_scale * elevation_scale),
    )
