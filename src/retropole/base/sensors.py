"""Sensors by name: their rings, noise and intensity scale, and the threshold for retro tape."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from .errors import UsageError, said
from .se3 import Array


@dataclass(frozen=True, eq=False)
class Sensor:
    """Data of a LiDAR model.

    Attributes
    ----------
    name
        Its name for users; case, blanks and dashes are ignored.
    aliases
        Other names of the same model.
    elevations
        (B,) rad, one ring each, from the lowest up; empty for a sensor without rings.
    azimuth_step
        Between two firings of a ring at 10 Hz, rad.
    elevation_span
        Lowest and highest elevation, rad.
    azimuth_span
        First and last azimuth of the field of view, rad, about the z axis from x; a turn for most.
    pattern
        ``spinning`` if a line of beams for each ring is swept over the azimuths, or ``rosette``
        for scans that do not repeat.
    rise
        (K,) how much higher than `elevations` the lines are, rad, at azimuths spaced evenly over
        the field of view; empty if they are straight.
    is_numbered
        Whether drivers number the lines, as rings.
    is_round
        Whether the field of view is an ellipse, as two prisms sweep it.
    points
        Maximum number of returns of one sweep.
    range_noise
        1 σ along the beam, metres.
    divergence
        Full angle of the beam, rad.
    min_range, max_range
        Metres.
    intensity_max
        Full scale of the intensity.
    threshold
        Intensity from which a return at about 5 m is treated as retro-reflective.
    retro_from
        Intensity that no diffuse surface exceeds at any range, by its maker; `threshold` if that
        is not known, and 0 if intensities are raw signal, which falls with the range.
    threshold_source, source
        Sources of the threshold and of the other figures.
    range_accuracy, retro_accuracy
        The manufacturer's figure for the range, ± metres, and for that of retro-reflectors; None
        if not stated.
    errors
        1 σ of the systematic errors of this instrument, by the names of `systematic.Sizes`;
        empty if nobody measured them.
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
    errors: Mapping[str, float] = field(default_factory=dict)
    azimuth_span: tuple[float, float] = (0.0, 2 * np.pi)
    rise: Array = field(default_factory=lambda: np.zeros(0))
    is_numbered: bool = True
    is_round: bool = False
    retro_from: float = np.inf

    @property
    def turn(self) -> float:
        """Width of the field of view in azimuth, rad."""
        return self.azimuth_span[1] - self.azimuth_span[0]

    @property
    def sees_all_around(self) -> bool:
        """Whether its field of view is a full turn."""
        return self.turn > 2 * np.pi - 1e-6

    @property
    def rings(self) -> int:
        """Maximum number of rings of its clouds; 0 if none are numbered."""
        return len(self.elevations) if self.is_numbered else 0

    @property
    def sweeps(self) -> int:
        """Number of sweeps equivalent to one of a LiDAR whose lines repeat: the spacing of evenly
        spread beams is then `DENSE`.
        """
        if self.pattern == "spinning":
            return 1
        low, high = np.sin(self.elevation_span)
        view = self.turn * (high - low) * (np.pi / 4 if self.is_round else 1.0)
        return int(np.ceil(view / (DENSE**2 * self.points)))

    @property
    def seconds(self) -> float:
        """Minimum duration of a recording, s: `sweeps`, rounded up to half a second."""
        return float(np.ceil(2 * self.sweeps * SWEEP_SECONDS) / 2)

    def risen(self, azimuth: Array) -> Array:
        """Rise of the lines above their elevation at azimuths (N,), rad."""
        if not len(self.rise):
            return np.zeros_like(azimuth)
        low = self.azimuth_span[0]
        at = np.linspace(0, self.turn, len(self.rise))
        return np.interp((azimuth - low) % (2 * np.pi), at, self.rise)

    def has_in_view(self, rays: Array, margin: Array | float = 0.0) -> NDArray[np.bool_]:
        """Which directions (N, 3) are in its azimuths, farther from their ends than a margin.

        Parameters
        ----------
        rays
            (N, 3) in the sensor's frame, of any length.
        margin
            (N,) rad, negative to allow as much beyond.
        """
        if self.sees_all_around:
            return np.ones(len(rays), dtype=bool)
        middle = np.mean(self.azimuth_span)
        off = np.arctan2(rays[:, 1], rays[:, 0]) - middle
        off = np.abs((off + np.pi) % (2 * np.pi) - np.pi)
        half = np.full(len(rays), self.turn / 2)
        if self.is_round:
            low, high = self.elevation_span
            up = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
            half *= np.sqrt(np.clip(1 - ((2 * up - low - high) / (high - low)) ** 2, 0, 1))
        return np.asarray(off + margin <= half)


SWEEP_SECONDS = 0.1
"""Time of one sweep: LiDARs run at 10 Hz by default."""

DENSE = float(np.radians(0.3))
"""Of beams spread evenly, rad: as many to a solid angle as 32 rings at a spacing of 1° have within
0.1°, or at 0.5° every 0.2°."""

Size = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class ListedErrors(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """1 σ of the systematic errors of an instrument, as a file has them; all may be left out."""

    zero_m: Size | None = None
    scale: Size | None = None
    slant_deg: Size | None = None
    encoder_deg: Size | None = None
    wobble_deg: Size | None = None
    bend_deg: Size | None = None
    elevation_deg: Size | None = None
    tape_m: Size | None = None
    ring_range_m: Size | None = None
    ring_elevation_deg: Size | None = None
    ring_azimuth_deg: Size | None = None
    width: Size | None = None

    def sizes(self) -> dict[str, float]:
        """Give those that are there, in SI units and by the names of `systematic.Sizes`."""
        given = msgspec.to_builtins(self)
        return {
            name.removesuffix("_deg").removesuffix("_m"): (
                float(np.radians(value)) if name.endswith("_deg") else value
            )
            for name, value in given.items()
        }


class Listed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of a model in ``sensors.toml``, which states the units."""

    noise_m: float
    divergence_mrad: float
    range_m: tuple[float, float]
    threshold: float
    threshold_source: str
    source: str
    aliases: tuple[str, ...] = ()
    elevations_deg: tuple[float | tuple[float, float, int], ...] = ()
    azimuth_step_deg: float = 0.0
    rosette_deg: tuple[float, float] | None = None
    points: int = 0
    full_scale: float = 255.0
    accuracy_m: float | None = None
    retro_accuracy_m: float | None = None
    errors: ListedErrors = ListedErrors()
    azimuth_deg: tuple[float, float] = (0.0, 360.0)
    rise_deg: tuple[float, ...] = ()
    numbered: bool = True
    round: bool = False
    retro_from: float | None = None

    def __post_init__(self) -> None:
        """Refuse values that no LiDAR has; `msgspec` reports the place."""
        near, far = self.range_m
        positive = (self.noise_m, self.divergence_mrad, near, far - near, self.full_scale)
        if not all(0.0 < value < np.inf for value in (*positive, self.threshold)):
            raise ValueError("noise, divergence, ranges, threshold and full scale are above zero")
        if not 0.0 <= (self.retro_from or 0.0) < np.inf:
            raise ValueError("retro_from is an intensity, not below zero")
        counts = [each[2] if isinstance(each, tuple) else 1 for each in self.elevations_deg]
        has_rings = sum(counts) <= 1024 and 0.0 < self.azimuth_step_deg <= 180.0
        if not (self.points > 0 if self.rosette_deg else has_rings and min(counts, default=0) > 0):
            raise ValueError(
                "expected elevations_deg and azimuth_step_deg, or rosette_deg and points"
            )
        if not (np.abs([*self._rings(), *(self.rosette_deg or ())]) <= 90.0).all():
            raise ValueError("elevations_deg and rosette_deg must be within 90° of the horizon")
        first, last = self.azimuth_deg
        if not (-360.0 <= first < last <= 360.0 and last - first <= 360.0):
            raise ValueError("azimuth_deg is the first and the last azimuth, over at most one turn")
        if self.round and not self.rosette_deg:
            raise ValueError("round is the field of a rosette")
        if not all(abs(rise) <= 45.0 for rise in self.rise_deg) or (
            self.rise_deg and self.rosette_deg
        ):
            raise ValueError("rise_deg is how much higher scan lines are, 45° at most")

    def _rings(self) -> list[float]:
        """Elevations of single rings, in degrees."""
        each = self.elevations_deg
        return [e for one in each for e in (np.linspace(*one) if isinstance(one, tuple) else [one])]

    def sensor(self, name: str) -> Sensor:
        """Make the sensor with its name, in SI units."""
        elevations = np.radians(np.sort(self._rings()))
        rise = np.radians(self.rise_deg)
        span = np.radians(self.rosette_deg) if self.rosette_deg else elevations[[0, -1]]
        span = span + np.array([rise.min(initial=0.0), rise.max(initial=0.0)])
        first, last = np.radians(self.azimuth_deg)
        columns = round((last - first) / float(np.radians(self.azimuth_step_deg or 360.0)))
        return Sensor(
            name=name,
            aliases=self.aliases,
            elevations=elevations,
            azimuth_step=float(np.radians(self.azimuth_step_deg)),
            elevation_span=(float(span[0]), float(span[1])),
            pattern="rosette" if self.rosette_deg else "spinning",
            points=self.points or len(elevations) * columns,
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
            errors=self.errors.sizes(),
            azimuth_span=(float(first), float(last)),
            rise=rise,
            is_numbered=self.numbered,
            is_round=self.round,
            retro_from=self.threshold if self.retro_from is None else self.retro_from,
        )


_TABLE: dict[str, dict[str, Any]] = tomllib.loads(
    files("retropole.base").joinpath("sensors.toml").read_text(encoding="utf-8")
)

SENSORS: dict[str, Sensor] = {
    name: each.sensor(name)
    for name, each in msgspec.convert(_TABLE, type=dict[str, Listed]).items()
}


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def find_sensor(name: str) -> Sensor:
    """Find a sensor by its name or an alias, or in a custom file.

    Parameters
    ----------
    name
        Case, blanks and dashes are ignored; or the path of a TOML file, as `read_sensor` reads it.

    Raises
    ------
    UsageError
        If no sensor has that name; lists the known ones. As `read_sensor` does.
    """
    if is_sensor_file(name):
        return read_sensor(Path(name))
    for sensor in SENSORS.values():
        if _plain(name) in {_plain(known) for known in (sensor.name, *sensor.aliases)}:
            return sensor
    raise UsageError(
        f"no sensor is named {name!r}; there are {', '.join(SENSORS)}, auto for any other, or "
        f"a {SENSOR_FILE} file with your description"
    )


SENSOR_FILE = ".toml"
"""Suffix of a file that describes a sensor."""


def is_sensor_file(name: str) -> bool:
    """Whether a sensor is named by a file that describes it."""
    return name.lower().endswith(SENSOR_FILE)


def name_from(folder: Path, name: str) -> str:
    """Give the name of a sensor so that it is valid from any folder: a file by its path."""
    return str((folder / name).resolve()) if is_sensor_file(name) else name


def read_sensor(path: Path) -> Sensor:
    """Read the TOML file of one LiDAR.

    Its keys are those of a model in ``sensors.toml``. With ``like`` it names a model of the table,
    which gives all values that the file does not state. ``[errors]`` has the 1 σ of the
    measured systematic errors of this LiDAR; values not in it are those of the model.

    Raises
    ------
    UsageError
        If there is no such file, or its content is not valid.
    """
    try:
        given = tomllib.loads(path.read_text(encoding="utf-8"))
        like = given.pop("like", None)
        # Only a model of the table: files could refer to each other without end.
        model = "" if like is None else find_sensor(str(like).removesuffix(SENSOR_FILE)).name
        listed = msgspec.convert({**_TABLE.get(model, {}), "aliases": (), **given}, Listed)
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: not a description of a sensor: {said(error)}") from error
    return listed.sensor(str(path))


def sensor_or_auto(name: str) -> Sensor | None:
    """Find a sensor as `find_sensor` does; None for ``auto``, which means any."""
    return None if name == "auto" else find_sensor(name)


@dataclass(frozen=True)
class Threshold:
    """Intensity from which a return is treated as retro-reflective, and how it was found.

    ``value`` applies up to `TAPE_RANGE`. Beyond it the threshold falls as the signal of tape may,
    with the square of the range, to ``least``; None if it applies at any range.
    """

    value: float
    found: str
    least: float | None = None

    def at(self, ranges: Array) -> Array:
        """Threshold (N,) of returns from some ranges (N,), metres."""
        if self.least is None:
            return np.full(len(ranges), self.value)
        falling = self.value * (TAPE_RANGE / np.maximum(ranges, TAPE_RANGE)) ** 2
        return np.maximum(falling, self.least)


TAPE_RANGE = 5.0
"""The table's thresholds are for tape at about this range, metres."""


LITTLE = "few returns are conspicuous"
"""End of the description of a threshold among the diffuse returns: none is much brighter."""

GIVEN = "given"
"""Description of a threshold given by the user."""

OF_BRIGHTEST = (0.55, 0.78)
"""The threshold is between these parts of the brightest returns (140 and 200 of 255)."""

BOTTOM = 0.01
"""Share of the returns that may be below the bottom of the scale."""


def auto_threshold(intensity: Array) -> Threshold:
    """Find the threshold from the cloud itself, on any scale.

    Most returns are diffuse. Their median and 95th percentile show where they end; tape is well
    above. A threshold that is too low costs little, since a pole is identified by its shape, so
    that if much of the scene saturates the threshold stays below the brightest returns.

    Parameters
    ----------
    intensity
        (N,) on a scale of 0–1, 8 bit, 16 bit or any other, as Leica's from -2048 up: parts of the
        brightest are relative to zero, or to the bottom of the scale if that is lower.
    """
    tail = _end_of_diffuse(intensity)
    # The sixth brightest return is used as the brightest: a single glint gives no information
    # about the scale.
    rank = min(6, len(intensity))
    top = float(np.partition(intensity, -rank)[-rank])
    # A few returns may have -1, or less, instead of an intensity.
    bottom = min(0.0, float(np.quantile(intensity, BOTTOM)))
    low, high = (bottom + part * (top - bottom) for part in OF_BRIGHTEST)
    if tail > high:
        return Threshold(high, f"auto: {OF_BRIGHTEST[1]:.0%} of the brightest; {LITTLE}")
    if tail < low:
        return Threshold(low, f"auto: {OF_BRIGHTEST[0]:.0%} of the brightest")
    return Threshold(tail, "auto: well above the diffuse returns")


def lower_thresholds(intensity: Array, chosen: Threshold) -> tuple[Threshold, ...]:
    """Thresholds to try if one shows too few poles: that of the cloud, and the end of the diffuse
    returns.

    A sensor's figure is for fresh tape at about 5 m. Old or far tape returns less, and because of a
    glint the cloud's threshold may be above it as well. A given threshold is kept.

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
    # This many times the spread of the diffuse returns above their median.
    return float(median + 2.5 * (high - median))


def threshold_for(
    intensity: Array, ranges: Array, sensor: Sensor | None, given: float | None
) -> Threshold:
    """Choose the threshold: the one given, else the sensor's, else the cloud's.

    A sensor's figure is used on the scale of the cloud: after division by the full scale in a
    driver no intensity is above 1. It falls with the range as long as all diffuse returns are
    below it: those that the sensor's maker states, and those of the cloud beyond `TAPE_RANGE`.

    Parameters
    ----------
    intensity, ranges
        (N,) of the cloud; ranges from the beam origin, metres.
    sensor, given
        The sensor, and the threshold of the user; None if either is not known.
    """
    if given is not None:
        return Threshold(float(given), GIVEN)
    if sensor is None:
        return auto_threshold(intensity)
    is_scaled = float(intensity.max()) <= 1.0 < sensor.threshold
    scale = 1 / sensor.intensity_max if is_scaled else 1.0
    value, found = scale * sensor.threshold, sensor.name + ", scaled to 0–1" * is_scaled
    far = intensity[ranges > TAPE_RANGE]
    least = max(scale * sensor.retro_from, _end_of_diffuse(far) if len(far) else np.inf)
    if least >= value:
        return Threshold(value, found)
    end = TAPE_RANGE * np.sqrt(value / max(least, 1e-9))
    return Threshold(
        value, f"{found}; falls to {least:.3g} from {TAPE_RANGE:g} to {end:.3g} m", least
    )
