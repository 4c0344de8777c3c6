"""How simulated recordings differ from exact geometry: families of errors, each of its own size.

What a family does is written in `devices` (errors that a LiDAR keeps), `footprint`, `glow`,
`environment` and `intensity`; a size of 0 (False, ``centre``) switches it off.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

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
        Scale of the sensor's own noise along the beam.
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
    pointing_noise
        1 σ of the direction of each shot in each of two directions across it, rad.
    noise_growth
        How the noise along the beam grows where little light returns: the relative noise that is
        added, in squares, at 10 m from a white surface. It grows with the range, and with the
        inverse root of the brightness.
    footprint
        What a beam reports whose footprint meets several surfaces.
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
"""All that a LiDAR meets on a site where its mast stands still. The sizes are assumptions: of the
order that LiDARs' manuals allow, but measured on no instrument."""

NOISE_MODELS = {"field": FIELD, "typical": TYPICAL, "none": EXACT}
"""Noise models by name."""
