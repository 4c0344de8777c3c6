"""Point clouds in ROS bags: topics, frames, and the layout of a message (the extra ``ros``).

``sensor_msgs/PointCloud2`` and Livox' ``CustomMsg`` have had one layout in ROS 1 and another in
every ROS 2 until now, so the definitions in a bag, if any, are not used. No ROS is needed.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import ReadError, naming, reported, shortened
from ..base.quantities import counted
from .bags import opened
from .fields import NANOSECONDS, USUAL, Columns, Wanted, frame_from_columns, noted
from .packets import packets_in
from .recordings import CLOUDS, Frame, Recording, Topic, is_of_livox, is_unix
from .unpacking import LARGEST_RECORD

DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""From the number of a type in a PointField to its name in NumPy."""

SMALLEST_POINT, MAX_SMALL_POINTS = 12, 2**22
"""Bytes of a point as drivers write it, and how many may be smaller: in memory a point takes 24
bytes and more, so that one of a byte would take many times its file."""

LIVOX_POINT = [("offset_time", "u4"), *((axis, "f4") for axis in "xyz")]
LIVOX_POINT += [(name, "u1") for name in ("reflectivity", "tag", "line")]
"""Values of a point in Livox' ``CustomMsg``; its time is in ns from that of the message."""

MAX_LISTED = 10
"""Topics that a message names."""

LONGEST_NAME = 1000
"""Characters of a frame's name that are kept. Exports refuse names of more than 500, so that one
that was cut is not taken for whole."""


def bag_topics(path: Path) -> tuple[Topic, ...]:
    """List the topics of a bag by name."""
    with opened(path) as bag:
        return bag.topics


def open_bag(path: Path, topic: str | None = None, wanted: Wanted = USUAL) -> Recording:
    """Open a bag, and choose the topic of point clouds: the given one, or the only one.

    If none has point clouds, one is chosen on which a driver publishes packets.

    Raises
    ------
    MissingExtraError
        If rosbags or mcap is not installed.
    ReadError
        If the bag cannot be read, or not exactly one topic fits; lists those there are.
    UsageError
        Where angles are given, and the topic has no packets.
    """
    topics = bag_topics(path)
    chosen = _choose(path, topics, topic)
    if chosen.of_packets:
        return packets_in(path, chosen, wanted)
    wanted.refuse_angles(f"{path}: topic {chosen.name} has no packets, angles do not apply")
    return Recording(path, chosen.count, partial(_frames, path, chosen, wanted), topic=chosen.name)


def _choose(path: Path, topics: tuple[Topic, ...], name: str | None) -> Topic:
    clouds = [topic for topic in topics if topic.of_clouds]
    packets = [topic for topic in topics if topic.of_packets]
    if any(topic.name == name for topic in packets) or not any(own.count for own in clouds):
        clouds = packets or clouds
    filled = [topic for topic in clouds if topic.count]
    named = next((topic for topic in topics if topic.name == name), None)
    if not clouds:
        fault = f"has no topic of {CLOUDS} or of Livox' CustomMsg; its topics are: "
        fault += _listed(topics, kinds=True)
    elif name is not None and named is None:
        fault = f"has no topic {name}; those of clouds are: {_listed(clouds)}"
    elif named is not None and named not in clouds:
        fault = f"topic {name} is of {named.kind}, expected {CLOUDS}; topics of that are: "
        fault += _listed(clouds)
    elif named is not None and not named.count:
        fault = f"topic {name} has no messages"
    elif not filled:
        fault = f"its topics of point clouds have no messages: {_listed(clouds)}"
    elif named is None and len(filled) > 1:
        fault = f"has {len(filled)} topics of point clouds, name one of them: {_listed(filled)}"
    else:
        return named or filled[0]
    raise ReadError(f"{path}: {fault}")


def _listed(topics: Sequence[Topic], *, kinds: bool = False) -> str:
    names = [
        f"{topic.name} ({topic.kind + ', ' if kinds else ''}{counted(topic.count, 'message')})"
        for topic in topics[:MAX_LISTED]
    ]
    more = len(topics) - MAX_LISTED
    return ", ".join(names) + (f" and {more} more" if more > 0 else "") if names else "none"


def _frames(path: Path, topic: Topic, wanted: Wanted, numbers: range) -> Iterator[Frame]:
    """Decode the chosen messages of a topic, each when it is requested."""
    with opened(path) as bag:
        number = -1
        for number, (stamp, data, encoding) in enumerate(bag.messages(topic.name, topic.kind)):
            if number in numbers:
                own = number, stamp, data, encoding, topic.kind
                yield frame_of(f"{path}: ", topic.name, *own, wanted)
            if number == numbers[-1]:
                return
        promised = f"promises {counted(topic.count, 'message')} on {topic.name}"
        raise ReadError(f"{promised}, has {number + 1}")


def frame_of(
    source: str,
    topic: str,
    number: int,
    stamp: int,
    data: bytes,
    encoding: str,
    kind: str = CLOUDS,
    wanted: Wanted = USUAL,
) -> Frame:
    """Decode a message with a point cloud.

    Parameters
    ----------
    source
        What is before the topic's name in the cloud's source: ``drive.bag: ``.
    topic, number, stamp
        Where and as which it came, and when, ns.
    data, encoding
        Its bytes, and ``ros1`` or ``cdr``.
    kind
        Its type.
    wanted
        Field that its intensity is read from.

    Raises
    ------
    ReadError
        If it is not such a message; names the topic and the number.
    """
    where = f"message {number} of {topic}"
    with naming(where):
        if len(data) > LARGEST_RECORD:
            raise ReadError(f"has {len(data):,} bytes, up to {LARGEST_RECORD:,} are read")
    if is_of_livox(kind):
        with naming(where), reported(kind):
            frame_id, columns, note = _livox_points(data, encoding)
        cloud = replace(frame_from_columns(where, columns, wanted), source=f"{source}{where}")
        name = shortened(frame_id, LONGEST_NAME)
        clock = float(columns["time"][0]) if len(columns["time"]) else None
        return Frame(number, noted(cloud, note), stamp / NANOSECONDS, name, clock=clock)
    with naming(where), reported(CLOUDS):
        # The decoder lets pass whatever is raised when bytes do not fit.
        message = _decoder(encoding)(data)
        columns = columns_of(message)
    cloud = replace(frame_from_columns(where, columns, wanted), source=f"{source}{where}")
    frame_id = shortened(message.header.frame_id, LONGEST_NAME)
    own = message.header.stamp
    clock = own.sec + own.nanosec / NANOSECONDS or None
    if cloud.time is not None and len(cloud.time) and is_unix(float(cloud.time[0])):
        # A driver may stamp messages by the clock of its computer.
        clock = float(cloud.time[0])
    return Frame(number, cloud, stamp / NANOSECONDS, frame_id, clock=clock)


def _livox_points(data: bytes, encoding: str) -> tuple[str, Columns, str]:
    """Decode a ``CustomMsg``: its frame_id, its columns with times in seconds, and what is odd.

    A header, ``uint64 timebase``, ``uint32 point_num``, ``uint8 lidar_id``, ``uint8[3] rsvd`` and
    the points. In CDR, each value begins at a multiple of its size.
    """
    is_plain = encoding == "ros1"
    order = "<" if is_plain or data[1] % 2 else ">"
    body, at = (data, 12) if is_plain else (data[4:], 8)
    (length,) = struct.unpack_from(f"{order}I", body, at)
    frame_id = body[at + 4 : at + 4 + length].rstrip(b"\0").decode(errors="replace")
    at += 4 + length
    at += 0 if is_plain else -at % 8
    timebase, promised, count = struct.unpack_from(f"{order}QI4xI", body, at)
    at += 20
    kinds = [(name, f"{order}{kind}") for name, kind in LIVOX_POINT]
    point = np.dtype(kinds if is_plain else [*kinds, ("_", "u1")])
    size = count * point.itemsize
    # The last point may lack its padding, and a message may be padded itself.
    if not (len(body) == at + size if is_plain else -1 <= len(body) - at - size <= 3):
        promises = f"promises {count:,} points, {size:,} bytes of them"
        raise ReadError(f"{promises}; {len(body) - at:,} bytes follow")
    points = np.frombuffer(body[at : at + size].ljust(size, b"\0"), point, count)
    columns = {name: points[name] for name, _ in LIVOX_POINT}
    columns["time"] = timebase / NANOSECONDS + columns.pop("offset_time") / NANOSECONDS
    odd = "point_num is not the number of points in a message; those that are there are read"
    return frame_id, columns, odd if promised != count else ""


@cache
def _decoder(encoding: str) -> Callable[[bytes], Any]:
    from rosbags.typesys import Stores, get_typestore

    if encoding == "ros1":
        return partial(get_typestore(Stores.ROS1_NOETIC).deserialize_ros1, typename=CLOUDS)
    return partial(get_typestore(Stores.LATEST).deserialize_cdr, typename=CLOUDS)


def columns_of(message: Any) -> Columns:
    """Give the fields of a PointCloud2 by name, as arrays (N,) or (N, C) that share its bytes.

    Fields may be anywhere in a point, in either byte order, and rows and points may be padded.

    Parameters
    ----------
    message
        With the attributes of ``sensor_msgs/PointCloud2``.

    Raises
    ------
    ReadError
        If the layout contradicts itself or the size of the data.
    """
    data = np.asarray(message.data, np.uint8)
    height, width, step, row = message.height, message.width, message.point_step, message.row_step
    record = _record(message.fields, step, ">" if message.is_bigendian else "<")
    if height * width == 0:
        return {name: np.zeros(0, kind) for name, (kind, *_) in (record.fields or {}).items()}
    if step < SMALLEST_POINT and height * width > MAX_SMALL_POINTS:
        raise ReadError(
            f"{height * width:,} points of {step} bytes; of more than {MAX_SMALL_POINTS:,}, each "
            f"has {SMALLEST_POINT} or more: x, y and z as float32"
        )
    # Drivers set row_step wrong; it matters only if there are several rows with padding.
    if height == 1 or len(data) == height * width * step:
        row = width * step
    if row < width * step or (height - 1) * row + width * step > len(data):
        raise ReadError(
            f"{height} rows of {width} points of {step} bytes, {row} per row, do not fit its "
            f"{len(data)} bytes of data"
        )
    points: NDArray[Any] = np.ndarray((height, width), record, data, strides=(row, step))
    points = points.reshape(-1)
    return {name: points[name] for name in record.names or ()}


def _record(fields: Any, step: int, order: str) -> np.dtype[np.void]:
    """Give the data type of one point."""
    names, kinds, offsets = [], list[Any](), []
    for k, entry in enumerate(fields):
        if entry.datatype not in DATATYPES:
            raise ReadError(
                f"field {entry.name} has datatype {entry.datatype}, expected "
                f"{min(DATATYPES)} to {max(DATATYPES)}"
            )
        # PCL, and with it many drivers, writes a count of 0 for one value.
        count = max(entry.count, 1)
        kind = np.dtype(order + DATATYPES[entry.datatype])
        if entry.offset + count * kind.itemsize > step:
            raise ReadError(
                f"field {entry.name} ends at byte {entry.offset + count * kind.itemsize}, a point "
                f"has {step}"
            )
        # The name of a field has no blank, so these are not in use.
        names.append(f"_ {k}" if not entry.name or entry.name in names else entry.name)
        kinds.append((kind, (count,)) if count > 1 else kind)
        offsets.append(entry.offset)
    return np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": step})
