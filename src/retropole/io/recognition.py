"""Which sensors of the table a cloud may be from, by the elevations of its rings or points."""

from __future__ import annotations

import numpy as np

from ..base.datatypes import Array, IntArray, PointCloud
from ..base.sensors import SENSORS, Sensor
from .beam_origin import with_beam_origin
from .rings import MAX_RING_SPREAD, elevations

SENSOR_GUESS_SAMPLE = 200_000
"""Points, evenly taken, by which the sensor is recognized: more take time and change nothing."""

MIN_RING_POINTS = 20
"""Rings with fewer points are left out: their median elevation is not reliable, and a few points
may carry a wrong number."""

RING_TOLERANCE, RING_TOLERANCE_OF_STEP = np.radians(0.35), 0.3
"""How far a ring's elevation may be from that of the table, rad, or as a part of the step between
rings, whichever is larger. Units of one model differ, and near returns show that beams do not
start in one point."""

POINT_TOLERANCE, MIN_SEPARATION = np.radians(0.1), 4
"""Without rings: how far a point's elevation may be from that of a ring of the table, rad; for
sensors whose rings are at least this many times as far apart."""

MIN_FITTING_SHARE = 0.95
"""Without rings: share of the points that must be so near a ring."""

MIN_SEEN_SHARE = 0.5
"""Share of the sensor's rings that must have returns: outdoors the sky gives none."""


def guess_sensors(cloud: PointCloud, named: Sensor | None = None) -> list[str]:
    """Name the sensors whose elevations a cloud has; empty where no sensor fits.

    With rings, the elevation of each ring is compared with the table; without, the elevations of
    all points are, for sensors whose rings are far enough apart. Sensors with the same elevations
    are all named. A cloud that was rotated out of its sensor's frame fits none, unless its rings
    tell where it was.

    Parameters
    ----------
    cloud
        In the sensor's frame, or with the origin and the axis of its beams.
    named
        A sensor to try besides those of the table.
    """
    cloud = with_beam_origin(cloud)
    part = cloud.select(np.arange(0, len(cloud), max(1, len(cloud) // SENSOR_GUESS_SAMPLE)))
    ray = part.xyz - part.origin
    ranges, elevation = np.linalg.norm(ray, axis=1), elevations(ray, part.axis)
    known = SENSORS if named is None else {**SENSORS, named.name: named}
    spinning = [sensor for sensor in known.values() if len(sensor.elevations)]
    if part.ring is not None and np.ptp(part.ring):
        rings = _ring_elevations(elevation, ranges, part.ring)
        fitting = [own for own in spinning if rings and _rings_fit(own, rings)]
    else:
        fitting = [own for own in spinning if _points_fit(own, elevation)]
    return [sensor.name for sensor in fitting]


def _ring_elevations(elevation: Array, ranges: Array, ring: IntArray) -> dict[int, float]:
    """Find the median elevation of each ring's farther half, rad.

    Empty where the points of a ring do not share one elevation.
    """
    elevations: dict[int, float] = {}
    spreads: list[float] = []
    order = np.argsort(ring, kind="stable")
    for one in np.split(order, np.flatnonzero(np.diff(ring[order])) + 1):
        far = ranges[one]
        own = elevation[one[far >= np.median(far)]]
        if len(own) >= MIN_RING_POINTS:
            elevations[int(ring[one[0]])] = median = float(np.median(own))
            spreads.append(float(np.median(np.abs(own - median))))
    return elevations if spreads and np.median(spreads) <= MAX_RING_SPREAD else {}


def _rings_fit(sensor: Sensor, rings: dict[int, float]) -> bool:
    """Whether each ring has its elevation, counted from the lowest or highest and from 0 or 1."""
    table = sensor.elevations
    numbers = np.array(list(rings))
    elevations = np.array(list(rings.values()))
    if len(rings) < MIN_SEEN_SHARE * len(table):
        return False
    step = float(np.median(np.diff(table)))
    within = max(RING_TOLERANCE, RING_TOLERANCE_OF_STEP * step)
    return any(
        np.max(np.abs(elevations - ordered[numbers - first])) <= within
        for first in (0, 1)
        if first <= numbers.min() and numbers.max() < len(table) + first
        for ordered in (table, table[::-1])
    )


def _points_fit(sensor: Sensor, elevation: Array) -> bool:
    """Whether most points are at the elevation of a ring, and most rings have points."""
    table = sensor.elevations
    if np.diff(table).min() < MIN_SEPARATION * POINT_TOLERANCE:
        return False
    after = np.clip(np.searchsorted(table, elevation), 1, len(table) - 1)
    index = after - (elevation - table[after - 1] < table[after] - elevation)
    fitting = np.abs(elevation - table[index]) <= POINT_TOLERANCE
    seen = len(np.unique(index[fitting])) / len(table)
    return bool(np.mean(fitting) >= MIN_FITTING_SHARE and seen >= MIN_SEEN_SHARE)
