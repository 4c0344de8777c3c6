"""``.bin`` files: points as plain float32 without a header, KITTI's four of them or nuScenes' five.

Nothing in such a file says how long a point is, and a wrong length gives a cloud of nonsense. So a
length counts only where its values are those of points, and one of two that could be is no guess.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import PointCloud
from ..base.errors import ReadError
from .fields import LARGEST, PLAIN_COLUMNS, cloud_from_columns, floats, read_whole

FOUR, FIVE = PLAIN_COLUMNS, (*PLAIN_COLUMNS, "ring")
"""Columns of KITTI's velodyne files, and of nuScenes' ``.pcd.bin`` files."""

FLOAT, LONG_RECORD = 4, 32
"""Bytes of a value; and of a point as PCL holds it in memory, x y z and intensity each padded."""

MOST_RINGS = 256
"""Rings are whole numbers below this; coordinates, four fifths of what a wrong length puts there,
are not."""

MOST_ODD = 0.01
"""Part of the points that may have a negative intensity, or a coordinate that none is. With a wrong
length a third and more of the intensities are coordinates, half of which are negative."""

TINIEST = 1e-20
"""No coordinate but zero is smaller, or above `LARGEST`, metres or millimetres: halves of float64,
whole numbers and padding that are read as float32 are."""

FEWEST_ROWS = 64
"""With fewer points, odd and even ones are not compared."""

SPREAD_RATIO, SAME_WAY = 8.0, 0.9
"""Every second point spreads so many times as wide as those between, and lies in another direction
(cosine): they are no points of one sweep, but halves of records twice as long. The upper and the
lower lasers of a VLP-16 alternate, and may see 4 m and 16 m, but in one direction."""


def read_bin(path: Path) -> PointCloud:
    """Read float32 x y z intensity (KITTI), or x y z intensity ring (nuScenes).

    Raises
    ------
    ReadError
        Where the values are neither's, or could be both's.
    """
    data = read_whole(path)
    fitting = [
        names
        for names, fits in ((FOUR, _are_four), (FIVE, _are_five))
        if len(data) % (FLOAT * len(names)) == 0 and fits(_rows(data, len(names)))
    ]
    if len(fitting) == 1:
        rows = _rows(data, len(fitting[0]))
        return cloud_from_columns(dict(zip(fitting[0], rows.T, strict=True)))
    raise ReadError(_why(data, bool(fitting)))


def _rows(data: bytes, columns: int) -> NDArray[Any]:
    return np.frombuffer(data, "<f4").reshape(-1, columns)


def _are_four(rows: NDArray[Any]) -> bool:
    return _are_points(rows) and not _alternate(rows)


def _are_five(rows: NDArray[Any]) -> bool:
    ring = rows[:, 4]
    with np.errstate(invalid="ignore"):
        are_rings = (ring >= 0) & (ring < MOST_RINGS) & (ring == np.round(ring))
    return bool(np.all(are_rings)) and _are_points(rows)


def _are_points(rows: NDArray[Any]) -> bool:
    """Whether x, y and z can be coordinates, and the fourth value an intensity."""
    with np.errstate(invalid="ignore"):
        size = np.abs(rows[:, :3])
        odd = np.any(((size < TINIEST) & (size > 0.0)) | (size > LARGEST), axis=1)
        odd |= rows[:, 3] < 0.0
    # What is not a number is no return, and dropped; infinity is one of the largest.
    return float(np.mean(odd & ~np.any(np.isinf(size), axis=1))) <= MOST_ODD


def _alternate(rows: NDArray[Any]) -> bool:
    """Whether every second row is something else than a point."""
    if len(rows) < FEWEST_ROWS or len(rows) * FLOAT * 4 % LONG_RECORD:
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
    return bool(np.any(high > SPREAD_RATIO * low) and np.median(cosine) < SAME_WAY)


def _why(data: bytes, are_both: bool) -> str:
    """Say why the values are no points, or two kinds of them, and how to convert them."""
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
