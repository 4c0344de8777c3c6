"""Packets as a sensor sends them, in a .pcap: Velodyne and Ouster.

Velodyne are decoded by velodyne-decoder (the extra ``velodyne``), Ouster by the manufacturer's SDK
(the extra ``ouster``). Frames are sweeps; the first and the last may be incomplete.

Where records of a capture are damaged or cut, a wrong length makes a reader take what follows for
packets, or stop. Here the next record is looked for instead, and what lies between is counted.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from ..base.datatypes import Array, IntArray
from ..base.errors import MissingExtraError, ReadError, naming, reported
from ..base.quantities import counted
from .fields import Columns, frame_from_columns, noted
from .recordings import Frame, Recording

PACKETS = (".pcap",)
"""Suffixes of packet captures."""

CAPTURES = (*PACKETS, ".pcapng", ".cap")
"""Suffixes that captures have, also those that may be of a format that is not read."""

VELODYNE_SIZE, VELODYNE_START = 1206, b"\xff\xee"
"""Bytes of a Velodyne packet of returns, and its first bytes."""

BLOCK_SIZE = 100
"""Bytes of each of the 12 blocks in a Velodyne packet of returns."""


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
        # Before what a sensor sends, IP and UDP have 28 bytes.
        ip = len(packet) - VELODYNE_SIZE - 28
        if ip < 2:
            continue
        content = packet[-VELODYNE_SIZE:]
        is_velodyne = is_velodyne or content.startswith(VELODYNE_START)
        # What says that this is IP and UDP, how long it is, and where blocks begin.
        protocols = packet[ip - 2 : ip + 1] + packet[ip + 9 : ip + 10] + packet[ip + 2 : ip + 4]
        alike[len(packet), protocols + content[: 12 * BLOCK_SIZE : BLOCK_SIZE]] += 1
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


PCAP_ORDERS = {b"\xd4\xc3\xb2\xa1": "<", b"\xa1\xb2\xc3\xd4": ">"}
PCAP_ORDERS |= {b"\x4d\x3c\xb2\xa1": "<", b"\xa1\xb2\x3c\x4d": ">"}
"""First bytes of a capture, and the byte order that they show; microseconds, then nanoseconds."""

PCAPNG_START = b"\x0a\x0d\x0d\x0a"
"""First bytes of a pcapng."""

CAPTURE_HEADER, PACKET_HEADER = 24, 16
"""Bytes before the first packet, and before each."""

MAX_PACKET = 2**17
"""Bytes that no packet reaches: UDP carries 65,507 at most."""

LARGE_BLOCK = 2**18
"""Bytes that are searched for a record at most at a time."""


class Record(NamedTuple):
    """Where the bytes of a packet begin in the file, and how many they are."""

    start: int
    size: int


@dataclass(frozen=True)
class Capture:
    """A capture that was walked through once.

    Attributes
    ----------
    records
        (N, 2) start and size of each packet, bytes.
    gaps
        (M, 2) start and size of what lies between them and holds none, bytes.
    size
        Of the file, bytes.
    """

    records: IntArray
    gaps: IntArray
    size: int

    def note(self, unreadable: int) -> str:
        """Say what is lost, where `unreadable` packets are of no use as well; or nothing."""
        lost = []
        if len(self.gaps):
            where = counted(len(self.gaps), "place")
            lost.append(
                f"{int(self.gaps[:, 1].sum()):,} of {self.size:,} bytes at {where} (from byte "
                f"{self.gaps[0, 0]}) hold no whole packet"
            )
        if unreadable:
            lost.append(f"{unreadable:,} of {len(self.records):,} packets cannot be read")
        if not lost:
            return ""
        return f"the capture is damaged or cut: {', and '.join(lost)}; their points are missing"


def walk(path: Path) -> Capture:
    """Find the packets of a capture.

    Raises
    ------
    ReadError
        Where the file is no capture, holds no whole packet, or is damaged all over.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        order = _byte_order(file.read(CAPTURE_HEADER))
        records, gaps = list[Record](), list[Record]()
        tries = [100_000]
        at = CAPTURE_HEADER
        while at < size:
            found, following = _record(file, at, size, order, tries)
            end = at if found is None else found.start + found.size
            if found is not None:
                records.append(found)
            if following > end:
                gaps.append(Record(end, following - end))
            at = following
            # More is not worth the time: it is no capture.
            if len(gaps) > 1000 or tries[0] <= 0:
                damaged = f"is damaged at {len(gaps)} places up to byte {at}"
                raise ReadError(f"{damaged}, expected a capture")
    if gaps and not records:
        raise ReadError(
            f"holds no whole packet in the {size - CAPTURE_HEADER} bytes after its header"
        )
    return Capture(
        np.array(records, np.int64).reshape(-1, 2), np.array(gaps, np.int64).reshape(-1, 2), size
    )


def _byte_order(head: bytes) -> str:
    if not head:
        raise ReadError("is empty, expected a capture of packets")
    if head[:4] == PCAPNG_START:
        raise ReadError("is a pcapng, expected a pcap; 'editcap -F pcap' converts it")
    order = PCAP_ORDERS.get(head[:4])
    if order is None or len(head) < CAPTURE_HEADER:
        raise ReadError(f"starts with {head[:4]!r}, expected a capture of packets")
    return order


def _record(
    file: BinaryIO, at: int, size: int, order: str, tries: list[int]
) -> tuple[Record | None, int]:
    """Give the record at a byte, or None where there is none, and the first byte of the next."""
    length = _length(file, at, size, order)
    if length is None:
        return None, _search(file, at + 1, size, order, tries)
    after = at + PACKET_HEADER + length
    if after == size or _length(file, after, size, order) is not None:
        return Record(at + PACKET_HEADER, length), after
    # Either this length is wrong, or what follows is damaged: then the next one lies further on.
    found = _search(file, at + PACKET_HEADER, size, order, tries)
    return (None if found < after else Record(at + PACKET_HEADER, length)), found


def _length(file: BinaryIO, at: int, size: int, order: str, *, strict: bool = False) -> int | None:
    """Give the length of the packet whose header is at a byte; None where there is no header."""
    file.seek(at)
    head = file.read(PACKET_HEADER)
    if len(head) < PACKET_HEADER:
        return None
    _, parts, length, sent = struct.unpack(f"{order}4I", head)
    # No fraction of a second has more parts: nanoseconds.
    plausible = 0 < length <= MAX_PACKET and parts < 10**9
    if strict:
        plausible &= length <= sent <= MAX_PACKET
    return length if plausible and at + PACKET_HEADER + length <= size else None


def _search(file: BinaryIO, start: int, size: int, order: str, tries: list[int]) -> int:
    """Find the first byte from which records follow each other, or the end of the file."""
    length = 2**12
    while start < size:
        file.seek(start)
        block = file.read(length + PACKET_HEADER - 1)
        for k in _headers(block, order):
            tries[0] -= 1
            if tries[0] <= 0:
                return size
            if _follow(file, start + int(k), size, order):
                return start + int(k)
        start, length = start + length, min(2 * length, LARGE_BLOCK)
    return size


def _headers(block: bytes, order: str) -> IntArray:
    """Find the places that may be headers by their numbers alone."""
    places = max(len(block) - PACKET_HEADER + 1, 0)
    # From each byte on, the four numbers of a header: a view, in which they overlap.
    numbers: IntArray = np.ndarray((places, 4), f"{order}u4", block, strides=(1, 4))
    _, parts, length, sent = numbers.T
    fits = (length > 0) & (length <= sent) & (sent <= MAX_PACKET) & (parts < 10**9)
    return np.flatnonzero(fits)


def _follow(file: BinaryIO, at: int, size: int, order: str) -> bool:
    """Whether several records follow each other from a byte on, or up to the end."""
    # Numbers by chance do not follow each other three times.
    for _ in range(3):
        length = _length(file, at, size, order, strict=True)
        if length is None:
            return False
        at += PACKET_HEADER + length
        if at == size:
            return True
    return True


def mended(path: Path, capture: Capture) -> bytes:
    """Give a damaged capture without what lies between its packets."""
    data = path.read_bytes()
    kept = [data[:CAPTURE_HEADER]]
    kept += [data[start - PACKET_HEADER : start + size] for start, size in capture.records]
    return b"".join(kept)


def packets(path: Path, capture: Capture) -> Iterator[bytes]:
    """Read the packets of a capture one after the other."""
    with path.open("rb") as file:
        for start, size in capture.records.tolist():
            file.seek(start)
            yield file.read(size)


def sizes_in_words(capture: Capture) -> str:
    """Name the sizes of most packets."""
    sizes = Counter(capture.records[:, 1].tolist()).most_common(3)
    words = ", ".join(f"{size} ({count} times)" for size, count in sizes)
    return f"{words or 'no'} bytes with their headers"
