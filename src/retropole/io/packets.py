"""Packets as a sensor sends them, in a .pcap: Velodyne and Ouster, by their own mathematics.

Velodyne by velodyne-decoder (optional part ``velodyne``), Ouster by the maker's kit (``ouster``).
Frames are sweeps; the first and the last are as long as the recording has them.
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
"""So many first packets tell what sent them."""

VELODYNE, UPPER_BLOCK = 1206, b"\xff\xee"
"""Bytes of a Velodyne packet of returns, and how it starts."""

MAGIC = {b"\xd4\xc3\xb2\xa1": "<", b"\xa1\xb2\xc3\xd4": ">"}
MAGIC |= {b"\x4d\x3c\xb2\xa1": "<", b"\xa1\xb2\x3c\x4d": ">"}
"""How a capture starts, and the byte order that tells; microseconds, then nanoseconds."""

NEXT_GENERATION = b"\x0a\x0d\x0d\x0a"
"""How a pcapng starts."""


def open_packets(path: Path) -> Recording:
    """Look at a capture: tell the maker, and count the sweeps, which takes a pass through it.

    Raises
    ------
    MissingExtraError
        Where the maker's part is not installed.
    ReadError
        Where the file is no capture of such packets, or an Ouster's metadata are missing.
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
    """Say which sizes the first packets have, and whether they are Velodyne's."""
    with path.open("rb") as file:
        head = file.read(24)
        if not head:
            raise ReadError(f"{path}: is empty, expected a capture of packets")
        if head[:4] == NEXT_GENERATION:
            raise ReadError(
                f"{path}: is a pcapng, expected a pcap; 'editcap -F pcap' makes one of it"
            )
        order = MAGIC.get(head[:4])
        if order is None:
            raise ReadError(f"{path}: starts with {head[:4]!r}, expected a capture of packets")
        sizes: Counter[int] = Counter()
        velodyne = False
        for _ in range(PROBED_PACKETS):
            record = file.read(16)
            if len(record) < 16:
                break
            (size,) = struct.unpack_from(f"{order}I", record, 8)
            # No packet of a sensor is larger than what UDP carries.
            if size > 2**17:
                raise ReadError(f"{path}: a packet of {size} bytes, expected 65,536 at most")
            packet = file.read(size)
            sizes[size] += 1
            velodyne |= packet[-VELODYNE : 2 - VELODYNE] == UPPER_BLOCK
    words = ", ".join(f"{size} ({count} times)" for size, count in sizes.most_common(3))
    return f"{words or 'no'} bytes with their headers", velodyne


Sweep = tuple[float, Any, Array]
"""When it was recorded, s; what gives its columns; where its beams start."""


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
    """Find the metadata of an Ouster beside its packets: of the same name, or the only ones."""
    same = path.with_suffix(".json")
    if same.is_file():
        return same
    beside = sorted(path.parent.glob("*.json"))
    if len(beside) == 1:
        return beside[0]
    have = f"{len(beside)} files .json, none of them {same.name}" if beside else "no .json"
    raise ReadError(
        f"{path}: its packets are no Velodyne's ({sizes}); an Ouster's need the sensor's metadata "
        f"beside them as {same.name}, found {have}"
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
                # In the sensor's frame, whose z = 0 is its base: the beams start above that.
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
    """Name the values of a sweep, row by row; where no light came back there is no coordinate."""
    returned = scan.field(names.RANGE) > 0
    xyz = np.where(returned[..., None], rays(scan), np.nan).reshape(-1, 3)
    own = {names.SIGNAL: "intensity", names.REFLECTIVITY: "reflectivity"}
    columns = {
        name: scan.field(field).reshape(-1) for field, name in own.items() if field in scan.fields
    }
    rows, sweep = returned.shape
    return {
        **dict(zip("xyz", xyz.T, strict=True)),
        **columns,
        "ring": np.repeat(np.arange(rows), sweep),
        "time": np.tile(scan.timestamp / 1e9, rows),
    }
