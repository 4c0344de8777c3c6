"""LAS and LAZ, by laspy (the optional part ``las``)."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..datatypes import PointCloud
from ..errors import MissingExtraError, ReadError
from .fields import INTENSITY, RING, TIME, cloud_from_columns

VLR_HEADER, EVLR_HEADER = 54, 60
"""Bytes before the content of an (extended) variable length record."""

PART = 200_000
"""Points read at a time."""


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
        with laspy.open(path) as file:
            header = file.header
            left = path.stat().st_size - header.offset_to_point_data
            size = header.point_count * header.point_format.size
            if not header.are_points_compressed and size > left:
                raise ReadError(
                    f"{path}: the header promises {header.point_count} points, {size} bytes; the "
                    f"file holds {left} after it"
                )
            names = _wanted(header.point_format.dimension_names)
            # In parts, so that memory follows what the file holds, not what its header promises.
            parts = [[np.array(part[name]) for name in names] for part in file.chunk_iterator(PART)]
    except ReadError:
        raise
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        # For damaged files laspy and its decoders raise a dozen unrelated types; a panic of the
        # LAZ decoder is not even an Exception.
        raise ReadError(f"{path}: is no readable LAS file ({error})") from None
    columns = {name: np.concatenate(column) for name, *column in zip(names, *parts, strict=True)}
    count = sum(len(part[0]) for part in parts)
    if count != header.point_count:
        raise ReadError(
            f"{path}: the header promises {header.point_count} points, the file holds {count}"
        )
    if not parts:
        raise ReadError(f"{path}: holds no points, expected at least one")
    return cloud_from_columns(path, columns)


def _check_header(path: Path) -> None:
    """Refuse counts that the file cannot hold: laspy would try to read that many, for minutes."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
    if not head:
        raise ReadError(f"{path}: is empty, expected a LAS header")
    if head[:4] != b"LASF" or len(head) < 227:
        raise ReadError(f"{path}: starts with {head[:4]!r}, expected a LAS header from 'LASF' on")
    start, points, records = struct.unpack_from("<HII", head, 94)
    if points > size or start + VLR_HEADER * records > points:
        raise ReadError(
            f"{path}: the header promises points from byte {points} on after {records} records of "
            f"{VLR_HEADER} bytes or more, the file holds {size} bytes"
        )
    if tuple(head[24:26]) >= (1, 4) and len(head) == 375:
        start, records = struct.unpack_from("<QI", head, 235)
        if records and start + EVLR_HEADER * records > size:
            raise ReadError(
                f"{path}: the header promises {records} extended records from byte {start} on, "
                f"the file holds {size} bytes"
            )


def _wanted(dimensions: Iterable[str]) -> list[str]:
    """Names of the scaled coordinates and of the other fields that mean something here."""
    known = {*INTENSITY, *RING, *TIME}
    return ["x", "y", "z"] + [
        name for name in dimensions if name.lower().removeprefix("scalar_") in known
    ]
