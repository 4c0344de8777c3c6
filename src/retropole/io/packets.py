"""Packets as a sensor sends them, in a .pcap: Velodyne and Ouster.

Velodyne are decoded by velodyne-decoder (the extra ``velodyne``), Ouster by the manufacturer's SDK
(the extra ``ouster``). Frames are sweeps; the first and the last may be incomplete.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ..base.datatypes import Array
from ..base.errors import MissingExtraError, ReadError
from .captures import mended, packets, sizes_in_words, walk
from .failures import naming, reported
from .fields import Columns, frame_from_columns, noted
from .recordings import Frame, Recording

PACKETS = (".pcap",)
"""Suffixes of packet captures."""

CAPTURES = (*PACKETS, ".pcapng", ".cap")
"""Suffixes that captures have, also those that may be of a format that is not read."""

VELODYNE_SIZE, VELODYNE_START = 1206, b"\xff\xee"
"""Bytes of a Velodyne packet of returns, and its first bytes."""

BLOCKS, BLOCK_SIZE = 12, 100
"""Of a Velodyne packet of returns: its blocks, and the bytes of each."""

IP_UDP = 28
"""Bytes of the headers of IP and UDP before what a sensor sends."""


def open_packets(path: Path) -> Recording:
    """Recognize the sensor of a capture, and count the sweeps, which takes a pass through it.

    Raises
    ------
    MissingExtraError
        Where the extra for the sensor is not installed.
    ReadError
        Where the file is not a capture of such packets, or an Ouster's metadata are missing.
    """
    with naming(path), reported("capture"):
        capture = walk(path)
    velodyne, unreadable = _of_velodyne(packets(path, capture))
    note = capture.note(unreadable)
    if velodyne:
        content = mended(path, capture) if len(capture.gaps) else None
        read = partial(_velodyne_sweeps, path, content)
    else:
        read = partial(_ouster_sweeps, path, _metadata(path, sizes_in_words(capture)))
    count = sum(1 for _ in read())
    if not count:
        raise ReadError(f"{path}: holds no sweep, its packets have {sizes_in_words(capture)}")

    def frames(numbers: range) -> Iterator[Frame]:
        for number, (stamp, columns, origin) in enumerate(read()):
            if number in numbers:
                where = f"{path}: sweep {number}"
                cloud = frame_from_columns(where, columns(), origin)
                yield Frame(number, noted(cloud, note), stamp)
            if number == numbers[-1]:
                return

    return Recording(path, count, frames)


def _of_velodyne(packets: Iterator[bytes]) -> tuple[bool, int]:
    """Tell whether packets are a Velodyne's, and how many of these the decoder would pass over."""
    is_velodyne = False
    alike: Counter[tuple[int, bytes]] = Counter()
    for packet in packets:
        ip = len(packet) - VELODYNE_SIZE - IP_UDP
        if ip < 2:
            continue
        content = packet[-VELODYNE_SIZE:]
        is_velodyne = is_velodyne or content.startswith(VELODYNE_START)
        # What says that this is IP and UDP, how long it is, and where blocks begin.
        protocols = packet[ip - 2 : ip + 1] + packet[ip + 9 : ip + 10] + packet[ip + 2 : ip + 4]
        alike[len(packet), protocols + content[: BLOCKS * BLOCK_SIZE : BLOCK_SIZE]] += 1
    if not is_velodyne:
        return False, 0
    # In packets of one sensor, all of this is the same.
    (length, _), count = alike.most_common(1)[0]
    return True, sum(n for (each, _), n in alike.items() if each == length) - count


Sweep = tuple[float, Callable[[], Columns], Array]
"""Time of recording, s; function that gives its columns; origin (3,) of its beams."""


def _velodyne_sweeps(path: Path, content: bytes | None) -> Iterator[Sweep]:
    """Decode a capture, or other bytes in its place."""
    try:
        import velodyne_decoder
    except ImportError:
        raise MissingExtraError("velodyne", "reading Velodyne packets") from None

    with naming(path), reported("capture"):
        source = path if content is None else BytesIO(content)
        for stamp, points in velodyne_decoder.read_pcap(source, as_pcl_structs=True):
            yield velodyne_sweep(stamp.host, points)


def velodyne_sweep(stamp: float, points: Any) -> Sweep:
    """Name the values of a sweep.

    Parameters
    ----------
    stamp, points
        As velodyne-decoder gives them: the host's time, and PCL's structures.
    """

    def columns() -> Columns:
        own: Columns = {name: points[name] for name in points.dtype.names}
        return {**own, "time": stamp + points["time"].astype(np.float64)}

    return stamp, columns, np.zeros(3)


def _metadata(path: Path, sizes: str) -> Path:
    """Find the metadata of an Ouster beside its packets: with the same name, or the only ones."""
    same = path.with_suffix(".json")
    if same.is_file():
        return same
    beside = sorted(path.parent.glob("*.json"))
    if len(beside) == 1:
        return beside[0]
    have = f"{len(beside)} files .json, none of them {same.name}" if beside else "no .json"
    raise ReadError(
        f"{path}: its packets are not from a Velodyne ({sizes}); those of an Ouster need the "
        f"sensor's metadata beside them as {same.name}, found {have}"
    )


def _ouster_sweeps(path: Path, metadata: Path) -> Iterator[Sweep]:
    try:
        from ouster.sdk import open_source
    except ImportError:
        raise MissingExtraError("ouster", "reading Ouster packets") from None

    with (
        naming(path),
        reported("capture"),
        closing(open_source(str(path), meta=[str(metadata)])) as source,
    ):
        sweep = ouster_sweeps(source.sensor_info[0])
        yield from (sweep(scan) for scans in source for scan in scans if scan is not None)


def ouster_sweeps(info: Any) -> Callable[[Any], Sweep]:
    """Give what makes sweeps of an Ouster's scans, from the `SensorInfo` of its metadata."""
    from ouster.sdk.core import ChanField, XYZLut

    # In the sensor's frame z = 0 is its base; the beams start above it.
    rays = XYZLut(info, use_extrinsics=False)
    origin = info.lidar_to_sensor_transform[:3, 3] / 1000

    def sweep(scan: Any) -> Sweep:
        start = float(scan.get_first_valid_column_timestamp()) / 1e9
        return start, partial(_ouster_columns, scan, rays, ChanField), origin

    return sweep


def _ouster_columns(scan: Any, rays: Any, names: Any) -> Columns:
    """Name the values of a sweep, ring by ring; without a return there is no coordinate."""
    returned = scan.field(names.RANGE) > 0
    xyz = np.where(returned[..., None], rays(scan), np.nan).reshape(-1, 3)
    own = {names.SIGNAL: "intensity", names.REFLECTIVITY: "reflectivity"}
    columns = {
        name: scan.field(field).reshape(-1) for field, name in own.items() if field in scan.fields
    }
    rings, columns_of_sweep = returned.shape
    return {
        **dict(zip("xyz", xyz.T, strict=True)),
        **columns,
        "ring": np.repeat(np.arange(rings), columns_of_sweep),
        "time": np.tile(scan.timestamp / 1e9, rings),
    }
