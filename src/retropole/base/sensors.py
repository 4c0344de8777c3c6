"""Sensors by name: their rings, noise and intensity scale, and the threshold for retro tape."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .errors import UsageError
from .se3 import Array

PAPER_SOURCE = "Xue et al. 2019, Table I"


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


def _spinning(
    name: str,
    aliases: tuple[str, ...],
    elevations_deg: Array,
    step_deg: float,
    noise: float,
    divergence_mrad: float,
    limits: tuple[float, float],
    threshold: tuple[float, str],
    source: str,
    full_scale: float = 255.0,
    accuracy: float | None = None,
    retro_accuracy: float | None = None,
) -> Sensor:
    elevations = np.radians(np.sort(elevations_deg))
    return Sensor(
        name=name,
        aliases=aliases,
        elevations=elevations,
        azimuth_step=float(np.radians(step_deg)),
        elevation_span=(float(elevations[0]), float(elevations[-1])),
        pattern="spinning",
        points=len(elevations) * round(360 / step_deg),
        range_noise=noise,
        divergence=divergence_mrad / 1000,
        min_range=limits[0],
        max_range=limits[1],
        intensity_max=full_scale,
        threshold=threshold[0],
        threshold_source=threshold[1],
        source=source,
        range_accuracy=accuracy,
        retro_accuracy=retro_accuracy,
    )


_RS32_DEG = np.concatenate(
    [
        [-25.0, -14.638, -10.281, -7.91, -6.424, -5.407],
        np.linspace(-14 / 3, 5 / 3, 20),
        [7 / 3, 10 / 3, 14 / 3, 7.0, 10.333, 15.0],
    ]
)
_VLP32_DEG = np.concatenate(
    [
        [-25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -14 / 3],
        np.linspace(-4.0, 5 / 3, 18),
        [7 / 3, 10 / 3, 14 / 3, 7.0, 10.333, 15.0],
    ]
)
_PANDAR64_DEG = np.concatenate(
    [
        [-25.0, -19.0],
        np.arange(-14.0, -6.5),
        np.linspace(-6.0, 2.0, 49),
        [3.0, 5.0, 8.0, 11.0, 15.0],
    ]
)

_ALL = (
    _spinning(
        "VLP-16", ("Puck",), np.linspace(-15, 15, 16), 0.2, 0.010, 3.0, (0.5, 100.0),
        (230.0, PAPER_SOURCE), "manufacturer's manual 63-9243: 16 rings 2° apart, ±3 cm",
        accuracy=0.03,
    ),
    _spinning(
        "VLP-32C", ("Ultra Puck",), _VLP32_DEG, 0.2, 0.010, 3.0, (0.5, 200.0),
        (120.0, "manufacturer: diffuse targets end at 100, retro begins at 101"),
        "manufacturer's manual 63-9325: 32 rings, 1/3° apart in the middle, ±3 cm",
        accuracy=0.03,
    ),
    _spinning(
        "HDL-32E", (), np.linspace(-30.67, 10.67, 32), 0.2, 0.010, 2.8, (1.0, 100.0),
        (230.0, PAPER_SOURCE), "manufacturer's manual 63-9113: 32 rings 1.33° apart, ±2 cm",
        accuracy=0.02,
    ),
    _spinning(
        "VLS-128", ("Alpha Prime",), np.linspace(-25, 15, 128), 0.2, 0.010, 3.0, (0.5, 245.0),
        (120.0, "manufacturer: diffuse targets end at 100, retro begins at 101; seen up to 110"),
        "manufacturer's manual 63-9483: 128 rings over 40°; taken as evenly spaced, they are not; "
        "±3 cm",
        accuracy=0.03,
    ),
    _spinning(
        "Pandar64", (), _PANDAR64_DEG, 0.2, 0.010, 2.0, (0.3, 200.0),
        (200.0, PAPER_SOURCE),
        "manufacturer's manual: 1/6° apart from −6° to +2°, 1° to 6° outside; rounded; ±2 cm",
        accuracy=0.02,
    ),
    _spinning(
        "PandarQT", ("QT64",), np.linspace(-52.1, 52.1, 64), 0.6, 0.015, 8.0, (0.1, 60.0),
        (200.0, PAPER_SOURCE),
        "manufacturer's manual: 64 rings over 104.2°; taken as evenly spaced",
    ),
    _spinning(
        "XT32", ("PandarXT-32",), np.linspace(-16, 15, 32), 0.18, 0.005, 1.5, (0.05, 120.0),
        (200.0, PAPER_SOURCE), "manufacturer's manual: 32 rings 1° apart, ±1 cm, 0.5 cm (1 σ)",
        accuracy=0.01,
    ),
    _spinning(
        "RS-LiDAR-16", ("RS16",), np.linspace(-15, 15, 16), 0.2, 0.010, 3.0, (0.4, 150.0),
        (200.0, PAPER_SOURCE), "manufacturer's manual: 16 rings 2° apart, ±2 cm",
        accuracy=0.02,
    ),
    _spinning(
        "RS-LiDAR-32", ("RS32",), _RS32_DEG, 0.2, 0.010, 3.0, (0.4, 200.0),
        (200.0, PAPER_SOURCE), "manufacturer's manual: 32 rings, 1/3° apart in the middle",
    ),
    _spinning(
        "C16", ("Leishen C16", "LS C16"), np.linspace(-15, 15, 16), 0.18, 0.010, 3.0, (0.5, 150.0),
        (200.0, PAPER_SOURCE), "manufacturer's manual: 16 rings 2° apart, ±3 cm",
        accuracy=0.03,
    ),
    _spinning(
        "C32", ("Leishen C32", "LS C32"), np.linspace(-16, 15, 32), 0.18, 0.010, 3.0, (0.5, 150.0),
        (200.0, PAPER_SOURCE), "manufacturer's manual: 32 rings 1° apart, ±3 cm",
        accuracy=0.03,
    ),
    _spinning(
        "OS0", ("OS0-128", "OS-0-128"), np.linspace(-45, 45, 128), 360 / 1024, 0.015, 6.1,
        (0.3, 75.0), (1000.0, "16-bit signal; recordings reach 6,268 on retro-reflectors"),
        "manufacturer's data sheet: 128 rings over 90°, 1024 columns; ±3 cm, ±10 cm on "
        "retro-reflectors", 65535.0, 0.03, 0.10,
    ),
    _spinning(
        "OS1", ("OS1-128", "OS-1-128"), np.linspace(-22.5, 22.5, 128), 360 / 1024, 0.010, 3.1,
        (0.3, 120.0), (1000.0, "16-bit signal; recordings reach 6,268 on retro-reflectors"),
        "manufacturer's data sheet: 128 rings over 45°, 1024 columns; ±3 cm, ±10 cm on "
        "retro-reflectors", 65535.0, 0.03, 0.10,
    ),
    Sensor(
        name="Mid-360",
        aliases=("Livox Mid-360", "MID360"),
        elevations=np.zeros(0),
        azimuth_step=0.0,
        elevation_span=(float(np.radians(-7)), float(np.radians(52))),
        pattern="rosette",
        points=20_000,
        range_noise=0.010,
        divergence=0.004,
        min_range=0.1,
        max_range=70.0,
        intensity_max=255.0,
        threshold=150.0,
        threshold_source="manufacturer's manual: 0–150 diffuse, 151–255 retro-reflective",
        source="manufacturer's manual: 200,000 returns a second, ≤ 2 cm (1 σ) at 10 m",
    ),
)  # fmt: skip

SENSORS: dict[str, Sensor] = {sensor.name: sensor for sensor in _ALL}


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
