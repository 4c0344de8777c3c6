"""Folders that grow by files, and bags that are being recorded: independent of their writer, they
are read on from the end of the last look.

An MCAP file has its index at its end, so that there is none yet: whole records are read in turn.
"""

from __future__ import annotations

import sqlite3
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from io import SEEK_END, BytesIO
from pathlib import Path
from stat import S_ISREG
from threading import Event
from time import monotonic
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, Protocol

import numpy as np

from ...base.errors import ReadError, UsageError, naming, readable, reported
from ...base.files import check_is_file
from ...base.quantities import counted
from .. import READERS, open_recording
from ..bags import MAX_TOPICS, check_extra, entries_of, open_database, topics_in
from ..fields import USUAL, Wanted
from ..recordings import CLOUDS, Frame, has_clouds, time_of_recording
from ..ros import MAX_LISTED, frame_of
from ..unpacking import LARGEST_RECORD, MAX_UNPACKED, allowance, opened_within
from .replay import QUIET

if TYPE_CHECKING:
    from mcap.summary import Summary

POLL = 0.1
"""Seconds between two looks: as often as most sensors turn."""

UNCHANGED_FOR, GIVE_UP = 0.3, 2.0
"""Seconds without a change after which a file is tried, since some formats do not show that a part
is missing; and after which one that cannot be read is not tried again."""

READ_ON = 0.5
"""Seconds for which a look reads what was recorded before, also if it is to wait for less."""


MCAP_START = b"\x89MCAP0\r\n"
"""First bytes of an MCAP file."""

RECORD_HEADER = 9
"""Bytes before the content of a record: its kind, and its length."""

READ = 3, 4, 5, 6
"""Kinds of records that are read: schemas, channels, messages and chunks."""

LARGEST_SKIPPED = 2**32
"""Bytes of others, as of attachments; a larger size is damage."""


class _Looking:
    """What both sources share: they look again and again until there is news."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._closed = Event()
        self._last = -np.inf
        self._lacks = "nothing received yet"

    @property
    def waits_for(self) -> str:
        """In words why nothing comes."""
        return "" if monotonic() - self._last < QUIET else self._lacks

    def newest(self, wait: float) -> Frame | None:
        """Give the newest sweep, as `Source` says."""
        until = monotonic() + wait
        while not self._closed.is_set():
            frame = self._look(until)
            now = monotonic()
            if frame is not None:
                self._last = now
                return frame
            if now >= until:
                return None
            self._closed.wait(min(POLL, until - now))
        return None

    def close(self) -> None:
        """End a wait, as `Source` says; no file stays open between two looks."""
        self._closed.set()

    def _look(self, until: float) -> Frame | None:
        raise NotImplementedError


class _Version(NamedTuple):
    """What changes where a file is written."""

    written: int
    size: int


@dataclass
class _File:
    """A file in one version: since when it is so, and whether it was given or cannot be read."""

    version: _Version
    since: float
    is_done: bool = False
    has_failed: bool = False


class FolderSource(_Looking):
    """A folder to which somebody adds a file for each sweep, or writes the same one again.

    Parameters
    ----------
    folder
        Its files that are point clouds are sweeps, of one format or several; hidden ones are not.
    wanted
        Field of their intensity.

    Raises
    ------
    ReadError
        If there is no such folder.
    """

    has_ended = False

    def __init__(self, folder: Path, wanted: Wanted = USUAL) -> None:
        if not folder.is_dir():
            raise ReadError(f"{folder}: there is no such folder")
        super().__init__(f"folder:{folder}")
        self._folder, self._wanted = folder, wanted
        self._files: dict[Path, _File] = {}
        self._count = 0
        self._see()

    def _see(self) -> list[Path]:
        """List the files that were not given yet, the newest first."""
        now = monotonic()
        with readable(self._folder):
            there = {path: _version_of(path) for path in self._folder.iterdir() if _may_be(path)}
        known, found = self._files, {path: own for path, own in there.items() if own is not None}
        self._files = {
            path: known[path] if path in known and known[path].version == own else _File(own, now)
            for path, own in found.items()
        }
        news = {path: each.version for path, each in self._files.items() if not each.is_done}
        self._lacks = (
            f"{self._folder}: no new file appears"
            if found
            else f"{self._folder}: has no point clouds yet, expected files of {', '.join(READERS)}"
        )
        odd = sorted(p.name for p in there.keys() - found.keys() if not p.is_dir())
        if odd:
            self._lacks += f"; {counted(len(odd), 'name')} left out, such as {odd[0]}, not a file"
        # Of files that were copied at once, the longer number is the later one.
        return sorted(news, key=lambda p: (news[p].written, len(p.name), p.name), reverse=True)

    def _look(self, until: float) -> Frame | None:
        news = self._see()
        for k, path in enumerate(news):
            file = self._files[path]
            unchanged = monotonic() - file.since
            if unchanged < UNCHANGED_FOR or (file.has_failed and unchanged < GIVE_UP):
                continue
            try:
                frame = next(open_recording(path, wanted=self._wanted).read(range(1)))
            except ReadError:
                if _version_of(path) != file.version:
                    continue
                file.has_failed = True
                if unchanged < GIVE_UP:
                    continue
                self._finish([path])
                raise
            if _version_of(path) != file.version:
                continue
            self._finish(news[k:])
            recorded = time_of_recording(frame.cloud)
            return Frame(self._count - 1, frame.cloud, recorded[0] if recorded else None)
        return None

    def _finish(self, paths: list[Path]) -> None:
        """Give or leave out files for good, in the version that they have now."""
        for path in paths:
            self._files[path].is_done = True
        self._count += len(paths)


def _may_be(path: Path) -> bool:
    """Whether a name is one of a point cloud."""
    return not path.name.startswith(".") and path.suffix.lower() in READERS


def _version_of(path: Path) -> _Version | None:
    """Give the version of a file; None if it is none, or is gone."""
    try:
        about = path.stat()
    except OSError:
        return None
    return _Version(about.st_mtime_ns, about.st_size) if S_ISREG(about.st_mode) else None


class Message(NamedTuple):
    """A message with a cloud that is not decoded: its time (ns), bytes and encoding."""

    stamp: int
    data: bytes
    encoding: str


class Recorded:
    """What was read of a bag until now: its topics, and of those with clouds the newest message.

    Parameters
    ----------
    topic
        The one that is wanted; None if it is the only one with clouds.
    """

    def __init__(self, topic: str | None) -> None:
        self._topic = topic
        self._kinds: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._newest: dict[str, Message] = {}

    def wants(self, topic: str, kind: str) -> bool:
        """Keep the type of a topic in mind, and return whether its messages are wanted."""
        self._kinds[topic] = kind
        return has_clouds(kind) and self._topic in (None, topic)

    def put(self, topic: str, message: Message, count: int = 1) -> None:
        """Read the last of this many messages."""
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
        return sorted(name for name, kind in self._kinds.items() if has_clouds(kind))

    def take(self) -> tuple[str, str, int, Message] | None:
        """Give topic, type, number and message of the newest cloud, and stay with that topic.

        Raises
        ------
        ReadError
            If the topic is of another type, or none was requested and several have clouds.
        """
        clouds = self._clouds
        listed = ", ".join(clouds[:MAX_LISTED]) or "none"
        if self._topic is None and len(clouds) > 1:
            raise ReadError(f"has {len(clouds)} topics of point clouds, name one of them: {listed}")
        kind = self._kinds.get(self._topic or "", CLOUDS)
        if not has_clouds(kind):
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
        """Read what was added; return whether that is all, or the time (monotonic) was up
        before.

        Raises
        ------
        ReadError
            If what was added is damaged; the next call goes on behind it if it can.
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
                        "bytes is not valid"
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
        # Alone, so that nothing in it links outside it.
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
            has_log = file.read(20)[18:] == b"\x02\x02"
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


class BagSource(_Looking):
    """A ROS bag that is being recorded.

    Parameters
    ----------
    path
        A file .mcap or .db3, or the folder of a ROS 2 bag; of a bag in several files, what was
        recorded before the last of them is not read.
    topic
        The topic to read; needed where several have point clouds.
    wanted
        Field of the intensity.

    Raises
    ------
    MissingExtraError
        If rosbags or mcap is not installed.
    ReadError
        If there is no such file or folder.
    UsageError
        If the bag is of a kind that shows its content only when it is closed.
    """

    def __init__(self, path: Path, topic: str | None = None, wanted: Wanted = USUAL) -> None:
        if not path.exists():
            raise ReadError(f"{path}: there is no such file or folder")
        if not path.is_dir():
            check_is_file(path)
        if not path.is_dir() and path.suffix.lower() not in PARTS:
            raise UsageError(
                f"{path}: cannot be read while it is written, only {' and '.join(PARTS)} can"
            )
        check_extra()
        super().__init__(f"bag:{path}")
        self._path, self._wanted = path, wanted
        self._recorded = Recorded(topic)
        self._parts: list[tuple[Path, Part]] = []

    @property
    def has_ended(self) -> bool:
        """Whether the end of a file was read; of a folder, another file may follow."""
        return not self._path.is_dir() and bool(self._parts) and self._parts[-1][1].has_ended

    def _look(self, until: float) -> Frame | None:
        self._find_parts()
        until = max(until, monotonic() + READ_ON)
        for number, (path, part) in enumerate(self._parts):
            with naming(path), reported("bag"):
                is_all = part.read_on(self._recorded, until)
            if not is_all:
                self._parts = self._parts[number:]
                self._lacks = f"{path}: older data are still being read"
                return None
        if not self._parts:
            self._lacks = f"{self._path}: has no file {' or '.join(PARTS)} yet"
            return None
        self._parts = self._parts[-1:]
        self._lacks = f"{self._path}: {self._recorded.lacks}"
        with naming(self._path):
            taken = self._recorded.take()
            if taken is None:
                return None
            topic, kind, number, message = taken
            return frame_of(f"{self._path}: ", topic, number, *message, kind, self._wanted)

    def _find_parts(self) -> None:
        """Find the last file of the bag, or those that follow the one that is read."""
        files = [self._path]
        if self._path.is_dir():
            with readable(self._path):
                found = [p for p in self._path.iterdir() if p.suffix.lower() in PARTS]
                for path in found:
                    check_is_file(path)
            # Recorders number them, and the longer number is the later one.
            files = sorted(found, key=lambda p: (len(p.name), p.name))
        read = [path for path, _ in self._parts if path in files]
        if read:
            files = files[files.index(read[-1]) + 1 :]
        else:
            self._parts, files = [], files[-1:]
        self._parts += [(path, PARTS[path.suffix.lower()](path)) for path in files]
