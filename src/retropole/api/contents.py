"""What a recording contains: frames, fields, intensities, and which sensors it may be from."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from ..base.datatypes import DEFAULT_RADIUS, Array, PointCloud, Scan
from ..base.files import path_in_text
from ..base.sensors import auto_threshold
from ..io import MAX_POINTS, FrameHeader, ReadRecording, read_recording, topics_of
from ..io.beams import guess_sensors, rings_fault, with_beam_origin, with_trusted_rings
from ..io.coordinates import oddity_of
from ..io.fields import NAMES, Unit, Wanted, intensities_of
from ..io.recordings import clock_offset
from ..result import Reading, document_of
from ..result.contents import CloudDoc, InfoDoc, IntensityDoc, TopicDoc
from ..verdict.similarity import beyond_sensors, unit_of_one

INTENSITY_BINS = 16
"""Bins of the histogram of intensities: what fits a terminal."""


def describe(
    path: str | Path,
    *,
    topic: str | None = None,
    frames: slice | None = None,
    unit: Unit = "m",
    intensity: str | None = None,
    angles: str | None = None,
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
    intensity
        Field that it is read from; None takes the usual one.
    angles
        Of packets, the file of the unit; None takes those of the table.

    Raises
    ------
    ReadError, UsageError, MissingExtraError
        As `io.read_cloud`.
    """
    wanted = Wanted(intensity, angles)
    return look_into(path, Reading(topic=topic, frames=frames, unit=unit, wanted=wanted))[0]


def look_into(path: str | Path, how: Reading) -> tuple[InfoDoc, list[PointCloud]]:
    """Describe a recording as `describe`, and give the clouds that were read."""
    path = Path(path)
    topics = topics_of(path)
    names: list[str | None] = [how.topic]
    if how.topic is None:
        filled = [own for own in topics if own.count]
        names = [own.name for own in filled if own.of_clouds]
        names = names or [own.name for own in filled if own.of_packets] or [None]
    read = partial(read_recording, path, frames=how.frames, max_points=MAX_POINTS, unit=how.unit)
    found = [read(topic=name, wanted=how.wanted) for name in names]
    document = InfoDoc(
        path=path_in_text(path),
        topics=[TopicDoc(own.name, own.kind, own.count) for own in topics],
        clouds=[_cloud(each, how.wanted.intensity) for each in found],
    )
    return document, [each.cloud for each in found]


def _cloud(read: ReadRecording, named: str | None) -> CloudDoc:
    given, count = read.cloud, read.recording.count
    cloud = with_beam_origin(with_trusted_rings(given))
    rate = _rate(read.headers[0], read.headers[-1])
    odd = oddity_of(cloud)
    oddity, units = ("", ()) if odd is None else (odd.text, odd.units)
    shown = None if odd is not None and odd.is_map else unit_of_one(cloud, DEFAULT_RADIUS)
    if shown is not None:
        units = (shown[0],)
        oddity = _in_unit(*shown, oddity or _beyond(cloud))
    ranges = np.linalg.norm(cloud.xyz - cloud.origin, axis=1)
    return document_of(
        CloudDoc,
        read.recording,
        cloud,
        frame_id=read.headers[0].frame_id or None,
        frames=count,
        frames_read=len(read.numbers),
        step=read.numbers.step,
        rate_hz=rate,
        duration_s=None if rate is None else (count - 1) / rate,
        points=len(cloud) + cloud.thinned,
        rings=None if given.ring is None else len(np.unique(given.ring)),
        rings_ignored=rings_fault(given),
        beam_origin_m=cloud.origin.tolist(),
        told_by_rings=cloud is not given and cloud.ring is not None,
        range_m=np.quantile(ranges, [0, 0.5, 1]).tolist(),
        intensity=None
        if cloud.intensity is None
        else _intensity(cloud.intensity, intensities_of(given.fields), named),
        sensors=[cloud.model] if cloud.model else guess_sensors(cloud),
        odd_coordinates=oddity,
        units=list(units),
        clock_offset_s=clock_offset(read.headers),
    )


def _beyond(cloud: PointCloud) -> str:
    """Report that a cloud reaches farther than its sensor."""
    sensors = " or ".join(guess_sensors(cloud))
    return (
        f"1 % of the points are beyond {beyond_sensors(cloud):g} m, farther than a {sensors} sees"
    )


def _in_unit(unit: Unit, scan: Scan, odd: str) -> str:
    """State in which unit a cloud shows poles, after the description of its odd ranges."""
    return (
        f"{odd}; read as {NAMES[unit]} it shows {len(scan.poles)} poles of radius "
        f"{DEFAULT_RADIUS:g} m, in metres none"
    )


def _rate(first: FrameHeader, last: FrameHeader) -> float | None:
    """Frames a second between two frames; None if their times do not give it."""
    if first.stamp is None or last.stamp is None or last.stamp <= first.stamp:
        return None
    return (last.number - first.number) / (last.stamp - first.stamp)


def _intensity(intensity: Array, fields: list[str], named: str | None) -> IntensityDoc:
    """Describe intensities, and which of several fields they are of: the named or the first."""
    field = named or next(iter(fields), "")
    low, high = min(0.0, float(intensity.min())), float(intensity.max())
    counts, edges = np.histogram(intensity, INTENSITY_BINS, (low, high if high > low else low + 1))
    # Where all intensities are the same there is no threshold, and extraction refuses the cloud.
    threshold = auto_threshold(intensity) if np.ptp(intensity) > 0 else None
    median, p95 = np.quantile(intensity, [0.5, 0.95])
    return IntensityDoc(
        median=float(median),
        p95=float(p95),
        max=high,
        bin_edges=edges.tolist(),
        counts=counts.tolist(),
        threshold=threshold.value if threshold else None,
        threshold_source=threshold.found if threshold else "none: all intensities are the same",
        field=field,
        others=[name for name in fields if name != field],
        retro_points=int(np.count_nonzero(intensity >= threshold.value)) if threshold else 0,
    )
