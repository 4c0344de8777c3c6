"""Plain arrays of numbers: KITTI's .bin, NumPy's .npy and .npz, and text."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datatypes import PointCloud
from ..errors import ReadError
from .fields import cloud_from_columns

PLAIN_COLUMNS = ("x", "y", "z", "intensity", "ring", "time")
"""What the columns of a table without names are."""


def _nonempty(path: Path) -> bytes:
    data = path.read_bytes()
    if not data:
        raise ReadError(f"{path}: is empty, expected points")
    return data


def read_kitti(path: Path) -> PointCloud:
    """Read a KITTI ``.bin``: float32 x y z intensity, and nothing else."""
    data = _nonempty(path)
    if len(data) % 16:
        raise ReadError(
            f"{path}: {len(data)} bytes, expected a multiple of 16 (float32 x y z intensity)"
        )
    return _from_table(path, np.frombuffer(data, "<f4").reshape(-1, 4))


def _from_table(path: Path, table: NDArray[Any]) -> PointCloud:
    if table.dtype.names is not None:
        table = table.reshape(-1)
        return cloud_from_columns(path, {name: table[name] for name in table.dtype.names or ()})
    if table.ndim != 2 or not 3 <= table.shape[1] <= len(PLAIN_COLUMNS):
        raise ReadError(
            f"{path}: an array of shape {table.shape}, expected (N, 3) to (N, 6): "
            f"{' '.join(PLAIN_COLUMNS)}"
        )
    if not (np.issubdtype(table.dtype, np.floating) or np.issubdtype(table.dtype, np.integer)):
        raise ReadError(f"{path}: an array of {table.dtype}, expected numbers")
    return cloud_from_columns(path, dict(zip(PLAIN_COLUMNS, table.T, strict=False)))


def _load(path: Path, file: Any) -> NDArray[Any]:
    """Read one ``.npy`` from an open file, its promise checked against the bytes there are."""
    version = np.lib.format.read_magic(file)
    reader = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if reader is None:
        raise ReadError(f"{path}: NPY version {version}, expected 1.0 or 2.0")
    shape, fortran, dtype = reader(file)
    if dtype.hasobject:
        raise ReadError(f"{path}: holds Python objects, expected numbers")
    body = file.read()
    size = int(np.prod([int(n) for n in shape], dtype=object)) * dtype.itemsize
    if len(body) < size:
        raise ReadError(f"{path}: promises {size} bytes of data, holds {len(body)}")
    flat = np.frombuffer(body[:size], dtype)
    return flat.reshape(shape, order="F" if fortran else "C")


def read_npy(path: Path) -> PointCloud:
    """Read an NPY array: (N, 3) to (N, 6), or one with named fields."""
    try:
        return _from_table(path, _load(path, io.BytesIO(_nonempty(path))))
    except (ValueError, EOFError, SyntaxError, TypeError, OverflowError) as error:
        raise ReadError(f"{path}: is no readable NPY file ({error})") from None


def read_npz(path: Path) -> PointCloud:
    """Read an NPZ: arrays x, y, z, or xyz or points (N, 3 and more), with intensity, ring, time."""
    try:
        with zipfile.ZipFile(io.BytesIO(_nonempty(path))) as archive:
            arrays = {}
            for name in archive.namelist():
                with archive.open(name) as file:
                    arrays[name.removesuffix(".npy")] = _load(path, file)
    except ReadError:
        raise
    except Exception as error:
        # A damaged archive raises a dozen unrelated types, from zipfile, zlib and NumPy.
        raise ReadError(f"{path}: is no readable NPZ file ({error})") from None
    columns: dict[str, NDArray[Any]] = {}
    for name, array in arrays.items():
        if name in ("xyz", "points", "arr_0") and array.ndim == 2 and array.shape[1] >= 3:
            columns |= dict(zip(PLAIN_COLUMNS, array.T, strict=False))
        else:
            columns[name] = array
    lengths = {len(column) if column.ndim else -1 for column in columns.values()}
    if len(lengths) > 1 or -1 in lengths:
        raise ReadError(f"{path}: its arrays have different lengths, expected one value a point")
    return cloud_from_columns(path, columns)


def read_text(path: Path) -> PointCloud:
    """Read a table of text: columns by name where the first line names them, else x y z intensity.

    Values are parted by commas, semicolons, tabs or blanks.
    """
    text = _nonempty(path).decode("utf-8-sig", errors="replace")
    for mark in ",;\t":
        text = text.replace(mark, " ")
    lines = text.splitlines()
    first = next((k for k, line in enumerate(lines) if line.split()), None)
    if first is None:
        raise ReadError(f"{path}: holds no lines, expected x y z and more in columns")
    names = lines[first].lstrip("/#").split()
    header = not all(_is_number(name) for name in names)
    rows = lines[first + 1 :] if header else lines[first:]
    try:
        table = np.loadtxt(io.StringIO("\n".join(rows)), ndmin=2)
    except ValueError as error:
        number = first + header + 1 + _first_bad(rows)
        raise ReadError(f"{path}, line {number}: expected {len(names)} numbers ({error})") from None
    if table.size == 0:
        raise ReadError(f"{path}: holds no points, expected at least one")
    if not header:
        return _from_table(path, table)
    if table.shape[1] != len(names):
        raise ReadError(
            f"{path}, line {first + 1}: names {len(names)} columns, the lines have {table.shape[1]}"
        )
    return cloud_from_columns(path, dict(zip(names, table.T, strict=True)))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _first_bad(rows: list[str]) -> int:
    """Index of the first row that is not numbers, or not as many as the first."""
    expected = None
    for k, row in enumerate(rows):
        words = row.split("#")[0].split()
        if words and not all(_is_number(word) for word in words):
            return k
        if words:
            expected = expected or len(words)
            if len(words) != expected:
                return k
    return 0
