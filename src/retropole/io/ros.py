"""ROS bags: .bag, .db3, .mcap and folders of ROS 2 bags, by rosbags and mcap (the extra ``ros``).

``sensor_msgs/PointCloud2`` has had one layout in ROS 1 and another in every ROS 2 so far, so the
definitions in a bag, if any, are not used. No ROS is needed.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingExtraError, ReadError
from .fields import Columns, frame_from_columns
from .recordings import CLOUDS, Frame, Recording, Topic, reported

BAGS = (".bag", ".db3", ".mcap")
"""Suffixes of bags."""

DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""From the number of a type in a PointField to its name in NumPy."""

REPAIR = (
    "; one that was cut short can be repaired by 'rosbag reindex' (.bag), 'ros2 bag reindex' (a "
    "folder) or 'mcap recover' (.mcap)"
)

SPECIAL = frozenset("%?#")
"""Characters of a path that mean something else in an address."""

MAX_LISTED = 10
"""Topics that a message names."""

NANOSECONDS = 1e9
"""In a second; bags count them."""


@dataclass(frozen=True, eq=False)
class _Bag:
    """An open bag: its topics, and time (ns), bytes and encoding of the messages of a topic.

    The encoding is ``ros1`` or ``cdr``.
    """

    topics: tuple[Topic, ...]
    messages: Callable[[str], Iterator[tuple[int, bytes, str]]]


def is_rosbag2(path: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return path.is_dir() and (path / "metadata.yaml").is_file()


def bag_topics(path: Path) -> tuple[Topic, ...]:
    """List the topics of a bag by name."""
    with _opened(path) as bag:
        return bag.topics


def open_bag(path: Path, topic: str | None = None) -> Recording:
    """Open a bag, and choose the topic of point clouds: the given one, or the only one.

    Raises
    ------
    MissingExtraError
        Where rosbags or mcap is not installed.
    ReadError
        Where the bag cannot be read, or not exactly one topic fits; lists those there are.
    """
    topics = bag_topics(path)
    chosen = _choose(path, topics, topic)
    return Recording(
        path,
        chosen.count,
        lambda numbers: _frames(path, chosen, numbers),
        topic=chosen.name,
    )


def _choose(path: Path, topics: tuple[Topic, ...], name: str | None) -> Topic:
    clouds = [topic for topic in topics if topic.of_clouds]
    if not clouds:
        raise ReadError(
            f"{path}: has no topic of {CLOUDS}; its topics are: {_listed(topics, kinds=True)}"
        )
    if name is not None:
        found = [topic for topic in topics if topic.name == name]
        if not found:
            raise ReadError(f"{path}: has no topic {name}; those of clouds are: {_listed(clouds)}")
        if not found[0].of_clouds:
            raise ReadError(
                f"{path}: topic {name} is of {found[0].kind}, expected {CLOUDS}; topics of that "
                f"are: {_listed(clouds)}"
            )
        if not found[0].count:
            raise ReadError(f"{path}: topic {name} has no messages")
        return found[0]
    filled = [topic for topic in clouds if topic.count]
    if not filled:
        raise ReadError(f"{path}: its topics of point clouds have no messages: {_listed(clouds)}")
    if len(filled) > 1:
        raise ReadError(
            f"{path}: has {len(filled)} topics of point clouds, name one of them: {_listed(filled)}"
        )
    return filled[0]


def _listed(topics: tuple[Topic, ...] | list[Topic], *, kinds: bool = False) -> str:
    words = [
        f"{topic.name} ({topic.kind + ', ' if kinds else ''}{topic.count} messages)"
        for topic in topics[:MAX_LISTED]
    ]
    more = len(topics) - MAX_LISTED
    return ", ".join(words) + (f" and {more} more" if more > 0 else "") if words else "none"


def _frames(path: Path, topic: Topic, numbers: range) -> Iterator[Frame]:
    """Decode the chosen messages of a topic, each when it is requested."""
    with _opened(path) as bag:
        number = -1
        for number, (stamp, data, encoding) in enumerate(bag.messages(topic.name)):
            if number in numbers:
                yield _frame(path, topic, number, stamp, data, encoding)
            if number == numbers[-1]:
                return
        raise ReadError(
            f"{path}: promises {topic.count} messages on {topic.name}, holds {number + 1}"
        )


def _frame(path: Path, topic: Topic, number: int, stamp: int, data: bytes, encoding: str) -> Frame:
    where = f"{path}: message {number} of {topic.name}"
    try:
        message = _decoder(encoding)(data)
        columns = columns_of(message)
    except ReadError as error:
        raise ReadError(f"{where}: {error}") from None
    except Exception as error:
        # The decoders let pass whatever is raised when bytes do not fit.
        raise ReadError(f"{where}: is not a readable {CLOUDS} ({error})") from None
    cloud = frame_from_columns(where, columns)
    return Frame(number, cloud, stamp / NANOSECONDS, message.header.frame_id)


@functools.cache
def _decoder(encoding: str) -> Callable[[bytes], Any]:
    from rosbags.typesys import Stores, get_typestore

    if encoding == "ros1":
        store = get_typestore(Stores.ROS1_NOETIC)
        return lambda data: store.deserialize_ros1(data, CLOUDS)
    store = get_typestore(Stores.LATEST)
    return lambda data: store.deserialize_cdr(data, CLOUDS)


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
        Where the layout contradicts itself or the size of the data.
    """
    data = np.asarray(message.data, np.uint8)
    height, width, step, row = message.height, message.width, message.point_step, message.row_step
    record = _record(message.fields, step, ">" if message.is_bigendian else "<")
    if height * width == 0:
        return {name: np.zeros(0, kind) for name, (kind, *_) in (record.fields or {}).items()}
    # Drivers set row_step wrong; it matters only where there are several rows with padding.
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


@contextmanager
def _opened(path: Path) -> Iterator[_Bag]:
    """Open a bag of any format; a failure names the file and what to do."""
    if path.is_file() and path.stat().st_size == 0:
        raise ReadError(f"{path}: is empty, expected a bag")
    try:
        import mcap.reader  # noqa: F401
        import rosbags.rosbag1
        import rosbags.rosbag2
    except ImportError:
        raise MissingExtraError("ros", "reading ROS bags") from None
    with reported(path, "bag", REPAIR):
        if path.suffix.lower() == ".mcap" and path.is_file():
            with _mcap(path) as bag:
                yield bag
        elif path.suffix.lower() == ".bag" and path.is_file():
            with rosbags.rosbag1.Reader(path) as reader:
                yield _from_rosbags(reader, "ros1")
        else:
            with _plainly_named(path) as plain, rosbags.rosbag2.Reader(plain) as reader:
                yield _from_rosbags(reader, "cdr")


@contextmanager
def _plainly_named(path: Path) -> Iterator[Path]:
    """Give a ROS 2 bag a name that rosbags opens as it is.

    It opens SQLite files by address: of ``run%41.db3`` it would read ``runA.db3``, and of what has
    a ``?`` or ``#`` the part before.
    """
    inside = path.iterdir() if path.is_dir() else ()
    for file in inside:
        if SPECIAL & set(file.name) and file.suffix.lower() == ".db3":
            raise ReadError(
                f"{path}: {file.name} has one of {' '.join(sorted(SPECIAL))} in its name, by which "
                "another file would be read: rename it, also in metadata.yaml"
            )
    if not SPECIAL & set(str(path)) and (path.is_dir() or path.suffix in BAGS):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / ("bag" if path.is_dir() else f"bag{path.suffix.lower()}")
        plain.symlink_to(path.resolve())
        yield plain


def _from_rosbags(reader: Any, encoding: str) -> _Bag:
    counts: dict[tuple[str, str], int] = {}
    for own in reader.connections:
        key = own.topic, own.msgtype
        counts[key] = counts.get(key, 0) + own.msgcount

    def messages(name: str) -> Iterator[tuple[int, bytes, str]]:
        wanted = [own for own in reader.connections if (own.topic, own.msgtype) == (name, CLOUDS)]
        for _, stamp, data in reader.messages(connections=wanted):
            yield stamp, data, encoding

    return _Bag(tuple(Topic(*key, count) for key, count in sorted(counts.items())), messages)


@contextmanager
def _mcap(path: Path) -> Iterator[_Bag]:
    """Open an MCAP file with messages of ROS 1 or ROS 2, with or without an index."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        indexed = summary is not None and summary.statistics is not None
        counts: dict[tuple[str, str], int] = {}
        if summary is not None and summary.statistics is not None:
            for number, channel in summary.channels.items():
                schema = summary.schemas.get(channel.schema_id)
                key = channel.topic, _kind(schema.name if schema else "")
                own = summary.statistics.channel_message_counts.get(number, 0)
                counts[key] = counts.get(key, 0) + own
        else:
            for schema, channel, _ in reader.iter_messages(log_time_order=False):
                key = channel.topic, _kind(schema.name if schema else "")
                counts[key] = counts.get(key, 0) + 1

        def messages(name: str) -> Iterator[tuple[int, bytes, str]]:
            # Without an index, sorting by time would hold the whole file in memory.
            for schema, channel, message in reader.iter_messages(
                topics=[name], log_time_order=indexed
            ):
                if schema is not None and _kind(schema.name) == CLOUDS:
                    yield message.log_time, message.data, channel.message_encoding

        yield _Bag(tuple(Topic(*key, count) for key, count in sorted(counts.items())), messages)


def _kind(name: str) -> str:
    """Name a type as ROS 2 does; ROS 1 has no ``msg`` in it."""
    package, slash, kind = name.partition("/")
    return f"{package}/msg/{kind}" if slash and "/" not in kind else name
