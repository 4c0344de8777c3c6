"""Recordings of many frames: which of them are read, and how they become one cloud."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import PointCloud
from ..base.errors import ReadError, UsageError

MAX_RECORDING_POINTS = 1_000_000
"""By default, frames are left out evenly so that about this many points are read: 10 sweeps of a
sensor with 128 rings, 40 of one with 16."""

UNIX_SECONDS = 1e9, 1e11
"""Stamps in this range are Unix time, seconds: from 2001 on. Clocks that were never set, and those
that start with the recording, stay below it."""

SIZED_FRAMES = 3
"""Number of first frames that show how large a frame is: of packets, the very first is short."""


CLOUDS = "sensor_msgs/msg/PointCloud2"
"""Type of the messages with point clouds, as ROS 2 writes it."""


def is_of_livox(kind: str) -> bool:
    """Whether a type of messages is the ``CustomMsg`` of Livox' drivers, of which there are three:
    ``livox_ros_driver``, ``livox_ros_driver2`` and, for ROS 2 only, ``livox_interfaces``.
    """
    return kind.startswith("livox_") and kind.endswith("/msg/CustomMsg")


def holds_clouds(kind: str) -> bool:
    """Whether messages of a type are point clouds that are read."""
    return kind == CLOUDS or is_of_livox(kind)


class FrameHeader(NamedTuple):
    """What is known of a frame apart from its points.

    Attributes
    ----------
    number
        Its place in the recording, from 0.
    stamp
        Time of recording, seconds of the recorder's clock, or None where the file does not say.
    frame_id
        Name of the coordinate frame; empty where the recording has none.
    """

    number: int
    stamp: float | None
    frame_id: str


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a recording.

    Attributes
    ----------
    number, stamp, frame_id
        As in `FrameHeader`.
    cloud
        Its points; an empty cloud is a frame without returns.
    sender
        Of packets that come now, the address and the port of who sends them.
    """

    number: int
    cloud: PointCloud
    stamp: float | None = None
    frame_id: str = ""
    sender: str = ""

    @property
    def header(self) -> FrameHeader:
        """All but the points."""
        return FrameHeader(self.number, self.stamp, self.frame_id)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, the type of its messages, and their number."""

    name: str
    kind: str
    count: int

    @property
    def of_clouds(self) -> bool:
        """Whether its messages are point clouds."""
        return holds_clouds(self.kind)


MAX_MESSAGES = 2**22
"""More are not read: those of 200 topics at 10 Hz for half an hour, and the index of all of them
is to fit into memory."""


@dataclass(frozen=True, eq=False)
class Bag:
    """An open bag.

    Attributes
    ----------
    topics
        By name.
    messages
        From the name and the type of a topic to time (ns), bytes and encoding of its messages. The
        encoding is ``ros1`` or ``cdr``.
    """

    topics: tuple[Topic, ...]
    messages: Callable[[str, str], Iterator[tuple[int, bytes, str]]]


def counted_topics(parts: Iterable[tuple[str, str, int]]) -> tuple[Topic, ...]:
    """Make topics of names, types and numbers of messages; equal ones are added up."""
    counts: dict[tuple[str, str], int] = {}
    for name, kind, count in parts:
        counts[name, kind] = counts.get((name, kind), 0) + count
    return tuple(Topic(*key, count) for key, count in sorted(counts.items()))


@dataclass(frozen=True, eq=False)
class Recording:
    """A file or folder whose frames can be read one by one.

    Attributes
    ----------
    path
        The file or folder.
    count
        How many frames it has.
    read
        From ascending frame numbers to these frames, each read when it is requested.
    topic
        Of a bag, the topic that the frames are on.
    """

    path: Path
    count: int
    read: Callable[[range], Iterator[Frame]]
    topic: str | None = None


@dataclass(frozen=True, eq=False)
class ReadRecording:
    """A recording whose frames were read and combined.

    Attributes
    ----------
    recording
        What was read.
    asked, numbers
        Which frames were asked for, and which of them were read.
    headers
        Of each frame that was read. The points are in `cloud` alone, so that none is in memory
        twice.
    cloud
        All frames combined, in the sensor's own frame.
    """

    recording: Recording
    asked: range
    numbers: range
    headers: tuple[FrameHeader, ...]
    cloud: PointCloud

    @property
    def left_out(self) -> int:
        """How many frames were asked for, and not read since all have too many points."""
        return len(self.asked) - len(self.numbers)

    @property
    def is_whole(self) -> bool:
        """Whether every frame was read."""
        return len(self.numbers) == self.recording.count


def chosen_frames(recording: Recording, frames: slice | None = None) -> range:
    """Choose the frames to read: the given ones, else evenly spread ones.

    Of a long recording, as many are taken as hold about `MAX_RECORDING_POINTS` points.

    Raises
    ------
    ReadError
        Where the recording has none of the given frames.
    UsageError
        Where the step of the slice is not positive.
    """
    if frames is not None:
        if frames.step is not None and frames.step < 1:
            raise UsageError(f"frames are read forwards, the step cannot be {frames.step}")
        wanted = range(*frames.indices(recording.count))
        if not wanted:
            parts = ("" if v is None else str(v) for v in (frames.start, frames.stop))
            raise ReadError(
                f"{recording.path}: has {recording.count} frames, numbered from 0; none is in "
                f"{':'.join(parts)}"
            )
        return wanted
    if recording.count == 1:
        return range(1)
    first = range(min(recording.count, SIZED_FRAMES))
    points = max(len(frame.cloud) for frame in recording.read(first))
    return range(
        0, recording.count, max(1, math.ceil(recording.count * points / MAX_RECORDING_POINTS))
    )


def joined(recording: Recording, frames: Sequence[Frame]) -> PointCloud:
    """Combine frames into one cloud; its `frame` is their number, None where there is only one.

    Raises
    ------
    ReadError
        Where no frame has a return, where origins differ, and where only some have an intensity.
    """
    dropped = sum(frame.cloud.dropped for frame in frames)
    full = [frame for frame in frames if len(frame.cloud)]
    if not full:
        raise ReadError(
            f"{recording.path}: none of the {dropped} points in {len(frames)} frames is finite and "
            "away from the sensor; expected coordinates in metres"
        )
    clouds = [frame.cloud for frame in full]
    first = clouds[0]
    for cloud in clouds[1:]:
        if not np.allclose(cloud.origin, first.origin):
            raise ReadError(
                f"{cloud.source}: its viewpoint {cloud.origin} differs from {first.origin} of "
                f"{first.source}, expected frames of one sensor at rest"
            )

    def column(name: str) -> NDArray[Any] | None:
        columns = [getattr(cloud, name) for cloud in clouds]
        missing = [cloud for cloud, values in zip(clouds, columns, strict=True) if values is None]
        if name == "intensity" and 0 < len(missing) < len(clouds):
            raise ReadError(
                f"{missing[0].source}: has no intensity, other frames of the recording have"
            )
        return None if missing else np.concatenate(columns)

    numbers = np.repeat([frame.number for frame in full], [len(cloud) for cloud in clouds])
    return replace(
        first,
        xyz=np.concatenate([cloud.xyz for cloud in clouds]),
        intensity=column("intensity"),
        ring=column("ring"),
        time=column("time"),
        frame=numbers.astype(np.int64) if len(frames) > 1 else None,
        recorded=_recorded([frame.stamp for frame in full]),
        dropped=dropped,
        thinned=sum(cloud.thinned for cloud in clouds),
        notes=tuple(dict.fromkeys(note for frame in full for note in frame.cloud.notes)),
        source=str(recording.path),
    )


def _recorded(stamps: Sequence[float | None]) -> tuple[float, float] | None:
    """First and last of the stamps; None unless all are Unix time."""
    known = [stamp for stamp in stamps if stamp is not None and is_unix(stamp)]
    return (min(known), max(known)) if len(known) == len(stamps) else None


def is_unix(seconds: float) -> bool:
    """Whether a time, s, may be one of a clock that is set."""
    return UNIX_SECONDS[0] <= seconds < UNIX_SECONDS[1]


def time_of_recording(cloud: PointCloud) -> tuple[float, float] | None:
    """First and last time at which a cloud was recorded, Unix seconds; None where it is not known.

    The points' own times go first, where they are Unix time. When a file was written says nothing.
    """
    if cloud.time is not None and len(cloud.time):
        first, last = float(np.nanmin(cloud.time)), float(np.nanmax(cloud.time))
        if is_unix(first) and is_unix(last):
            return first, last
    return cloud.recorded
