"""Recordings of many frames: which are read, how many points are kept, and one cloud of all."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.clocks import is_set
from ..base.datatypes import IntArray, PointCloud
from ..base.errors import ReadError, UsageError
from ..base.quantities import step_of

PACKETS = (".pcap", ".pcapng")
"""Suffixes of packet captures."""

CAPTURES = (*PACKETS, ".cap")
"""Suffixes that captures have, also those that may be of a format that is not read."""

LVX = (".lvx2", ".lvx")
"""Suffixes of the recordings of Livox' viewers."""

MAX_RECORDING_POINTS = 1_000_000
"""By default, frames are left out evenly so that about this many points are read: 10 sweeps of a
sensor with 128 rings, 40 of one with 16."""

UNIX_SECONDS = 1e9, 1e11
"""Stamps in this range are Unix time, seconds: from 2001 on. Clocks that were never set, and those
that start with the recording, stay below it."""

CLOUDS = "sensor_msgs/msg/PointCloud2"
"""Type of the messages with point clouds, as ROS 2 writes it."""


def is_of_livox(kind: str) -> bool:
    """Whether a type of messages is the ``CustomMsg`` of Livox' drivers, of which there are three:
    ``livox_ros_driver``, ``livox_ros_driver2`` and, for ROS 2 only, ``livox_interfaces``.
    """
    return kind.startswith("livox_") and kind.endswith("/msg/CustomMsg")


def has_clouds(kind: str) -> bool:
    """Whether messages of a type are point clouds that are read."""
    return kind == CLOUDS or is_of_livox(kind)


PACKET_MESSAGES = frozenset(
    {
        *("velodyne_msgs/msg/VelodyneScan", "pandar_msgs/msg/PandarScan"),
        *("nebula_msgs/msg/NebulaPackets", "hesai_ros_driver/msg/UdpFrame"),
        *("rslidar_msg/msg/RslidarPacket", "rslidar_msgs/msg/rslidarScan"),
        *("robosense_msgs/msg/RobosenseScan", "lslidar_msgs/msg/LslidarPacket"),
    }
)
"""Types of the messages in which drivers publish packets."""

PACKETS_OF = "packets of "
"""Start of the name that replaces a type if a capture has several LiDARs."""


class FrameHeader(NamedTuple):
    """What is known of a frame besides its points.

    Attributes
    ----------
    number
        Its place in the recording, from 0.
    stamp
        Time of recording, seconds of the recorder's clock, or None if the file does not say.
    frame_id
        Name of the coordinate frame; empty if the recording has none.
    clock
        When the frame was made by the clock of the LiDAR, or by that of its driver, seconds; None
        where the recording does not have it next to the recorder's.
    """

    number: int
    stamp: float | None
    frame_id: str
    clock: float | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a recording.

    Attributes
    ----------
    number, stamp, frame_id, clock
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
    clock: float | None = None

    @property
    def header(self) -> FrameHeader:
        """All but the points."""
        return FrameHeader(self.number, self.stamp, self.frame_id, self.clock)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, the type of its messages, and their number."""

    name: str
    kind: str
    count: int

    @property
    def of_clouds(self) -> bool:
        """Whether its messages are point clouds."""
        return has_clouds(self.kind)

    @property
    def of_packets(self) -> bool:
        """Whether it has packets of which clouds are made."""
        return self.kind in PACKET_MESSAGES or self.kind.startswith(PACKETS_OF)


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
        Of a bag, the topic that the frames are on; of a capture, their sender, if there are
        several.
    model
        Of packets, the LiDAR that sent them, as `PointCloud` has it.
    """

    path: Path
    count: int
    read: Callable[[range], Iterator[Frame]]
    topic: str | None = None
    model: str = ""


@dataclass(frozen=True, eq=False)
class ReadRecording:
    """A recording whose frames were read and combined.

    Attributes
    ----------
    recording
        What was read.
    requested, numbers
        Which frames were requested, and which of them were read.
    headers
        Of each frame that was read. The points are in `cloud` alone, so that none is in memory
        twice.
    cloud
        All frames combined, in the frame of the sensor.
    """

    recording: Recording
    requested: range
    numbers: range
    headers: tuple[FrameHeader, ...]
    cloud: PointCloud

    @property
    def left_out(self) -> int:
        """How many frames were requested, and not read since all have too many points."""
        return len(self.requested) - len(self.numbers)

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
        If the recording has none of the given frames.
    UsageError
        If the step of the slice is not positive.
    """
    if frames is not None:
        if frames.step is not None and frames.step < 1:
            raise UsageError(
                f"frames are read in increasing order, the step cannot be {frames.step}"
            )
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
    # Of packets, the very first frame is short.
    first = range(min(recording.count, 3))
    points = max(len(frame.cloud) for frame in recording.read(first))
    return range(
        0, recording.count, max(1, math.ceil(recording.count * points / MAX_RECORDING_POINTS))
    )


def joined(recording: Recording, frames: Sequence[Frame]) -> PointCloud:
    """Combine frames into one cloud; its `frame` is their number, None if there is only one.

    Raises
    ------
    ReadError
        If no frame has a return, if origins differ, or if only some have an intensity.
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


def clock_offset(headers: Sequence[FrameHeader]) -> float | None:
    """Median of how far a LiDAR's clock is ahead of the recorder's, s; None if it is not known.

    By up to some tenths of a second it is not that of the clocks: frames are recorded when they
    have come.
    """
    offsets = [
        each.clock - each.stamp
        for each in headers
        if each.clock is not None and each.stamp is not None and is_unix(each.stamp)
    ]
    return float(np.median(offsets)) if offsets else None


def is_unix(seconds: float) -> bool:
    """Whether a time, s, may be one of a clock that is set."""
    return UNIX_SECONDS[0] <= seconds < UNIX_SECONDS[1]


def time_of_recording(cloud: PointCloud) -> tuple[float, float] | None:
    """First and last time at which a cloud was recorded, Unix seconds; None if it is not known.

    The times of the points go first, where they are Unix time, unless they are far from the
    recorder's: clocks that were never set count from a date of the maker's, which two LiDARs may
    share. When a file was written gives no information.
    """
    if cloud.time is not None and len(cloud.time):
        first, last = float(np.nanmin(cloud.time)), float(np.nanmax(cloud.time))
        near = cloud.recorded is None or is_set(first - cloud.recorded[0])
        if is_unix(first) and is_unix(last) and near:
            return first, last
    return cloud.recorded


MAX_POINTS = 1_500_000
"""Points of one cloud that are worked on unless more are requested. Of four streets recorded with
30 sweeps of 100,000 points, thinned to this many, the refined pose was as good as of all
(0.001° to 0.009° off instead of 0.002° to 0.005°), in less than half the time."""

LEAST_POINTS = 1000
"""No fewer are requested: they show no pole."""

FEWEST_FRAMES = 20
"""Of more frames, every second is left out before any is downsampled: whole frames keep the pattern
of the beams, and this many show what moved."""

BRIGHT_SHARE = 0.01
"""Part of the points that are left which the brightest may be: 15,000 points. Returns on
poles are some thousands, and so small a part moves no threshold found from the cloud."""


def downsample(cloud: PointCloud, most: int) -> PointCloud:
    """Keep `most` points of a cloud: the brightest, since returns on poles are few, and the others
    evenly in their order.

    Parameters
    ----------
    cloud
        Any; itself where it has no more.
    most
        How many points to keep, 1 or more.

    Returns
    -------
    PointCloud
        With its points in their order; `thinned` is the number of those left out.
    """
    if len(cloud) <= most:
        return cloud
    kept = np.zeros(len(cloud), bool)
    brightest = int(BRIGHT_SHARE * most)
    if cloud.intensity is not None and brightest:
        # Where more are equally bright, as where all saturate, they are downsampled like the
        # others.
        kept = cloud.intensity > np.partition(cloud.intensity, -brightest - 1)[-brightest - 1]
    others = np.flatnonzero(~kept)
    count = most - (len(cloud) - len(others))
    # Steps are 0.6 to 1.6 times their mean, so that one of 2 or more takes no point twice.
    is_kept = 2 * count <= len(others)
    kept[others] = not is_kept
    kept[others[_evenly(len(others), count if is_kept else len(others) - count)]] = is_kept
    return replace(cloud.select(kept), thinned=cloud.thinned + len(cloud) - most)


def _evenly(number: int, count: int) -> IntArray:
    """Choose `count` of `number` places, of which there are twice as many or more."""
    k = np.arange(count)
    # Multiples of the golden ratio, modulo 1, keep no step with the number of rings, which
    # neighbours differ by.
    return ((k + (k * ((5**0.5 - 1) / 2)) % 1.0) * (number / max(count, 1))).astype(np.int64)


def read_within(
    recording: Recording,
    numbers: range,
    most: int,
    progress: Callable[[str], None] = lambda step: None,
) -> tuple[range, list[Frame]]:
    """Read frames with no more than `most` points together, and never hold many more.

    Of many frames, every second is left out as often as it takes; of few, each is downsampled to
    its share.

    Parameters
    ----------
    recording, numbers
        What to read, and which of its frames.
    most
        How many points.
    progress
        Called as each of several frames is about to be read, with which of how many it is.

    Returns
    -------
    tuple of range and list of Frame
        Which frames were read, and these; all of them where they have no more points.
    """
    kept: list[Frame] = []
    while True:
        while _points(kept) > most:
            if len(numbers) > FEWEST_FRAMES:
                numbers = numbers[::2]
                kept = [frame for frame in kept if frame.number in numbers]
            else:
                share = max(most // len(numbers), 1)
                kept = [replace(frame, cloud=downsample(frame.cloud, share)) for frame in kept]
        if len(kept) == len(numbers):
            return numbers, kept
        _report_progress(progress, recording, len(kept), len(numbers))
        for frame in recording.read(numbers[len(kept) :]):
            kept.append(frame)
            _report_progress(progress, recording, len(kept), len(numbers))
            if _points(kept) > most:
                break


def _report_progress(
    progress: Callable[[str], None], recording: Recording, done: int, count: int
) -> None:
    if done < count > 1:
        progress(step_of(f"read {recording.path.name}: frame", done + 1, count))


def _points(frames: list[Frame]) -> int:
    return sum(len(frame.cloud) for frame in frames)
