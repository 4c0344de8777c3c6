"""Recordings of Livox' viewers: LVX2, and LVX of the LiDARs before.

Both are headers, a description of each LiDAR, and frames, each with the bytes that it takes; in a
frame are packages of points as the LiDARs send them (LVX Specifications v1.1, LVX2 Specifications
v1.0). Coordinates are in the frame of each LiDAR: the pose that a description has is not applied.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from ..base.errors import ReadError, naming, reported
from ..base.quantities import counted
from .fields import USUAL, Columns, Wanted, frame_from_columns, noted
from .recordings import PACKETS_OF, Frame, Recording, Topic

MAGIC = 0xAC0EA767
"""In the header, after the signature ``livox_tech`` and four bytes for the version."""

HEADER, FRAME = struct.Struct("<16s4BIIB"), struct.Struct("<QQQ")
"""Signature, version, magic, milliseconds of a frame, LiDARs; and where a frame is, where the next
one begins, and its number."""

KIND = f"{PACKETS_OF}Livox"
"""What `Topic` calls their kind."""

WHOLE = np.dtype([("xyz", "<i4", 3), ("intensity", "u1"), ("tag", "u1")])
SMALL = np.dtype([("xyz", "<i2", 3), ("intensity", "u1"), ("tag", "u1")])
BARE = np.dtype([("xyz", "<i4", 3), ("intensity", "u1")])
"""A point in millimetres; in centimetres; and in millimetres without a tag."""

POINTS: dict[int, np.dtype[Any]] = {1: WHOLE, 2: SMALL}
"""Of the types of points of LVX2 those that are read."""

OLD_POINTS: dict[int, tuple[int, np.dtype[Any]]] = {
    0: (100, BARE),
    2: (96, WHOLE),
    4: (96, WHOLE),
    7: (90, WHOLE),
    # As angles; and what an inertial sensor measured.
    **{kind: (1, np.dtype(f"V{size}")) for kind, size in ((1, 900), (3, 960), (5, 768), (8, 660))},
    6: (1, np.dtype("V24")),
}
"""Of LVX also how many are in a package; those of one firing follow each other."""

OF_MOTION = {True: 0, False: 6}
"""Type of packages with what an inertial sensor measured, of LVX2 and of LVX."""


class _File(NamedTuple):
    """Content of the headers: whether it is LVX2, LiDARs by their number, and where frames are."""

    is_new: bool
    names: dict[int, str]
    frames: list[tuple[int, int]]
    note: str


def lvx_topics(path: Path) -> tuple[Topic, ...]:
    """List the LiDARs of a recording as topics, by their serial numbers.

    Raises
    ------
    ReadError
        If it is not such a file.
    """
    found = _look(path)
    return tuple(Topic(name, KIND, len(found.frames)) for name in sorted(found.names.values()))


def open_lvx(path: Path, topic: str | None = None, wanted: Wanted = USUAL) -> Recording:
    """Open a recording, and choose a LiDAR: the given one, or the only one.

    Raises
    ------
    ReadError
        If it is not such a file, or not exactly one LiDAR fits; lists those there are.
    """
    found = _look(path)
    own = [number for number, name in found.names.items() if topic in (None, name)]
    if len(own) != 1:
        names = ", ".join(sorted(found.names.values())) or "none"
        has = f"has no LiDAR {topic}" if topic else f"has {counted(len(found.names), 'LiDAR')}"
        raise ReadError(f"{path}: {has}, expected one of: {names}")
    if not found.frames:
        raise ReadError(f"{path}: has no frames{found.note and f': {found.note}'}")
    read = partial(_frames, path, found, own[0], wanted)
    return Recording(path, len(found.frames), read, topic=found.names[own[0]])


def _look(path: Path) -> _File:
    """Read the headers, and follow the frames from each to the next."""
    with naming(path), reported("recording of Livox"), path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(0)
        signature, major, minor, _, _, magic, _, lidars = HEADER.unpack(file.read(HEADER.size))
        is_known = major == 2 or (major, minor) == (1, 1)
        if not signature.startswith(b"livox_tech") or magic != MAGIC or not is_known:
            raise ValueError("it does not begin like a file of version 2 or 1.1")
        is_new = major == 2
        names = {}
        for _ in range(lidars):
            about = file.read(63 if is_new else 59)
            number = struct.unpack_from("<I" if is_new else "B", about, 32)[0]
            code = about[:16].split(b"\0")[0].decode("ascii", errors="replace")
            names[number] = code if code.isprintable() and code else str(number)
        frames, at, note = [], file.tell(), ""
        while size - at >= FRAME.size:
            file.seek(at)
            _, after, _ = FRAME.unpack(file.read(FRAME.size))
            # The last frame of a recording that was cut says where it would have ended.
            end = min(after, size) if after >= at + FRAME.size else at
            if end == at:
                note = f"the data after byte {at:,} are damaged and left out"
                break
            frames.append((at + FRAME.size, end))
            at = end
            note = "the last frame is cut" if after > size else ""
    return _File(is_new, names, frames, note)


def _frames(
    path: Path, found: _File, lidar: int, wanted: Wanted, numbers: range
) -> Iterator[Frame]:
    with naming(path), path.open("rb") as file:
        for number in numbers:
            where = f"{path}: frame {number}"
            with reported("frame"):
                columns, stamp, notes = _columns(file, found, number, lidar)
            cloud = frame_from_columns(where, columns, wanted)
            yield Frame(number, noted(cloud, found.note, *notes), stamp)


def _columns(
    file: BinaryIO, found: _File, number: int, lidar: int
) -> tuple[Columns, float | None, list[str]]:
    """Columns of a frame's points of one LiDAR, its time, s, and what is not read."""
    start, end = found.frames[number]
    file.seek(start)
    data = file.read(end - start)
    xyz, intensity, times, other = [], [], [], set[int]()
    at = 0
    while at < len(data):
        package = _package(found.is_new, data, at)
        if package is None:
            break
        own, time, kind, (first, at) = package
        point = POINTS.get(kind) if found.is_new else OLD_POINTS[kind][1]
        if own != lidar or kind == OF_MOTION[found.is_new]:
            continue
        if point is None or not point.names:
            other.add(kind)
            continue
        points = np.frombuffer(data, point, (at - first) // point.itemsize, first)
        unit = 0.01 if point is SMALL else 0.001
        xyz.append(points["xyz"] * unit)
        intensity.append(points["intensity"])
        times.append(np.full(len(points), time))
    places = np.concatenate([np.zeros((0, 3)), *xyz])
    columns = {axis: places[:, k] for k, axis in enumerate("xyz")}
    columns["intensity"] = np.concatenate([np.zeros(0), *intensity])
    columns["time"] = np.concatenate([np.zeros(0), *times])
    notes = [f"points of type {kind} are not read" for kind in sorted(other)]
    return columns, float(times[0][0]) if times else None, notes


def _package(is_new: bool, data: bytes, at: int) -> tuple[int, float, int, tuple[int, int]] | None:
    """LiDAR, time, type of points and their bytes, first and end; None if it is cut."""
    try:
        if is_new:
            _, lidar, _, _, time, _, kind, size = struct.unpack_from("<BIBBQHBI", data, at)
            first = at + 27
        else:
            lidar, kind, time = struct.unpack_from("<B9xBQ", data, at)
            count, point = OLD_POINTS[kind]
            first, size = at + 19, count * point.itemsize
    except (struct.error, KeyError):
        return None
    return (lidar, time / 1e9, kind, (first, first + size)) if first + size <= len(data) else None
