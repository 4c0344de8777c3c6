"""From named columns to a point cloud: which names mean what, and which points are dropped."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datatypes import Array, PointCloud
from ..errors import ReadError

INTENSITY = ("intensity", "intensities", "i", "reflectivity", "reflectance", "remission")
RING = ("ring", "channel", "laser_id", "line", "beam")
TIME = ("time", "t", "timestamp", "time_stamp", "offset_time", "gps_time", "gpstime")

Columns = Mapping[str, NDArray[Any]]


def _find(columns: Columns, names: tuple[str, ...]) -> NDArray[Any] | None:
    """Take the first column that has one of the names; CloudCompare puts ``scalar_`` in front."""
    plain = {name.lower().removeprefix("scalar_"): name for name in columns}
    for name in names:
        if name in plain:
            return columns[plain[name]]
    return None


def cloud_from_columns(path: Path, columns: Columns, origin: Array | None = None) -> PointCloud:
    """Make a cloud of columns (N,), or (N, C) for fields with several values, by their names.

    Of several values of an intensity, a ring or a time, the first is taken. Integer times are kept
    as they are: what unit they have, files do not say.

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
    missing = [name for name, column in found.items() if column is None]
    if missing:
        have = ", ".join(columns) or "none"
        raise ReadError(f"{path}: field {', '.join(missing)} is missing; the fields are: {have}")
    first = {name: _first(column) for name, column in found.items() if column is not None}
    xyz = np.stack([first[name].astype(np.float64) for name in "xyz"], axis=1)
    if len(xyz) == 0:
        raise ReadError(f"{path}: holds no points, expected at least one")
    start = np.zeros(3) if origin is None else origin
    with np.errstate(over="ignore", invalid="ignore"):
        kept = np.all(np.isfinite(xyz), axis=1)
        kept &= np.any(xyz != 0, axis=1) & np.any(xyz != start, axis=1)
    if not kept.any():
        raise ReadError(
            f"{path}: none of its {len(xyz)} points is finite and away from the sensor; expected "
            "coordinates in metres"
        )
    intensity, ring, time = (_find(columns, names) for names in (INTENSITY, RING, TIME))
    return PointCloud(
        xyz=np.ascontiguousarray(xyz[kept]),
        intensity=None if intensity is None else _strength(_first(intensity)[kept]),
        ring=None if ring is None else _whole(_first(ring)[kept]),
        time=None if time is None else _first(time)[kept].astype(np.float64),
        origin=start,
        dropped=int(np.count_nonzero(~kept)),
        source=str(path),
    )


def _first(column: NDArray[Any]) -> NDArray[Any]:
    return column if column.ndim == 1 else column[:, 0]


def _strength(values: NDArray[Any]) -> Array:
    intensity = values.astype(np.float64)
    if not np.all(np.isfinite(intensity)):
        # A return without a measured strength is a weak one; it cannot be tape.
        intensity = np.nan_to_num(intensity, nan=0.0, posinf=0.0, neginf=0.0)
    return intensity


def _whole(values: NDArray[Any]) -> NDArray[np.int64]:
    numbers = np.nan_to_num(values.astype(np.float64), nan=-1.0, posinf=-1.0, neginf=-1.0)
    return np.clip(numbers, -(2**31), 2**31).astype(np.int64)
