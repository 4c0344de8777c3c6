"""Bags of all kinds as files: .bag, .db3, .mcap, and folders of ROS 2 bags (the extra ``ros``).

.db3 is SQLite, and a database is a program too: a view or a computed column may run for ever and
make GiB of nothing. So only tables of plain columns are read, messages are of bounded length, and
the steps of SQLite are counted. The records of an MCAP are decoded by mcap; what a chunk unpacks to
is bounded here, since mcap unpacks whatever there is. rosbags reads ROS 1 bags; of an MCAP it reads
no messages of ROS 1, and it limits neither the unpacked size of a chunk nor the work of SQLite.
"""

from __future__ import annotations

import bz2
import heapq
import io
import re
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, BinaryIO

from ..base.errors import MissingExtraError, ReadError, naming, reported
from ..base.files import check_is_file
from .recordings import MAX_MESSAGES, Bag, counted_topics
from .unpacking import LARGEST_RECORD, Spend, allowance, opened_within, unpack_file, unpacked

if TYPE_CHECKING:
    from mcap.summary import Summary

REPAIR = (
    "; one that was cut short can be repaired by 'rosbag reindex' (.bag), 'ros2 bag reindex' (a "
    "folder) or 'mcap recover' (.mcap)"
)

METADATA = "metadata.yaml"
"""File that makes a folder a ROS 2 bag."""

MAX_METADATA = 2**20
"""Bytes of the metadata of a bag; those of 100 topics have 1e5, and 6 levels."""

TABLES = ("topics", "messages")

MAX_TOPICS = 10_000
"""More are not read."""

STEPS_COUNTED = 10_000
"""Steps of SQLite between two counts."""


def is_rosbag2(path: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return path.is_dir() and (path / METADATA).is_file()


def check_extra() -> None:
    """Check that what reads bags is installed.

    Raises
    ------
    MissingExtraError
        If it is not.
    """
    try:
        import mcap.records  # noqa: F401
        import rosbags.rosbag1  # noqa: F401
    except ImportError:
        raise MissingExtraError("ros", "reading ROS bags") from None


@contextmanager
def opened(path: Path) -> Iterator[Bag]:
    """Open a bag of any format; a failure names the file and what to do.

    Raises
    ------
    MissingExtraError
        If rosbags or mcap is not installed.
    ReadError
        If it cannot be read, or takes more memory or time than a file of its size can need.
    """
    if path.is_file() and path.stat().st_size == 0:
        raise ReadError(f"{path}: is empty, expected a bag")
    check_extra()
    open_one = _folder if path.is_dir() else OPENERS[path.suffix.lower()]
    with naming(path), reported("bag", REPAIR), open_one(path) as bag:
        yield bag


@contextmanager
def _ros1(path: Path) -> Iterator[Bag]:
    """Open a ROS 1 bag by rosbags, with bounds on what its chunks and its index may take."""
    import lz4.frame
    from rosbags import rosbag1

    size = path.stat().st_size
    spend = allowance(size)
    indexed = 0
    kinds = {bz2.decompress: "bz2", lz4.frame.decompress: "lz4"}

    class Reader(rosbag1.Reader):
        def read_chunk(self) -> Any:
            chunk = super().read_chunk()
            if chunk.datasize > LARGEST_RECORD:
                raise ReadError(f"a chunk of {chunk.datasize:,} bytes, too large for a recording")
            kind = kinds.get(chunk.decompressor, "")
            return chunk._replace(decompressor=lambda data: unpacked(kind, data, spend))

        def read_index_data(self, pos: int, indexes: Any) -> None:
            nonlocal indexed
            file: Any = self.bio
            start = file.tell()
            super().read_index_data(pos, indexes)
            indexed += file.tell() - start
            # In the index, a message takes 12 bytes.
            if indexed > min(size, MAX_MESSAGES * 12):
                raise ReadError(
                    f"its index has more than {indexed // 12:,} messages; up to "
                    f"{MAX_MESSAGES:,} are read, and no more than fit into its {size:,} bytes"
                )

    with Reader(path) as reader:

        def messages(name: str, kind: str) -> Iterator[tuple[int, bytes, str]]:
            wanted = [own for own in reader.connections if (own.topic, own.msgtype) == (name, kind)]
            for _, stamp, data in reader.messages(connections=wanted):
                spend(len(data))
                yield stamp, data, "ros1"

        parts = ((own.topic, own.msgtype, own.msgcount) for own in reader.connections)
        yield Bag(counted_topics(parts), messages)


@contextmanager
def open_database(path: Path, size: int, mode: str) -> Iterator[sqlite3.Connection]:
    """Open a bag in SQLite.

    Parameters
    ----------
    path, size
        The file, and its bytes.
    mode
        Of SQLite's addresses: ``ro``, or ``ro&immutable=1`` where nobody writes it.

    Raises
    ------
    ReadError
        If its topics and messages are not plain tables, or if to read it takes more than a
        file of its size can need.
    """
    # An address, since only that can state that the file does not change; as_uri quotes the path.
    address = f"{path.absolute().as_uri()}?mode={mode}"
    # Half a second to wait for a recorder that is writing.
    with closing(sqlite3.connect(address, 0.5, uri=True)) as database:
        database.text_factory = lambda text: text.decode(errors="replace")
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(size, LARGEST_RECORD))
        database.execute("PRAGMA trusted_schema=OFF")
        with _counted_steps(size, database):
            _check_tables(database)
            yield database


def topics_in(database: sqlite3.Connection) -> list[tuple[int, str, str]]:
    """List number, name and type of the topics, at most one more than `MAX_TOPICS`."""
    query = f"SELECT id, {_text('name')}, {_text('type')} FROM topics LIMIT ?"
    return database.execute(query, [MAX_TOPICS + 1]).fetchall()


@contextmanager
def _sqlite(path: Path) -> Iterator[Bag]:
    size = path.stat().st_size
    with open_database(path, size, "ro&immutable=1") as database:
        topics = topics_in(database)
        counts = dict(
            database.execute(
                "SELECT topic_id, count(*) FROM messages GROUP BY topic_id LIMIT ?",
                [MAX_TOPICS + 1],
            )
        )
        if max(len(topics), len(counts)) > MAX_TOPICS or sum(counts.values()) > MAX_MESSAGES:
            raise ReadError(
                f"has {sum(counts.values()):,} messages and {len(topics):,} topics, up to "
                f"{MAX_MESSAGES:,} and {MAX_TOPICS:,} are read; 'ros2 bag convert' splits it"
            )

        def messages(name: str, kind: str) -> Iterator[tuple[int, bytes, str]]:
            own = [number for number, *key in topics if key == [name, kind]]
            # Only what is short is sorted; the messages are fetched one by one.
            rows = database.execute(
                "SELECT rowid, timestamp FROM messages "
                f"WHERE topic_id IN ({','.join('?' * len(own))}) ORDER BY timestamp, rowid",
                own,
            ).fetchall()
            spend = allowance(size)
            for row, stamp in rows:
                found = database.execute("SELECT data FROM messages WHERE rowid = ?", [row])
                data = found.fetchone()[0]
                if not isinstance(data, bytes):
                    raise ReadError(f"message {row} is of {type(data).__name__}, expected bytes")
                spend(len(data))
                yield stamp, data, "cdr"

        parts = ((name, kind, counts.get(number, 0)) for number, name, kind in topics)
        yield Bag(counted_topics(parts), messages)


def _text(column: str) -> str:
    """Read a column as text, whatever it contains: SQLite lets any value be of any type."""
    return f"substr(CAST(coalesce({column}, '') AS TEXT), 1, 1000)"


def _check_tables(database: sqlite3.Connection) -> None:
    """Refuse topics or messages that are computed when they are read."""
    for name in TABLES:
        # SQLite goes by this text and not by the type that is next to it.
        found = database.execute(
            "SELECT sql FROM sqlite_master WHERE lower(name) = ? LIMIT 1", [name]
        ).fetchone()
        if found is None:
            raise ReadError(f"is a database without the table {name}, expected a bag")
        hidden = [row[6] for row in database.execute(f"PRAGMA table_xinfo({name})")]
        if not re.match(r"CREATE\s+TABLE\s", str(found[0]), re.IGNORECASE) or any(hidden):
            raise ReadError(
                f"{name} is not a table of plain columns but computed when it is read, which "
                "recorders do not write"
            )


@contextmanager
def _counted_steps(size: int, database: sqlite3.Connection) -> Iterator[None]:
    """Stop SQLite where it takes more steps than a file of that size can need, and by Ctrl-C."""
    # To count and to sort the messages takes about 30 steps for each, which has 20 bytes at least.
    left = (1_000_000 + 5 * size) // STEPS_COUNTED

    def is_over() -> bool:
        nonlocal left
        left -= 1
        return left < 0

    database.set_progress_handler(is_over, STEPS_COUNTED)
    try:
        yield
    except sqlite3.OperationalError as error:
        if "interrupted" not in str(error):
            raise
        if left >= 0:  # by what was raised while it counted, which sqlite3 swallows
            raise KeyboardInterrupt from None
        raise ReadError(
            f"reading it takes more steps than a database of {size:,} bytes can need: it is "
            "damaged, or its content is computed"
        ) from None


FOOTER = 37
"""Bytes of the last record and of the mark at the end of the file."""

RECORD_COST = 512
"""Bytes that a record costs in addition to its size, by the memory and time that it takes."""

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
        If a chunk, or all chunks, unpack to more than `unpacking` allows.
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
    """Read the index at the end of a file; empty if it has none."""
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
    """Give the messages in file order: to sort those of a whole file would take its memory."""
    from mcap.stream_reader import StreamReader
    from mcap.summary import Summary

    index = Summary()
    file.seek(0)
    for record in StreamReader(file, emit_chunks=True).records:
        yield from entries_of(record, index, spend)


def entries_of(record: Any, index: Summary, spend: Spend) -> Iterator[Entry]:
    """Give the messages of a record, and keep its topics and types in the index."""
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

    # Of a chunk, the time of its first message is used for all messages in it.
    waiting: list[tuple[int, int, int, Any]] = [
        (chunk.message_start_time, chunk.chunk_start_offset, -1, None)
        for chunk in index.chunk_indexes
        if name is None
        or not chunk.message_index_offsets
        or any(index.channels[n].topic == name for n in chunk.message_index_offsets)
    ]
    heapq.heapify(waiting)
    buffered = 0
    while waiting:
        _, start, _, message = heapq.heappop(waiting)
        if message is not None:
            buffered -= len(message.data) + RECORD_COST
            yield _entry(index, message)
            continue
        file.seek(start + 9)
        chunk = Chunk.read(ReadDataStream(file))
        for number, record in enumerate(_parts(chunk, spend)):
            if not isinstance(record, Message):
                continue
            if name is not None and index.channels[record.channel_id].topic != name:
                continue
            buffered += len(record.data) + RECORD_COST
            if buffered > MAX_WAITING:
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


OPENERS = {".bag": _ros1, ".db3": _sqlite, ".mcap": open_mcap}

BAGS = tuple(OPENERS)
"""Suffixes of bags."""


@contextmanager
def _folder(path: Path) -> Iterator[Bag]:
    """Open the files of a ROS 2 bag one after the other, as its metadata name them."""
    about = _metadata(path)
    storage = str(about["storage_identifier"])
    suffix = {"mcap": ".mcap", "sqlite3": ".db3"}.get(storage)
    if not storage:  # as some programs leave it, the files show it
        suffix = next((PurePath(str(name)).suffix for name in about["relative_file_paths"]), None)
        suffix = suffix if suffix in OPENERS else None
    mode = str(about.get("compression_mode") or "none").lower()
    kind = str(about.get("compression_format") or "")
    is_known = mode == "none" or (mode in ("file", "message") and kind == "zstd")
    if suffix is None or not is_known:
        raise ReadError(
            f"its storage is {storage}, its compression {mode} {kind}; "
            "expected mcap or sqlite3, and none or zstd"
        )
    files = [path / PurePath(str(name)).name for name in about["relative_file_paths"]]
    for file in files:
        check_is_file(file)
    spend = allowance(sum(file.stat().st_size for file in files))
    with ExitStack() as stack:
        if mode == "file":
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            packed, files = files, [folder / f"{k}{suffix}" for k in range(len(files))]
            for file, to in zip(packed, files, strict=True):
                unpack_file(file, to, "zstd", spend)
        bags = []
        for file in files:
            with naming(file.name):
                bags.append(stack.enter_context(OPENERS[suffix](file)))
        packing = "zstd" if mode == "message" else ""

        def messages(name: str, kind: str) -> Iterator[tuple[int, bytes, str]]:
            for bag, file in zip(bags, files, strict=True):
                with naming(file.name):
                    for stamp, data, encoding in bag.messages(name, kind):
                        yield stamp, unpacked(packing, data, spend), encoding

        topics = [(own.name, own.kind, own.count) for bag in bags for own in bag.topics]
        yield Bag(counted_topics(topics), messages)


def _metadata(path: Path) -> dict[str, Any]:
    """Read the names of the files in the metadata of a ROS 2 bag.

    Raises
    ------
    ReadError
        If they are longer than any, nested without end, or have aliases, which grow.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent

    file = path / METADATA
    with file.open("rb") as read:
        text = read.read(MAX_METADATA + 1)
    depth, is_plain = 0, len(text) <= MAX_METADATA
    for event in YAML(typ="safe").parse(text) if is_plain else ():
        depth += isinstance(event, CollectionStartEvent)
        depth -= isinstance(event, CollectionEndEvent)
        is_plain &= depth <= 20 and not isinstance(event, AliasEvent)
        if not is_plain:
            break
    if not is_plain:
        raise ReadError(
            f"{METADATA}: more than {MAX_METADATA:,} bytes or 20 levels, or an "
            "alias, which the metadata of no bag have"
        )
    found: dict[str, Any] = YAML(typ="safe").load(text)["rosbag2_bagfile_information"]
    return found
