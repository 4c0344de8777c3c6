"""Recordings of many frames: which are read, and how they become one cloud."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datatypes import PointCloud
from ..errors import MissingExtraError, ReadError, UsageError

MAX_RECORDING_POINTS = 1_000_000
"""Where nothing else is asked for, frames are left out, evenly, so that about so many points are
read: 10 sweeps of a sensor of 128 beams, 40 of one of 16."""

SIZED_FRAMES = 3
"""So many first frames tell how large a frame is: the very first of packets is cut short."""


@contextmanager
def reported(path: Path, what: str, remedy: str = "") -> Iterator[None]:
    """Say of any failure of a library which file it was, and what to do.

    For damaged files the libraries raise a dozen unrelated types; an OSError with a number is the
    system's, one without comes from unpacking.
    """
    try:
        yield
    except (ReadError, MissingExtraError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise ReadError(f"{path}: cannot be read ({error.strerror})") from None
        words = str(error) or type(error).__name__
        raise ReadError(f"{path}: is no readable {what} ({words}){remedy}") from None


CLOUDS = "sensor_msgs/msg/PointCloud2"
"""What messages of point clouds are called, in the way of ROS 2."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a recording.

    Attributes
    ----------
    number
        Its place in the recording, from 0.
    cloud
        Its points; none at all is a frame without returns.
    stamp
        When it was recorded, seconds of the recorder's clock, or None where nothing says.
    frame_id
        What the recording calls the coordinate frame; empty where it does not.
    """

    number: int
    cloud: PointCloud
    stamp: float | None = None
    frame_id: str = ""


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, the type of its messages, and how many there are."""

    name: str
    kind: str
    count: int

    @property
    def of_clouds(self) -> bool:
        """Whether its messages are point clouds."""
        return self.kind == CLOUDS


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
        From ascending frame numbers to these frames, each read when it is asked for.
    topic
        Of a bag, the topic that the frames are on.
    """

    path: Path
    count: int
    read: Callable[[range], Iterator[Frame]]
    topic: str | None = None


def chosen_frames(recording: Recording, frames: slice | None = None) -> range:
    """Say which frames to read: those asked for, else as many as hold `MAX_RECORDING_POINTS`, evenly spread.

    Raises
    ------
    ReadError
        Where the recording has none of the frames asked for.
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
    """Put frames together as one cloud; its `frame` is their number, None where there is one.

    Raises
    ------
    ReadError
        Without returns in any; where the origins differ; where some have no intensity.
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
                f"{first.source}, expected frames of one resting sensor"
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
        dropped=dropped,
        source=str(recording.path),
    )
