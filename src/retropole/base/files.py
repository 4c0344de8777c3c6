"""Reading documents that may be anything, and writing files so that none is left half written."""

from __future__ import annotations

import errno
import glob
import os
import re
import secrets
import signal
import socket
import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from .errors import ReadError, UsageError

LARGEST_DOCUMENT = 2**24
"""Bytes of a document with a transform; a result of ten placements has 2e5."""

UNFINISHED = ".retropole-unfinished"
"""How the name of a file ends that is being written."""

RUNNING = ".running"
"""Name of the note of the run that has a folder for itself; it is removed with the run."""

LONGEST_NOTE = 2**12
"""Bytes of a note; one has about 100."""

KINDS = {
    stat.S_ISDIR: "a folder",
    stat.S_ISFIFO: "a named pipe",
    stat.S_ISSOCK: "a socket",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
}
"""What a path may be other than a file."""

unfinished: set[str] = set()
"""Files that are removed with the run: whoever ends the process at once removes them first."""

older: dict[Path, Path] = {}
"""Where the files of a run before are that were set aside, by their original names."""

leaving: list[Callable[[], None]] = []
"""What else comes first: of where other machines look, none sees that a process has ended."""


def check_is_file(path: Path) -> None:
    """Refuse a path that is not a file: opening a pipe waits for its writer, a device never ends.

    Raises
    ------
    ReadError
        If it is something else.
    OSError
        If there is nothing, or it may not be looked at.
    """
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode):
        kind = next(
            (kind_name for is_it, kind_name in KINDS.items() if is_it(mode)), "something else"
        )
        raise ReadError(f"{path}: is {kind}, expected a file")


def read_document(path: Path) -> bytes:
    """Read a file that is expected to hold a transform, and not more than one would have.

    Raises
    ------
    ReadError
        If it is longer.
    OSError
        If it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(LARGEST_DOCUMENT + 1)
    if len(data) > LARGEST_DOCUMENT:
        raise ReadError(f"{path}: more than {LARGEST_DOCUMENT} bytes, too long for a transform")
    return data


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file whole or not at all, and make its folder where there is none.

    Whoever reads ``path`` sees the old content or the new, also after an interrupt or a full disk.
    A link is followed, the permissions of a file that is there are kept, and anything but a file (a
    device, a pipe) is written to as it is.

    Raises
    ------
    OSError
        If it cannot be written, or another process is writing into its folder.
    """
    write_together({path: data})


def write_together(files: Mapping[Path, bytes]) -> None:
    """Write files of one folder, which belong together, all of them or none.

    The data go to temporary files next to the targets, which are then renamed. The others than the
    first are removed before: whatever ends the process, those that are there are of one run.
    If a file of a run before was set aside it is replaced, with its links and permissions.

    Raises
    ------
    OSError
        As `write_atomically`.
    """
    back = [path for path in files if _put_back(path)]
    try:
        _write_together(files)
    except BaseException:
        with suppress(OSError):
            _set_aside_until_written(back)
        raise


def _write_together(files: Mapping[Path, bytes]) -> None:
    places = {Path(os.path.realpath(path)): data for path, data in files.items()}
    regular = {place: data for place, data in places.items() if _is_file(place)}
    for folder in dict.fromkeys(place.parent for place in regular):
        folder.mkdir(parents=True, exist_ok=True)
        with _alone_in(folder):
            _replace({place: data for place, data in regular.items() if place.parent == folder})
    for place, data in places.items():
        if place not in regular:
            with _named(place), place.open("wb") as device:
                device.write(data)


@contextmanager
def stream_atomically(path: Path) -> Iterator[BinaryIO]:
    """Write a file part by part, whole or not at all: for what does not fit into memory.

    As `write_atomically`, but other processes may write into its folder meanwhile.

    Yields
    ------
    BinaryIO
        That can be read and seeked in. The file gets its name when all went well.

    Raises
    ------
    UsageError
        If it is not a file: neither a device nor a pipe goes back to its header.
    OSError
        As `write_atomically`.
    """
    place = Path(os.path.realpath(path))
    if not _is_file(place):
        raise UsageError(f"{path}: is not a regular file, and cannot be written in parts")
    place.parent.mkdir(parents=True, exist_ok=True)
    with _alone_in(place.parent):
        _sweep(place)
    temporary = _temporary(place)
    try:
        with _named(place):
            flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
            with os.fdopen(os.open(temporary, flags, 0o600), "w+b") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            _permit_as(place, temporary)
            with _alone_in(place.parent), _signals_wait():
                os.replace(temporary, place)
    finally:
        Path(temporary).unlink(missing_ok=True)
        unfinished.discard(temporary)


def _temporary(place: Path) -> str:
    """Name a temporary file next to another, which is removed with the run."""
    name = f".{place.name[:100]}.{secrets.token_hex(4)}{UNFINISHED}"
    temporary = str(place.parent / name)
    # Before it is there: a signal may come at any moment.
    unfinished.add(temporary)
    return temporary


def set_aside(paths: Iterable[Path]) -> list[Path]:
    """Rename files, ``result.json`` to ``older-result.json``: nobody takes them for new ones.

    Of a link, the link is renamed. A file that has the new name already is replaced.

    Returns
    -------
    list of Path
        The new names of those that were there.

    Raises
    ------
    OSError
        If one cannot be renamed, or another process is writing into its folder.
    """
    moved = []
    for path in paths:
        if path.is_file():
            with _alone_in(path.parent):
                moved.append(path.replace(path.with_name(f"older-{path.name}")))
    return moved


@contextmanager
def without_older(paths: Iterable[Path]) -> Iterator[list[Path]]:
    """Set files of a run before aside, for as long as this one has not written them.

    Gives a list; at the end it has those that were not replaced, under their new names.

    Raises
    ------
    OSError
        As `set_aside`.
    """
    names = list(paths)
    left: list[Path] = []
    _set_aside_until_written(names)
    try:
        yield left
    finally:
        for path in names:
            if older.pop(_key(path), None) is not None:
                left.append(path.with_name(f"older-{path.name}"))


def _set_aside_until_written(paths: Iterable[Path]) -> None:
    for path in paths:
        for moved in set_aside([path]):
            older[_key(path)] = _key(moved)


def _put_back(path: Path) -> bool:
    """Give a file that was set aside its original name again; return whether there was one."""
    aside = older.pop(_key(path), None)
    if aside is None or not aside.is_file():
        return False
    aside.replace(path)
    return True


def _key(path: Path) -> Path:
    return Path(os.path.abspath(path))


@contextmanager
def _named(place: Path) -> Iterator[None]:
    """Have an error of the system name the file that it is about."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(place)) from None


def _is_file(place: Path) -> bool:
    """Whether a path is a file, or can become one."""
    try:
        return stat.S_ISREG(place.stat().st_mode)
    except FileNotFoundError:
        return True


@contextmanager
def run_alone(folder: Path, command: str = "") -> Iterator[None]:
    """Keep other runs from a folder, which is made where there is none, from now on.

    The system lets go when the process ends, however that is. A note in the folder says who has it;
    it is removed with the run, and so is a folder that was made for it and stayed empty.

    Parameters
    ----------
    folder
        The folder.
    command
        What the note calls the run: ``retropole watch``.

    Raises
    ------
    OSError
        If another run has it: the message says which. Where it cannot be written to.
    """
    is_new = not folder.exists()
    note = folder / RUNNING
    descriptor = _own(note)
    unfinished.add(str(note))
    try:
        with suppress(OSError):
            os.ftruncate(descriptor, 0)
            os.write(descriptor, this_run(command).encode())
        yield
    finally:
        # Before another run has it; only if what is open cannot be removed, after that.
        with suppress(OSError):
            if os.name != "nt":
                note.unlink()
        os.close(descriptor)
        with suppress(OSError):
            if os.name == "nt":
                note.unlink()
        unfinished.discard(str(note))
        if is_new:
            with suppress(OSError):
                folder.rmdir()


def _own(note: Path) -> int:
    """Make and lock a note, and give its descriptor."""
    while True:
        note.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = _opened(note)
        except FileNotFoundError:
            continue  # a run that has just ended removed its folder
        if not _locked(descriptor):
            who = os.read(descriptor, LONGEST_NOTE).decode(errors="replace")
            os.close(descriptor)
            raise taken(str(note.parent), who)
        try:
            if os.path.samestat(os.fstat(descriptor), note.stat()):
                return descriptor
        except FileNotFoundError:
            pass
        os.close(descriptor)  # a run that has just ended removed this one


def _opened(note: Path) -> int:
    try:
        return os.open(note, os.O_RDWR | os.O_CREAT, 0o666)
    except PermissionError:
        # One that another user's run left, as it was killed, can be locked all the same.
        if not note.exists():
            raise
        return os.open(note, os.O_RDONLY)


def this_run(command: str = "") -> str:
    """Describe this process, and its start time."""
    since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    named = f"{command}, " if command else ""
    return f"{named}process {os.getpid()} on {socket.gethostname()}, since {since}"


def taken(folder: str, who: str = "", remedy: str = "") -> BlockingIOError:
    """Make the error of a folder that another run has."""
    named = f" ({who})" if who else ""
    why = f"another run is writing to it{named}; nothing was written{remedy}"
    return BlockingIOError(errno.EAGAIN, why, folder)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Keep other processes from writing into a folder; the system lets go when a process ends.

    Where folders cannot be locked, as on Windows and some network drives, there is no lock.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except PermissionError:
        yield
        return
    try:
        if not _locked(descriptor):
            raise taken(str(folder))
        yield
    finally:
        os.close(descriptor)


def _locked(descriptor: int) -> bool:
    """Lock an open file or folder; return whether no other process has it.

    True also if the file system has no locks.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            # Where the system locks bytes, the one that is locked is far behind those to be read.
            os.lseek(descriptor, 2**30, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            os.lseek(descriptor, 0, os.SEEK_SET)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if sys.platform == "win32":
            os.lseek(descriptor, 0, os.SEEK_SET)
        return error.errno not in (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
    return True


def _replace(files: Mapping[Path, bytes]) -> None:
    """Write temporary files next to the targets, and switch."""
    for place in files:
        _sweep(place)
    written: dict[Path, str] = {}
    try:
        for place, data in files.items():
            with _named(place):
                written[place] = _temporary(place)
                flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
                with os.fdopen(os.open(written[place], flags, 0o600), "wb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
                _permit_as(place, written[place])
        with _signals_wait():
            for place in list(files)[1:]:
                place.unlink(missing_ok=True)
            for place, temporary in written.items():
                if place.exists() and place.stat().st_nlink > 1:
                    # The other names of the file shall have the same content.
                    place.write_bytes(files[place])
                else:
                    os.replace(temporary, place)
    finally:
        for temporary in written.values():
            Path(temporary).unlink(missing_ok=True)
            unfinished.discard(temporary)


def path_in_text(path: str | Path) -> str:
    """Write a path so that any document can hold it: bytes that are not UTF-8 as ``\\xff``."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


def path_of_text(text: str) -> Path:
    """Undo `path_in_text`, if there is no such path."""
    path = Path(text)
    if path.exists() or "\\x" not in text:
        return path
    data = os.fsencode(text)
    named = re.sub(rb"\\x([89a-f][0-9a-f])", lambda found: bytes([int(found[1], 16)]), data)
    return Path(os.fsdecode(named))


def _sweep(place: Path) -> None:
    """Remove what a process that was killed left of a file."""
    for left in place.parent.glob(f".{glob.escape(place.name[:100])}.*{UNFINISHED}"):
        left.unlink(missing_ok=True)


def _permit_as(place: Path, temporary: str) -> None:
    """Give a temporary file the permissions that the file has, or would be given."""
    try:
        old = place.stat()
    except FileNotFoundError:
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        return
    # To give a file to another owner takes rights that few have.
    with suppress(OSError, AttributeError):
        os.chown(temporary, old.st_uid, old.st_gid)
    os.chmod(temporary, stat.S_IMODE(old.st_mode))


@contextmanager
def _signals_wait() -> Iterator[None]:
    """Defer interrupts for a moment, if the system can."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
