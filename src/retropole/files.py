"""Reading documents that may be anything, and writing files so that none is left half written."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from .errors import ReadError

LARGEST_DOCUMENT = 2**24
"""Bytes of a document that holds a transform; a result of ten placements has 2e5."""


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

    The data go to a temporary file beside the target, which is then renamed: whoever reads
    ``path`` sees the old content or the new, also after an interrupt or a full disk.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
        # mkstemp makes files for the owner alone; give what an ordinary open would have given.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
