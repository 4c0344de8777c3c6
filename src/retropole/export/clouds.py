"""Fused clouds and surfels as files of other programs: PCD, PLY, LAS, LAZ and MCAP, part by part.

Memory does not grow with the file. What a calibration warns of is written into each.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import Array
from ..base.errors import MissingExtraError, UsageError, naming, printable
from ..base.files import stream_atomically
from ..base.palette import COLORS
from ..base.version import __version__
from ..fusion.merging import NO_RING, POINT, Points
from ..fusion.surfels import Surfels
from ..io.fields import NANOSECONDS, records_of
from .recording import cloud_stream

SUFFIXES = (".ply", ".pcd", ".las", ".laz", ".mcap")
"""Of the files that are written."""

LAS_SCALE = 1e-4
"""Step of LAS coordinates, metres: finer than any LiDAR's, and 32 bits reach 214 km."""

GPS_EPOCH, LEAP_SECONDS, LAS_SHIFT = 315_964_800, 18, 1_000_000_000
"""Unix time of the start of GPS time, seconds that it is ahead of UTC since 2017, and what LAS
takes from it ("adjusted standard GPS time", LAS 1.4 R15)."""

RAMP = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)])
"""Colours of heights from low to high: viridis, which colour-blind readers order as others do."""

APART_RAMP = np.array([(0, 114, 178), (230, 230, 230), (213, 94, 0)])
"""Of distances: blue behind, orange in front."""

MOST_APART = 0.02
"""Distance of surfaces at either end of `APART_RAMP`, metres (chosen)."""

LARGE = 1e3
"""From this coordinate on, metres, float32 has steps of 0.06 mm and more."""

Rgb = NDArray[np.uint8]
Columns = dict[str, NDArray[Any]]
Lines = Callable[[int], list[str]]


@dataclass(frozen=True, eq=False)
class About:
    """Description of the points in a file.

    Attributes
    ----------
    names
        Of the LiDARs, by their index.
    frame
        Name of the frame of the coordinates.
    comments
        Sentences for a reader: the verdict, the frame, what is warned of.
    has_intensity, has_ring, has_time
        Whether any LiDAR knows them.
    is_large
        Whether coordinates do not fit float32: they are map coordinates.
    middle
        (3,) about where the points are, whole metres.
    is_unix
        Whether times are Unix time.
    intensity_scale
        What intensities are multiplied by for whole numbers of 16 bits.
    wkt
        The coordinate system, empty if there is none.
    colour
        From points to RGB (N, 3); None for no colours.
    """

    names: Sequence[str]
    frame: str
    comments: Sequence[str]
    has_intensity: bool
    has_ring: bool
    has_time: bool
    is_large: bool
    middle: Array
    is_unix: bool
    intensity_scale: float = 1.0
    wkt: str = ""
    colour: Callable[[Points], Rgb] | None = None


def by_lidar(points: Points) -> Rgb:
    """Colour points as the report colours their LiDARs."""
    table = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in COLORS], np.uint8)
    return np.asarray(table[points["lidar"] % len(COLORS)])


def by_value(values: Array, low: float, high: float, ramp: Array = RAMP) -> Rgb:
    """Colour values (N,) from low to high along a ramp (K, 3); those that are none are black."""
    share = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0) * (len(ramp) - 1)
    at = np.arange(len(ramp))
    columns = [np.interp(share, at, column) for column in ramp.T]
    return np.asarray(np.nan_to_num(np.column_stack(columns)).round()).astype(np.uint8)


@contextmanager
def cloud_writer(path: Path, about: About) -> Iterator[Callable[[Points, float], None]]:
    """Write fused points to a file of one of `SUFFIXES`, which is there when all went well.

    Yields
    ------
    Callable
        Writes points; MCAP needs the time of their sweep, Unix seconds, and one LiDAR at a time.

    Raises
    ------
    UsageError
        For another suffix, and where a coordinate does not fit the file.
    MissingExtraError
        If what writes the format is not installed.
    OSError
        As `base.files.stream_atomically`.
    """
    suffix = path.suffix.lower()
    writers = {".ply": _ply, ".pcd": _pcd, ".mcap": _mcap}
    if suffix not in SUFFIXES:
        raise UsageError(
            f"{path}: unknown suffix {suffix!r}, expected one of {', '.join(SUFFIXES)}"
        )
    with stream_atomically(path) as file, naming(path):
        if suffix in writers:
            with writers[suffix](file, about) as write:
                yield write
        else:
            with _las(file, about, suffix == ".laz") as write:
                yield write


def columns_of(points: Points, about: About) -> Columns:
    """Give the attributes of points by the names that readers know."""
    xyz = points["xyz"] if about.is_large else points["xyz"].astype(np.float32)
    columns: Columns = dict(zip("xyz", xyz.T, strict=True))
    if about.has_intensity:
        columns["intensity"] = points["intensity"]
    if about.has_ring:
        columns["ring"] = points["ring"]
    if about.has_time:
        columns["timestamp"] = points["time"]
    columns["lidar"] = points["lidar"]
    return columns


def comments_of(about: About) -> list[str]:
    """All that is to be known, as ASCII without line breaks."""
    lidars = [f"lidar {k}: {name}" for k, name in enumerate(about.names)]
    ring = [f"ring {NO_RING}: not known"] * about.has_ring
    lines = [f"frame: {about.frame}, metres", *about.comments, *lidars, *ring]
    return [printable(each).encode("ascii", "backslashreplace").decode() for each in lines]


PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "u4": "uint"}


def _header(fields: Sequence[tuple[str, str]], comments: Sequence[str], ply: bool) -> Lines:
    """Make the header of fields, each with its type as NumPy has it, for any number of points."""

    def lines(count: int) -> list[str]:
        if ply:
            return [
                *("ply", "format binary_little_endian 1.0"),
                *(f"comment {line}" for line in comments),
                f"element vertex {count}",
                *(f"property {PLY_TYPES[kind]} {name}" for name, kind in fields),
                "end_header",
            ]
        return [
            "# .PCD v0.7 - Point Cloud Data file format",
            *(f"# {line}" for line in comments),
            "VERSION 0.7",
            f"FIELDS {' '.join(name for name, _ in fields)}",
            f"SIZE {' '.join(kind[1] for _, kind in fields)}",
            f"TYPE {' '.join(kind[0].upper() for _, kind in fields)}",
            f"COUNT {' '.join('1' for _ in fields)}",
            f"WIDTH {count}",
            "HEIGHT 1",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {count}",
            "DATA binary",
        ]

    return lines


def _text(lines: Sequence[str], mark: str, length: int = 0) -> bytes:
    """Write a header of a length, or with room for a larger number: a comment fills it."""
    filled = [*lines[:2], f"{mark} ", *lines[2:], ""]
    spare = length - len("\n".join(filled)) if length else 2 * len(str(2**63))
    filled[2] += "-" * spare
    return "\n".join(filled).encode("ascii")


@contextmanager
def _counted(
    file: BinaryIO, records: Callable[[Points], NDArray[Any]], about: About, *, ply: bool
) -> Iterator[Callable[[Points, float], None]]:
    """Write records after a header that states their number, and is completed at the end."""
    count, mark = 0, "comment" if ply else "#"
    kind = records(np.zeros(0, POINT)).dtype
    fields = [(name, own.str[1:]) for name, (own, *_) in (kind.fields or {}).items()]
    header = _header(fields, comments_of(about), ply)
    length = file.write(_text(header(0), mark))

    def write(points: Points, when: float) -> None:
        nonlocal count
        count += len(points)
        file.write(records(points).tobytes())

    yield write
    file.seek(0)
    file.write(_text(header(count), mark, length))


@contextmanager
def _pcd(file: BinaryIO, about: About) -> Iterator[Callable[[Points, float], None]]:
    def records(points: Points) -> NDArray[Any]:
        columns = columns_of(points, about)
        if about.colour is not None:
            rgb = about.colour(points).astype(np.uint32)
            columns["rgb"] = rgb[:, 0] << 16 | rgb[:, 1] << 8 | rgb[:, 2]
        return records_of(columns)

    with _counted(file, records, about, ply=False) as write:
        yield write


def _rgb(columns: Columns, colours: Rgb) -> None:
    columns |= dict(zip(("red", "green", "blue"), colours.T, strict=True))


@contextmanager
def _ply(file: BinaryIO, about: About) -> Iterator[Callable[[Points, float], None]]:
    def records(points: Points) -> NDArray[Any]:
        columns = columns_of(points, about)
        if about.colour is not None:
            _rgb(columns, about.colour(points))
        return records_of(columns)

    with _counted(file, records, about, ply=True) as write:
        yield write


@contextmanager
def _las(file: BinaryIO, about: About, packed: bool) -> Iterator[Callable[[Points, float], None]]:
    """Write LAS 1.4: its LiDAR as ``point_source_id``, counted from 1, since 0 is the file itself.

    What LAS has no place for, the ring and the intensity on the sensor's scale, are extra
    dimensions.
    """
    try:
        import laspy
        from laspy.vlrs.vlr import VLR
    except ImportError:
        raise MissingExtraError("las", "writing LAS and LAZ") from None
    header = laspy.LasHeader(version="1.4", point_format=6 if about.colour is None else 7)
    header.scales, header.offsets = np.full(3, LAS_SCALE), np.round(about.middle)
    header.system_identifier, header.generating_software = "MERGE", f"retropole {__version__}"
    header.global_encoding.wkt = True
    # Without this the times of points are seconds of the week.
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType(int(about.is_unix))
    if about.wkt:
        record = b"" + about.wkt.encode() + b"\0"
        header.vlrs.append(VLR("LASF_Projection", 2112, "OGC WKT coordinate system", record))
    comments = "\n".join(comments_of(about)).encode()[:65_535]
    header.vlrs.append(VLR("LASF_Spec", 3, "Text area description", comments))
    extra: list[tuple[str, type]] = [("ring", np.uint16)] * about.has_ring
    extra += [("raw_intensity", np.float32)] * about.has_intensity
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind) for name, kind in extra])
    backend = laspy.LazBackend.Lazrs if packed else None
    reach = LAS_SCALE * 2**31

    def write(points: Points, when: float) -> None:
        if not len(points):
            return
        away = np.abs(points["xyz"] - header.offsets).max()
        if away >= reach:
            raise UsageError(
                f"a point is {away / 1000:,.0f} km from the first ones, a LAS file reaches up to "
                f"{reach / 1000:,.0f} km: remove it with --crop"
            )
        record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
        record.x, record.y, record.z = points["xyz"].T
        record.return_number[:] = record.number_of_returns[:] = 1
        record.point_source_id[:] = points["lidar"] + 1
        if about.has_time:
            shift = LEAP_SECONDS - GPS_EPOCH - LAS_SHIFT if about.is_unix else 0
            record.gps_time[:] = np.nan_to_num(points["time"] + shift)
        if about.has_ring:
            record["ring"] = points["ring"]
        if about.has_intensity:
            record["raw_intensity"] = points["intensity"]
            whole = np.nan_to_num(points["intensity"] * about.intensity_scale).round()
            record.intensity[:] = np.clip(whole, 0, 65_535)
        if about.colour is not None:
            # Of 8 bits, all of 16: 255 is 65535.
            for name, own in zip(("red", "green", "blue"), about.colour(points).T, strict=True):
                record[name] = own.astype(np.uint16) * 257
        writer.write_points(record)

    with laspy.open(
        file, mode="w", header=header, do_compress=packed, laz_backend=backend, closefd=False
    ) as writer:
        yield write


@contextmanager
def _mcap(file: BinaryIO, about: About) -> Iterator[Callable[[Points, float], None]]:
    """Write a message for each sweep, all in one frame, on a topic for each LiDAR."""
    topics = topics_of_lidars(about.names)
    frames = dict.fromkeys(topics, re.sub(r"\W", "_", about.frame.partition(" ")[0]))
    metadata = {f"note {k}": line for k, line in enumerate(comments_of(about))}

    def write(points: Points, when: float) -> None:
        if len(points):
            topic = topics[int(points["lidar"][0])]
            write_message(topic, round(when * NANOSECONDS), records_of(columns_of(points, about)))

    with cloud_stream(file, frames, metadata) as write_message:
        yield write


def topics_of_lidars(names: Sequence[str]) -> list[str]:
    """Name a topic for each LiDAR by what its name has that a topic may have."""
    topics: list[str] = []
    for name in names:
        bare = re.sub(r"[^0-9A-Za-z_]", "_", name)
        bare = f"lidar_{bare}" if not bare[:1].isalpha() else bare
        topic = f"/{bare}/points"
        topics.append(f"/{bare}_{len(topics)}/points" if topic in topics else topic)
    return topics


def surfel_columns(surfels: Surfels) -> Columns:
    """Give the attributes of surfels, by the names that CloudCompare and others read."""
    large = np.abs(surfels.centres).max(initial=0.0) > LARGE
    kind = np.float64 if large else np.float32
    columns: Columns = dict(zip("xyz", surfels.centres.astype(kind).T, strict=True))
    columns |= zip(("nx", "ny", "nz"), surfels.normals.astype(np.float32).T, strict=True)
    for name in ("radius", "thickness", "intensity"):
        columns[name] = getattr(surfels, name).astype(np.float32)
    columns["count"] = surfels.count.astype(np.uint32)
    columns["lidars"] = surfels.lidars.astype(np.uint32)
    return columns


def surfel_file(surfels: Surfels, apart: Array, comments: Sequence[str]) -> bytes:
    """Write surfels as PLY.

    Parameters
    ----------
    surfels
        In any frame.
    apart
        (M,) distance to the surface of another LiDAR, metres, NaN if none is known: it gives the
        colour, blue for behind it, orange for in front, grey for neither and dark where not known.
    comments
        ASCII lines.
    """
    columns = surfel_columns(surfels)
    columns["distance"] = apart.astype(np.float32)
    colours = by_value(apart, -MOST_APART, MOST_APART, APART_RAMP)
    colours[np.isnan(apart)] = 90
    _rgb(columns, colours)
    records = records_of(columns)
    fields = [(name, own.str[1:]) for name, (own, *_) in (records.dtype.fields or {}).items()]
    return _text(_header(fields, comments, True)(len(records)), "comment") + records.tobytes()
