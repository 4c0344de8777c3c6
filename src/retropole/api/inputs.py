"""From what a user gives, a path, an array or a cloud, to a cloud and its entry in the result."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import MAX_RADIUS, MIN_RADIUS, PER_POINT, PointCloud
from ..base.errors import ReadError, Refusal, UsageError
from ..base.files import path_in_text
from ..base.quantities import counted
from ..base.sensors import Sensor, sensor_or_auto
from ..io import (
    ARRAY_SOURCE,
    MAX_POINTS,
    ReadRecording,
    cloud_from_array,
    only_returns,
    read_recording,
    sha256_of,
    thinned,
)
from ..io.units import Unit, in_metres, unit_named
from ..result import InputDoc, RunConfig
from ..scene.copies import what_to_give

CloudSource = str | Path | PointCloud | NDArray[Any]
"""What gives a cloud: a path that `io.read_cloud` reads, a cloud, or an array (N, 3) or (N, 4) of
x, y, z and intensity."""


@dataclass(frozen=True, eq=False)
class Input:
    """A cloud, and what it was made of.

    Attributes
    ----------
    given
        The path, the cloud or the array.
    cloud
        The points, in the sensor's own frame.
    sensor
        What recorded it; None where not known.
    threshold
        Intensity from which a return counts as retro-reflective; None where none was given.
    read
        Of a path, what was read there.
    """

    given: CloudSource
    cloud: PointCloud
    sensor: Sensor | None
    threshold: float | None
    read: ReadRecording | None = None

    @property
    def name(self) -> str:
        """The path; of a cloud or an array, what its source is called."""
        if isinstance(self.given, str | Path):
            return str(self.given)
        return self.cloud.source or ARRAY_SOURCE

    @property
    def topic(self) -> str | None:
        """Of a bag, the topic that was read."""
        return None if self.read is None else self.read.recording.topic


class InputPair(NamedTuple):
    """Target and source of one placement of the poles."""

    target: Input
    source: Input


def check_radius(radius: float) -> None:
    """Refuse a radius, metres, that no taped pole has.

    Raises
    ------
    UsageError
        With what is expected.
    """
    if not MIN_RADIUS <= radius <= MAX_RADIUS:
        raise UsageError(
            f"radius is {radius}, expected a number from {MIN_RADIUS:g} to {MAX_RADIUS:g} m: half "
            "the thickness of the poles"
        )


def read_input(
    given: CloudSource,
    *,
    sensor: str = "auto",
    threshold: float | None = None,
    topic: str | None = None,
    frames: slice | None = None,
    max_points: int = MAX_POINTS,
    unit: Unit = "m",
    role: str = "cloud",
    progress: Callable[[str], None] = lambda step: None,
) -> Input:
    """Take a cloud as the user gives it, and look up its sensor.

    Parameters
    ----------
    given
        A path, a cloud or an array. Points of any of them that are not finite or at zero range are
        dropped and counted.
    sensor
        Name of the sensor, or ``auto``.
    threshold
        Intensity from which a return counts as retro-reflective; None to find it.
    topic, frames
        Of a recording, the topic of a bag and the frames, as `io.read_cloud` takes them.
    max_points
        Of a cloud with more, so many are kept, as `io.read_cloud` does.
    unit
        Of the coordinates, of a path, a cloud or an array: ``m``, ``cm`` or ``mm``.
    role
        What messages call it: ``target``.
    progress
        Called as each of several frames is about to be read, with which of how many it is.

    Raises
    ------
    UsageError
        For an unknown sensor or unit, for an array of another shape, for anything else than these
        three, and where a topic or frames are named of what is no file.
    ReadError, MissingExtraError
        As `io.read_cloud`.
    """
    known, unit = sensor_or_auto(sensor), unit_named(unit)
    if isinstance(given, str | Path):
        read = read_recording(
            given, topic=topic, frames=frames, max_points=max_points, unit=unit, progress=progress
        )
        return Input(given, read.cloud, known, threshold, read)
    if not isinstance(given, PointCloud) and not hasattr(given, "__array__"):
        raise UsageError(
            f"{role}: of type {type(given).__name__}, expected a path, a PointCloud, or an array "
            "of shape (N, 3) or (N, 4)"
        )
    if topic is not None or frames is not None:
        raise UsageError(f"{role}: a topic or frames can be chosen in a file, not in an array")
    if isinstance(given, PointCloud):
        returns = in_metres(only_returns(given, role), unit)
        return Input(given, thinned(returns, max_points), known, threshold)
    array = np.asarray(given)
    cloud = in_metres(cloud_from_array(array, role), unit)
    return Input(array, thinned(cloud, max_points), known, threshold)


def read_placements(
    target: CloudSource | Sequence[CloudSource],
    source: CloudSource | Sequence[CloudSource],
    config: RunConfig,
    progress: Callable[[str], None] = lambda step: None,
) -> tuple[InputPair, ...]:
    """Take the target and the source of every placement, with the options of a run.

    Raises
    ------
    UsageError
        Where the numbers of targets and sources differ or are 0, and as `read_input`.
    ReadError, MissingExtraError
        As `read_input`.
    """
    targets, sources = _each(target), _each(source)
    if len(targets) != len(sources) or not targets:
        raise UsageError(
            f"{counted(len(targets), 'target')} and {counted(len(sources), 'source')} are "
            f"given, expected one of each "
            "for every placement"
        )
    frames = None if config.frames is None else slice(*config.frames)
    pairs = []
    for k, (of_target, of_source) in enumerate(zip(targets, sources, strict=True), 1):
        which = f" of placement {k}" if len(targets) > 1 else ""
        pair = InputPair(
            read_input(
                of_target,
                sensor=config.sensor_target,
                threshold=config.threshold_target,
                topic=config.target_topic,
                frames=frames,
                max_points=config.max_points,
                unit=config.unit,
                role=f"target{which}",
                progress=progress,
            ),
            read_input(
                of_source,
                sensor=config.sensor_source,
                threshold=config.threshold_source,
                topic=config.source_topic,
                frames=frames,
                max_points=config.max_points,
                unit=config.source_unit,
                role=f"source{which}",
                progress=progress,
            ),
        )
        pairs.append(pair)
    return tuple(pairs)


def _each(given: CloudSource | Sequence[CloudSource]) -> Sequence[CloudSource]:
    if isinstance(given, str) or not isinstance(given, Sequence):
        return [given]
    return given


def input_documents(inputs: Iterable[Input]) -> list[InputDoc]:
    """Write the entries of clouds in the result document; each file is hashed once."""
    hash_of = cache(sha256_of)
    return [
        InputDoc(
            path=path_in_text(each.name),
            sha256=hash_of(each.name) if each.read else _hash_of_arrays(each.given),
            points=len(each.cloud),
            dropped=each.cloud.dropped,
            thinned=each.cloud.thinned,
            frames_left_out=0 if each.read is None else each.read.left_out,
            sensor="auto" if each.sensor is None else each.sensor.name,
            threshold=each.threshold,
            notes=list(each.cloud.notes),
        )
        for each in inputs
    ]


def recording_hash(path: Path) -> str:
    """SHA-256 of a recording, as the result document has it; it is not read as one.

    Raises
    ------
    ReadError
        Where it cannot be read, or is neither a file nor a folder: to open a pipe waits for whoever
        writes to it.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise ReadError(f"{path}: is neither a file nor a folder")
    return sha256_of(path)


def repeated(pairs: Sequence[InputPair], documents: Sequence[InputDoc]) -> Refusal | None:
    """Refuse a recording that is given twice, under whatever name; None where none is.

    One bag may be target and source, with a topic for each.

    Parameters
    ----------
    pairs, documents
        The inputs, and their entries in the result document, target and source in turn.
    """
    seen: dict[tuple[str, str | None], tuple[int, str, str]] = {}
    each = [
        (k, lidar, given)
        for k, pair in enumerate(pairs, 1)
        for lidar, given in zip(("TARGET", "SOURCE"), pair, strict=True)
    ]
    for (k, lidar, given), document in zip(each, documents, strict=True):
        n, other, name = seen.setdefault((document.sha256, given.topic), (k, lidar, given.name))
        if (n, other) == (k, lidar):
            continue
        several = len(pairs) > 1
        names = (
            f"{other}{f' of placement {n}' if several else ''}",
            f"{lidar}{f' of placement {k}' if several else ''}",
        )
        what = f"topic {given.topic} of {given.name}" if given.topic else given.name
        advice = what_to_give(n, k)
        if given.topic is not None and n == k:
            advice = (
                "--target-topic and --source-topic (in Python target_topic and source_topic) tell "
                "two LiDARs of one bag apart"
            )
        return Refusal(
            "same_recording",
            f"{names[0]} and {names[1]} are both {what}; {advice}"
            if given.name == name
            else f"{names[0]} and {names[1]}, {name} and {given.name}, are the same byte for byte: "
            f"one is a copy of the other; {advice}",
            {"sha256": document.sha256},
        )
    return None


def intensity_hint(code: str, inputs: Iterable[Input]) -> str:
    """Say what to give instead where an array has no intensity; empty for any other refusal."""
    arrays = (each for each in inputs if not isinstance(each.given, str | Path | PointCloud))
    if code != "no_intensity" or all(each.cloud.intensity is not None for each in arrays):
        return ""
    return "; give an array of shape (N, 4): x, y, z, intensity"


def _hash_of_arrays(given: CloudSource) -> str:
    """SHA-256 of the bytes of an array, or of the arrays of a cloud one after the other."""
    arrays = [given]
    if isinstance(given, PointCloud):
        columns = [getattr(given, name) for name in PER_POINT]
        arrays = [given.xyz, *(column for column in columns if column is not None)]
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
