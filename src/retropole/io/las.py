"""LAS and LAZ, by laspy (the optional part ``las``).

laspy believes the header: one wrong byte in it makes laspy take gigabytes before it notices. The
sizes that the header promises are therefore held against the size of the file first.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..datatypes import PointCloud
from ..errors import MissingExtraError, ReadError
from .fields import INTENSITY, RING, TIME, cloud_from_columns

PART = 16 * 2**20
"""Bytes of unpacked points read at a time."""

MAX_LAZ_RATIO = 1000
"""Scans pack 5 to 20 fold: a file that promises more than this holds something else."""

SMALLEST_HEADER = 227
SMALLEST_RECORD = 54
"""Bytes of a variable length record that holds nothing."""

SMALLEST_POINT = 20
"""Bytes of a point of the shortest format."""

FORMAT, PACKED = 104, 0x80
"""Byte of the header that holds the format of the points, and its bit for LAZ."""

LAYERED = 3
"""How LAZ calls the packing of formats 6 to 10, which puts each kind of value in its own layer."""

LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""How many layers the items of a point have: the point itself, RGB, RGB and NIR, wave packet."""

EXTRA_BYTES = 14
"""The item whose every byte is a layer."""


def read_las(path: Path) -> PointCloud:
    """Read a LAS or LAZ file, with its scale and offset applied.

    Raises
    ------
    MissingExtraError
        Where laspy is not installed.
    ReadError
        Where laspy cannot read the file, or the file is shorter than its header promises.
    """
    try:
        import laspy
    except ImportError:
        raise MissingExtraError("las", "reading LAS and LAZ") from None
    _check_header(path)
    try:
        # One thread: several gain a sixth of the time, and hang in processes made by fork.
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as file:
            header = file.header
            _check_points(
                path,
                header.point_count,
                header.point_format.size,
                path.stat().st_size - header.offset_to_point_data,
                packed=header.are_points_compressed,
            )
            for record in header.vlrs.get("LasZipVlr"):
                _check_layers(path, header.offset_to_point_data, record.record_data)
            names = _wanted(header.point_format.dimension_names)
            # In parts, so that memory follows what the file holds, not what its header promises.
            size = max(1, PART // header.point_format.size)
            parts = [[np.array(part[name]) for name in names] for part in file.chunk_iterator(size)]
    except ReadError:
        raise
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        # For damaged files laspy and its decoders raise a dozen unrelated types; a panic of the
        # LAZ decoder is not even an Exception.
        raise ReadError(f"{path}: is no readable LAS file ({error})") from None
    if not parts:
        raise ReadError(f"{path}: holds no points, expected at least one")
    columns = {name: np.concatenate(column) for name, *column in zip(names, *parts, strict=True)}
    count = sum(len(part[0]) for part in parts)
    if count != header.point_count:
        raise ReadError(
            f"{path}: the header promises {header.point_count} points, the file holds {count}"
        )
    return cloud_from_columns(path, columns)


def _check_header(path: Path) -> None:
    """Check that the records and chunks the header promises have room in the file."""
    size = path.stat().st_size
    if size == 0:
        raise ReadError(f"{path}: is empty, expected a LAS header")
    with path.open("rb") as file:
        head = file.read(SMALLEST_HEADER)
    if head[:4] != b"LASF" or len(head) < SMALLEST_HEADER:
        raise ReadError(
            f"{path}: starts with {head[:4]!r} and has {size} bytes, expected a LAS header, which "
            f"starts with b'LASF' and has {SMALLEST_HEADER} or more"
        )
    length, points, records = struct.unpack_from("<HII", head, 94)
    if points > size:
        raise ReadError(
            f"{path}: the header says that points start at byte {points}, the file ends at {size}"
        )
    if length + SMALLEST_RECORD * records > points:
        raise ReadError(
            f"{path}: the header promises {records} variable length records, which the bytes "
            f"{length} to {points} before the points cannot hold"
        )
    if head[FORMAT] & PACKED:
        _check_chunks(path, points)


def _check_points(path: Path, count: int, size: int, left: int, *, packed: bool) -> None:
    """Check that `count` points of `size` bytes can come from the `left` bytes of the file."""
    if count * size > left * (MAX_LAZ_RATIO if packed else 1):
        raise ReadError(
            f"{path}: the header promises {count} points, {count * size} bytes"
            f"{' unpacked' if packed else ''}; the file holds {left} after it"
        )


def _check_chunks(path: Path, start: int) -> None:
    """Refuse a count of LAZ chunks that the file cannot hold.

    The decoder makes room for as many as the file says, and where there is none, it ends the
    process: no exception could be caught. A chunk starts with one point as it is.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(_chunk_table(path, file, start) + 4)
        chunks = struct.unpack("<I", file.read(4))[0]
    if chunks * SMALLEST_POINT > size:
        raise ReadError(f"{path}: promises {chunks} chunks, its {size} bytes cannot hold them")


def _chunk_table(path: Path, file: BinaryIO, start: int) -> int:
    """Find the byte where the LAZ chunks end and their table begins."""
    size = path.stat().st_size
    file.seek(start)
    head = file.read(8)
    table: int = struct.unpack("<q", head)[0] if len(head) == 8 else 0
    if table == -1:  # a writer that could not go back put the place at the very end
        file.seek(size - 8)
        table = struct.unpack("<q", file.read(8))[0]
    if not start < table <= size - 8:
        raise ReadError(
            f"{path}: its table of chunks is said to be at byte {table}, expected between "
            f"{start} and {size - 8}"
        )
    return table


def _check_layers(path: Path, start: int, packing: bytes) -> None:
    """Refuse LAZ layers that the file cannot hold, for the same reason as chunks.

    A chunk of layers is its first point, how many points it has, how long each layer is, and the
    layers; the next one follows at once.
    """
    if len(packing) < 34 or struct.unpack_from("<H", packing)[0] != LAYERED:
        return
    items = list(struct.iter_unpack("<HHH", packing[34 : 34 + (len(packing) - 34) // 6 * 6]))
    first = sum(length for _, length, _ in items)
    layers = sum(
        length if kind == EXTRA_BYTES else LAYERS.get(kind, 0) for kind, length, _ in items
    )
    with path.open("rb") as file:
        end = _chunk_table(path, file, start)
        position = start + 8
        while position < end:
            file.seek(position + first + 4)
            sizes = file.read(4 * layers)
            # An item of no known kind makes no layers; the place still moves on, by 4 at least.
            position += first + 4 + 4 * layers
            if len(sizes) == 4 * layers:
                position += sum(struct.unpack(f"<{layers}I", sizes))
            if len(sizes) < 4 * layers or position > end:
                raise ReadError(
                    f"{path}: a chunk promises layers up to byte {position}, the chunks end at "
                    f"{end}"
                )


def _wanted(dimensions: Iterable[str]) -> list[str]:
    """Names of the scaled coordinates and of the other fields that mean something here."""
    known = {*INTENSITY, *RING, *TIME}
    return ["x", "y", "z"] + [
        name for name in dimensions if name.lower().removeprefix("scalar_") in known
    ]
