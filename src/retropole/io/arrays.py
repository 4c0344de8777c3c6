"""Plain arrays of numbers: NumPy's .npy and .npz, and text, also that of other formats."""

from __future__ import annotations

import codecs
import io
import math
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import Array, PointCloud
from ..base.errors import ReadError, UsageError
from .failures import LineError, reported
from .fields import PLAIN_COLUMNS, REAL_KINDS, cloud_from_columns, has_meaning, read_whole
from .unpacking import Spend, allowance

TABLE_KEYS = ("xyz", "points", "arr_0")
"""Names of a table of points in an NPZ."""

SEPARATORS = ";\t,"
"""What separates the values of a text: the first of these that occurs, else blanks."""

MAX_HEAD = 2**20
"""Bytes that comments and names of columns, and the first line of numbers, may take."""

ARRAY_SOURCE = "<array>"
"""Source of a cloud that was made of an array."""

MAX_DEFLATE_RATIO = 1100
"""Deflate compresses at most 1032 bytes into one; an entry that promises more is damaged."""

NPZ_ALLOWED, NPZ_RATIO = 2**28, 20
"""Bytes that the arrays of an NPZ may take: so many, and so many times its size, with 8 for each
number. Coordinates compress 2 to 10 fold."""

NUMBER = 8
"""Bytes of a number in a point cloud."""


def _is_table(array: NDArray[Any]) -> bool:
    return array.ndim == 2 and array.shape[1] in (3, 4)


def _from_table(table: NDArray[Any]) -> PointCloud:
    if table.dtype.names is not None:
        table = table.reshape(-1)
        return cloud_from_columns({name: table[name] for name in table.dtype.names or ()})
    if not _is_table(table):
        raise ReadError(
            f"a table of shape {table.shape} without names of columns, expected (N, 3) or (N, 4): "
            + " ".join(PLAIN_COLUMNS)
        )
    return cloud_from_columns(dict(zip(PLAIN_COLUMNS, table.T, strict=False)))


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
        Where it has another shape or no numbers, and where no point in it is a return.
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
        raise ReadError("holds Python objects, expected numbers")
    if not dtype.itemsize or any(n < 0 for n in shape):
        raise ReadError(f"an array of {dtype} and shape {shape}, expected numbers")
    size = math.prod(int(n) for n in shape) * dtype.itemsize
    if size > left:
        raise ReadError(f"promises {size} bytes of data, the file holds {left} in all")
    spend(max(size, NUMBER * size // dtype.itemsize))
    body = file.read(size)
    if len(body) < size:
        raise ReadError(f"promises {size} bytes of data, the file holds {len(body)}")
    return np.frombuffer(body, dtype).reshape(shape, order="F" if fortran else "C")


def read_npy(path: Path) -> PointCloud:
    """Read an NPY array: (N, 3), (N, 4), or one with named fields."""
    data = read_whole(path)
    # The header is Python text: NumPy raises whatever reading a damaged one raises.
    with reported("NPY file"):
        array = _load(io.BytesIO(data), len(data))
    return _from_table(array)


def read_npz(path: Path) -> PointCloud:
    """Read an NPZ: x, y and z, or one table xyz or points (N, 3 or 4); intensity, ring, time.

    Where there is only one array, its name does not matter. Arrays with other names are skipped.
    """
    data = read_whole(path)
    arrays: dict[str, NDArray[Any]] = {}
    spend = allowance(len(data), NPZ_ALLOWED, NPZ_RATIO)
    # A damaged archive raises a dozen unrelated types, from zipfile, zlib and NumPy.
    with reported("NPZ file"), zipfile.ZipFile(io.BytesIO(data)) as archive:
        for entry in archive.infolist():
            if entry.file_size > MAX_DEFLATE_RATIO * max(entry.compress_size, 1):
                promised = f"{entry.compress_size} bytes cannot unpack to {entry.file_size}"
                raise ReadError(f"{entry.filename}: {promised}")
            name = entry.filename.removesuffix(".npy")
            if len(archive.infolist()) > 1 and not has_meaning(name, besides=(*"xyz", *TABLE_KEYS)):
                continue
            with archive.open(entry) as file:
                arrays[name] = _load(file, entry.file_size, spend)
    if len(arrays) == 1:
        return _from_table(*arrays.values())
    tables = [name for name in TABLE_KEYS if name in arrays]
    if len(tables) > 1:
        raise ReadError(f"holds {' and '.join(tables)}, expected one table of points")
    for name in tables:
        table = arrays.pop(name)
        if not _is_table(table):
            raise ReadError(f"{name} has shape {table.shape}, expected (N, 3) or (N, 4)")
        # An array of intensities takes precedence over a fourth column.
        arrays = dict(zip(PLAIN_COLUMNS, table.T, strict=False)) | arrays
    return cloud_from_columns(arrays)


def read_text(path: Path) -> PointCloud:
    """Read a table of text: columns by name where a first line names them, else x y z intensity.

    Values are separated by semicolons, tabs, commas or blanks: the first of these that is in the
    first line of numbers. Lines that start with ``#`` or ``//`` are comments; the last one before
    the numbers that names x, y and z names the columns.
    """
    body = read_whole(path).removeprefix(codecs.BOM_UTF8)
    body = body.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    names, first, position = _names(body)
    raw = body[position:].partition(b"\n")[0]
    if len(raw) > MAX_HEAD:
        raise LineError(first, f"{len(raw):,} bytes, expected x y z and more")
    line = raw.decode("ascii", errors="replace")
    separator = _separator(line)
    columns = len(names) or len(line.split("#")[0].split(separator))
    table = read_table(body[position:], columns, line=first, separator=separator)
    if not names:
        return _from_table(table)
    if len({name.lower() for name in names}) < len(names):
        raise ReadError(f"two columns have one name, the names are: {', '.join(names)}")
    return cloud_from_columns(dict(zip(names, table.T, strict=True)))


def _names(body: bytes) -> tuple[list[str], int, int]:
    """Find the names of the columns, if any, and line and position of the first numbers."""
    names, commented, position = list[str](), True, 0
    for number, raw in enumerate(body[:MAX_HEAD].splitlines(keepends=True), 1):
        if raw.isspace():
            position += len(raw)
            continue
        line = raw.decode("utf-8", errors="replace").strip()
        plain = line.lstrip("#/").strip()
        words = [word.strip(" \"'") for word in plain.split(_separator(plain))]
        # Words that only start like a number are not names: 1,5 is an error and not a title.
        if plain == line and any(
            is_number(word) or re.match(r"[-+.]?[0-9]", word) for word in words
        ):
            return names, number, position
        if plain == line and plain:
            if not commented:
                raise LineError(number, f"{line[:60]!r}, expected numbers")
            names, commented = words, False
        elif commented and {"x", "y", "z"} <= {word.lower() for word in words}:
            # Of the comments, only one that names the coordinates names the columns.
            names = words
        position += len(raw)
    raise ReadError(
        f"holds no lines of numbers in its first {min(len(body), MAX_HEAD):,} bytes, "
        "expected x y z and more in columns"
    )


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
    (N, columns) array.

    Raises
    ------
    ReadError
        Naming the first line that does not have `columns` numbers.
    """
    # Only these end a line for NumPy and for editors; str.splitlines knows many others.
    if b"\r" in body:
        body = body.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
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
        words = f"{content[:60]!r}, expected {columns} numbers"
        raise LineError(line + number, words) from None
    if table.shape[1] != columns:
        number, _ = _first_bad(body, columns, separator) or (0, "")
        raise LineError(line + number, f"holds {table.shape[1]} values, expected {columns}")
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
        words = plain.split(separator)
        if plain and (len(words) != columns or not all(is_number(w.strip()) for w in words)):
            return k, content
    return None
