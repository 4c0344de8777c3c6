"""Folders that grow by files, and bags that are being recorded: whoever writes them, they are read
on from where the last look ended.
"""

from __future__ import annotations

from pathlib import Path
from stat import S_ISREG
from threading import Event
from time import monotonic
from typing import NamedTuple

import numpy as np

from ...base.errors import ReadError, UsageError, naming, readable, reported
from ...base.files import check_is_file
from ...base.quantities import counted
from .. import READERS, open_recording
from ..bags import check_extra
from ..recordings import Frame, time_of_recording
from ..ros import frame_of
from .growing import PARTS, Part, Recorded
from .mailbox import QUIET

POLL = 0.1
"""Seconds between two looks: as often as most sensors turn."""

SETTLED, GIVE_UP = 0.3, 2.0
"""Seconds without a change after which a file is tried, since some formats do not show that a part
is missing; and after which one that cannot be read is not tried again."""

READ_ON = 0.5
"""Seconds for which a look reads what was recorded before, also where it is to wait for less."""


class _Looking:
    """What both sources share: they look again and again until there is news."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._closed = Event()
        self._last = -np.inf
        self._lacks = "nothing came yet"

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


class FolderSource(_Looking):
    """A folder to which somebody adds a file for each sweep, or writes the same one again.

    Parameters
    ----------
    folder
        Its files that are point clouds are sweeps, of one format or several; hidden ones are not.

    Raises
    ------
    ReadError
        Where there is no such folder.
    """

    has_ended = False

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise ReadError(f"{folder}: there is no such folder")
        super().__init__(f"folder:{folder}")
        self._folder = folder
        self._done: dict[Path, _Version] = {}
        # Since when a file that was not given yet has been as it is, and which cannot be read so.
        self._since: dict[Path, tuple[_Version, float]] = {}
        self._failed: set[Path] = set()
        self._count = 0
        self._see()

    def _see(self) -> list[Path]:
        """List the files that were not given yet, the newest first."""
        now = monotonic()
        with readable(self._folder):
            there = {path: _version_of(path) for path in self._folder.iterdir() if _may_be(path)}
        found = {path: own for path, own in there.items() if own is not None}
        news = {path: own for path, own in found.items() if self._done.get(path) != own}
        for path, own in news.items():
            if path not in self._since or self._since[path][0] != own:
                self._since[path] = own, now
                self._failed.discard(path)
        self._since = {path: self._since[path] for path in news}
        self._failed &= news.keys()
        self._done = {path: own for path, own in self._done.items() if path in found}
        self._lacks = (
            f"{self._folder}: no new file comes"
            if found
            else f"{self._folder}: has no point clouds yet, expected files of {', '.join(READERS)}"
        )
        odd = sorted(p.name for p in there.keys() - found.keys() if not p.is_dir())
        if odd:
            self._lacks += f"; {counted(len(odd), 'name')} left out, as {odd[0]}, no file"
        # Of files that were copied at once, the longer number is the later one.
        return sorted(news, key=lambda p: (news[p].written, len(p.name), p.name), reverse=True)

    def _look(self, until: float) -> Frame | None:
        news = self._see()
        for k, path in enumerate(news):
            version, since = self._since[path]
            unchanged = monotonic() - since
            if unchanged < SETTLED or (path in self._failed and unchanged < GIVE_UP):
                continue
            try:
                frame = next(open_recording(path).read(range(1)))
            except ReadError:
                if _version_of(path) != version:
                    continue
                self._failed.add(path)
                if unchanged < GIVE_UP:
                    continue
                self._finish([path])
                raise
            if _version_of(path) != version:
                continue
            self._finish(news[k:])
            recorded = time_of_recording(frame.cloud)
            return Frame(self._count - 1, frame.cloud, recorded[0] if recorded else None)
        return None

    def _finish(self, paths: list[Path]) -> None:
        """Give or leave out files for good, in the version that they have now."""
        for path in paths:
            self._done[path], _ = self._since.pop(path)
            self._failed.discard(path)
        self._count += len(paths)


def _may_be(path: Path) -> bool:
    """Whether a name is one of a point cloud."""
    return not path.name.startswith(".") and path.suffix.lower() in READERS


def _version_of(path: Path) -> _Version | None:
    """Give the version of a file; None where it is none, or is gone."""
    try:
        about = path.stat()
    except OSError:
        return None
    return _Version(about.st_mtime_ns, about.st_size) if S_ISREG(about.st_mode) else None


class BagSource(_Looking):
    """A ROS bag that is being recorded.

    Parameters
    ----------
    path
        A file .mcap or .db3, or the folder of a ROS 2 bag; of a bag in several files, what was
        recorded before the last of them is not read.
    topic
        The topic to read; needed where several have point clouds.

    Raises
    ------
    MissingExtraError
        Where rosbags or mcap is not installed.
    ReadError
        Where there is no such file or folder.
    UsageError
        Where the bag is of a kind that shows what it holds only when it is closed.
    """

    def __init__(self, path: Path, topic: str | None = None) -> None:
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
        self._path = path
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
                self._lacks = f"{path}: what was recorded before is still being read"
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
            topic, kind, number, (stamp, data, encoding) = taken
            return frame_of(f"{self._path}: ", topic, number, stamp, data, encoding, kind)

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
