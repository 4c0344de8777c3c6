"""LAS and LAZ, with laspy (the extra ``las``).

laspy trusts the header: one wrong byte in it makes laspy allocate gigabytes before it notices. The
sizes that the header promises are therefore compared with the size of the file first.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import PointCloud
from ..base.errors import MissingExtraError, ReadError, said
from .fields import USUAL, Wanted, cloud_from_columns, has_meaning
from .maps import is_near, nothing_near

READ_BLOCK = 16 * 2**20
"""Bytes of decompressed points that are read at a time."""

MAX_LAZ_RATIO = 1000
"""Scans compress 5 to 20 fold: a file that promises more than this is damaged."""

SMALLEST_HEADER = 227
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Number of layers of the items of a point: the point itself, RGB, RGB and NIR, wave packet."""

ITEM_SIZES = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
"""Bytes of each kind of item, after LASzip's specification; extra bytes (0 and 14) have any."""

ITEMS_AT, ITEM = 34, "<HHH"
"""Byte of LAZ's record at which the items of a point begin, after their number; and an item."""

FIRST_CHUNK = 8
"""Bytes from the start of the points to the first chunk: the position of the table of chunks."""


def read_las(path: Path, wanted: Wanted = USUAL) -> PointCloud:
    """Read a LAS or LAZ file, with its scale and offset applied.

    Raises
    ------
    MissingExtraError
        If laspy is not installed.
    ReadError
        If laspy cannot read the file, or the file is shorter than its header promises.
    """
    try:
        import laspy
    except ImportError:
        raise MissingExtraError("las", "reading LAS and LAZ") from None
    size = path.stat().st_size
    with path.open("rb") as opened:
        _check_header(opened, size)
    try:
        # One thread: several gain a sixth of the time, and stall in processes made by fork.
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as file:
            header = file.header
            left = size - header.offset_to_point_data
            needed = header.point_count * header.point_format.size
            if needed > left * (MAX_LAZ_RATIO if header.are_points_compressed else 1):
                raise ReadError(
                    f"the header promises {header.point_count} points, {needed} bytes"
                    f"{' decompressed' if header.are_points_compressed else ''}; the file has "
                    f"{left} after it"
                )
            for record in header.vlrs.get("LasZipVlr"):
                _check_items(header.point_format.size, record.record_data)
                _check_layers(path, header.offset_to_point_data, record.record_data)
            # The scaled coordinates, and the other fields that are used here.
            own = header.point_format.dimension_names
            known = wanted.names(own)
            names = [*"xyz", *(name for name in own if has_meaning(name, *known))]
            # In blocks, so that memory follows what is in the file, not what its header promises.
            chunks = file.chunk_iterator(max(1, READ_BLOCK // header.point_format.size))
            blocks = [_columns(block, names, wanted) for block in chunks]
    except (ReadError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        # For damaged files laspy and its decoders raise a dozen unrelated types; a panic of the
        # LAZ decoder is not even an Exception.
        raise ReadError(f"is not a readable LAS file ({said(error)})") from None
    if not blocks:
        raise ReadError("has no points, expected at least one")
    kept = [columns for _, columns in blocks]
    columns = {name: np.concatenate(column) for name, *column in zip(names, *kept, strict=True)}
    count = sum(read for read, _ in blocks)
    if count != header.point_count:
        raise ReadError(f"the header promises {header.point_count} points, the file has {count}")
    if wanted.place is not None and not any(len(own) for own, *_ in kept):
        raise nothing_near(wanted.place, 0, header.mins, header.maxs)
    return cloud_from_columns(columns, wanted)


def _columns(
    block: Any, names: Sequence[str], wanted: Wanted
) -> tuple[int, list[NDArray[np.generic]]]:
    """Count a block's points, and give the columns of those that are wanted."""
    columns = [np.array(block[name]) for name in names]
    count = len(columns[0])
    if wanted.place is not None:
        rows = np.flatnonzero(is_near(columns[0], columns[1], wanted.place))
        columns = [column[rows] for column in columns]
    return count, columns


def _check_header(file: BinaryIO, size: int) -> None:
    """Check that the file is long enough for the records and chunks that the header promises.

    The decoder allocates memory for as many chunks as the file says, and if there is not enough,
    it ends the process: no exception could be caught. A chunk starts with one uncompressed point.
    """
    if size == 0:
        raise ReadError("is empty, expected a LAS header")
    head = file.read(SMALLEST_HEADER)
    if head[:4] != b"LASF" or len(head) < SMALLEST_HEADER:
        raise ReadError(
            f"starts with {head[:4]!r} and has {size} bytes, expected a LAS header, which starts "
            f"with b'LASF' and has {SMALLEST_HEADER} or more"
        )
    length, points, records = struct.unpack_from("<HII", head, 94)
    if points > size:
        stated = f"the header states that points start at byte {points}"
        raise ReadError(f"{stated}, the file ends at {size}")
    # A record has 54 bytes without content.
    if length + 54 * records > points:
        raise ReadError(
            f"the header promises {records} variable length records, which the bytes {length} to "
            f"{points} before the points cannot hold"
        )
    # The highest bit of the format of points means LAZ.
    if not head[104] & 0x80:
        return
    # Counts of points and of layers have 4 bytes.
    file.seek(_chunk_table(file, points, size) + 4)
    chunks = struct.unpack("<I", file.read(4))[0]
    # A point of the shortest format has 20 bytes.
    if chunks * 20 > size:
        raise ReadError(f"promises {chunks} chunks, its {size} bytes cannot hold them")


def _chunk_table(file: BinaryIO, start: int, size: int) -> int:
    """Find the byte where the LAZ chunks end and their table begins."""
    file.seek(start)
    head = file.read(FIRST_CHUNK)
    table: int = struct.unpack("<q", head)[0] if len(head) == FIRST_CHUNK else 0
    if table == -1:  # a writer that could not go back put the position at the very end
        file.seek(size - FIRST_CHUNK)
        table = struct.unpack("<q", file.read(FIRST_CHUNK))[0]
    if not start < table <= size - FIRST_CHUNK:
        stated = f"its table of chunks is said to be at byte {table}"
        raise ReadError(f"{stated}, expected between {start} and {size - FIRST_CHUNK}")
    return table


def _check_items(size: int, record: bytes) -> None:
    """Refuse a LAZ whose items do not make up a point: its decoder reads past the end of one."""
    items = _items(record)
    sizes = [length for _, length, _ in items]
    known = all(ITEM_SIZES.get(kind, length) == length for kind, length, _ in items)
    if sum(sizes) != size or not known:
        items_have = f"its {len(sizes)} compressed items have {sizes} bytes"
        raise ReadError(f"{items_have}, a point has {size}")


def _items(record: bytes) -> list[tuple[int, int, int]]:
    """Kind, bytes and version of each item of a point, as LAZ's record has them."""
    if len(record) < ITEMS_AT:
        return []
    (count,) = struct.unpack_from("<H", record, ITEMS_AT - 2)
    whole = (len(record) - ITEMS_AT) // struct.calcsize(ITEM) * struct.calcsize(ITEM)
    return list(struct.iter_unpack(ITEM, record[ITEMS_AT : ITEMS_AT + whole]))[:count]


def _check_layers(path: Path, start: int, record: bytes) -> None:
    """Refuse LAZ layers that the file cannot hold, for the same reason as chunks.

    A chunk of layers is its first point, the number of its points, the length of each layer, and
    the layers; the next one follows at once.
    """
    # Number 3 is the compression of formats 6 to 10, which keeps each kind of value in a layer.
    if len(record) < ITEMS_AT or struct.unpack_from("<H", record)[0] != 3:
        return
    items = _items(record)
    first = sum(length for _, length, _ in items)
    # Of the extra bytes, item 14, each byte is a layer.
    layers = sum(length if kind == 14 else LAYERS.get(kind, 0) for kind, length, _ in items)
    with path.open("rb") as file:
        end = _chunk_table(file, start, path.stat().st_size)
        position = start + FIRST_CHUNK
        while position < end:
            file.seek(position + first + 4)
            sizes = file.read(4 * layers)
            # Unknown items have no layers; the position still grows, by the count at least.
            position += first + 4 + 4 * layers
            complete = len(sizes) == 4 * layers
            if complete:
                position += sum(struct.unpack(f"<{layers}I", sizes))
            if not complete or position > end:
                promised = f"a chunk promises layers up to byte {position}"
                raise ReadError(f"{promised}, the chunks end at {end}")
