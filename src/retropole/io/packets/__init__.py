"""Packets as a sensor sends them, in a .pcap: Velodyne and Ouster.

Frames are sweeps; the first and the last may be incomplete.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from ...base.errors import ReadError, naming, reported
from ..fields import frame_from_columns, noted
from ..recordings import Frame, Recording
from .capture import mended, packets, sizes_in_words, walk
from .ouster import metadata_beside, sweeps_of_capture
from .velodyne import of_velodyne, velodyne_sweeps

PACKETS = (".pcap",)
"""Suffixes of packet captures."""

CAPTURES = (*PACKETS, ".pcapng", ".cap")
"""Suffixes that captures have, also those that may be of a format that is not read."""


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
    velodyne, unreadable = of_velodyne(packets(path, capture))
    note = capture.note(unreadable)
    if velodyne:
        content = mended(path, capture) if len(capture.gaps) else None
        read = partial(velodyne_sweeps, path, content)
    else:
        read = partial(sweeps_of_capture, path, metadata_beside(path, sizes_in_words(capture)))
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
