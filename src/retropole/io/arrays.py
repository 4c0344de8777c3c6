"""Plain arrays of numbers: NumPy's .npy and .npz, text, also that of other formats, and .bin.

Nothing in a ``.bin`` states how long a point is, and a wrong length gives a cloud of nonsense. So a
length is used only if its values are those of points, and of two possible lengths none is guessed.
"""

from __future__ import annotations

import codecs
import io
import math
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import Array, PointCloud
from ..base.errors import LineError, ReadError, UsageError, reported
from .fields import (
    LARGEST,
    PLAIN_COLUMNS,
    REAL_KINDS,
    USUAL,
    Wanted,
    cloud_from_columns,
    floats,
    has_coordinates,
    has_meaning,
    noted,
    read_whole,
)
from .unpacking import Spend, allowance

TABLE_KEYS = ("xyz", "points", "arr_0")
"""Names of a table of points in an NPZ."""

SEPARATORS = ";\t,"
"""What separates the values of a text: the first of these that occurs, else blanks."""

DECIMAL_COMMA = re.compile(r"[-+]?[0-9]+(,[0-9]+)?([eE][-+]?[0-9]+)?")
"""A number as it is written where the comma is the decimal mark."""

HEXADECIMAL = re.compile(rb"(?<![\w.+-])0[xX][0-9a-fA-F]{1,16}(?![\w.])")
"""A whole number as Livox Viewer writes its error codes."""

COLOURS = ("red", "green", "blue")
LEICA_COLUMNS = (*PLAIN_COLUMNS[:3], *COLOURS), (*PLAIN_COLUMNS, *COLOURS)
"""What six and seven columns of a ``.pts`` are."""

MAX_COLUMNS = 10_000
"""Values of a point; more are an error, and would take the time."""

MAX_HEAD = 2**20
"""Bytes that comments and names of columns, and the first line of numbers, may take."""

ARRAY_SOURCE = "<array>"
"""Source of a cloud that was made of an array."""


def _is_table(array: NDArray[Any]) -> bool:
    return array.ndim == 2 and array.shape[1] in (3, 4)


def _from_table(table: NDArray[Any], wanted: Wanted = USUAL) -> PointCloud:
    if table.dtype.names is not None:
        table = table.reshape(-1)
        columns = {name: table[name] for name in table.dtype.names or ()}
        return cloud_from_columns(columns, wanted)
    if not _is_table(table):
        raise ReadError(
            f"a table of shape {table.shape} without names of columns, expected (N, 3) or (N, 4): "
            + " ".join(PLAIN_COLUMNS)
        )
    return cloud_from_columns(dict(zip(PLAIN_COLUMNS, table.T, strict=False)), wanted)


def cloud_from_array(array: NDArray[Any], name: str = ARRAY_SOURCE) -> PointCloud:
    """Make a cloud of an array in memory.

    Points that are not finite or at zero range are dropped and counted, as when a file is read.

    Parameters
    ----------
    array
        (N, 3) x y z in metres, (N, 4) x y z intensity, or a structured array with named fields.
    name
        What to call it in messages.

    Raises
    ------
    UsageError
        If it has another shape or no numbers, and if no point in it is a return.
    """
    are_numbers = array.dtype.kind in REAL_KINDS and array.size > 0
    if array.dtype.names is None and not (_is_table(array) and are_numbers):
        raise UsageError(
            f"{name}: an array of {array.dtype} of shape {array.shape}, expected numbers of shape "
            "(N, 3): x, y, z in metres, or (N, 4): x, y, z, intensity"
        )
    try:
        cloud = _from_table(array)
    except ReadError as error:
        raise UsageError(f"{name}: {error}") from None
    return replace(cloud, source=ARRAY_SOURCE)


def _load(file: IO[bytes], left: int, spend: Spend = lambda _: None) -> NDArray[Any]:
    """Read one ``.npy`` from an open file of `left` bytes; its header may not promise more.

    Its numbers are counted by `spend` before they are read.
    """
    npy = np.lib.format
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ReadError(f"NPY version {version}, expected 1.0 or 2.0")
    reader = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, fortran, dtype = reader(file)
    if dtype.hasobject:
        raise ReadError("has Python objects, expected numbers")
    if not dtype.itemsize or any(n < 0 for n in shape):
        raise ReadError(f"an array of {dtype} and shape {shape}, expected numbers")
    size = math.prod(int(n) for n in shape) * dtype.itemsize
    if size > left:
        raise ReadError(f"promises {size} bytes of data, the file has only {left}")
    # A number in a point cloud takes 8 bytes.
    spend(max(size, 8 * size // dtype.itemsize))
    body = file.read(size)
    if len(body) < size:
        raise ReadError(f"promises {size} bytes of data, the file has {len(body)}")
    return np.frombuffer(body, dtype).reshape(shape, order="F" if fortran else "C")


def read_npy(path: Path, wanted: Wanted = USUAL) -> PointCloud:
    """Read an NPY array: (N, 3), (N, 4), or one with named fields."""
    data = read_whole(path)
    # The header is Python text: NumPy raises whatever reading a damaged one raises.
    with reported("NPY file"):
        array = _load(io.BytesIO(data), len(data))
    return _from_table(array, wanted)


def read_npz(path: Path, wanted: Wanted = USUAL) -> PointCloud:
    """Read an NPZ: x, y and z, or one table xyz or points (N, 3 or 4); intensity, ring, time.

    If there is only one array, its name does not matter. Arrays with other names are skipped.
    """
    data = read_whole(path)
    arrays: dict[str, NDArray[Any]] = {}
    # This much in all, and this many times its size; coordinates compress 2 to 10 fold.
    spend = allowance(len(data), 2**28, 20)
    # A damaged archive raises a dozen unrelated types, from zipfile, zlib and NumPy.
    with reported("NPZ file"), zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = [entry.filename.removesuffix(".npy") for entry in archive.infolist()]
        known = *"xyz", *TABLE_KEYS, *(wanted.names(names) if len(names) > 1 else ())
        for name, entry in zip(names, archive.infolist(), strict=True):
            # Deflate compresses at most 1032 bytes into one; an entry that promises more is
            # damaged.
            if entry.file_size > 1100 * max(entry.compress_size, 1):
                promised = f"{entry.compress_size} bytes cannot unpack to {entry.file_size}"
                raise ReadError(f"{entry.filename}: {promised}")
            if len(names) > 1 and not has_meaning(name, *known):
                continue
            with archive.open(entry) as file:
                arrays[name] = _load(file, entry.file_size, spend)
    if len(arrays) == 1:
        (only,) = arrays.values()
        return _from_table(only, wanted)
    tables = [name for name in TABLE_KEYS if name in arrays]
    if len(tables) > 1:
        raise ReadError(f"has {' and '.join(tables)}, expected one table of points")
    for name in tables:
        table = arrays.pop(name)
        if not _is_table(table):
            raise ReadError(f"{name} has shape {table.shape}, expected (N, 3) or (N, 4)")
        # An array of intensities takes precedence over a fourth column.
        arrays = dict(zip(PLAIN_COLUMNS, table.T, strict=False)) | arrays
    return cloud_from_columns(arrays, wanted)


def read_text(path: Path, wanted: Wanted = USUAL) -> PointCloud:
    """Read a table of text: columns by name where a first line names them, else x y z intensity.

    Values are separated by semicolons, tabs, commas or blanks: the first of these that is in the
    first line of numbers. Lines that start with ``#`` or ``//`` are comments; the last one before
    the numbers that names x, y and z names the columns. A line of one whole number before the
    points is their number. Decimal commas are read if they cannot be anything else.
    """
    return _read_lines(path, wanted)


def read_pts(path: Path, wanted: Wanted = USUAL) -> PointCloud:
    """Read a text as `read_text` does, also with colours, without names, as Leica's programs do.

    Six columns are x y z and red, green, blue; of seven, the fourth is the intensity.
    """
    return _read_lines(path, wanted, LEICA_COLUMNS)


def _read_lines(path: Path, wanted: Wanted, wide: tuple[tuple[str, ...], ...] = ()) -> PointCloud:
    """Read a text; `wide` are the names that columns without names may have, if there are more."""
    body = as_utf8(read_whole(path)).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    head = _head(body)
    body = body[head.position :]
    raw = body.partition(b"\n")[0]
    if len(raw) > MAX_HEAD:
        raise LineError(head.line, f"{len(raw):,} bytes, expected x y z and more")
    line = raw.decode("ascii", errors="replace").split("#")[0]
    separator, notes = _separator(line), list(head.notes)
    # Where there are points as well, commas may separate thousands.
    if b"," in body and b"." not in body and _has_decimal_commas(line, separator):
        body = body.replace(b",", b".")
        separator = None if separator == "," else separator
        notes.append("its commas are read as decimal marks")
    columns = len(head.names) or len(line.split(separator))
    if columns > MAX_COLUMNS:
        raise LineError(head.line, f"{columns:,} columns, expected {MAX_COLUMNS:,} at most")
    table = read_table(body, columns, line=head.line, separator=separator)
    if head.promised is not None and len(table) != head.promised:
        stated = f"promises {head.promised} points, {len(table)} lines of numbers follow"
        raise LineError(head.counted_at, stated)
    names = head.names or next((list(own) for own in wide if len(own) == columns), [])
    if not names:
        return noted(_from_table(table, wanted), *notes)
    if not head.names:
        _check_colours(table[:, -len(COLOURS) :])
    if len({name.lower() for name in names}) < len(names):
        raise ReadError(f"two columns have one name, the names are: {', '.join(names)}")
    known = wanted.names(names)
    own = {
        name: _whole(column) if has_meaning(name, *known) else column
        for name, column in zip(names, table.T, strict=True)
    }
    return noted(cloud_from_columns(own, wanted), *notes)


def as_utf8(data: bytes) -> bytes:
    """Give a text as UTF-8 without a byte order mark; one of UTF-16 has such a mark."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        data = data.decode("utf-16", errors="replace").encode("utf-8", errors="replace")
    return data.removeprefix(codecs.BOM_UTF8)


def _has_decimal_commas(line: str, separator: str | None) -> bool:
    """Whether commas can only be decimal marks, by the first line of numbers."""
    values = line.split()
    between_blanks = len(values) >= 3 and all(map(DECIMAL_COMMA.fullmatch, values))
    return separator in (";", "\t") or between_blanks


def _check_colours(values: Array) -> None:
    """Refuse a file whose last columns are not colours, so that others may not be an intensity."""
    if not (np.all(values == np.rint(values)) and np.all((values >= 0) & (values <= 255))):
        raise ReadError(
            "its last three columns are not colours from 0 to 255, expected x y z intensity red "
            "green blue; a first line may name the columns"
        )


def _whole(column: Array) -> NDArray[Any]:
    """Give whole numbers as such: a text has no types, and of times they are ticks."""
    with np.errstate(invalid="ignore"):
        # Up to this, a float64 represents every whole number.
        is_whole = np.all(np.abs(column) <= 2**53) and np.all(column == np.rint(column))
    return column.astype(np.int64) if is_whole else column


class _Head(NamedTuple):
    """What is before the first line of numbers, and its number and position."""

    names: list[str]
    promised: int | None
    counted_at: int
    line: int
    position: int
    notes: tuple[str, ...]


def _head(body: bytes) -> _Head:
    """Find the names of the columns and the number of points, if any, and the first numbers."""
    names, commented, position = list[str](), True, 0
    promised: int | None = None
    counted_at, notes = 0, tuple[str, ...]()
    for number, raw in enumerate(body[:MAX_HEAD].splitlines(keepends=True), 1):
        if raw.isspace():
            position += len(raw)
            continue
        line = raw.decode("utf-8", errors="replace").strip()
        plain = line.lstrip("#/").strip()
        values = [word.strip(" \"'") for word in plain.split(_separator(plain))]
        is_comment = plain != line
        if not is_comment and promised is None and re.fullmatch("[0-9]{1,15}", plain):
            # CloudCompare and Leica's programs write how many points follow.
            promised, counted_at = int(plain), number
        elif not is_comment and names and not notes and _is_of_device(values, len(names)):
            notes = (f"line {number} has {len(values)} values and is left out: {line[:60]!r}",)
        # Words that only start like a number are not names: 1,5 is an error and not a title.
        elif not is_comment and any(
            is_number(word) or re.match(r"[-+.]?[0-9]", word) for word in values
        ):
            return _Head(names, promised, counted_at, number, position, notes)
        elif not is_comment:
            if not commented:
                raise LineError(number, f"{line[:60]!r}, expected numbers")
            names, commented = values, False
        elif commented and has_coordinates(values):
            # Of the comments, only one that names the coordinates names the columns.
            names = values
        position += len(raw)
    raise ReadError(
        f"has no lines of numbers in its first {min(len(body), MAX_HEAD):,} bytes, "
        "expected x y z and more in columns"
    )


def _is_of_device(cells: list[str], columns: int) -> bool:
    """Whether a line is of the sensor and not of a point: Livox Viewer 2 begins with such a one."""
    is_serial = re.fullmatch("[0-9A-Z]{10,30}", cells[0]) is not None and not is_number(cells[0])
    return is_serial and len(cells) != columns


def _separator(line: str) -> str | None:
    return next((separator for separator in SEPARATORS if separator in line), None)


def read_table(body: bytes, columns: int, *, line: int, separator: str | None = None) -> Array:
    """Read the lines of a text as a table of numbers, without blank lines and # comments.

    Parameters
    ----------
    body
        The text. Bytes that are not ASCII become question marks, which are not numbers.
    columns
        How many values each line must have.
    line
        Number that the first line of `body` has in the file.
    separator
        What separates the values; None is any number of blanks.

    Returns
    -------
    (N, columns) array; hexadecimal numbers (0x1F) are whole numbers.

    Raises
    ------
    ReadError
        Naming the first line that does not have `columns` numbers.
    """
    # Only these end a line for NumPy and for editors; str.splitlines knows many others.
    if b"\r" in body:
        body = body.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"0x" in body or b"0X" in body:
        body = HEXADECIMAL.sub(lambda found: b"%d" % int(found[0], 16), body)
    if not any(part.split(b"#", 1)[0].strip() for part in io.BytesIO(body)):
        return np.empty((0, columns))
    # Line by line: the whole as a string takes several times the memory of the file.
    lines = io.TextIOWrapper(io.BytesIO(body), "ascii", errors="replace", newline="\n")
    try:
        table = np.loadtxt(lines, delimiter=separator, ndmin=2, dtype=np.float64)
    except ValueError:
        bad = _first_bad(body, columns, separator)
        if bad is None:
            raise ReadError(f"its lines are not {columns} numbers each") from None
        number, content = bad
        message = f"{content[:60]!r}, expected {columns} numbers"
        raise LineError(line + number, message) from None
    if table.shape[1] != columns:
        number, _ = _first_bad(body, columns, separator) or (0, "")
        raise LineError(line + number, f"has {table.shape[1]} values, expected {columns}")
    return table


def is_number(word: str) -> bool:
    """Whether a word reads as a number, nan and inf included."""
    try:
        float(word)
    except ValueError:
        return False
    # Python reads 1_000 as a number, NumPy and all others do not.
    return "_" not in word


def _first_bad(body: bytes, columns: int, separator: str | None) -> tuple[int, str] | None:
    """Find the first line without `columns` numbers: its index, and what it contains."""
    for k, line in enumerate(io.BytesIO(body)):
        content = line.rstrip(b"\n").decode("ascii", errors="replace").replace("�", "?")
        plain = content.split("#", 1)[0].strip(None if separator is None else " ")
        values = plain.split(separator)
        if plain and (len(values) != columns or not all(is_number(w.strip()) for w in values)):
            return k, content
    return None


FOUR, FIVE = PLAIN_COLUMNS, (*PLAIN_COLUMNS, "ring")
"""Columns of KITTI's velodyne files, and of nuScenes' ``.pcd.bin`` files."""

FLOAT, LONG_RECORD = 4, 32
"""Bytes of a value; and of a point as in PCL's memory, x y z and intensity each padded."""

TINIEST = 1e-20
"""No coordinate but zero is smaller, or above `LARGEST`, metres or millimetres: halves of float64,
whole numbers and padding that are read as float32 are."""


def read_bin(path: Path, wanted: Wanted = USUAL) -> PointCloud:
    """Read float32 x y z intensity (KITTI), or x y z intensity ring (nuScenes).

    Raises
    ------
    ReadError
        If the values are neither's, or could be both's.
    """
    data = read_whole(path)
    fitting = [
        names
        for names, fits in ((FOUR, _are_four), (FIVE, _are_five))
        if len(data) % (FLOAT * len(names)) == 0 and fits(_rows(data, len(names)))
    ]
    if len(fitting) == 1:
        rows = _rows(data, len(fitting[0]))
        return cloud_from_columns(dict(zip(fitting[0], rows.T, strict=True)), wanted)
    raise ReadError(_why(data, bool(fitting)))


def _rows(data: bytes, columns: int) -> NDArray[Any]:
    return np.frombuffer(data, "<f4").reshape(-1, columns)


def _are_four(rows: NDArray[Any]) -> bool:
    return _are_points(rows) and not _alternate(rows)


def _are_five(rows: NDArray[Any]) -> bool:
    ring = rows[:, 4]
    with np.errstate(invalid="ignore"):
        # Coordinates, four fifths of what a wrong length puts there, are not whole numbers.
        are_rings = (ring >= 0) & (ring < 256) & (ring == np.round(ring))
    return bool(np.all(are_rings)) and _are_points(rows)


def _are_points(rows: NDArray[Any]) -> bool:
    """Whether x, y and z can be coordinates, and the fourth value an intensity."""
    with np.errstate(invalid="ignore"):
        size = np.abs(rows[:, :3])
        odd = np.any(((size < TINIEST) & (size > 0.0)) | (size > LARGEST), axis=1)
        odd |= rows[:, 3] < 0.0
    # What is not a number is not a return, and dropped; infinity is one of the largest.
    # With a wrong length, a third and more of the intensities are coordinates, half of which are
    # negative.
    return float(np.mean(odd & ~np.any(np.isinf(size), axis=1))) <= 0.01


def _alternate(rows: NDArray[Any]) -> bool:
    """Whether every second row is something else than a point."""
    if len(rows) < 64 or len(rows) * FLOAT * 4 % LONG_RECORD:
        return False
    ground = floats(rows[:, :2])
    ground = np.where(np.isfinite(ground), ground, 0.0)
    spreads = [
        np.ptp(np.quantile(part, [0.05, 0.95], axis=0), axis=0)
        for part in (ground[::2], ground[1::2])
    ]
    low, high = np.minimum(*spreads), np.maximum(*spreads)
    length = np.maximum(np.linalg.norm(ground, axis=1), TINIEST)
    cosine = np.sum(ground[:-1] * ground[1:], axis=1) / (length[:-1] * length[1:])
    # Points of one sweep spread equally, and lie in one direction: the upper and the lower lasers
    # of a VLP-16 alternate, and may see 4 m and 16 m.
    return bool(np.any(high > 8.0 * low) and np.median(cosine) < 0.9)


def _why(data: bytes, are_both: bool) -> str:
    """State why the values are not points, or two kinds of points, and how to convert them."""
    size = len(data)
    if size % (4 * FLOAT) and size % (5 * FLOAT):
        return (
            f"{size} bytes, expected a multiple of 16 (float32 x y z intensity, KITTI) or of 20 "
            "(and ring, nuScenes)"
        )
    if not are_both and size % LONG_RECORD == 0 and _alternate(_rows(data, 4)):
        return (
            "its points seem to have 32 bytes, as PCL and ROS hold x y z _ intensity; write these: "
            "np.save('a.npy', np.fromfile(FILE, 'f4').reshape(-1, 8)[:, [0, 1, 2, 4]])"
        )
    why = (
        "could be four float32 a point (KITTI) or five (nuScenes)"
        if are_both
        else "its values are not float32 x y z intensity (KITTI), nor with a ring (nuScenes)"
    )
    return (
        f"{why}; write x y z intensity, of N columns: "
        "np.save('a.npy', np.fromfile(FILE, 'f4').reshape(-1, N)[:, :4])"
    )
