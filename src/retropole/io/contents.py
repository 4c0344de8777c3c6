"""What a recording contains: frames, fields, intensities, and which sensors it may be from."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from ..base.datatypes import Array, IntArray, PointCloud
from ..base.files import path_in_text
from ..base.sensors import SENSORS, Sensor, auto_threshold
from . import MAX_POINTS, FrameHeader, ReadRecording, read_recording, topics_of
from .beam_origin import with_beam_origin
from .coordinates import oddity_of
from .rings import MAX_RING_SPREAD, elevations, rings_fault, with_trusted_rings
from .units import Unit

INTENSITY_BINS = 16
"""Bins of the histogram of intensities: what fits a terminal."""

SENSOR_GUESS_SAMPLE = 200_000
"""Points, evenly taken, by which the sensor is recognized: more take time and change nothing."""

MIN_RING_POINTS = 20
"""Rings with fewer points are left out: their median elevation is not reliable."""

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


class TopicDoc(msgspec.Struct):
    """A topic of a bag."""

    name: str
    type: str
    messages: int


class IntensityDoc(msgspec.Struct):
    """Intensities: quantiles, a histogram over even bins, and where retro-reflectors may begin."""

    median: float
    p95: float
    max: float
    bin_edges: list[float]
    counts: list[int]
    threshold: float | None
    threshold_source: str
    retro_points: int


class CloudDoc(msgspec.Struct):
    """The frames of a file, or of one topic of a bag; why its rings are ignored, or nothing.

    `beam_origin_m` is where the beams start, and `told_by_rings` whether that is not from the file.
    `odd_coordinates` says why the coordinates cannot be metres about the LiDAR, and `units` which
    units would explain it.
    """

    topic: str | None
    frame_id: str | None
    frames: int
    frames_read: int
    step: int
    rate_hz: float | None
    duration_s: float | None
    fields: dict[str, str]
    points: int
    dropped: int
    notes: list[str]
    rings: int | None
    rings_ignored: str
    beam_origin_m: list[float]
    told_by_rings: bool
    range_m: list[float]
    intensity: IntensityDoc | None
    sensors: list[str]
    odd_coordinates: str
    units: list[str]


class InfoDoc(msgspec.Struct, kw_only=True):
    """What a recording contains, as ``retropole info`` prints it."""

    schema: Literal["retropole/info/1"] = "retropole/info/1"
    path: str
    topics: list[TopicDoc]
    clouds: list[CloudDoc]


def describe(
    path: str | Path,
    *,
    topic: str | None = None,
    frames: slice | None = None,
    unit: Unit = "m",
) -> InfoDoc:
    """Describe a recording without calibrating anything.

    Parameters
    ----------
    path
        Whatever `io.read_cloud` reads.
    topic
        Of a bag, the topic to describe; None takes every topic of point clouds.
    frames
        The frames to read; None takes those that `io.read_cloud` would.
    unit
        Of the coordinates.

    Raises
    ------
    ReadError, UsageError, MissingExtraError
        As `io.read_cloud`.
    """
    path = Path(path)
    topics = topics_of(path)
    names: list[str | None] = [topic]
    if topic is None:
        names = [own.name for own in topics if own.of_clouds and own.count] or [None]
    read = partial(read_recording, path, frames=frames, max_points=MAX_POINTS, unit=unit)
    return InfoDoc(
        path=path_in_text(path),
        topics=[TopicDoc(own.name, own.kind, own.count) for own in topics],
        clouds=[_cloud(read(topic=name)) for name in names],
    )


def _cloud(read: ReadRecording) -> CloudDoc:
    given, count = read.cloud, read.recording.count
    cloud = with_beam_origin(with_trusted_rings(given))
    rate = _rate(read.headers[0], read.headers[-1])
    odd = oddity_of(cloud)
    ranges = np.linalg.norm(cloud.xyz - cloud.origin, axis=1)
    return CloudDoc(
        topic=read.recording.topic,
        frame_id=read.headers[0].frame_id or None,
        frames=count,
        frames_read=len(read.numbers),
        step=read.numbers.step,
        rate_hz=rate,
        duration_s=None if rate is None else (count - 1) / rate,
        fields=dict(cloud.fields),
        points=len(cloud) + cloud.thinned,
        dropped=cloud.dropped,
        notes=list(cloud.notes),
        rings=None if given.ring is None else len(np.unique(given.ring)),
        rings_ignored=rings_fault(given),
        beam_origin_m=cloud.origin.tolist(),
        told_by_rings=cloud is not given and cloud.ring is not None,
        range_m=[float(value) for value in np.quantile(ranges, [0, 0.5, 1])],
        intensity=None if cloud.intensity is None else _intensity(cloud.intensity),
        sensors=guess_sensors(cloud),
        odd_coordinates="" if odd is None else odd.words,
        units=[] if odd is None else list(odd.units),
    )


def _rate(first: FrameHeader, last: FrameHeader) -> float | None:
    """Frames a second between two frames; None where their times do not give it."""
    if first.stamp is None or last.stamp is None or last.stamp <= first.stamp:
        return None
    return (last.number - first.number) / (last.stamp - first.stamp)


def _intensity(intensity: Array) -> IntensityDoc:
    low, high = min(0.0, float(intensity.min())), float(intensity.max())
    counts, edges = np.histogram(intensity, INTENSITY_BINS, (low, high if high > low else low + 1))
    # Where all intensities are the same there is no threshold, and extraction refuses the cloud.
    threshold = auto_threshold(intensity) if np.ptp(intensity) > 0 else None
    median, p95 = np.quantile(intensity, [0.5, 0.95])
    return IntensityDoc(
        median=float(median),
        p95=float(p95),
        max=high,
        bin_edges=[float(edge) for edge in edges],
        counts=[int(count) for count in counts],
        threshold=threshold.value if threshold else None,
        threshold_source=threshold.found if threshold else "none: all intensities are the same",
        retro_points=int(np.count_nonzero(intensity >= threshold.value)) if threshold else 0,
    )


def guess_sensors(cloud: PointCloud) -> list[str]:
    """Name the sensors of the table whose elevations a cloud has; empty where no sensor fits.

    With rings, the elevation of each ring is compared with the table; without, the elevations of
    all points are, for sensors whose rings are far enough apart. Sensors with the same elevations
    are all named. A cloud that was rotated out of its sensor's frame fits none, unless its rings
    tell where it was.

    Parameters
    ----------
    cloud
        In the sensor's frame, or with the origin and the axis of its beams.
    """
    cloud = with_beam_origin(cloud)
    part = cloud.select(np.arange(0, len(cloud), max(1, len(cloud) // SENSOR_GUESS_SAMPLE)))
    ray = part.xyz - part.origin
    ranges, elevation = np.linalg.norm(ray, axis=1), elevations(ray, part.axis)
    spinning = [sensor for sensor in SENSORS.values() if len(sensor.elevations)]
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
    for number in np.unique(ring):
        own, far = elevation[ring == number], ranges[ring == number]
        own = own[far >= np.median(far)]
        if len(own) >= MIN_RING_POINTS:
            elevations[int(number)] = median = float(np.median(own))
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
    for first in (0, 1):
        index = numbers - first
        if index.min() < 0 or index.max() >= len(table):
            continue
        for ordered in (table, table[::-1]):
            if np.max(np.abs(elevations - ordered[index])) <= within:
                return True
    return False


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
