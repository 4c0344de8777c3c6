"""Packets as a sensor sends them, in a .pcap: Velodyne and Ouster.

Velodyne are decoded by velodyne-decoder (the extra ``velodyne``), Ouster by the manufacturer's SDK
(the extra ``ouster``). Frames are sweeps; the first and the last may be incomplete.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..datatypes import Array
from ..errors import MissingExtraError, ReadError
from .fields import Columns, frame_from_columns
from .recordings import Frame, Recording, reported

PACKETS = (".pcap",)
"""Suffixes of packet captures."""

PROBED_PACKETS = 1000
"""Number of first packets by which the sensor is recognized."""

VELODYNE_SIZE, VELODYNE_START = 1206, b"\xff\xee"
"""Bytes of a Velodyne packet of returns, and its first bytes."""

PCAP_ORDERS = {b"\xd4\xc3\xb2\xa1": "<", b"\xa1\xb2\xc3\xd4": ">"}
PCAP_ORDERS |= {b"\x4d\x3c\xb2\xa1": "<", b"\xa1\xb2\x3c\x4d": ">"}
"""First bytes of a capture, and the byte order that they show; microseconds, then nanoseconds."""

PCAPNG_START = b"\x0a\x0d\x0d\x0a"
"""First bytes of a pcapng."""

CAPTURE_HEADER, PACKET_HEADER = 24, 16
"""Bytes before the first packet, and before each."""

MAX_PACKET = 2**17
"""Bytes that no packet reaches: UDP carries 65,507 at most."""


def open_packets(path: Path) -> Recording:
    """Recognize the sensor of a capture, and count the sweeps, which takes a pass through it.

    Raises
    ------
    MissingExtraError
        Where the extra for the sensor is not installed.
    ReadError
        Where the file is not a capture of such packets, or an Ouster's metadata are missing.
    """
    with reported(path, "capture"):
        sizes, velodyne = _first_packets(path)
    read = _velodyne(path) if velodyne else _ouster(path, _metadata(path, sizes))
    count = sum(1 for _ in read())
    if not count:
        raise ReadError(f"{path}: holds no sweep, its packets have {sizes}")

    def frames(numbers: range) -> Iterator[Frame]:
        for number, (stamp, columns, origin) in enumerate(read()):
            if number in numbers:
                where = f"{path}: sweep {number}"
                yield Frame(number, frame_from_columns(where, columns(), origin), stamp)
            if number == numbers[-1]:
                return

    return Recording(path, count, frames)


def _first_packets(path: Path) -> tuple[str, bool]:
    """Give the sizes of the first packets in words, and whether they are Velodyne's."""
    with path.open("rb") as file:
        head = file.read(CAPTURE_HEADER)
        if not head:
            raise ReadError(f"{path}: is empty, expected a capture of packets")
        if head[:4] == PCAPNG_START:
            raise ReadError(f"{path}: is a pcapng, expected a pcap; 'editcap -F pcap' converts it")
        order = PCAP_ORDERS.get(head[:4])
        if order is None:
            raise ReadError(f"{path}: starts with {head[:4]!r}, expected a capture of packets")
        sizes: Counter[int] = Counter()
        velodyne = False
        for _ in range(PROBED_PACKETS):
            record = file.read(PACKET_HEADER)
            if len(record) < PACKET_HEADER:
                break
            (size,) = struct.unpack_from(f"{order}I", record, 8)
            if size > MAX_PACKET:
                raise ReadError(f"{path}: a packet of {size} bytes, expected 65,536 at most")
            packet = file.read(size)
            sizes[size] += 1
            velodyne |= packet[-VELODYNE_SIZE : 2 - VELODYNE_SIZE] == VELODYNE_START
    words = ", ".join(f"{size} ({count} times)" for size, count in sizes.most_common(3))
    return f"{words or 'no'} bytes with their headers", velodyne


Sweep = tuple[float, Any, Array]
"""Time of recording, s; function that gives its columns; origin (3,) of its beams."""


def _velodyne(path: Path) -> Any:
    try:
        import velodyne_decoder
    except ImportError:
        raise MissingExtraError("velodyne", "reading Velodyne packets") from None

    def sweeps() -> Iterator[Sweep]:
        with reported(path, "capture"):
            for stamp, points in velodyne_decoder.read_pcap(path, as_pcl_structs=True):

                def columns(points: Any = points, start: float = stamp.host) -> Columns:
                    own: Columns = {name: points[name] for name in points.dtype.names}
                    return {**own, "time": start + points["time"].astype(np.float64)}

                yield stamp.host, columns, np.zeros(3)

    return sweeps


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


def _ouster(path: Path, metadata: Path) -> Any:
    try:
        from ouster.sdk import open_source
        from ouster.sdk.core import ChanField, XYZLut
    except ImportError:
        raise MissingExtraError("ouster", "reading Ouster packets") from None

    def sweeps() -> Iterator[Sweep]:
        with reported(path, "capture"):
            source = open_source(str(path), meta=[str(metadata)])
            try:
                info = source.sensor_info[0]
                # In the sensor's frame z = 0 is its base; the beams start above it.
                rays = XYZLut(info, use_extrinsics=False)
                origin = info.lidar_to_sensor_transform[:3, 3] / 1000
                for scans in source:
                    for scan in scans:
                        if scan is None:
                            continue

                        def columns(scan: Any = scan) -> Columns:
                            return _ouster_columns(scan, rays, ChanField)

                        yield float(scan.get_first_valid_column_timestamp()) / 1e9, columns, origin
            finally:
                source.close()

    return sweeps


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
