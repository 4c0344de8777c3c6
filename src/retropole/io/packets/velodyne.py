"""Packets of Velodynes, decoded by velodyne-decoder (the extra ``velodyne``)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ...base.errors import MissingExtraError, naming, reported
from ..fields import Columns
from .sweeps import Sweep

VELODYNE_SIZE, VELODYNE_START = 1206, b"\xff\xee"
"""Bytes of a Velodyne packet of returns, and its first bytes."""

BLOCK_SIZE = 100
"""Bytes of each of the 12 blocks in a Velodyne packet of returns."""


def of_velodyne(packets: Iterator[bytes]) -> tuple[bool, int]:
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


def velodyne_sweeps(path: Path, content: bytes | None) -> Iterator[Sweep]:
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
