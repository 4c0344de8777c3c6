"""One run at a time in a dataset: a lock of the system's in a folder, an object at a URL."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from ..base.files import RUNNING, leaving, run_alone, taken, this_run
from .storage import absolute, below, exists, is_url, read_bytes, remove, write_new

LONGEST_NOTE = 2**12
"""Bytes of the note of a run; one has about 100."""


@contextmanager
def alone_in(folder: str) -> Iterator[None]:
    """Keep other runs from a folder, or from a URL, from now on.

    At a URL an object is the lock. Nothing removes it where a process is killed: no clock tells a
    run that is slow from one that is no more, so whoever knows it has to.

    Raises
    ------
    OSError
        Where another run has it: the message says which. Where nothing can be written there.
    ReadError
        Where the file system cannot be asked.
    """
    if not is_url(folder):
        with run_alone(Path(absolute(folder))):
            yield
        return
    # Of two runs that say the same of themselves each knows its own.
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
