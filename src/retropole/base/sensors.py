"""Sensors by name: their rings, noise and intensity scale, and the threshold for retro tape."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.resources import files
from typing import Literal

import msgspec
import numpy as np

from .errors import UsageError
from .se3 import Array


@dataclass(frozen=True, eq=False)
class Sensor:
    """What is known of a LiDAR model.

    Attributes
    ----------
    name
        What users call it; case, blanks and dashes do not count.
    aliases
        Other names of the same model.
    elevations
        (B,) rad, one ring each, from the lowest up; empty for a sensor without rings.
    azimuth_step
        Between two firings of a ring at 10 Hz, rad.
    elevation_span
        Lowest and highest elevation, rad.
    pattern
        ``spinning``, or ``rosette`` for scans that do not repeat.
    points
        Returns of one sweep at most.
    range_noise
        1 σ along the beam, metres.
    divergence
        Full angle of the beam, rad.
    min_range, max_range
        Metres.
    intensity_max
        Full scale of the intensity.
    threshold
        Intensity from which a return at about 5 m counts as retro-reflective.
    threshold_source, source
        Where the threshold and the other figures come from.
    range_accuracy, retro_accuracy
        What the manufacturer states for the range, ± metres, and for that of retro-reflectors; None
        where nothing is.
    """

    name: str
    aliases: tuple[str, ...]
    elevations: Array
    azimuth_step: float
    elevation_span: tuple[float, float]
    pattern: Literal["spinning", "rosette"]
    points: int
    range_noise: float
    divergence: float
    min_range: float
    max_range: float
    intensity_max: float
    threshold: float
    threshold_source: str
    source: str
    range_accuracy: float | None = None
    retro_accuracy: float | None = None


class Listed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What ``sensors.toml`` holds of a model; it says in which units."""

    aliases: tuple[str, ...]
    noise_m: float
    divergence_mrad: float
    range_m: tuple[float, float]
    threshold: float
    threshold_source: str
    source: str
    elevations_deg: tuple[float | tuple[float, float, int], ...] = ()
    azimuth_step_deg: float = 0.0
    rosette_deg: tuple[float, float] | None = None
    points: int = 0
    full_scale: float = 255.0
    accuracy_m: float | None = None
    retro_accuracy_m: float | None = None

    def sensor(self, name: str) -> Sensor:
        """Give it its name, in SI units."""
        rings = [
            np.linspace(*each) if isinstance(each, tuple) else [each]
            for each in self.elevations_deg
        ]
        elevations = np.radians(np.sort(np.concatenate(rings))) if rings else np.zeros(0)
        span = np.radians(self.rosette_deg) if self.rosette_deg else elevations[[0, -1]]
        return Sensor(
            name=name,
            aliases=self.aliases,
            elevations=elevations,
            azimuth_step=float(np.radians(self.azimuth_step_deg)),
            elevation_span=(float(span[0]), float(span[1])),
            pattern="rosette" if self.rosette_deg else "spinning",
            points=self.points or len(elevations) * round(360 / self.azimuth_step_deg),
            range_noise=self.noise_m,
            divergence=self.divergence_mrad / 1000,
            min_range=self.range_m[0],
            max_range=self.range_m[1],
            intensity_max=self.full_scale,
            threshold=self.threshold,
            threshold_source=self.threshold_source,
            source=self.source,
            range_accuracy=self.accuracy_m,
            retro_accuracy=self.retro_accuracy_m,
        )


_TABLE = files("retropole.base").joinpath("sensors.toml").read_bytes()

SENSORS: dict[str, Sensor] = {
    name: each.sensor(name)
    for name, each in msgspec.toml.decode(_TABLE, type=dict[str, Listed]).items()
}


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def find_sensor(name: str) -> Sensor:
    """Find a sensor by its name or an alias; case, blanks and dashes do not count.

    Raises
    ------
    UsageError
        Where no sensor has that name; lists those there are.
    """
    for sensor in SENSORS.values():
        if _plain(name) in {_plain(known) for known in (sensor.name, *sensor.aliases)}:
            return sensor
    raise UsageError(
        f"no sensor is called {name!r}; there are {', '.join(SENSORS)}, and auto for any other"
    )


def sensor_or_auto(name: str) -> Sensor | None:
    """Find a sensor as `find_sensor` does; None for ``auto``, which stands for any."""
    return None if name == "auto" else find_sensor(name)


@dataclass(frozen=True)
class Threshold:
    """Intensity from which a return counts as retro-reflective, and how it was found."""

    value: float
    found: str


GIVEN = "given"
"""How a threshold was found that the user gave."""

BRIGHT_TAIL = 2.5
"""The threshold lies so many times the spread of the diffuse returns above their median, …"""

OF_BRIGHTEST = (0.55, 0.78)
"""… but between these parts of the brightest returns (140 and 200 of 255)."""

BRIGHTEST = 6
"""The brightest return is taken as the sixth: a single glint says nothing of the scale."""


def auto_threshold(intensity: Array) -> Threshold:
    """Find the threshold from the cloud itself, on whatever scale it has.

    Most returns are diffuse. Their median and 95th percentile tell where they end; tape lies well
    above. Erring low is cheap, since a pole is told by its shape, so where much of the scene
    saturates the threshold stays below the brightest returns.

    Parameters
    ----------
    intensity
        (N,) on a scale of 0–1, 8 bit, 16 bit or any other from zero up.
    """
    tail = _end_of_diffuse(intensity)
    rank = min(BRIGHTEST, len(intensity))
    top = float(np.partition(intensity, -rank)[-rank])
    low, high = (part * top for part in OF_BRIGHTEST)
    if tail > high:
        return Threshold(high, f"auto: {OF_BRIGHTEST[1]:.0%} of the brightest; little stands out")
    if tail < low:
        return Threshold(low, f"auto: {OF_BRIGHTEST[0]:.0%} of the brightest")
    return Threshold(tail, "auto: well above the diffuse returns")


def lower_thresholds(intensity: Array, chosen: Threshold) -> tuple[Threshold, ...]:
    """What to try where a threshold shows too few poles: the cloud's own, and the end of diffuse.

    A sensor's figure is for fresh tape at about 5 m. Old or far tape returns less, and a glint may
    hold the cloud's own threshold above it as well. What was given stays as it is.

    Parameters
    ----------
    intensity
        (N,) of the cloud.
    chosen
        As `threshold_for` gives it.

    Returns
    -------
    tuple of Threshold
        The highest first, all below the chosen one; none for one that was given.
    """
    if chosen.found == GIVEN:
        return ()
    end = Threshold(_end_of_diffuse(intensity), "auto: well above the diffuse returns")
    below: list[Threshold] = []
    for each in (auto_threshold(intensity), end):
        if each.value < (below[-1] if below else chosen).value:
            below.append(each)
    return tuple(below)


def _end_of_diffuse(intensity: Array) -> float:
    median, high = np.quantile(intensity, [0.5, 0.95])
    return float(median + BRIGHT_TAIL * (high - median))


def threshold_for(intensity: Array, sensor: Sensor | None, given: float | None) -> Threshold:
    """Choose the threshold: the one given, else the sensor's, else the cloud's own.

    A sensor's figure is used on the scale the cloud has it: a driver that divides by the full
    scale leaves no intensity above 1.
    """
    if given is not None:
        return Threshold(float(given), GIVEN)
    if sensor is None:
        return auto_threshold(intensity)
    if float(intensity.max()) <= 1.0 < sensor.threshold:
        return Threshold(sensor.threshold / sensor.intensity_max, f"{sensor.name}, scaled to 0–1")
    return Threshold(sensor.threshold, sensor.name)
