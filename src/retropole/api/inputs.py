"""From what a user gives, a path, an array or a cloud, to a cloud and its entry in the result."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import PER_POINT, PointCloud, Scan
from ..base.errors import Refusal, UsageError, quoting
from ..base.files import path_in_text
from ..base.quantities import counted
from ..base.sensors import Sensor, sensor_or_auto
from ..extraction.sensor_pattern import sensor_doubt
from ..io import (
    ARRAY_SOURCE,
    ReadRecording,
    cloud_from_array,
    downsample,
    only_returns,
    read_recording,
    sha256_of,
)
from ..io.beams import with_beam_origin, with_trusted_rings
from ..io.coordinates import Oddity, oddity_of
from ..io.fields import USUAL, in_metres, unit_named
from ..io.maps import as_map
from ..io.recordings import clock_offset
from ..result import DEFAULT_CONFIG, InputDoc, Reading, RunConfig, document_of
from ..surfaces.scans import find_poles
from ..surfaces.static import what_to_give

CloudSource = str | Path | PointCloud | NDArray[Any]
"""What gives a cloud: a path that `io.read_cloud` reads, a cloud, or an array (N, 3) or (N, 4) of
x, y, z and intensity."""


class Listener(NamedTuple):
    """Callbacks for the progress of a run.

    Attributes
    ----------
    progress
        Called with the name of each step as it starts; while a recording of several frames is read,
        with which of how many.
    on_read
        Called with each cloud once it is read.
    """

    progress: Callable[[str], None] = lambda step: None
    on_read: Callable[[Input], None] = lambda given: None


SILENT = Listener()
"""No callbacks."""


@dataclass(frozen=True, eq=False)
class Input:
    """A cloud, and what it was made of.

    Attributes
    ----------
    given
        The path, the cloud or the array.
    cloud
        The points, in the frame of the sensor.
    sensor
        What recorded it; None if not known.
    threshold
        Intensity from which a return is treated as retro-reflective; None if none was given.
    read
        Of a path, what was read there.
    how
        How it was read.
    """

    given: CloudSource
    cloud: PointCloud
    sensor: Sensor | None
    threshold: float | None
    read: ReadRecording | None = None
    how: Reading = DEFAULT_CONFIG.of_target

    @property
    def name(self) -> str:
        """The path; of a cloud or an array, what its source is called."""
        if isinstance(self.given, str | Path):
            return str(self.given)
        return self.cloud.source or ARRAY_SOURCE

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the recording, or of the arrays."""
        return sha256_of(self.name) if self.read else _hash_of_arrays(self.given)

    @property
    def topic(self) -> str | None:
        """Of a bag, the topic that was read."""
        return None if self.read is None else self.read.recording.topic

    @property
    def oddity(self) -> Oddity | None:
        """Why its coordinates cannot be metres about the LiDAR; None if they can."""
        return None if self.cloud.is_map else oddity_of(self.cloud)

    @property
    def sensor_doubt(self) -> str:
        """Why it is hardly of the sensor that was named; empty if it may be."""
        if self.sensor is None:
            return ""
        return sensor_doubt(with_beam_origin(with_trusted_rings(self.cloud)), self.sensor)

    def search(self, radius: float, *, for_poles: bool = True) -> Scan:
        """Find the poles of a radius, metres, in it; a refusal is in the scan.

        If it is not searched for poles, what moved is left out all the same.
        """
        sensor, threshold = self.sensor, self.threshold
        return find_poles(
            self.cloud, sensor=sensor, threshold=threshold, radius=radius, search=for_poles
        )


class InputPair(NamedTuple):
    """Target and source of one placement of the poles."""

    target: Input
    source: Input


def read_input(
    given: CloudSource,
    how: Reading = DEFAULT_CONFIG.of_target,
    listener: Listener = SILENT,
    *,
    role: str = "cloud",
) -> Input:
    """Read a cloud in any form that a user may give, and look up its sensor.

    Parameters
    ----------
    given
        A path, a cloud or an array. Points of any of them that are not finite or at zero range are
        dropped and counted.
    how
        Of which sensor and in which unit it is, and what is read of a recording.
    listener
        Receives each of several frames, and the cloud once it is read.
    role
        What messages call it: ``target``.

    Raises
    ------
    UsageError
        For an unknown sensor or unit, for an array of another shape, for any other type than these
        three, or if a topic, frames or an intensity are named for an input that is not a file.
    ReadError, MissingExtraError
        As `io.read_cloud`.
    """
    sensor, unit, read = sensor_or_auto(how.sensor), unit_named(how.unit), None
    if isinstance(given, str | Path):
        read = read_recording(
            given,
            topic=how.topic,
            frames=how.frames,
            max_points=how.max_points,
            unit=unit,
            wanted=how.wanted,
            progress=listener.progress,
        )
        cloud = read.cloud
    elif not isinstance(given, PointCloud) and not hasattr(given, "__array__"):
        raise UsageError(
            f"{role}: of type {type(given).__name__}, expected a path, a PointCloud, or an array "
            "of shape (N, 3) or (N, 4)"
        )
    elif (how.topic, how.frames, how.wanted._replace(place=None)) != (None, None, USUAL):
        raise UsageError(
            f"{role}: a topic, frames, intensity and angles can be chosen in files only, not in "
            "arrays"
        )
    else:
        if isinstance(given, PointCloud):
            cloud = only_returns(given, role)
        else:
            given = np.asarray(given)
            cloud = cloud_from_array(given, role)
        cloud = downsample(in_metres(cloud, unit), how.max_points)
    if how.wanted.place is not None:
        cloud = as_map(cloud, how.wanted.place)
    reader_input = Input(given, cloud, sensor, how.threshold, read, how)
    listener.on_read(reader_input)
    return reader_input


def read_pair(
    target: CloudSource,
    source: CloudSource,
    config: RunConfig,
    listener: Listener = SILENT,
    which: str = "",
) -> InputPair:
    """Read a target and a source, with the options of a run; see `read_input`.

    Parameters
    ----------
    which
        What messages add to their names: ``of placement 2`` and a space before it.
    """
    return InputPair(
        read_input(target, config.of_target, listener, role=f"target{which}"),
        read_input(source, config.of_source, listener, role=f"source{which}"),
    )


def read_placements(
    target: CloudSource | Sequence[CloudSource],
    source: CloudSource | Sequence[CloudSource],
    config: RunConfig,
    listener: Listener = SILENT,
) -> tuple[InputPair, ...]:
    """Read the target and the source of every placement, with the options of a run.

    Raises
    ------
    UsageError
        If the numbers of targets and sources differ or are 0, and as `read_input`.
    ReadError, MissingExtraError
        As `read_input`.
    """
    targets, sources = _each(target), _each(source)
    if len(targets) != len(sources) or not targets:
        raise UsageError(
            f"{counted(len(targets), 'target')} and {counted(len(sources), 'source')} are given, "
            "expected one of each for every placement"
        )
    return tuple(
        read_pair(*pair, config, listener, f" of placement {k}" if len(targets) > 1 else "")
        for k, pair in enumerate(zip(targets, sources, strict=True), 1)
    )


def _each(given: CloudSource | Sequence[CloudSource]) -> Sequence[CloudSource]:
    if isinstance(given, str) or not isinstance(given, Sequence):
        return [given]
    return given


def input_documents(inputs: Iterable[Input]) -> list[InputDoc]:
    """Write the entries of clouds in the result document; each file is hashed once."""
    hash_of = cache(sha256_of)
    return [
        document_of(
            InputDoc,
            each.cloud,
            path=path_in_text(each.name),
            sha256=hash_of(each.name) if each.read else each.sha256,
            points=len(each.cloud),
            frames_left_out=0 if each.read is None else each.read.left_out,
            sensor="auto" if each.sensor is None else each.sensor.name,
            threshold=each.threshold,
            frame_id=_frame_of(each),
            clock_offset_s=None if each.read is None else clock_offset(each.read.headers),
        )
        for each in inputs
    ]


def _frame_of(given: Input) -> str:
    """Name the one frame that a recording says its points are in; empty if there is none."""
    names = set() if given.read is None else {each.frame_id for each in given.read.headers}
    name = names.pop() if len(names) == 1 else ""
    return name if name == quoting(name) else ""


recording_hash = sha256_of
"""SHA-256 of a recording, as the result document has it; it is not read as one."""


def refuse_repeated(
    inputs: Sequence[Input], documents: Sequence[InputDoc], message: Callable[[int, int], str]
) -> Refusal | None:
    """Refuse a recording that is given twice, under whatever name; None if none is.

    One bag may hold several LiDARs, a topic for each.

    Parameters
    ----------
    inputs, documents
        What was read, and the entries in the result document.
    message
        Says it of the numbers of both, from 0.
    """
    seen: dict[tuple[str, str | None], int] = {}
    for k, (given, document) in enumerate(zip(inputs, documents, strict=True)):
        first = seen.setdefault((document.sha256, given.topic), k)
        if first != k:
            return Refusal("same_recording", message(first, k), {"sha256": document.sha256})
    return None


def warn_repeated(inputs: Sequence[Input], first: int, second: int) -> str:
    """Report that a recording is given twice.

    Parameters
    ----------
    inputs
        Target and source of each placement.
    first, second
        Numbers of both in these, from 0.
    """
    several = len(inputs) > 2
    names = [
        ("TARGET", "SOURCE")[k % 2] + (f" of placement {k // 2 + 1}" if several else "")
        for k in (first, second)
    ]
    one, other = inputs[first], inputs[second]
    advice = what_to_give(first // 2, second // 2)
    if other.topic is not None and first // 2 == second // 2:
        advice = (
            '--topic /a --topic /b (in Python topic=("/a", "/b")) distinguish two LiDARs of one bag'
        )
    if one.name == other.name:
        what = f"topic {other.topic} of {other.name}" if other.topic else other.name
        return f"{names[0]} and {names[1]} are both {what}; {advice}"
    return (
        f"{names[0]} and {names[1]}, {one.name} and {other.name}, are identical: one is a "
        f"copy of the other; {advice}"
    )


def intensity_hint(code: str, inputs: Iterable[Input]) -> str:
    """Advise on arrays without intensity; empty for any other refusal."""
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
