"""Packets written as the makers' manuals describe them, apart from the tables that are tested."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retropole.io.packets.models import Returns

Rows = list[tuple[float, list[float], list[int]]]
"""Azimuth of a row, degrees; distance of each firing, m; its intensity."""

SECONDS = 1_700_000_000
"""Of the packets' clocks: 2023-11-14 22:13:20 UTC."""


@dataclass(frozen=True)
class Spinning:
    """What a manual says of a LiDAR that turns.

    Attributes
    ----------
    begin, end
        Bytes before and after the blocks, of when the first and the last firing is, µs after
        `SECONDS`.
    flag, per_block, blocks
        First bytes of a block, firings in it, and blocks in a packet.
    unit, order
        Metres of a unit of distance, and the order of bytes.
    firing, period
        When a firing of a row is, and when the next row is, µs.
    lens
        Metres ahead, degrees clockwise, metres up.
    y_ahead
        Whether y is at azimuth 0.
    rows_of
        Rows of a packet; as many as blocks unless said.
    """

    begin: Callable[[int], bytes]
    end: Callable[[int], bytes]
    flag: bytes
    per_block: int
    blocks: int
    unit: float
    order: str
    firing: Callable[[int], float]
    period: float
    lens: tuple[float, float, float]
    y_ahead: bool = False
    rows: int = 0

    def packet(self, rows: Rows, micros: int, ends: int = 0) -> bytes:
        """Write a packet; rows of more firings than a block has go to several blocks."""
        blocks = []
        for azimuth, distances, intensities in rows:
            for k in range(0, len(distances), self.per_block):
                head = self.flag + struct.pack(f"{self.order}H", round(azimuth * 100) % 36000)
                part = zip(
                    distances[k : k + self.per_block],
                    intensities[k : k + self.per_block],
                    strict=True,
                )
                body = (struct.pack(f"{self.order}HB", round(d / self.unit), i) for d, i in part)
                blocks.append(head + b"".join(body))
        assert len(blocks) == self.blocks
        return self.begin(micros) + b"".join(blocks) + self.end(ends)

    def point(
        self, azimuth: float, step: float, slot: int, distance: float, up: float, aside: float
    ) -> tuple[float, float, float]:
        """Say where a firing of a row hit, as the manual's formula does."""
        at = azimuth + step * self.firing(slot) / self.period
        beam = math.radians(at + aside)
        lens = math.radians(at + self.lens[1] + (aside if self.y_ahead else 0))
        out = distance * math.cos(math.radians(up))
        ahead = out * math.cos(beam) + self.lens[0] * math.cos(lens)
        right = out * math.sin(beam) + self.lens[0] * math.sin(lens)
        height = distance * math.sin(math.radians(up)) + self.lens[2]
        return (right, ahead, height) if self.y_ahead else (ahead, -right, height)


def _calendar(micros: int) -> bytes:
    return bytes([23, 11, 14, 22, 13, 20]) + struct.pack(">HH", *divmod(micros, 1000))


def _unix(micros: int) -> bytes:
    return struct.pack(">HII", 0, SECONDS, micros)


def _old(model: int, micros: int) -> bytes:
    return (
        bytes.fromhex("55aa050a5aa550a0")
        + bytes(12)
        + _calendar(micros)
        + bytes([model] + 11 * [0])
    )


def _new(micros: int, after: str = "06") -> bytes:
    begin = bytes.fromhex("55aa055a0001") + bytes(14) + _unix(micros) + bytes.fromhex(after)
    return begin.ljust(42, b"\0")


def _leishen(model: int, micros: int) -> bytes:
    return bytes([23, 11, 14, 22, 13, 20]) + struct.pack("<I", micros * 1000) + bytes([0x37, model])


def _steps(*groups: tuple[int, float]) -> list[float]:
    return [k * step for count, step in groups for k in range(count)]


AIRY = [0, 5.712, 12.376, 19.04, 25.704, 33.32, 41.888, 50.456, 59.024, 70.448, 81.872, 93.296]
HELIOS = [0, 1.57, 3.15, 4.72, 6.3, 7.87, 9.45, 11.36, 13.26, 15.17, 17.08, 18.99, 20.56, 22.14]
HELIOS += [23.71, 25.29, 26.53, 29.01, 27.77, 30.25, 31.49, 33.98, 32.73, 35.22, 36.46, 37.7]
HELIOS += [38.94, 40.18, 41.42, 42.67, 43.91, 45.15]
TOGETHER = [3, 2, 4, *[3] * 4, *[2] * 8, 3, *[3] * 3, 2, 4, 2, 3, 3, 2, 2, 2, 3, 2, 1, 2, 3]
RUBY_LITE = np.repeat([*range(16)] * 2, TOGETHER)
FFEE, TAIL = bytes.fromhex("ffee"), b"\0" * 6

MANUALS = {
    "RS-LiDAR-16": Spinning(
        lambda t: _old(1, t), lambda _: TAIL, FFEE, 32, 12, 0.005, ">",
        lambda k: 2.8 * (k % 16) + 55.5 * (k // 16), 111.0, (0.03825, 0, 0),
    ),
    "RS-LiDAR-32": Spinning(
        lambda t: _old(2, t), lambda _: TAIL, FFEE, 32, 12, 0.005, ">",
        lambda k: 2.88 * (k % 16) + 1.44 * (k // 16) + (1.44 if k % 16 == 15 else 0), 55.52,
        (0.03997, 0, 0),
    ),
    "Bpearl": Spinning(
        lambda t: _old(3, t), lambda _: TAIL, FFEE, 32, 12, 0.005, ">",
        lambda k: 2.56 * (k % 16) + 1.28 * (k // 16) + (5.2 if k % 16 > 7 else 0), 55.52,
        (0.01473, 0, 0.09427),
    ),
    "Helios": Spinning(
        _new, lambda _: TAIL, FFEE, 32, 12, 0.0025, ">", lambda k: HELIOS[k], 55.56,
        (0.03498, 0, 0),
    ),
    "Helios 16P": Spinning(
        _new, lambda _: TAIL, FFEE, 32, 12, 0.0025, ">",
        lambda k: HELIOS[k % 16] + 55.56 * (k // 16), 111.12, (0.03498, 0, 0),
    ),
    "Ruby": Spinning(
        lambda t: (bytes.fromhex("55aa055a") + bytes(6) + _unix(t)).ljust(80, b"\0"),
        lambda _: b"\0" * 4, b"\xfe\x01", 128, 3, 0.005, ">",
        lambda k: 3.236 * (k % 64 // 4), 55.55, (0.03615, 0, 0),
    ),
    "Ruby Lite": Spinning(
        lambda t: (bytes.fromhex("55aa055a") + bytes(6) + _unix(t)).ljust(80, b"\0"),
        lambda _: b"\0" * 192, b"\xfe\x01", 80, 4, 0.005, ">",
        lambda k: 3.236 * RUBY_LITE[k], 55.552, (0.03615, 0, 0),
    ),
    "Airy": Spinning(
        lambda t: _new(t, "000002"), lambda _: b"\0" * 22, FFEE, 48, 8, 0.005, ">",
        lambda k: AIRY[k // 8], 111.08, (0.01002, 0, 0.04532), rows=4,
    ),
    "C16": Spinning(
        lambda _: b"", lambda t: _leishen(0x10, t), FFEE, 32, 12, 0.004, "<",
        lambda k: 3.125 * k, 100.0, (0.0361, -20.25, 0), y_ahead=True,
    ),
    "C32": Spinning(
        lambda _: b"", lambda t: _leishen(0x20, t), FFEE, 32, 12, 0.004, "<",
        lambda k: 1.5625 * k, 50.0, (0.0361, -20.25, 0), y_ahead=True,
    ),
    "C16 v3": Spinning(
        lambda _: b"", lambda t: struct.pack("<IBB", t, 0x37, 0x10), FFEE, 32, 12, 0.0025, "<",
        lambda k: 3.125 * k, 100.0, (0.0431, -14.68, 0), y_ahead=True,
    ),
    "C32 v3": Spinning(
        lambda _: b"", lambda t: struct.pack("<IBB", t, 0x37, 0x20), FFEE, 32, 12, 0.004, "<",
        lambda k: 1.5625 * k, 50.0, (0.0494, -12.98, 0), y_ahead=True,
    ),
}  # fmt: skip


def difop(elevation: list[float], azimuth: list[float], unit: float = 0.01) -> bytes:
    """Write a RoboSense's DIFOP packet: from byte 468 on signs and values."""
    angles = b"".join(
        struct.pack(">BH", each < 0, round(abs(each) / unit)) for each in (*elevation, *azimuth)
    )
    start = bytes.fromhex("a5ff005a11115555")
    return (start.ljust(468, b"\0") + angles).ljust(1248, b"\0")


def together(parts: Iterable[Returns]) -> Returns:
    """Put together what was decoded part by part."""
    first, *others = parts
    columns: Any = zip(first, *others, strict=True)
    found: Any = [None if own[0] is None else np.concatenate(own) for own in columns]
    return Returns(*found)


def as_array(packets: list[bytes]) -> NDArray[np.uint8]:
    """Put packets of one size into an array (N, size)."""
    return np.frombuffer(b"".join(packets), np.uint8).reshape(len(packets), -1)
