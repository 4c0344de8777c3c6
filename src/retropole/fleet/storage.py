"""Files on any file system of fsspec: local paths, or ``s3://``, ``gs://``, ``memory://``.

A *place* is a path or a URL as text.
"""

from __future__ import annotations

import errno
import logging
import os
import posixpath
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from datetime import UTC, datetime
from functools import reduce
from pathlib import Path
from typing import Any
from uuid import uuid4

from ..base.errors import MissingExtraError, ReadError, RetropoleError, UsageError, said
from ..base.files import (
    RUNNING,
    check_is_file,
    leaving,
    run_alone,
    taken,
    this_run,
    write_atomically,
)

LARGEST_LIST = 2**28
"""Bytes of a list of sites: a million lines of 250."""


LONGEST_NOTE = 2**12
"""Bytes of the note of a run; one has about 100."""

LOCAL = ("file", "local")
PROTOCOLS = ("s3", "gs", "abfs", "memory")
"""Protocols of URLs that are followed: a list from another source must not make a worker connect
anywhere."""

_others: ContextVar[tuple[str, ...]] = ContextVar("_others", default=())


def other_protocols() -> tuple[str, ...]:
    """Name the protocols that are followed in addition to `PROTOCOLS`."""
    return _others.get()


@contextmanager
def also_following(protocols: Iterable[str]) -> Iterator[None]:
    """Follow URLs of other protocols than `PROTOCOLS` too."""
    token = _others.set(tuple(protocols))
    try:
        yield
    finally:
        _others.reset(token)


def filesystem(place: str) -> tuple[Any, str]:
    """Open the file system of a place, and give the path there.

    Raises
    ------
    MissingExtraError
        If fsspec is not installed.
    UsageError
        If URLs of this protocol are not followed, or a package that fsspec needs for them is
        missing.
    """
    try:
        from fsspec.core import url_to_fs
        from fsspec.implementations.local import LocalFileSystem
    except ImportError:
        raise MissingExtraError("fleet", "a fleet") from None
    if not is_url(place):
        return LocalFileSystem(), str(LocalFileSystem._strip_protocol(place))
    _check_protocol(place)
    try:
        system, path = url_to_fs(place)
    except Exception as error:
        raise UsageError(f"{place}: {said(error)}") from None
    # Errors are reported here, and once.
    logging.getLogger(type(system).__module__.partition(".")[0]).setLevel(logging.CRITICAL)
    return system, str(path)


def _check_protocol(url: str) -> None:
    """Refuse a URL that is not to be followed; of a chain (zip::ftp://…) any part connects."""
    if "::" in url or url.partition("://")[0] not in (*PROTOCOLS, *other_protocols()):
        raise UsageError(
            f"{url}: expected a path, or a URL of {', '.join(PROTOCOLS)}; --protocol adds "
            "another one of fsspec, chains (::) are never followed"
        )


def is_url(place: str) -> bool:
    """Whether a place is a URL of another file system than the local one."""
    protocol, sign, _ = place.partition("://")
    return bool(sign) and protocol not in LOCAL


def absolute(place: str) -> str:
    """Write a local path in full, as workers in other folders need it; a URL unchanged.

    Raises
    ------
    MissingExtraError, UsageError
        As `filesystem`.
    """
    if is_url(place):
        _check_protocol(place)
        return place
    return filesystem(place)[1]


def below(folder: str, *names: str) -> str:
    """Join a folder and names in it; an absolute name is kept."""
    return reduce(_below, names, folder)


def _below(folder: str, name: str) -> str:
    if "://" in name or posixpath.isabs(name) or Path(name).is_absolute():
        return name
    if not is_url(folder):
        return str(Path(folder) / name)
    scheme, _, path = folder.partition("://")
    # As the local system would: `..` goes one folder up.
    return f"{scheme}://{posixpath.normpath(posixpath.join('/', path, name))[1:]}"


def folder_of(place: str) -> str:
    """Name the folder that a file is in."""
    if not is_url(place):
        return str(Path(place).parent)
    return place.rpartition("/")[0]


def exists(place: str, *, as_folder: bool = False) -> bool:
    """Whether there is a file or a folder, or only a folder.

    Raises
    ------
    ReadError
        If the file system cannot be queried.
    """
    with _file_system(place, "cannot be looked for") as (system, path):
        system.invalidate_cache()
        return bool(system.isdir(path) if as_folder else system.exists(path))


@contextmanager
def _file_system(place: str, fault: str) -> Iterator[tuple[Any, str]]:
    """Open the file system of a path; add the path and the failed action to its errors."""
    system, path = filesystem(place)
    try:
        yield system, path
    except RetropoleError:
        raise
    except Exception as error:
        if getattr(error, "errno", None) == errno.ENOSPC:
            raise
        raise ReadError(f"{place}: {fault} ({_why(error)})") from None


@contextmanager
def _changed(place: str) -> Iterator[tuple[Any, str]]:
    """Open the file system of a path; whatever it raises is an `OSError` that names the path."""
    system, path = filesystem(place)
    try:
        yield system, path
    except Exception as error:
        raise OSError(getattr(error, "errno", None) or errno.EIO, _why(error), place) from None


def _why(error: Exception) -> str:
    """Describe the error; for missing files, stores give only an internal address."""
    if isinstance(error, FileNotFoundError):
        return os.strerror(errno.ENOENT)
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


def found_below(folder: str) -> list[str]:
    """Name every file and folder below a folder, from there on, in order.

    Raises
    ------
    ReadError
        If it cannot be listed.
    """
    with _file_system(folder, "cannot be listed") as (system, path):
        found = system.find(path, withdirs=True)
    return sorted(posixpath.relpath(each, path) for each in found if each.rstrip("/") != path)


def matching(pattern: str) -> list[str]:
    """Give the places that match a glob, in order.

    Raises
    ------
    ReadError
        If the file system cannot be queried.
    """
    with _file_system(pattern, "cannot be listed") as (system, path):
        found = sorted(system.glob(path))
    if not is_url(pattern):
        return found
    # The begin of the pattern, such as a host or an account, is not always contained in the paths.
    fixed = re.split(r"[*?[]", path, maxsplit=1)[0]
    start = pattern.rstrip("/").removesuffix(path[len(fixed) :])
    return [start + each.removeprefix(fixed) for each in found]


def names_in(folder: str) -> list[str]:
    """Name the files of a folder, in order; none if there is no folder.

    Raises
    ------
    ReadError
        If it cannot be listed.
    """
    with _file_system(folder, "cannot be listed") as (system, path):
        system.invalidate_cache()
        try:
            found = system.ls(path, detail=False)
        except FileNotFoundError:
            return []
    return sorted(posixpath.basename(str(each).replace("\\", "/")) for each in found)


def written(place: str) -> datetime:
    """Give the time at which a file, or the last file of a folder, was written; UTC, to the second.

    Raises
    ------
    ReadError
        If there is none, or the file system does not know.
    """
    with _file_system(place, "when it was written is not known") as (system, path):
        files = system.find(path) if system.isdir(path) else [path]
        last: datetime = max(system.modified(each) for each in files)
    return last.astimezone(UTC).replace(microsecond=0)


@contextmanager
def open_file(place: str, most: int = LARGEST_LIST) -> Iterator[Any]:
    """Open a file to read; of a large one, parts can be read alone.

    Raises
    ------
    ReadError
        If it cannot be read, or is too long.
    """
    with _file_system(place, "cannot be read") as (system, path):
        if not is_url(place):
            check_is_file(Path(path))
    with _file_system(place, "cannot be read") as (system, path), system.open(path, "rb") as file:
        if file.seek(0, os.SEEK_END) > most:
            raise ReadError(f"{place}: more than {most} bytes")
        file.seek(0)
        yield file


def read_bytes(place: str, most: int = LARGEST_LIST) -> bytes:
    """Read all of a file.

    Raises
    ------
    ReadError
        As `open_file`.
    """
    with open_file(place, most) as file:
        return bytes(file.read())


def write_bytes(place: str, data: bytes) -> None:
    """Write a file completely or not at all, and make its folder if there is none.

    An object store puts an object whole; on the local system the file is renamed into its place,
    and a pipe or a device is written to.

    Raises
    ------
    OSError
        If it cannot be written; names the path.
    """
    if not is_url(place):
        write_atomically(Path(absolute(place)), data)
        return
    with _changed(place) as (system, path):
        _make_folder(system, place, path)
        system.pipe_file(path, data)


def replace_bytes(place: str, data: bytes) -> None:
    """Write a file as `write_bytes` does, but never into a pipe or a device, where it were lost.

    Raises
    ------
    OSError
        As `write_bytes`.
    ReadError
        If there is something else than a file.
    """
    if not is_url(place) and Path(absolute(place)).exists():
        check_is_file(Path(absolute(place)))
    write_bytes(place, data)


def write_new(url: str, data: bytes) -> None:
    """Write a file at a URL where there is none; of several who do at once one does.

    Some systems write over what is there all the same: who needs to know reads it again.

    Raises
    ------
    OSError
        As `write_bytes`.
    """
    with _changed(url) as (system, path):
        _make_folder(system, url, path)
        with suppress(FileExistsError):
            system.pipe_file(path, data, mode="create")


def _make_folder(system: Any, place: str, path: str) -> None:
    """Make the folder of a file; an object store has none, and would make the bucket of a slip."""
    if place.partition("://")[0] not in PROTOCOLS:
        system.makedirs(posixpath.dirname(path), exist_ok=True)


def remove(place: str) -> None:
    """Remove a file.

    Raises
    ------
    OSError
        If it cannot be removed; names the path.
    """
    with _changed(place) as (system, path):
        system.rm_file(path)


def fetch(place: str, into: Path) -> Path:
    """Copy a file, or a folder with all in it, into a local folder.

    The metadata of an Ouster's packets, a file of the same name next to them, comes along.

    Returns
    -------
    Path
        Of the copy.

    Raises
    ------
    ReadError
        If it cannot be read.
    OSError
        If there is no room.
    """
    local = into / posixpath.basename(place.rstrip("/"))
    into.mkdir(parents=True, exist_ok=True)
    with _file_system(place, "cannot be read") as (system, path):
        metadata = f"{path.removesuffix('.pcap')}.json"
        system.get(path, str(local), recursive=system.isdir(path))
        if path.endswith(".pcap") and system.exists(metadata):
            system.get(metadata, str(into / posixpath.basename(metadata)))
    return local


@contextmanager
def alone_in(folder: str) -> Iterator[None]:
    """Keep other runs from a folder, or from a URL, from now on.

    At a URL an object is the lock. Nothing removes it where a process is killed: no clock
    distinguishes a slow run from one that has ended, so whoever knows it has to.

    Raises
    ------
    OSError
        If another run has it: the message says which. If nothing can be written there.
    ReadError
        If the file system cannot be queried.
    """
    if not is_url(folder):
        with run_alone(Path(absolute(folder))):
            yield
        return
    # Of two runs with the same description, each knows its note.
    note, own = below(folder, RUNNING), f"{this_run()}\n{uuid4().hex}\n".encode()

    def leave() -> None:
        if exists(note) and read_bytes(note) == own:
            remove(note)

    leaving.append(leave)
    try:
        # Some stores would write over it.
        if not exists(note):
            write_new(note, own)
        if (found := read_bytes(note, LONGEST_NOTE)) != own:
            who = found.decode(errors="replace").partition("\n")[0]
            raise taken(folder, who, f"; if that run was killed, remove {RUNNING} there")
        yield
    finally:
        try:
            leave()
        finally:
            leaving.remove(leave)
