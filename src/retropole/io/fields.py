"""From named columns to a point cloud: which names mean what, and which points are dropped."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datatypes import Array, IntArray, PointCloud
from ..errors import ReadError

INTENSITY = ("intensity", "intensities", "i", "reflectivity", "reflectance", "remission")
RING = ("ring", "channel", "laser_id", "line", "beam")
TIME = ("time", "t", "timestamp", "time_stamp", "offset_time", "gps_time", "gpstime")

LAST_SECOND = 1e11
"""Later than any clock counts in seconds (year 5138), earlier than any counts its milliseconds."""

Columns = Mapping[str, NDArray[Any]]


def _find(columns: Columns, names: tuple[str, ...]) -> str | None:
    """Name the first column that means one of the names, in any case; exact spelling goes first.

    CloudCompare puts ``scalar_`` in front of what it does not know.
    """
    plain = {name: name for name in columns}
    for name in columns:
        plain.setdefault(name.lower(), name)
    for name in columns:
        plain.setdefault(name.lower().removeprefix("scalar_"), name)
    return next((plain[name] for name in names if name in plain), None)


def cloud_from_columns(path: Path, columns: Columns, origin: Array | None = None) -> PointCloud:
    """Make a cloud of columns (N,), or (N, C) for fields with several values, by their names.

    Of several values of a field (a dual return's intensities), the first is taken. An intensity
    that is not finite counts as 0: a return without a measured strength cannot be tape. Where none
    is finite, the file has no intensity. Colours (rgb) are no intensity.

    Parameters
    ----------
    path
        The file, for messages.
    columns
        What the file holds, by name.
    origin
        (3,) where the beams start; None is the origin of the frame.

    Raises
    ------
    ReadError
        Without x, y or z, without points, or with none that is finite and away from the origin.
    """
    found = {name: _find(columns, (name,)) for name in ("x", "y", "z")}
    missing = [name for name, own in found.items() if own is None]
    if missing:
        have = ", ".join(columns) or "none"
        raise ReadError(f"{path}: field {', '.join(missing)} is missing; the fields are: {have}")
    parts = [_numbers(path, own, columns[own]) for own in found.values() if own is not None]
    if len({len(part) for part in parts}) > 1:
        raise ReadError(
            f"{path}: x, y and z have {', '.join(str(len(part)) for part in parts)} values, "
            "expected one each a point"
        )
    xyz = np.stack([part.astype(np.float64) for part in parts], axis=1)
    if len(xyz) == 0:
        raise ReadError(f"{path}: holds no points, expected at least one")
    start = np.zeros(3) if origin is None else origin
    kept = np.all(np.isfinite(xyz), axis=1)
    kept &= np.any(xyz != 0, axis=1) & np.any(xyz != start, axis=1)
    if not kept.any():
        raise ReadError(
            f"{path}: none of its {len(xyz)} points is finite and away from the sensor; expected "
            "coordinates in metres"
        )

    def optional(names: tuple[str, ...]) -> NDArray[Any] | None:
        own = _find(columns, names)
        if own is None:
            return None
        values = _numbers(path, own, columns[own])
        if len(values) != len(xyz):
            raise ReadError(
                f"{path}: {own} has {len(values)} values for {len(xyz)} points, expected one each"
            )
        return values[kept]

    return PointCloud(
        xyz=np.ascontiguousarray(xyz[kept]),
        intensity=_strength(optional(INTENSITY)),
        ring=_whole(optional(RING)),
        time=_seconds(optional(TIME)),
        origin=start,
        dropped=int(np.count_nonzero(~kept)),
        source=str(path),
    )


def _numbers(path: Path, name: str, column: NDArray[Any]) -> NDArray[Any]:
    """One number a point, the first of several; refuse text, complex numbers and the like."""
    if column.dtype.kind not in "fiub" or column.ndim not in (1, 2) or column.shape[1:] == (0,):
        raise ReadError(
            f"{path}: field {name} is {column.dtype} {list(column.shape[1:]) or ''}, expected "
            "numbers"
        )
    return column if column.ndim == 1 else column[:, 0]


def _strength(values: NDArray[Any] | None) -> Array | None:
    if values is None:
        return None
    intensity = values.astype(np.float64)
    finite = np.isfinite(intensity)
    return np.where(finite, intensity, 0.0) if finite.any() else None


def _whole(values: NDArray[Any] | None) -> IntArray | None:
    """Beam indices; a table stores them as floats. What is no index at all is no ring."""
    if values is None:
        return None
    numbers = values.astype(np.float64)
    with np.errstate(invalid="ignore"):
        indices = np.all(np.abs(numbers) < 2**31) and np.all(numbers == np.round(numbers))
    return numbers.astype(np.int64) if indices else None


def _seconds(values: NDArray[Any] | None) -> Array | None:
    """Floats that can be seconds; of counts of ticks no file says how long one is."""
    if values is None or values.dtype.kind != "f":
        return None
    seconds = values.astype(np.float64)
    with np.errstate(invalid="ignore"):
        plausible = np.all(np.abs(seconds) < LAST_SECOND)
    return seconds if plausible else None
