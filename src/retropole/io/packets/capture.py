"""Captures of packets: .pcap and .pcapng, and what UDP carries in them.

Where records of a capture are damaged or cut, a wrong length makes a reader take what follows for
packets, or stop. Here the next record is looked for instead, and what lies between is counted.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...base.datatypes import Array, IntArray
from ...base.errors import ReadError
from ...base.quantities import counted

PCAP_ORDERS = {b"\xd4\xc3\xb2\xa1": "<", b"\xa1\xb2\xc3\xd4": ">"}
PCAP_ORDERS |= {b"\x4d\x3c\xb2\xa1": "<", b"\xa1\xb2\x3c\x4d": ">"}
"""First bytes of a capture, and the byte order that they show; microseconds, then nanoseconds."""

NANOSECOND_STARTS = (b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d")

PCAPNG_START = b"\x0a\x0d\x0d\x0a"
"""First bytes of a pcapng."""

BLOCK_HEADER, INTERFACE, SIMPLE, PACKET, RESOLUTION = 12, 1, 3, 6, 9
"""Of a pcapng: bytes of the smallest block; kinds of blocks, and the option of an interface that
states how long a tick is. From draft-ietf-opsawg-pcapng, 4."""

CAPTURE_HEADER, PACKET_HEADER = 24, 16
"""Bytes before the first packet, and before each."""

MAX_PACKET = 2**17
"""Bytes that no packet reaches: UDP carries at most 65,507."""

LARGE_BLOCK = 2**18
"""Bytes that are searched for a record at most at a time."""


class Record(NamedTuple):
    """Where the bytes of a packet begin in the file, how many they are, when it came, s, and of
    which type its outermost layer is.
    """

    start: int
    size: int
    time: float = 0.0
    link: int = 0


class Datagram(NamedTuple):
    """What a LiDAR sent in one packet, by whom (``IP:port``), and when it came, s."""

    payload: bytes
    sender: str
    time: float


@dataclass(frozen=True)
class Capture:
    """A capture that was walked through once.

    Attributes
    ----------
    records
        (N, 2) start and size of each packet, bytes.
    gaps
        (M, 2) start and size of what lies between them and has none, bytes.
    size
        Of the file, bytes.
    times, links
        (N,) when each packet came, s, and the type of its outermost layer.
    """

    records: IntArray
    gaps: IntArray
    size: int
    times: Array
    links: IntArray

    def note(self, unreadable: int) -> str:
        """Report what is lost, if `unreadable` packets cannot be used either; or nothing."""
        lost = []
        if len(self.gaps):
            where = counted(len(self.gaps), "place")
            lost.append(
                f"{int(self.gaps[:, 1].sum()):,} of {self.size:,} bytes at {where} (from byte "
                f"{self.gaps[0, 0]}) contain no complete packet"
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
        If the file is not a capture, has no whole packet, or is damaged all over.
    """
    size = path.stat().st_size
    records, gaps = list[Record | NDArray[np.void]](), list[Record]()
    tries = [100_000]
    with path.open("rb") as file:
        head = file.read(CAPTURE_HEADER)
        if head[:4] == PCAPNG_START:
            found = _blocks(file, size, tries)
            header = 0
        else:
            found = _plain(file, size, _byte_order(head), tries)
            header = CAPTURE_HEADER
        for record, following, at in found:
            if isinstance(record, Record):
                end = record.start + record.size
                records += [record] if record.size else []
            elif record is not None:
                end = following
                records.append(record)
            else:
                end = at
            if following > end:
                gaps.append(Record(end, following - end))
            # More is not worth the time: it is not a capture.
            if len(gaps) > 1000 or tries[0] <= 0:
                damaged = f"is damaged at {len(gaps)} places up to byte {following}"
                raise ReadError(f"{damaged}, expected a capture")
    if not records and (gaps or not header):
        raise ReadError(f"has no complete packet in the {size - header} bytes after its header")
    found_records = _table(records)
    return Capture(
        np.column_stack([found_records["start"], found_records["size"]]),
        np.array([own[:2] for own in gaps], np.int64).reshape(-1, 2),
        size,
        found_records["time"],
        found_records["link"],
    )


RECORDS = np.dtype([("start", "i8"), ("size", "i8"), ("time", "f8"), ("link", "i8")])
"""What `Record` has, of many."""

Step = tuple[Record | NDArray[np.void] | None, int, int]
"""A record, many records, or None if there is none; the byte at which the next begins, and that at
which it was looked for."""

OF_ONE_SIZE = 8
"""This many records of one size in a row may be followed by more, which are found at once."""


def _table(records: list[Record | NDArray[np.void]]) -> NDArray[np.void]:
    """Collect records in one table, in their order."""
    parts, ones = list[NDArray[np.void]](), list[Record]()
    for own in records:
        if isinstance(own, Record):
            ones.append(own)
        else:
            parts += [np.array(ones, RECORDS), own]
            ones = []
    return np.concatenate([*parts, np.array(ones, RECORDS)])


def _similar_records(
    block: bytes, here: int, length: int, at: int, order: Order
) -> NDArray[np.void]:
    """Find the records of one size that follow each other, but the last, from a place on."""
    step = PACKET_HEADER + length
    count = (len(block) - here) // step
    heads = np.ndarray((count, 4), f"{order.mark}u4", block, here, (step, 4))
    differ = np.flatnonzero((heads[:, 2] != length) | (heads[:, 1] >= 10**9))
    heads = heads[: max((differ[0] if len(differ) else count) - 1, 0)]
    found = np.empty(len(heads), RECORDS)
    found["start"] = at + here + PACKET_HEADER + step * np.arange(len(heads))
    found["time"] = heads[:, 0] + heads[:, 1] * order.tick
    found["size"], found["link"] = length, order.link
    return found


def _plain(file: BinaryIO, size: int, order: Order, tries: list[int]) -> Iterator[Step]:
    """Walk through the records of a pcap."""
    header = struct.Struct(f"{order.mark}4I")
    at = CAPTURE_HEADER
    while at < size:
        # As long as each is followed by another, they are read from a block at once.
        file.seek(at)
        block = file.read(LARGE_BLOCK)
        last, here, same = len(block) - PACKET_HEADER, 0, 0
        while True:
            second, part, length, _ = header.unpack_from(block, here) if here <= last else (0,) * 4
            following = here + PACKET_HEADER + length
            if not 0 < length <= MAX_PACKET or part >= 10**9 or following > last:
                break
            _, part_after, length_after, _ = header.unpack_from(block, following)
            after = at + following + PACKET_HEADER + length_after
            if not 0 < length_after <= MAX_PACKET or part_after >= 10**9 or after > size:
                break
            start = at + here + PACKET_HEADER
            same = same + 1 if length_after == length else 0
            if same > OF_ONE_SIZE:
                many = _similar_records(block, here, length, at, order)
                following = here + len(many) * (PACKET_HEADER + length)
                if len(many):
                    yield many, at + following, at + here
                    here, same = following, 0
                    continue
                following = here + PACKET_HEADER + length
            record = Record(start, length, second + part * order.tick, order.link)
            yield record, start + length, at + here
            here = following
        at += here
        if at < size:
            found, end = _record(file, at, size, order, tries)
            yield found, end, at
            at = end


def _blocks(file: BinaryIO, size: int, tries: list[int]) -> Iterator[Step]:
    """Walk through the blocks of a pcapng; those without a packet are records of no bytes.

    If a block does not end as it begins, the next one with a packet is looked for.
    """
    at, order = 0, "<"
    interfaces: list[tuple[int, float]] = []
    while at < size:
        file.seek(at)
        head = file.read(BLOCK_HEADER)
        if head[:4] == PCAPNG_START:
            order = ">" if head[8:12] == b"\x1a\x2b\x3c\x4d" else "<"
            interfaces = []
        length = _block_length(file, at, size, order)
        if length is None:
            following = _search_blocks(file, at + 4, size, order, tries)
            yield None, following, at
            at = following
            continue
        file.seek(at)
        block = file.read(min(length, LARGE_BLOCK))
        (kind,) = struct.unpack_from(f"{order}I", block)
        record = Record(at, 0)
        if kind == INTERFACE:
            interfaces.append(_interface(block, order))
        elif kind == PACKET and length >= 32:
            number, high, low, captured = struct.unpack_from(f"{order}4I", block, 8)
            if captured <= length - 32 and number < len(interfaces):
                link, tick = interfaces[number]
                record = Record(at + 28, captured, (high << 32 | low) * tick, link)
        elif kind == SIMPLE and interfaces:
            (sent,) = struct.unpack_from(f"{order}I", block, 8)
            record = Record(at + 12, min(sent, length - 16), 0.0, interfaces[0][0])
        # The padding of a block is not a gap.
        yield record, record.start + record.size, at
        at += length


def _interface(block: bytes, order: str) -> tuple[int, float]:
    """Read of an interface the type of its outermost layer, and how long a tick is, s."""
    (link,) = struct.unpack_from(f"{order}H", block, 8)
    at, tick = 16, 1e-6
    while at + 4 <= len(block) - 4:
        code, size = struct.unpack_from(f"{order}2H", block, at)
        if code == RESOLUTION and size == 1:
            exponent = block[at + 4] & 0x7F
            tick = float(2 if block[at + 4] & 0x80 else 10) ** -exponent
        at += 4 + size + -size % 4
    return link, tick


def _block_length(file: BinaryIO, at: int, size: int, order: str) -> int | None:
    """Give the length of the block at a byte; None if it does not end as it begins."""
    file.seek(at + 4)
    head = file.read(4)
    if len(head) < 4:
        return None
    (length,) = struct.unpack(f"{order}I", head)
    if length < BLOCK_HEADER or length % 4 or at + length > size:
        return None
    file.seek(at + length - 4)
    return length if file.read(4) == head else None


def _search_blocks(file: BinaryIO, start: int, size: int, order: str, tries: list[int]) -> int:
    """Find the next block with a packet, or the end of the file."""
    mark = struct.pack(f"{order}I", PACKET)
    while start < size:
        file.seek(start)
        part = file.read(LARGE_BLOCK + 3)
        at = part.find(mark)
        while at >= 0 and tries[0] > 0:
            tries[0] -= 1
            length = _block_length(file, start + at, size, order)
            if length is not None and length <= MAX_PACKET + 64:
                return start + at
            at = part.find(mark, at + 1)
        start += LARGE_BLOCK
    return size


class Order(NamedTuple):
    """Of a pcap: its byte order, how long a tick is, s, and the type of outermost layers."""

    mark: str
    tick: float
    link: int


def _byte_order(head: bytes) -> Order:
    if not head:
        raise ReadError("is empty, expected a capture of packets")
    mark = PCAP_ORDERS.get(head[:4])
    if mark is None or len(head) < CAPTURE_HEADER:
        raise ReadError(f"starts with {head[:4]!r}, expected a capture of packets")
    (link,) = struct.unpack_from(f"{mark}I", head, 20)
    return Order(mark, 1e-9 if head[:4] in NANOSECOND_STARTS else 1e-6, link & 0xFFFF)


def _record(
    file: BinaryIO, at: int, size: int, order: Order, tries: list[int]
) -> tuple[Record | None, int]:
    """Give the record at a byte, or None if there is none, and the first byte of the next."""
    head = _header(file, at, size, order.mark)
    if head is None:
        return None, _search(file, at + 1, size, order.mark, tries)
    length, second, part = head
    record = Record(at + PACKET_HEADER, length, second + part * order.tick, order.link)
    after = at + PACKET_HEADER + length
    if after == size or _header(file, after, size, order.mark) is not None:
        return record, after
    # Either this length is wrong, or what follows is damaged: then the next one lies further on.
    found = _search(file, at + PACKET_HEADER, size, order.mark, tries)
    return (None if found < after else record), found


def _header(
    file: BinaryIO, at: int, size: int, order: str, *, strict: bool = False
) -> tuple[int, int, int] | None:
    """Give length, second and part of the packet whose header is at a byte; None if none is."""
    file.seek(at)
    head = file.read(PACKET_HEADER)
    if len(head) < PACKET_HEADER:
        return None
    second, parts, length, sent = struct.unpack(f"{order}4I", head)
    # No fraction of a second has more parts: nanoseconds.
    plausible = 0 < length <= MAX_PACKET and parts < 10**9
    if strict:
        plausible &= length <= sent <= MAX_PACKET
    is_whole = plausible and at + PACKET_HEADER + length <= size
    return (length, second, parts) if is_whole else None


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
        head = _header(file, at, size, order, strict=True)
        if head is None:
            return False
        at += PACKET_HEADER + head[0]
        if at == size:
            return True
    return True


class SimilarPackets(NamedTuple):
    """Packets of one sender that differ in what they measured alone.

    Attributes
    ----------
    first
        One of these packets.
    rows, times
        Which of all they are, ascending, and when each came, s.
    starts
        Where in the file the payload of each begins.
    """

    first: Datagram
    rows: Sequence[int] | IntArray
    times: Sequence[float] | Array
    starts: Sequence[int] | IntArray = ()


def similar_packets(
    path: Path, capture: Capture, marks: Callable[[bytes], Sequence[slice] | None]
) -> Iterator[SimilarPackets]:
    """Read what UDP carries in the packets of a capture; similar ones together.

    A packet that carries none, or is damaged, gives an empty payload.

    Parameters
    ----------
    path, capture
        The file, and what `walk` found in it.
    marks
        From a payload to the parts of it in which payloads like it are the same; None if each is
        to be looked at by itself.
    """
    starts, sizes = capture.records.T
    with path.open("rb") as file:
        for begin in range(0, len(starts), READ_AT_ONCE):
            left = np.arange(begin, min(begin + READ_AT_ONCE, len(starts)))
            offset = int(starts[begin])
            end = int(starts[left[-1]] + sizes[left[-1]])
            file.seek(offset)
            # A gap may be as large as the file.
            block = file.read(end - offset) if end - offset <= LARGEST_READ else b""
            while len(left):
                row, size, time = int(left[0]), int(sizes[left[0]]), float(capture.times[left[0]])
                at = int(starts[row]) - offset
                packet = block[at : at + size]
                if not block:
                    file.seek(int(starts[row]))
                    packet = file.read(size)
                first, payload, fixed = _udp(packet, int(capture.links[row]), time)
                here = int(starts[row]) + payload
                own = marks(first.payload) if first.payload and block else None
                if own is None:
                    yield SimilarPackets(first, (row,), (time,), (here,))
                    left = left[1:]
                    continue
                parts = [
                    np.arange(size)[part.start + payload : part.stop + payload] for part in own
                ]
                compared = np.concatenate([fixed, *parts])
                is_like = (sizes[left] == size) & (capture.links[left] == capture.links[row])
                places = (starts[left[is_like]] - offset)[:, None] + compared
                found = np.frombuffer(block, np.uint8)[places]
                is_like[is_like] = (found == found[0]).all(axis=1)
                rows, left = left[is_like], left[~is_like]
                yield SimilarPackets(first, rows, capture.times[rows], starts[rows] + payload)


def _udp(packet: bytes, link: int, time: float) -> tuple[Datagram, int, IntArray]:
    """Take the UDP payload of a packet, its position, and which bytes before it are the same in
    each packet of its size and sender.
    """
    nothing = Datagram(b"", "", time), 0, np.zeros(0, np.int64)
    at = _ip(packet, link)
    size = len(packet) - at
    if at < 0 or size < 28 or packet[at] >> 4 != 4 or packet[at + 9] != UDP:
        return nothing
    udp = at + (packet[at] & 15) * 4
    whole = packet[at + 2] << 8 | packet[at + 3]
    if not udp - at + 8 <= whole <= size:
        return nothing
    address = ".".join(str(byte) for byte in packet[at + 12 : at + 16])
    port = int.from_bytes(packet[udp : udp + 2], "big")
    # But for the number of the packet and both checksums.
    fixed = np.delete(np.arange(udp + 8), [at + 4, at + 5, at + 10, at + 11, udp + 6, udp + 7])
    return Datagram(packet[udp + 8 : at + whole], f"{address}:{port}", time), udp + 8, fixed


def packets(path: Path, capture: Capture) -> Iterator[bytes]:
    """Read the packets of a capture one after the other."""
    with path.open("rb") as file:
        for start, size in capture.records.tolist():
            file.seek(start)
            yield file.read(size)


def stacks_of(path: Path, starts: IntArray, size: int) -> Iterator[NDArray[np.uint8]]:
    """Read parts of a file of one size by where they begin, ascending: some together (N, size)."""
    with path.open("rb") as file:
        for k in range(0, len(starts), READ_AT_ONCE):
            own = starts[k : k + READ_AT_ONCE]
            first, length = int(own[0]), int(own[-1] - own[0]) + size
            if length <= LARGEST_READ:
                file.seek(first)
                block = np.frombuffer(file.read(length), np.uint8)
                yield np.lib.stride_tricks.sliding_window_view(block, size)[own - first]
                continue
            parts = []
            for start in own.tolist():
                file.seek(start)
                parts.append(file.read(size))
            yield np.frombuffer(b"".join(parts), np.uint8).reshape(-1, size)


READ_AT_ONCE = 256
"""Packets that are read at once where they lie together."""

LARGEST_READ = 2**21
"""Largest number of bytes read for them together, else each by itself."""

UDP = 17
"""Number of UDP in an IP packet."""

LINKS = {0: 4, 108: 4, 113: 16, 276: 20, 101: 0, 12: 0, 228: 0}
"""Bytes before IP by the type of the outermost layer: loopbacks, Linux' cooked ones, and none."""


def _ip(packet: bytes, link: int) -> int:
    """Find the byte of a packet where IP begins; -1 where it carries something else."""
    if link in LINKS:
        return LINKS[link]
    at = 12
    # Tags of virtual networks are before the type.
    while packet[at : at + 2] in (b"\x81\x00", b"\x88\xa8"):
        at += 4
    return at + 2 if packet[at : at + 2] == b"\x08\x00" else -1


def sizes_in_words(capture: Capture) -> str:
    """Name the sizes of most packets."""
    sizes = Counter(capture.records[:, 1].tolist()).most_common(3)
    counts = ", ".join(f"{size} ({count} times)" for size, count in sizes)
    return f"{counts or 'no'} bytes with their headers"
