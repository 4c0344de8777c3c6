"""PCD, the Point Cloud Library's format: ascii, binary and binary_compressed.

The header is read here, so that its sizes are checked against that of the file before any memory is
allocated; the data are one NumPy record array. Only the decompression is a library's. pypcd4, which
reads PCD too, takes one that was cut between two points for a smaller one, mixes up the values of
compressed fields that have several, and cannot read a COUNT of 0 or padding that is left out.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import Array, PointCloud
from ..base.errors import LineError, ReadError, UsageError, naming, said
from ..base.files import write_atomically
from .arrays import read_table
from .fields import (
    LARGEST,
    MAX_PROMISED,
    USUAL,
    Columns,
    Wanted,
    cloud_from_columns,
    left_out,
    noted,
    read_whole,
    records_of,
)

MAX_HEADER = 64 * 1024
"""Bytes; a file without a DATA line in this many is not a PCD."""

MAX_VALUES = 10_000
"""Values of a point; more are an error in the header, and would take the memory."""

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
    notes: tuple[str, ...]

    @property
    def record(self) -> np.dtype[np.void]:
        """Data type of one point; padding and repeated names get separate names."""
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


def read_pcd(path: Path, wanted: Wanted = USUAL) -> PointCloud:
    """Read a PCD file; the translation of its VIEWPOINT is the beam origin.

    Raises
    ------
    ReadError
        If the header or the data are not what they should be.
    """
    data = read_whole(path, "a PCD header")
    header = _parse_header(data)
    if header.points == 0:
        raise ReadError("POINTS is 0, expected at least one point")
    body = memoryview(data)[header.start :]
    if header.encoding == "ascii":
        columns, more = _read_ascii(bytes(body), header)
    elif header.encoding == "binary":
        columns, more = _read_binary(body, header)
    else:
        columns, more = _read_compressed(body, header), 0
    cloud = cloud_from_columns(columns, wanted, header.origin)
    return noted(cloud, *header.notes, left_out(header.points, more) if more else "")


Entries = dict[str, tuple[int, list[str]]]
"""By key, the number of a line and its values."""


def _parse_header(data: bytes) -> Header:
    entries: Entries = {}
    position, number = 0, 0
    while "DATA" not in entries:
        end = data.find(b"\n", position, position + MAX_HEADER)
        if end < 0 or position > MAX_HEADER:
            raise ReadError(f"the header ends at line {number} without a DATA line")
        number += 1
        values = data[position:end].decode("ascii", errors="replace").split()
        position = end + 1
        if not values or values[0].startswith("#"):
            continue
        if values[0] not in KEYS:
            raise LineError(number, f"starts with {values[0]!r}, expected one of {', '.join(KEYS)}")
        key = "FIELDS" if values[0] == "COLUMNS" else values[0]
        if key in entries:
            raise LineError(number, f"{key} again, after line {entries[key][0]}")
        entries[key] = (number, values[1:])
    names = _entry(entries, "FIELDS")[1]
    sizes, counts = _whole(entries, "SIZE", 1), _whole(entries, "COUNT", 0, [1] * len(names))
    line, types = _entry(entries, "TYPE")
    if not len(names) == len(sizes) == len(counts) == len(types):
        numbers = f"{len(names)}, {len(sizes)}, {len(types)} and {len(counts)} fields"
        stated = f"FIELDS, SIZE, TYPE and COUNT name {numbers}, expected the same number"
        raise LineError(line, stated)
    for name, letter, size in zip(names, types, sizes, strict=True):
        if size not in PCD_SIZES.get(letter, ()):
            kind = f"field {name} has type {letter} of {size} bytes"
            raise LineError(line, f"{kind}, expected F of 4 or 8, I or U of 1, 2, 4 or 8")
    kinds = [f"<{letter.lower()}{size}" for letter, size in zip(types, sizes, strict=True)]
    (width, *_), (height, *_) = _whole(entries, "WIDTH", 0), _whole(entries, "HEIGHT", 0, [1])
    points = _whole(entries, "POINTS", 0, [width * height])[0]
    notes = []
    if width * height == 0 < points:
        # Some writers know the number of points only; PCL reads it so, up to 1.12.
        notes.append(f"WIDTH {width} and HEIGHT {height} are ignored: POINTS is {points}")
    elif width * height != points:
        product = f"WIDTH {width} times HEIGHT {height} is not POINTS {points}"
        raise ReadError(f"{product}: the header contradicts itself")
    if sum(counts) > MAX_VALUES:
        raise ReadError(f"a point has {sum(counts)} values, expected {MAX_VALUES} at most")
    line, values = entries["DATA"]
    if values not in (["ascii"], ["binary"], ["binary_compressed"]):
        stated = f"DATA {' '.join(values)}"
        raise LineError(line, f"{stated}, expected ascii, binary or binary_compressed")
    origin = _viewpoint(*entries.get("VIEWPOINT", (0, ["0"] * 7)))
    # Some writers put a field of no values where there is no padding to be said.
    empty = [name for name, count in zip(names, counts, strict=True) if not count and name != "_"]
    if empty:
        notes.append(f"of COUNT 0, so without values: {', '.join(empty)}")
    if not any(counts):
        raise ReadError("COUNT is 0 for every field, expected x, y and z at least")
    return Header(
        tuple(name for name, count in zip(names, counts, strict=True) if count),
        tuple(kind for kind, count in zip(kinds, counts, strict=True) if count),
        tuple(filter(None, counts)),
        points,
        origin,
        values[0],
        start=position,
        lines=number,
        notes=tuple(notes),
    )


def _entry(entries: Entries, key: str) -> tuple[int, list[str]]:
    if key not in entries:
        raise ReadError(f"the header has no {key} line")
    return entries[key]


def _whole(entries: Entries, key: str, low: int, default: list[int] | None = None) -> list[int]:
    """Read whole numbers, one at least."""
    if key not in entries and default is not None:
        return default
    line, given = _entry(entries, key)
    try:
        values = [int(word) for word in given]
    except ValueError:
        values = []
    if not values or min(values) < low or max(values) > MAX_PROMISED:
        raise LineError(line, f"{key} {' '.join(given)}, expected whole numbers from {low}")
    return values


def _viewpoint(line: int, given: list[str]) -> Array:
    try:
        values = np.array([float(word) for word in given])
    except ValueError:
        values = np.zeros(0)
    if len(values) != 7 or not np.all(np.abs(values) <= LARGEST):
        stated = f"VIEWPOINT {' '.join(given)}"
        raise LineError(line, f"{stated}, expected seven numbers tx ty tz qw qx qy qz")
    return values[:3]


def _read_ascii(body: bytes, header: Header) -> tuple[Columns, int]:
    """Read a text, and count the lines that the header does not promise."""
    promised, values = f"the header promises {header.points} points", sum(header.counts)
    # Each value takes a character and a blank or line end; the last line may lack its end.
    if len(body) + 1 < 2 * values * header.points:
        cannot = f"the {len(body)} bytes after it cannot hold them"
        raise ReadError(f"{promised} of {values} values, {cannot}")
    table = read_table(body, values, line=header.lines + 1)
    if len(table) < header.points:
        raise ReadError(f"{promised}, the file has {len(table)} lines")
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


def _read_binary(body: memoryview, header: Header) -> tuple[Columns, int]:
    """Read records, and count those that the header does not promise; zeros are padding."""
    record = header.record
    size = header.points * record.itemsize
    if len(body) < size:
        promised = f"{header.points} points of {record.itemsize} bytes, {size} in all"
        raise ReadError(f"the header promises {promised}, the file has {len(body)} after it")
    points = np.frombuffer(body, record, header.points)
    rest = bytes(body[size:]).rstrip(b"\0")
    return {name: points[name] for name in record.names or ()}, len(rest) // record.itemsize


def _read_compressed(body: memoryview, header: Header) -> Columns:
    """Read compressed data, which are stored field by field, not point by point."""
    names = header.record.names or ()
    fields = list(zip(names, header.kinds, header.counts, strict=True))
    # PCL leaves padding out of compressed data, other writers keep it: the size shows which.
    bare = [field for field, name in zip(fields, header.names, strict=True) if name != "_"]
    sizes = {
        header.points * sum(np.dtype(kind).itemsize * count for _, kind, count in layout): layout
        for layout in (bare, fields)
    }
    plain = _decompress(body, sorted(sizes))
    columns: dict[str, NDArray[Any]] = {}
    position = 0
    for name, kind, count in sizes[len(plain)]:
        values = np.frombuffer(plain, kind, header.points * count, position)
        position += values.nbytes
        columns[name] = values.reshape(header.points, count) if count > 1 else values
    return columns


def _decompress(body: memoryview, sizes: list[int]) -> bytes:
    import lzf

    left = len(body) - LZF_SIZES
    if left < 0:
        raise ReadError("ends before the two sizes of its compressed data")
    compressed, size = struct.unpack_from("<II", body)
    if size not in sizes:
        raise ReadError(f"its data decompress to {size} bytes, the header promises {sizes[-1]}")
    if compressed > left:
        raise ReadError(f"promises {compressed} bytes of compressed data, has {left}")
    # LZF writes at least three bytes for 264.
    if size > 300 * compressed:
        raise ReadError(f"{compressed} bytes cannot decompress to {size}")
    try:
        plain: bytes | None = lzf.decompress(bytes(body[LZF_SIZES:][:compressed]), size)
    except ValueError as error:
        raise ReadError(f"its compressed data are damaged ({said(error)})") from None
    if plain is None or len(plain) != size:
        have = f"they decompress to {'more' if plain is None else f'only {len(plain)}'}"
        raise ReadError(f"its compressed data are damaged: {have}, not {size} bytes")
    return plain


def write_pcd(path: str | Path, cloud: PointCloud) -> None:
    """Write a cloud as binary PCD, whole or not at all; arguments and errors of `pcd_of`."""
    with naming(path):
        data = pcd_of(cloud)
    write_atomically(Path(path), data)


def pcd_of(cloud: PointCloud) -> bytes:
    """Give a cloud as the bytes of a binary PCD.

    Coordinates and intensity are float32, a ring uint16, a time float64; VIEWPOINT is the
    origin of the beams, without rotation. The frame index has no separate field, so it is left
    out.

    Raises
    ------
    UsageError
        If a value does not fit float32 or uint16.
    """
    columns: list[tuple[str, str, NDArray[Any] | None]] = [
        *((name, "<f4", cloud.xyz[:, axis]) for axis, name in enumerate("xyz")),
        ("intensity", "<f4", cloud.intensity),
        ("ring", "<u2", cloud.ring),
        ("timestamp", "<f8", cloud.time),
    ]
    kept = [(name, kind, column) for name, kind, column in columns if column is not None]
    for name, kind, column in kept:
        fits = np.iinfo(kind) if name == "ring" else np.finfo(kind)
        if column.size and not (fits.min <= column.min() and column.max() <= fits.max):
            runs = f"{name} runs from {column.min():g} to {column.max():g}"
            raise UsageError(f"{runs}, a PCD stores {fits.min:g} to {fits.max:g}")
    points = records_of({name: column.astype(kind) for name, kind, column in kept})
    kinds = [kind for _, kind, _ in kept]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(name for name, *_ in kept)}",
        f"SIZE {' '.join(kind[2] for kind in kinds)}",
        f"TYPE {' '.join(kind[1].upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {len(cloud)}",
        "HEIGHT 1",
        "VIEWPOINT " + " ".join(repr(float(v)) for v in cloud.origin) + " 1 0 0 0",
        f"POINTS {len(cloud)}",
        "DATA binary",
        "",
    ]
    return "\n".join(header).encode("ascii") + points.tobytes()
