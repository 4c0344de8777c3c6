"""Captures of packets: .pcap.

Where records of a capture are damaged or cut, a wrong length makes a reader take what follows for
packets, or stop. Here the next record is looked for instead, and what lies between is counted.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from ...base.datatypes import IntArray
from ...base.errors import ReadError
from ...base.quantities import counted

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
