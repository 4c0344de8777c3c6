"""MCAP files with messages of ROS 1 or ROS 2, with or without an index.

The records are decoded by mcap; what a chunk unpacks to is bounded here, since mcap unpacks
whatever there is.
"""

from __future__ import annotations

import heapq
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from ..base.errors import ReadError
from .recordings import Bag, counted_topics
from .unpacking import Spend, allowance, opened_within, unpacked

if TYPE_CHECKING:
    from mcap.summary import Summary

FOOTER = 37
"""Bytes of the last record and of the mark at the end of the file."""

RECORD_COST = 512
"""Bytes that a record is counted as besides its own: so much memory and time it takes."""

MAX_WAITING = 2**28
"""Bytes of messages that may wait to be sorted by time, where chunks overlap."""

Entry = tuple[str, str, Any, str]
"""Topic, type, message and encoding."""


@contextmanager
def open_mcap(path: Path) -> Iterator[Bag]:
    """Open an MCAP file.

    Raises
    ------
    ReadError
        Where a chunk, or all of them, unpack to more than `unpacking` allows.
    """
    with opened_within(path) as file:
        size = path.stat().st_size
        index = _index(file)

        def entries(name: str | None) -> Iterator[Entry]:
            spend = allowance(size)
            if index.chunk_indexes:
                return _by_time(file, index, spend, name)
            return _in_turn(file, spend)

        if index.statistics:
            own = index.statistics.channel_message_counts
            topics = counted_topics(
                (channel.topic, _kind_of(index, channel), own.get(number, 0))
                for number, channel in index.channels.items()
            )
        else:
            topics = counted_topics((topic, kind, 1) for topic, kind, *_ in entries(None))

        def messages(name: str, kind: str) -> Iterator[tuple[int, bytes, str]]:
            for topic, own, message, encoding in entries(name):
                if (topic, own) == (name, kind):
                    yield message.log_time, message.data, encoding

        yield Bag(topics, messages)


def _index(file: BinaryIO) -> Summary:
    """Read the index at the end of a file; empty where it has none."""
    from mcap.records import Channel, ChunkIndex, Footer, Schema, Statistics
    from mcap.stream_reader import StreamReader
    from mcap.summary import Summary

    found = Summary()
    if file.seek(0, io.SEEK_END) < FOOTER:
        raise ValueError("it is too short")
    file.seek(-FOOTER, io.SEEK_END)
    footer = next(StreamReader(file, skip_magic=True, emit_chunks=True).records)
    if not isinstance(footer, Footer):
        raise ValueError("it does not end as such a file does")
    if footer.summary_start == 0:
        return found
    file.seek(footer.summary_start)
    for record in StreamReader(file, skip_magic=True, emit_chunks=True).records:
        if isinstance(record, Channel):
            found.channels[record.id] = record
        elif isinstance(record, Schema):
            found.schemas[record.id] = record
        elif isinstance(record, ChunkIndex):
            found.chunk_indexes.append(record)
        elif isinstance(record, Statistics):
            found.statistics = record
    return found


def _in_turn(file: BinaryIO, spend: Spend) -> Iterator[Entry]:
    """Give the messages as they stand: to sort those of a whole file would take its memory."""
    from mcap.stream_reader import StreamReader
    from mcap.summary import Summary

    index = Summary()
    file.seek(0)
    for record in StreamReader(file, emit_chunks=True).records:
        yield from entries_of(record, index, spend)


def entries_of(record: Any, index: Summary, spend: Spend) -> Iterator[Entry]:
    """Give the messages of a record, and keep in the index what it says of topics and types."""
    from mcap.records import Channel, Message, Schema

    for each in _parts(record, spend):
        if isinstance(each, Schema):
            index.schemas[each.id] = each
        elif isinstance(each, Channel):
            index.channels[each.id] = each
        elif isinstance(each, Message):
            yield _entry(index, each)


def _by_time(file: BinaryIO, index: Summary, spend: Spend, name: str | None) -> Iterator[Entry]:
    """Give the messages of the chunks that may have a topic, in the order of their times."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk, Message

    # Of a chunk, the time of its first message stands for all that it holds.
    waiting: list[tuple[int, int, int, Any]] = [
        (chunk.message_start_time, chunk.chunk_start_offset, -1, None)
        for chunk in index.chunk_indexes
        if name is None
        or not chunk.message_index_offsets
        or any(index.channels[n].topic == name for n in chunk.message_index_offsets)
    ]
    heapq.heapify(waiting)
    held = 0
    while waiting:
        _, start, _, message = heapq.heappop(waiting)
        if message is not None:
            held -= len(message.data) + RECORD_COST
            yield _entry(index, message)
            continue
        file.seek(start + 9)
        chunk = Chunk.read(ReadDataStream(file))
        for number, record in enumerate(_parts(chunk, spend)):
            if not isinstance(record, Message):
                continue
            if name is not None and index.channels[record.channel_id].topic != name:
                continue
            held += len(record.data) + RECORD_COST
            if held > MAX_WAITING:
                raise ReadError(
                    f"more than {MAX_WAITING:,} bytes of messages lie in chunks that overlap in "
                    "time; 'mcap sort' puts them in order"
                )
            heapq.heappush(waiting, (record.log_time, start, number, record))


def _entry(index: Summary, message: Any) -> Entry:
    channel = index.channels[message.channel_id]
    return channel.topic, _kind_of(index, channel), message, channel.message_encoding


def _parts(record: Any, spend: Spend) -> Iterator[Any]:
    """Give the records of a chunk one by one; any other record as it is."""
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Chunk, Message, Schema

    if not isinstance(record, Chunk):
        spend(RECORD_COST)
        yield record
        return
    data = unpacked(record.compression, record.data, spend)
    stream = ReadDataStream(io.BytesIO(data))
    readers: dict[int, Callable[[Any], Any]] = {
        Opcode.CHANNEL: Channel.read,
        Opcode.SCHEMA: Schema.read,
    }
    while stream.count < len(data):
        spend(RECORD_COST)
        code, length = stream.read1(), stream.read8()
        if code == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif code in readers:
            yield readers[code](stream)
        else:
            stream.read(length)


def _kind_of(index: Summary, channel: Any) -> str:
    """Name the type of a channel as ROS 2 does; ROS 1 has no ``msg`` in it."""
    schema = index.schemas.get(channel.schema_id)
    name: str = schema.name if schema else ""
    package, slash, kind = name.partition("/")
    return f"{package}/msg/{kind}" if slash and "/" not in kind else name
