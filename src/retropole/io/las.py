"""LAS and LAZ, by laspy (the optional part ``las``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..datatypes import PointCloud
from ..errors import MissingExtraError, ReadError
from .fields import cloud_from_columns


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
    if path.stat().st_size == 0:
        raise ReadError(f"{path}: is empty, expected a LAS header")
    try:
        with laspy.open(path) as file:
            header = file.header
            left = path.stat().st_size - header.offset_to_point_data
            size = header.point_count * header.point_format.size
            if not header.are_points_compressed and size > left:
                raise ReadError(
                    f"{path}: the header promises {header.point_count} points, {size} bytes; the "
                    f"file holds {left} after it"
                )
            points = file.read()
    except ReadError:
        raise
    except Exception as error:
        # laspy and its decoders raise a dozen unrelated types for damaged files.
        raise ReadError(f"{path}: is no readable LAS file ({error})") from None
    columns = {name: np.asarray(points[name]) for name in ("x", "y", "z", "intensity")}
    if "gps_time" in points.point_format.dimension_names:
        columns["gps_time"] = np.asarray(points["gps_time"])
    return cloud_from_columns(path, columns)
