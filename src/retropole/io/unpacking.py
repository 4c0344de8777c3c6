"""Decompressing the content of a bag, within bounds: a file of some KB may unpack to GiB.

The sizes that the file itself states are not trusted: the bytes are counted as they come.
"""

from __future__ import annotations

import bz2
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from ..base.errors import ReadError
from ..base.files import check_is_file

MAX_UNPACKED = 2**26
"""Bytes that one chunk, or one message, may unpack to. Recorders end a chunk after 0.8 to 4 MiB,
and a sweep of a sensor with 128 rings has 10 MiB."""

LARGEST_RECORD = MAX_UNPACKED + 2**20
"""Bytes of a record that are read at once: with what is before a chunk."""

ALLOWED, ALLOWED_RATIO = 2**29, 100
"""Bytes that all of a bag may unpack to: this many, and this many times its size. Scans compress 2
to 20 fold."""

Spend = Callable[[int], None]
"""Counts bytes, and raises if a file exceeds its limit."""


class BoundedFile(io.BufferedReader):
    """A file that says itself how much of it to read next, and of which no more is read than that
    can be: a file of some KB may have holes of GiB, which it calls a record."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read this many bytes.

        Raises
        ------
        ReadError
            If they are more than `LARGEST_RECORD`.
        """
        if size is None or not 0 <= size <= LARGEST_RECORD:
            raise ReadError(
                f"a record of {size:,} bytes; up to {LARGEST_RECORD:,} are read, more than "
                "any recorder writes"
            )
        return super().read(size)


def opened_within(path: Path) -> BoundedFile:
    """Open a file to read no more at once than a record can have.

    Raises
    ------
    ReadError, OSError
        As `check_is_file`.
    """
    check_is_file(path)
    return BoundedFile(path.open("rb", buffering=0))


def allowance(size: int, base: int = ALLOWED, ratio: int = ALLOWED_RATIO) -> Spend:
    """Make the account of a file of `size` bytes, with `base` bytes and `ratio` times its size."""
    allowed = base + ratio * size
    spent = 0

    def spend(count: int) -> None:
        nonlocal spent
        spent += count
        if spent > allowed:
            limit = f"its {size:,} bytes unpack to more than {allowed:,}"
            raise ReadError(f"{limit}, too much for a recording")

    return spend


def unpacked(kind: str, data: bytes, spend: Spend) -> bytes:
    """Decompress a chunk or a message.

    Parameters
    ----------
    kind
        ``bz2``, ``lz4`` or ``zstd``; anything else is not compressed.
    data
        The compressed bytes.
    spend
        Where the decompressed ones are counted.

    Raises
    ------
    ReadError
        If there are more than `MAX_UNPACKED`, or than the file may have in all.
    """
    if kind not in ("bz2", "lz4", "zstd"):
        if len(data) > LARGEST_RECORD:
            raise ReadError(f"a chunk or message of {len(data):,} bytes, too large for a recording")
        spend(len(data))
        return data
    out = io.BytesIO()
    for block in _blocks(kind, io.BytesIO(data), spend):
        if out.tell() + len(block) > MAX_UNPACKED:
            limit = f"{len(data):,} bytes of it unpack to more than {MAX_UNPACKED:,}"
            raise ReadError(f"{limit}, too much for a chunk of a recording")
        out.write(block)
    return out.getvalue()


def unpack_file(packed: Path, to: Path, kind: str, spend: Spend) -> None:
    """Decompress a whole file into another."""
    with packed.open("rb") as file, to.open("wb") as written:
        written.writelines(_blocks(kind, file, spend))


def _blocks(kind: str, file: BinaryIO, spend: Spend) -> Iterator[bytes]:
    """Decompress a file block by block, each counted before it is given."""
    with _stream(kind, file) as stream:
        while block := stream.read(2**20):
            spend(len(block))
            yield block


def _stream(kind: str, file: BinaryIO) -> Any:
    """Open a compressed file as one of its decompressed bytes."""
    if kind == "bz2":
        return bz2.BZ2File(file)
    if kind == "lz4":
        import lz4.frame

        return lz4.frame.open(file)
    import zstandard

    # A frame may need a window of GiB.
    own = zstandard.ZstdDecompressor(max_window_size=MAX_UNPACKED)
    return own.stream_reader(file, read_across_frames=True)
