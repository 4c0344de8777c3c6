"""How a pole looks by a sensor's beams, their width and step (docs/detection.md, Wide beams)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.sensors import Sensor

RMS_PER_RADIUS = 0.62
"""Beams evenly spaced across a cylinder scatter by so many radii about their line."""


ORDINARY_DIVERGENCE = 0.003
"""Full angle of most sensors' beams, rad."""


@dataclass(frozen=True)
class Beams:
    """What is known of the beams that met a line: full angle, and step of the sweep, rad.

    Zero where it is not known: nothing is then granted for it.
    """

    divergence: float = 0.0
    step: float = 0.0


UNKNOWN = Beams()


def beams_by(sensor: Sensor | None) -> Beams:
    """The beams of a sensor; None where it is not known."""
    return UNKNOWN if sensor is None else Beams(sensor.divergence, sensor.azimuth_step)


def beam_scatter(distance: float, radius: float, beams: Beams) -> float:
    """Scatter, metres, that wide beams add to that which returns on a pole have by ordinary ones.

    A return lies on the axis of its beam, and a beam whose edge alone meets the pole gives one too:
    the pole looks wider by half a beam on either side. The limits here hold for beams of
    `ORDINARY_DIVERGENCE`, and for unknown ones.

    Parameters
    ----------
    distance, radius
        From where the beams start to the pole, and of the pole, metres.
    beams
        That met it.
    """
    seen = _seen_radius(distance, radius, beams.divergence)
    ordinary = _seen_radius(distance, radius, ORDINARY_DIVERGENCE)
    return float(RMS_PER_RADIUS * np.sqrt(max(seen**2 - ordinary**2, 0.0)))


def returns_per_ring(distance: float, radius: float, beams: Beams) -> float:
    """How many returns one ring can leave on a pole; parameters as for `beam_scatter`.

    Infinite where the step is not known.
    """
    if beams.step == 0 or distance == 0:
        return np.inf
    return 2 * _seen_radius(distance, radius, beams.divergence) / (distance * beams.step)


def _seen_radius(distance: float, radius: float, divergence: float) -> float:
    return radius + distance * divergence / 2
