"""Whether a cloud can be of the sensor that was named: by its rings and by its elevations.

A wrong name gives a wrong threshold, noise and beam width, and so a wrong statement of how certain
the answer is. Only what contradicts the name counts: a cloud may always have fewer rings, and show
less of the field of view, since it was cropped or nothing was there.

Also how a pole looks by the width and step of the beams (docs/evidence/detection.md, Wide beams).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.datatypes import Array, BoolArray, PointCloud, kept
from ..base.errors import Refusal
from ..base.quantities import counted
from ..base.sensors import Sensor
from ..base.systematic import Sizes, sizes_of, spinning
from ..io.beams import (
    BEYOND_VIEW,
    MANY_BEYOND,
    MAX_RING_SPREAD,
    MIN_RING_POINTS,
    RING_SAMPLE,
    azimuth_arc,
    elevations,
    guess_sensors,
    is_wider,
    ring_spread,
)

RMS_PER_RADIUS, DEPTH_PER_RADIUS = 0.62, float(np.pi / 4)
"""Beams evenly spaced across a cylinder scatter by this many radii about their line, which runs
this many in front of the axis."""


ORDINARY_DIVERGENCE = 0.003
"""Full angle of most sensors' beams, rad."""


ORDINARY_NOISE, NOISY = 0.010, 0.015
"""1 σ of the ranges of most sensors, metres, for which the limits are; with up to this much more
they were set, and nothing is granted."""


NEAR_POLES_END = 8.0
"""Limits of scatter were set on poles no farther than this, metres."""


@dataclass(frozen=True)
class Beams:
    """What is known of the beams that hit a line: full angle, rad, and 1 σ of the ranges,
    metres.

    Zero where it is not known: nothing is then granted for it.
    """

    divergence: float = 0.0
    noise: float = 0.0


UNKNOWN = Beams()


def beams_by(sensor: Sensor | None) -> Beams:
    """The beams of a sensor; None if it is not known."""
    return UNKNOWN if sensor is None else Beams(sensor.divergence, sensor.range_noise)


def beam_scatter(distance: float, radius: float, beams: Beams) -> float:
    """Scatter, metres, that wide or noisy beams add to that of returns on a near pole by ordinary
    ones.

    A return lies on the axis of its beam, and a beam whose edge alone hits the pole gives one too:
    the pole looks wider by half a beam on either side. The limits here hold for beams of
    `ORDINARY_DIVERGENCE` up to `NEAR_POLES_END`, and for unknown ones.

    Parameters
    ----------
    distance, radius
        From where the beams start to the pole, and of the pole, metres.
    beams
        That hit it.
    """
    seen = _seen_radius(distance, radius, beams.divergence)
    ordinary = _seen_radius(min(distance, NEAR_POLES_END), radius, ORDINARY_DIVERGENCE)
    wide = RMS_PER_RADIUS**2 * max(seen**2 - ordinary**2, 0.0)
    noisy = beams.noise**2 - ORDINARY_NOISE**2 if beams.noise > NOISY else 0.0
    return float(np.sqrt(wide + noisy))


def _seen_radius(distance: float, radius: float, divergence: float) -> float:
    return radius + distance * divergence / 2


MOST_LINES = 8
"""A LiDAR without rings has no more lasers that its driver may number instead: a Mid-360 has 4."""

MAX_CONE_SPREAD = float(np.radians(0.1))
"""Half of the points of a ring lie within this of one elevation, rad, where a LiDAR turns about one
axis: its rings are cones. Offsets of the lasers from the axis make up to 0.05°, and lines
that a mirror or a lens bends are off by degrees."""

FEWEST_POINTS = 1000
"""Of fewer points without rings none are doubted: a cloud cropped to its poles shows no field of
view."""


def check_sensor(cloud: PointCloud, sensor: Sensor | None) -> None:
    """Refuse a cloud whose rings are not those of the sensor that was named.

    Parameters
    ----------
    cloud
        With valid rings, or none, and the beam origin and axis by them.
    sensor
        What was named; None is any.

    Raises
    ------
    Refusal
        ``wrong_sensor``.
    """
    if sensor is None or cloud.ring is None:
        return
    numbers, counts = np.unique(cloud.ring, return_counts=True)
    rings = numbers[counts >= MIN_RING_POINTS]
    known = sensor.rings
    too_many = {"sensor": sensor.name, "rings": len(rings), "most": known}
    if known and len(rings) > known:
        what = f"{counted(len(rings), 'ring')}, the {sensor.name} has {known}"
        raise _refusal(cloud, what, too_many)
    if len(rings) == 0 or ring_spread(cloud) > MAX_RING_SPREAD:
        return
    if not known and len(rings) > MOST_LINES:
        rings_in_words = f"{counted(len(rings), 'ring')}, each of one elevation"
        raise _refusal(cloud, f"{rings_in_words}, the {sensor.name} has none", too_many)
    part = np.flatnonzero(np.isin(cloud.ring, rings))
    part = part[:: 1 + (len(part) - 1) // RING_SAMPLE]
    ring, elevation = cloud.ring[part], elevations(cloud.xyz[part] - cloud.origin, cloud.axis)
    medians = np.array([np.median(elevation[ring == one]) for one in np.unique(ring)])
    if np.any(_beyond(medians, sensor)):
        low, high = np.degrees([medians.min(), medians.max()])
        raise _refusal(
            cloud,
            f"rings from {low:.1f}° to {high:.1f}°, the {sensor.name} sees from {_span(sensor)}",
            {"sensor": sensor.name, "lowest_deg": float(low), "highest_deg": float(high)},
        )
    if is_wider(cloud, sensor):
        values = {"sensor": sensor.name, "azimuths_deg": float(np.degrees(azimuth_arc(cloud)))}
        raise _refusal(cloud, _wider(cloud, sensor), values)


def error_sizes(cloud: PointCloud, sensor: Sensor | None) -> Sizes:
    """Give the sizes of the errors of the LiDAR that recorded a cloud.

    Of one that was not named and whose rings are cones, scan lines bend as little as of any that
    spins.

    Parameters
    ----------
    cloud
        With valid rings, or none, and the beam origin and axis by them.
    sensor
        What was named; None is any.
    """
    sizes = sizes_of(sensor)
    return spinning(sizes) if sensor is None and _spins(cloud) else sizes


@kept
def _spins(cloud: PointCloud) -> bool:
    """Whether the rings of a cloud are the cones of a LiDAR that turns about one axis."""
    if cloud.ring is None or ring_spread(cloud) > MAX_CONE_SPREAD:
        return False
    return len(np.unique(cloud.ring)) > MOST_LINES


def sensor_doubt(cloud: PointCloud, sensor: Sensor | None) -> str:
    """State why a cloud is probably not of the given sensor; empty if it may be, or if
    `check_sensor` refuses it.

    Its rings are those of another sensor, or without rings it shows more than the sensor sees. No
    proof that the name is wrong: a cloud that was downsampled ring by ring, turned or moved may
    look the same.

    Parameters
    ----------
    cloud, sensor
        As `check_sensor` takes them.
    """
    if sensor is None or len(cloud) == 0:
        return ""
    try:
        check_sensor(cloud, sensor)
    except Refusal:
        return ""
    if ring_spread(cloud) <= MAX_RING_SPREAD:
        fitting = guess_sensors(cloud, sensor)
        if not fitting or sensor.name in fitting:
            return ""
        return (
            f"the rings of {_named(cloud)} are those of {' or '.join(fitting)}, not those of "
            f"{sensor.name}, which was given"
        )
    if len(cloud) < FEWEST_POINTS:
        return ""
    part = slice(None, None, 1 + (len(cloud) - 1) // RING_SAMPLE)
    elevation = elevations(cloud.xyz[part] - cloud.origin, cloud.axis)
    share = float(np.mean(_beyond(elevation, sensor)))
    if share > MANY_BEYOND:
        what = (
            f"{share:.0%} of the points of {_named(cloud)} are outside the field of view of the "
            f"{sensor.name} ({_span(sensor)})"
        )
    elif is_wider(cloud, sensor):
        what = f"{_named(cloud)} has {_wider(cloud, sensor)}"
    else:
        return ""
    return (
        f"{what}: it was recorded by another LiDAR, or its points were rotated or moved since, "
        "so that the origin of the beams is not known"
    )


def _wider(cloud: PointCloud, sensor: Sensor) -> str:
    return (
        f"azimuths over {np.degrees(azimuth_arc(cloud)):.0f}°, the {sensor.name} sees "
        f"{np.degrees(sensor.turn):.0f}°"
    )


def _beyond(elevation: Array, sensor: Sensor) -> BoolArray:
    """Which elevations (N,) a sensor does not see, upright or upside down: those of which fewer
    are.
    """
    low, high = sensor.elevation_span
    upright = (elevation < low - BEYOND_VIEW) | (elevation > high + BEYOND_VIEW)
    downward = (-elevation < low - BEYOND_VIEW) | (-elevation > high + BEYOND_VIEW)
    return upright if np.count_nonzero(upright) <= np.count_nonzero(downward) else downward


def _refusal(cloud: PointCloud, what: str, values: dict[str, Any]) -> Refusal:
    fitting = " or ".join(guess_sensors(cloud))
    advice = f"name the sensor that recorded it{f', {fitting}' if fitting else ''}, or none"
    return Refusal("wrong_sensor", f"{_named(cloud)} has {what}: {advice}", values)


def _span(sensor: Sensor) -> str:
    low, high = np.degrees(sensor.elevation_span)
    return f"{low:.1f}° to {high:.1f}°"


def _named(cloud: PointCloud) -> str:
    return cloud.source or "the cloud"
