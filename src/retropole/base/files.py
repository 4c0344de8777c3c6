"""Reading documents that may be anything, and writing files so that none is left half written."""

from __future__ import annotations

import errno
import glob
import os
import re
import signal
import socket
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from .errors import ReadError

LARGEST_DOCUMENT = 2**24
"""Bytes of a document that holds a transform; a result of ten placements has 2e5."""

UNFINISHED = ".retropole-unfinished"
"""How the name of a file ends that is being written."""

RUNNING = ".running"
"""Name of the note of the last run that had a folder for itself."""

unfinished: set[str] = set()
"""Files that are being written: whoever ends the process at once removes them first."""

leaving: list[Callable[[], None]] = []
"""What else comes first: of where other machines look, none sees that a process has ended."""


def read_document(path: Path) -> bytes:
    """Read a file that is expected to hold a transform, and not more of it than one would have.

    Raises
    ------
    ReadError
        Where it is longer.
    OSError
        Where it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(LARGEST_DOCUMENT + 1)
    if len(data) > LARGEST_DOCUMENT:
        raise ReadError(f"{path}: more than {LARGEST_DOCUMENT} bytes, no transform is so long")
    return data


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file whole or not at all, and make its folder where there is none.

    Whoever reads ``path`` sees the old content or the new, also after an interrupt or a full disk.
    A link is followed, the permissions of a file that is there are kept, and what is no file (a
    device, a pipe) is written to as it is.

    Raises
    ------
    OSError
        Where it cannot be written, or another process is writing into its folder.
    """
    write_together({path: data})


def write_together(files: Mapping[Path, bytes]) -> None:
    """Write files of one folder, which belong together, all of them or none.

    The data go to temporary files beside the targets, which are then renamed. The others than the
    first are removed before: whatever ends the process, those that are there are of one run.

    Raises
    ------
    OSError
        As `write_atomically`.
    """
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
        Where one cannot be renamed, or another process is writing into its folder.
    """
    moved = []
    for path in paths:
        if path.is_file():
            with _alone_in(path.parent):
                moved.append(path.replace(path.with_name(f"older-{path.name}")))
    return moved


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
def run_alone(folder: Path) -> Iterator[None]:
    """Keep other runs from a folder, which is made where there is none, from now on.

    Raises
    ------
    OSError
        Where another run has it: the message says which.
    """
    folder.mkdir(parents=True, exist_ok=True)
    note = folder / RUNNING
    note.touch()
    with _alone_in(folder, note):
        with _named(note):
            note.write_text(this_run())
        yield


def this_run() -> str:
    """Say which process this is, and since when it runs."""
    since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return f"process {os.getpid()} on {socket.gethostname()}, since {since}"


def taken(folder: str, who: str = "", remedy: str = "") -> BlockingIOError:
    """Make the error of a folder that another run has."""
    named = f" ({who})" if who else ""
    why = f"another run is writing to it{named}; nothing was written{remedy}"
    return BlockingIOError(errno.EAGAIN, why, folder)


@contextmanager
def _alone_in(folder: Path, note: Path | None = None) -> Iterator[None]:
    """Keep other processes from writing into a folder; the system lets go when a process ends.

    With a note, which says who has it, that is locked: files may be written to the folder as ever.
    Where the system has no such locks, as on Windows and some network drives, there is none.
    """
    try:
        import fcntl

        descriptor = os.open(note or folder, os.O_RDONLY)
    except (ImportError, PermissionError):
        yield
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise taken(str(folder), "" if note is None else note.read_text()) from None
    except OSError:
        pass
    try:
        yield
    finally:
        os.close(descriptor)


def _replace(files: Mapping[Path, bytes]) -> None:
    """Write temporary files beside the targets, and switch."""
    for place in files:
        _sweep(place)
    written: dict[Path, str] = {}
    try:
        for place, data in files.items():
            with _named(place):
                descriptor, written[place] = tempfile.mkstemp(
                    dir=place.parent, prefix=f".{place.name[:100]}.", suffix=UNFINISHED
                )
                unfinished.add(written[place])
                with os.fdopen(descriptor, "wb") as file:
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
    """Undo `path_in_text`, where there is no path that is called so."""
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
    """Let interrupts wait for a moment, where the system can."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
