"""What is in a recording: its frames, fields and intensities, and which sensor it may be of."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from ..datatypes import Array, IntArray, PointCloud
from ..sensors import SENSORS, Sensor, auto_threshold
from . import FrameHeader, ReadRecording, read_recording, topics_of

BINS = 16
"""Of the histogram of intensities."""

SENSOR_GUESS_SAMPLE = 200_000
"""So many points, evenly taken, tell which sensor it is."""

MIN_RING_POINTS = 20
"""A ring of fewer points has no elevation worth the name."""

WITHIN, PART_OF_STEP = np.radians(0.35), 0.3
"""How far a ring may be from its beam: so much, or this part of the step between beams. Sensors
differ one by one, and near returns show that beams do not start in one point."""

SPREAD = np.radians(0.5)
"""Half of the points of a ring are within this of its elevation, or the cloud was turned."""

ON_BEAM, BEAM_SEPARATION = np.radians(0.1), 4
"""Without rings: how near its beam a point is, for sensors whose beams are so many times that
apart, …"""

MOST = 0.95
"""… and for so many of the points."""

SEEN = 0.5
"""Part of the sensor's beams that must have returns: out of doors the sky gives none."""


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
    """The frames of a file, or of one topic of a bag."""

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
    rings: int | None
    range_m: list[float]
    intensity: IntensityDoc | None
    sensors: list[str]


class InfoDoc(msgspec.Struct, kw_only=True):
    """What is in a recording, as ``retropole info`` says it."""

    schema: Literal["retropole/info/1"] = "retropole/info/1"
    path: str
    topics: list[TopicDoc]
    clouds: list[CloudDoc]


def describe(path: str | Path, *, topic: str | None = None, frames: slice | None = None) -> InfoDoc:
    """Look into a recording.

    Parameters
    ----------
    path
        Whatever `io.read_cloud` reads.
    topic
        Of a bag, the topic to look at; None looks at all of point clouds.
    frames
        Which frames to look at; None takes those that `io.read_cloud` would.

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
    return InfoDoc(
        path=str(path),
        topics=[TopicDoc(own.name, own.kind, own.count) for own in topics],
        clouds=[_cloud(read_recording(path, topic=name, frames=frames)) for name in names],
    )


def _cloud(read: ReadRecording) -> CloudDoc:
    cloud, count = read.cloud, read.recording.count
    rate = _rate(read.headers[0], read.headers[-1])
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
        points=len(cloud),
        dropped=cloud.dropped,
        rings=None if cloud.ring is None else len(np.unique(cloud.ring)),
        range_m=[float(value) for value in np.quantile(ranges, [0, 0.5, 1])],
        intensity=None if cloud.intensity is None else _intensity(cloud.intensity),
        sensors=guess_sensors(cloud),
    )


def _rate(first: FrameHeader, last: FrameHeader) -> float | None:
    """Frames a second between two frames; None where their times do not give it."""
    if first.stamp is None or last.stamp is None or last.stamp <= first.stamp:
        return None
    return (last.number - first.number) / (last.stamp - first.stamp)


def _intensity(intensity: Array) -> IntensityDoc:
    low, high = min(0.0, float(intensity.min())), float(intensity.max())
    counts, edges = np.histogram(intensity, BINS, (low, high if high > low else low + 1))
    # Where all are the same there is no threshold, and extraction refuses.
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
    """Name the sensors of the table whose beams a cloud's points lie on; none where none fits.

    With rings, each ring's elevation is held against the beams; without, all points are, for
    sensors whose beams are far enough apart for that to say something. Sensors with the same beams
    are all named. A cloud that was turned out of its sensor's frame fits none.

    Parameters
    ----------
    cloud
        In the sensor's frame.
    """
    part = cloud.select(np.arange(0, len(cloud), max(1, len(cloud) // SENSOR_GUESS_SAMPLE)))
    ray = part.xyz - part.origin
    ranges = np.linalg.norm(ray, axis=1)
    elevation = np.arcsin(ray[:, 2] / ranges)
    spinning = [sensor for sensor in SENSORS.values() if len(sensor.elevations)]
    if part.ring is not None and np.ptp(part.ring):
        rings = _ring_elevations(elevation, ranges, part.ring)
        fitting = [own for own in spinning if rings and _rings_fit(own, rings)]
    else:
        fitting = [own for own in spinning if _points_fit(own, elevation)]
    return [sensor.name for sensor in fitting]


def _ring_elevations(elevation: Array, ranges: Array, ring: IntArray) -> dict[int, float]:
    """Median elevation of each ring's farther half; none at all where rings have several."""
    elevations: dict[int, float] = {}
    spreads: list[float] = []
    for number in np.unique(ring):
        own, far = elevation[ring == number], ranges[ring == number]
        own = own[far >= np.median(far)]
        if len(own) >= MIN_RING_POINTS:
            elevations[int(number)] = median = float(np.median(own))
            spreads.append(float(np.median(np.abs(own - median))))
    return elevations if spreads and np.median(spreads) <= SPREAD else {}


def _rings_fit(sensor: Sensor, rings: dict[int, float]) -> bool:
    """Whether ring after ring is at its beam, counted from the lowest or the highest, 0 or 1."""
    beams = sensor.elevations
    numbers = np.array(list(rings))
    elevations = np.array(list(rings.values()))
    if len(rings) < SEEN * len(beams):
        return False
    within = max(WITHIN, PART_OF_STEP * float(np.median(np.diff(beams))))
    for first in (0, 1):
        index = numbers - first
        if index.min() < 0 or index.max() >= len(beams):
            continue
        for ordered in (beams, beams[::-1]):
            if np.max(np.abs(elevations - ordered[index])) <= within:
                return True
    return False


def _points_fit(sensor: Sensor, elevation: Array) -> bool:
    beams = sensor.elevations
    if np.diff(beams).min() < BEAM_SEPARATION * ON_BEAM:
        return False
    after = np.clip(np.searchsorted(beams, elevation), 1, len(beams) - 1)
    index = after - (elevation - beams[after - 1] < beams[after] - elevation)
    apart = np.abs(elevation - beams[index])
    on_beam = apart <= ON_BEAM
    return bool(np.mean(on_beam) >= MOST and len(np.unique(index[on_beam])) >= SEEN * len(beams))
