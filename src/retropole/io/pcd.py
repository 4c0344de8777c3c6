"""PCD, the Point Cloud Library's format: ascii, binary and binary_compressed.

The header is read here, so that its sizes are checked against that of the file before any memory is
allocated; the data are one NumPy record array. Only the decompression is a library's.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import Array, PointCloud
from ..base.errors import ReadError, UsageError
from ..base.files import write_atomically
from .failures import naming
from .fields import LARGEST, MAX_PROMISED, Columns, cloud_from_columns, left_out, read_whole
from .table import read_table

MAX_HEADER = 64 * 1024
"""Bytes; a file without a DATA line in so many is not a PCD."""

MAX_VALUES = 10_000
"""Values of a point; more are an error in the header, and would take the memory."""

MAX_LZF_RATIO = 300
"""LZF writes at least three bytes for 264: a file that promises more is damaged."""

LZF_SIZES = 8
"""Bytes of the two sizes in front of compressed data."""

KEYS = (
    *("VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT"),
    *("VIEWPOINT", "POINTS", "DATA"),
)
PCD_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
"""Bytes that a value of each type may have; NumPy's names of the types are the small letters."""


@dataclass(frozen=True, eq=False)
class Header:
    """The header of a PCD file."""

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    counts: tuple[int, ...]
    points: int
    origin: Array
    encoding: str
    start: int
    lines: int

    @property
    def record(self) -> np.dtype[np.void]:
        """Data type of one point; padding and repeated names get names of their own."""
        seen: set[str] = set()
        fields = []
        for k, (name, kind, count) in enumerate(
            zip(self.names, self.kinds, self.counts, strict=True)
        ):
            # A name in the file has no blank, so these are not in use.
            own = f"_ {k}" if name == "_" or name in seen else name
            seen.add(name)
            fields.append((own, kind, (count,)) if count > 1 else (own, kind))
        return np.dtype(fields)


def read_pcd(path: Path) -> PointCloud:
    """Read a PCD file; the translation of its VIEWPOINT is the beam origin.

    Raises
    ------
    ReadError
        Where the header or the data are not what they should be.
    """
    data = read_whole(path, "a PCD header")
    header = _parse_header(path, data)
    if header.points == 0:
        raise ReadError(f"{path}: POINTS is 0, expected at least one point")
    if header.encoding == "ascii":
        columns, more = _read_ascii(path, data[header.start :], header)
    elif header.encoding == "binary":
        columns, more = _read_binary(path, data, header)
    else:
        columns, more = _read_compressed(path, data, header), 0
    cloud = cloud_from_columns(path, columns, header.origin)
    return replace(cloud, notes=(left_out(header.points, more),)) if more else cloud


def _parse_header(path: Path, data: bytes) -> Header:
    entries: dict[str, tuple[int, list[str]]] = {}
    position, number = 0, 0
    while "DATA" not in entries:
        end = data.find(b"\n", position, position + MAX_HEADER)
        if end < 0 or position > MAX_HEADER:
            raise ReadError(f"{path}: the header ends at line {number} without a DATA line")
        number += 1
        words = data[position:end].decode("ascii", errors="replace").split()
        position = end + 1
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in KEYS:
            expected = "one of " + ", ".join(KEYS)
            raise ReadError(f"{path}, line {number}: starts with {words[0]!r}, expected {expected}")
        key = "FIELDS" if words[0] == "COLUMNS" else words[0]
        if key in entries:
            raise ReadError(f"{path}, line {number}: {key} again, after line {entries[key][0]}")
        entries[key] = (number, words[1:])

    def entry(key: str) -> tuple[int, list[str]]:
        if key not in entries:
            raise ReadError(f"{path}: the header has no {key} line")
        return entries[key]

    def whole(key: str, low: int, default: list[int] | None = None) -> list[int]:
        if key not in entries and default is not None:
            return default
        line, words = entry(key)
        try:
            values = [int(word) for word in words]
        except ValueError:
            values = []
        if not values or min(values) < low or max(values) > MAX_PROMISED:
            raise ReadError(
                f"{path}, line {line}: {key} {' '.join(words)}, expected whole numbers from {low}"
            )
        return values

    names = entry("FIELDS")[1]
    sizes, counts = whole("SIZE", 1), whole("COUNT", 1, [1] * len(names))
    line, types = entry("TYPE")
    if not len(names) == len(sizes) == len(counts) == len(types):
        raise ReadError(
            f"{path}, line {line}: FIELDS, SIZE, TYPE and COUNT name {len(names)}, {len(sizes)}, "
            f"{len(types)} and {len(counts)} fields, expected the same number"
        )
    for name, letter, size in zip(names, types, sizes, strict=True):
        if size not in PCD_SIZES.get(letter, ()):
            raise ReadError(
                f"{path}, line {line}: field {name} has type {letter} of {size} bytes, expected F "
                "of 4 or 8, I or U of 1, 2, 4 or 8"
            )
    kinds = tuple(f"<{letter.lower()}{size}" for letter, size in zip(types, sizes, strict=True))
    width = whole("WIDTH", 0)[0]
    height = whole("HEIGHT", 0, [1])[0]
    points = whole("POINTS", 0, [width * height])[0]
    if width * height != points:
        raise ReadError(
            f"{path}: WIDTH {width} times HEIGHT {height} is not POINTS {points}: the header "
            "contradicts itself"
        )
    if sum(counts) > MAX_VALUES:
        raise ReadError(f"{path}: a point has {sum(counts)} values, expected {MAX_VALUES} at most")
    line, words = entries["DATA"]
    if words not in (["ascii"], ["binary"], ["binary_compressed"]):
        raise ReadError(
            f"{path}, line {line}: DATA {' '.join(words)}, expected ascii, binary or "
            "binary_compressed"
        )
    origin = _viewpoint(path, entries)
    return Header(
        tuple(names), kinds, tuple(counts), points, origin, words[0], start=position, lines=number
    )


def _viewpoint(path: Path, entries: dict[str, tuple[int, list[str]]]) -> Array:
    if "VIEWPOINT" not in entries:
        return np.zeros(3)
    line, words = entries["VIEWPOINT"]
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.zeros(0)
    if len(values) != 7 or not np.all(np.abs(values) <= LARGEST):
        raise ReadError(
            f"{path}, line {line}: VIEWPOINT {' '.join(words)}, expected seven numbers tx ty tz qw "
            "qx qy qz"
        )
    return values[:3]


def _read_ascii(path: Path, body: bytes, header: Header) -> tuple[Columns, int]:
    """Read a text, and count the lines that the header does not promise."""
    values = sum(header.counts)
    # Each value takes a character and a blank or line end; the last line may lack its end.
    if len(body) + 1 < 2 * values * header.points:
        raise ReadError(
            f"{path}: the header promises {header.points} points of {values} values, the "
            f"{len(body)} bytes after it cannot hold them"
        )
    table = read_table(path, body, values, line=header.lines + 1)
    if len(table) < header.points:
        raise ReadError(
            f"{path}: the header promises {header.points} points, the file holds {len(table)} lines"
        )
    points = table[: header.points]
    ends = np.cumsum(header.counts)
    names = header.record.names or ()
    columns = {
        name: _as_declared(points[:, end - count : end], kind)
        for name, kind, end, count in zip(names, header.kinds, ends, header.counts, strict=True)
    }
    return columns, len(table) - len(points)


def _as_declared(values: Array, kind: str) -> NDArray[Any]:
    """Give text the type that the header declares, so that all encodings of a cloud read the same.

    Whole numbers that do not fit the type stay as they are, rather than wrap around.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        typed = values.astype(kind)
        return typed if kind[1] == "f" or np.array_equal(typed, values) else values


def _read_binary(path: Path, data: bytes, header: Header) -> tuple[Columns, int]:
    """Read records, and count those that the header does not promise; zeros are padding."""
    record = header.record
    size, left = header.points * record.itemsize, len(data) - header.start
    if left < size:
        raise ReadError(
            f"{path}: the header promises {header.points} points of {record.itemsize} bytes, "
            f"{size} in all, the file holds {left} after it"
        )
    points = np.frombuffer(data, record, header.points, header.start)
    rest = data[header.start + size :].rstrip(b"\0")
    return {name: points[name] for name in record.names or ()}, len(rest) // record.itemsize


def _read_compressed(path: Path, data: bytes, header: Header) -> Columns:
    """Read compressed data, which are stored field by field, not point by point."""
    names = header.record.names or ()
    fields = list(zip(names, header.kinds, header.counts, strict=True))
    # PCL leaves padding out of compressed data, other writers keep it: the size tells which.
    bare = [field for field, name in zip(fields, header.names, strict=True) if name != "_"]
    sizes = {
        header.points * sum(np.dtype(kind).itemsize * count for _, kind, count in layout): layout
        for layout in (bare, fields)
    }
    plain = _decompress(path, data, header.start, sorted(sizes))
    columns: dict[str, NDArray[Any]] = {}
    position = 0
    for name, kind, count in sizes[len(plain)]:
        values = np.frombuffer(plain, kind, header.points * count, position)
        position += values.nbytes
        columns[name] = values.reshape(header.points, count) if count > 1 else values
    return columns


def _decompress(path: Path, data: bytes, start: int, sizes: list[int]) -> bytes:
    import lzf

    left = len(data) - start - LZF_SIZES
    if left < 0:
        raise ReadError(f"{path}: ends before the two sizes of its compressed data")
    compressed, plain_size = struct.unpack_from("<II", data, start)
    if plain_size not in sizes:
        raise ReadError(
            f"{path}: its data decompress to {plain_size} bytes, the header promises {sizes[-1]}"
        )
    if compressed > left:
        raise ReadError(f"{path}: promises {compressed} bytes of compressed data, holds {left}")
    if plain_size > MAX_LZF_RATIO * compressed:
        raise ReadError(f"{path}: {compressed} bytes cannot decompress to {plain_size}")
    first = start + LZF_SIZES
    try:
        plain: bytes | None = lzf.decompress(data[first : first + compressed], plain_size)
    except ValueError as error:
        raise ReadError(f"{path}: its compressed data are damaged ({error})") from None
    if plain is None or len(plain) != plain_size:
        have = "more" if plain is None else f"only {len(plain)}"
        raise ReadError(
            f"{path}: its compressed data are damaged: they decompress to {have}, not "
            f"{plain_size} bytes"
        )
    return plain


def write_pcd(path: str | Path, cloud: PointCloud) -> None:
    """Write a cloud as binary PCD, whole or not at all; arguments and errors of `pcd_of`."""
    with naming(path):
        data = pcd_of(cloud)
    write_atomically(Path(path), data)


def pcd_of(cloud: PointCloud) -> bytes:
    """Give a cloud as the bytes of a binary PCD.

    Coordinates and intensity are float32, a ring uint16, a time float64; VIEWPOINT holds the
    origin of the beams, without rotation. The frame index has no field of its own, so it is left
    out.

    Raises
    ------
    UsageError
        Where a value does not fit float32 or uint16.
    """
    columns: list[tuple[str, str, NDArray[Any] | None]] = [
        *((name, "<f4", cloud.xyz[:, axis]) for axis, name in enumerate("xyz")),
        ("intensity", "<f4", cloud.intensity),
        ("ring", "<u2", cloud.ring),
        ("timestamp", "<f8", cloud.time),
    ]
    fields = [(name, kind) for name, kind, column in columns if column is not None]
    points = np.empty(len(cloud), np.dtype(fields))
    for name, kind, column in columns:
        if column is None:
            continue
        fits = np.iinfo(kind) if name == "ring" else np.finfo(kind)
        if column.size and not (fits.min <= column.min() and column.max() <= fits.max):
            raise UsageError(
                f"{name} runs from {column.min():g} to {column.max():g}, a PCD holds "
                f"{fits.min:g} to {fits.max:g}"
            )
        points[name] = column
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(name for name, _ in fields),
        "SIZE " + " ".join(kind[2] for _, kind in fields),
        "TYPE " + " ".join(kind[1].upper() for _, kind in fields),
        "COUNT " + " ".join("1" for _ in fields),
        f"WIDTH {len(cloud)}",
        "HEIGHT 1",
        "VIEWPOINT " + " ".join(repr(float(v)) for v in cloud.origin) + " 1 0 0 0",
        f"POINTS {len(cloud)}",
        "DATA binary",
        "",
    ]
    return "\n".join(header).encode("ascii") + points.tobytes()
