"""Bags that are being recorded: what was added since the last look, of .mcap and .db3.

An MCAP file has its index at its end, so that there is none yet: whole records are read in turn.
"""

from __future__ import annotations

import sqlite3
import struct
from collections import Counter
from collections.abc import Callable
from io import SEEK_END, BytesIO
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, Protocol

from ...base.errors import ReadError
from ...base.files import check_is_file
from ..bags import MAX_TOPICS, entries_of, open_database, topics_in
from ..recordings import CLOUDS, holds_clouds
from ..ros import MAX_LISTED
from ..unpacking import LARGEST_RECORD, MAX_UNPACKED, allowance, opened_within

if TYPE_CHECKING:
    from mcap.summary import Summary

MCAP_START = b"\x89MCAP0\r\n"
"""First bytes of an MCAP file."""

RECORD_HEADER = 9
"""Bytes before the content of a record: its kind, and its length."""

READ = 3, 4, 5, 6
"""Kinds of records that are read: schemas, channels, messages and chunks."""

LARGEST_SKIPPED = 2**32
"""Bytes of others, as of attachments; what says that it is larger is damage."""

HAS_LOG = b"\x02\x02"
"""Bytes 18 and 19 of a database of SQLite with a log ahead of it (WAL)."""


class Message(NamedTuple):
    """A message with a cloud that is not decoded: its time (ns), bytes and encoding."""

    stamp: int
    data: bytes
    encoding: str


class Recorded:
    """What was read of a bag so far: its topics, and of those with clouds the newest message.

    Parameters
    ----------
    topic
        The one that is wanted; None where it is the only one with clouds.
    """

    def __init__(self, topic: str | None) -> None:
        self._topic = topic
        self._kinds: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._newest: dict[str, Message] = {}

    def wants(self, topic: str, kind: str) -> bool:
        """Keep the type of a topic in mind, and tell whether its messages are wanted."""
        self._kinds[topic] = kind
        return holds_clouds(kind) and self._topic in (None, topic)

    def put(self, topic: str, message: Message, count: int = 1) -> None:
        """Take the last of so many messages that came."""
        self._counts[topic] += count
        self._newest[topic] = message

    @property
    def lacks(self) -> str:
        """In words what is missing: messages, or the topic."""
        clouds = [self._topic] if self._topic else self._clouds
        if len(clouds) == 1 and clouds[0] in self._kinds:
            return f"nothing is recorded on {clouds[0]}"
        wanted = f"topic {self._topic}" if self._topic else f"topic of {CLOUDS}"
        have = [f"{name} ({kind})" for name, kind in sorted(self._kinds.items())]
        return f"has no {wanted} yet; its topics are: {', '.join(have[:MAX_LISTED]) or 'none'}"

    @property
    def _clouds(self) -> list[str]:
        return sorted(name for name, kind in self._kinds.items() if holds_clouds(kind))

    def take(self) -> tuple[str, str, int, Message] | None:
        """Give topic, type, number and message of the newest cloud, and stay with that topic.

        Raises
        ------
        ReadError
            Where the topic is of another type, or none was asked for and several have clouds.
        """
        clouds = self._clouds
        listed = ", ".join(clouds[:MAX_LISTED]) or "none"
        if self._topic is None and len(clouds) > 1:
            raise ReadError(f"has {len(clouds)} topics of point clouds, name one of them: {listed}")
        kind = self._kinds.get(self._topic or "", CLOUDS)
        if not holds_clouds(kind):
            other = f"topic {self._topic} is of {kind}, expected {CLOUDS}"
            raise ReadError(f"{other}; topics of that are: {listed}")
        chosen = self._topic or next(iter(self._newest), "")
        message = self._newest.pop(chosen, None)
        if message is None:
            return None
        self._topic = chosen
        return chosen, self._kinds[chosen], self._counts[chosen] - 1, message


class Part(Protocol):
    """A file of a bag, and how far it was read."""

    has_ended: bool

    def read_on(self, into: Recorded, until: float) -> bool:
        """Read what was added; tell whether that is all, or the time (monotonic) was up before.

        Raises
        ------
        ReadError
            Where what was added is damaged; the next call goes on behind it if it can.
        """
        ...


class GrowingMcap:
    """An MCAP file."""

    def __init__(self, path: Path) -> None:
        self.has_ended = False
        self._path = path
        self._begin()

    def _begin(self) -> None:
        from mcap.summary import Summary

        self._at = 0
        self._index: Summary = Summary()

    def read_on(self, into: Recorded, until: float) -> bool:
        """Read the records that are whole by now."""
        with opened_within(self._path) as file:
            size = file.seek(0, SEEK_END)
            if size < self._at:
                self._begin()  # somebody records anew under the same name
            if self._at == 0:
                file.seek(0)
                start = file.read(len(MCAP_START))
                if not MCAP_START.startswith(start):
                    raise ReadError(f"starts with {start!r}, expected an MCAP file")
                if len(start) < len(MCAP_START):
                    return True
                self._at = len(start)
            while self._at + RECORD_HEADER <= size:
                file.seek(self._at)
                code, length = struct.unpack("<BQ", file.read(RECORD_HEADER))
                if code == 0 or length > (LARGEST_RECORD if code in READ else LARGEST_SKIPPED):
                    raise ReadError(
                        f"is damaged at byte {self._at}: a record of kind {code} and {length:,} "
                        "bytes is none"
                    )
                if self._at + RECORD_HEADER + length > size:
                    break
                # Before it is read: of a damaged one, its end is known.
                self._at += RECORD_HEADER + length
                self._read(code, length, file, into)
                if monotonic() > until:
                    return False
        return True

    def _read(self, code: int, length: int, file: BinaryIO, into: Recorded) -> None:
        from mcap.data_stream import ReadDataStream
        from mcap.opcode import Opcode
        from mcap.records import Channel, Chunk, Schema
        from mcap.records import Message as Entry

        readers: dict[int, Callable[[Any], Any]] = {
            Opcode.CHUNK: Chunk.read,
            Opcode.CHANNEL: Channel.read,
            Opcode.SCHEMA: Schema.read,
            Opcode.MESSAGE: lambda stream: Entry.read(stream, length),
        }
        if code == Opcode.FOOTER:
            self.has_ended = True
        if code not in READ:
            return
        # Alone, so that nothing in it leads beyond it.
        record = readers[code](ReadDataStream(BytesIO(file.read(length))))
        spend = allowance(length, MAX_UNPACKED)
        for topic, kind, entry, encoding in entries_of(record, self._index, spend):
            if into.wants(topic, kind):
                into.put(topic, Message(entry.log_time, entry.data, encoding))


class GrowingDatabase:
    """A database of SQLite.

    Each look opens it and lets it go again, so that no recorder has to wait long.
    """

    has_ended = False

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last = 0

    def read_on(self, into: Recorded, until: float) -> bool:
        """Read the rows that follow the last one."""
        check_is_file(self._path)
        # With a log ahead of it (WAL), what was recorded last is there alone.
        log = self._path.with_name(f"{self._path.name}-wal")
        size = self._path.stat().st_size + (log.stat().st_size if log.exists() else 0)
        if size == 0:
            return True
        with self._path.open("rb") as file:
            has_log = file.read(20)[18:] == HAS_LOG
        # One that is closed has put its log away; to look for it would make an empty one.
        mode = "ro&immutable=1" if has_log and not log.exists() else "ro"
        try:
            with open_database(self._path, size, mode) as database:
                self._read(database, into)
        except sqlite3.OperationalError as error:
            # It is being written right now.
            if error.sqlite_errorcode & 0xFF not in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
                raise
        return True

    def _read(self, database: sqlite3.Connection, into: Recorded) -> None:
        names = {
            number: name for number, name, kind in topics_in(database) if into.wants(name, kind)
        }
        ((last,),) = database.execute("SELECT max(rowid) FROM messages").fetchall()
        if (last or 0) < self._last:
            self._last = 0  # somebody records anew under the same name
        # All rows are fetched: as long as some are left, the recorder cannot write.
        found = database.execute(
            "SELECT topic_id, count(*), max(rowid) FROM messages WHERE rowid > ? "
            "GROUP BY topic_id ORDER BY max(rowid) LIMIT ?",
            [self._last, MAX_TOPICS],
        ).fetchall()
        for number, count, row in found:
            self._last = max(self._last, row)
            if number not in names:
                continue
            query = "SELECT timestamp, data FROM messages WHERE rowid = ?"
            ((stamp, data),) = database.execute(query, [row]).fetchall()
            if not isinstance(stamp, int) or not isinstance(data, bytes):
                raise ReadError(f"message {row} is no time and bytes")
            into.put(names[number], Message(stamp, data, "cdr"), count)


PARTS: dict[str, Callable[[Path], Part]] = {".mcap": GrowingMcap, ".db3": GrowingDatabase}
"""From the suffix of a file to what reads it while it grows."""
