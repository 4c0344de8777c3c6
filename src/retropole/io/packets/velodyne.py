"""Packets of Velodynes, decoded by velodyne-decoder (the extra ``velodyne``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...base.errors import MissingExtraError, naming, reported
from ..fields import Columns
from .capture import Datagram
from .sweeps import Sweep

VELODYNE_SIZE, VELODYNE_START = 1206, b"\xff\xee"
"""Bytes of a Velodyne packet of returns, and its first bytes."""

BLOCK_SIZE = 100
"""Bytes of each of the 12 blocks in a Velodyne packet of returns."""


MODELS_BY_BYTE = {0x21: "HDL-32E", 0x22: "VLP-16", 0x28: "VLP-32C", 0xA1: "VLS-128"}
"""Models by the last byte of a packet (manual 63-9243, 9.3.1). A HDL-64E has other things there,
and no return mode before it."""

RETURN_MODES = (0x37, 0x38, 0x39)
"""Byte before the last of a packet: strongest, last, both."""


def is_velodyne(payload: bytes) -> bool:
    """Whether a packet has returns of a Velodyne: its size, and where its blocks begin."""
    # The lower lasers of an HDL-64E have another second byte.
    starts = payload[: 12 * BLOCK_SIZE : BLOCK_SIZE]
    return len(payload) == VELODYNE_SIZE and starts == VELODYNE_START[:1] * 12


def model_of(payload: bytes) -> str:
    """Name the model that sent a packet; empty if it does not say."""
    return MODELS_BY_BYTE.get(payload[-1], "") if payload[-2] in RETURN_MODES else ""


def velodyne_sweeps(path: Path, coming: Callable[[], Iterator[Datagram]] | None) -> Iterator[Sweep]:
    """Decode a capture, or packets of one sensor.

    Parameters
    ----------
    path
        Of the capture.
    coming
        Its packets, where it has more than those of one Velodyne; None if it is to be read by
        velodyne-decoder, which finds out which HDL-64E it is.
    """
    try:
        import velodyne_decoder
    except ImportError:
        raise MissingExtraError("velodyne", "reading Velodyne packets") from None

    with naming(path), reported("capture"):
        if coming is None:
            for stamp, points in velodyne_decoder.read_pcap(path, as_pcl_structs=True):
                yield velodyne_sweep(stamp.host, points)
            return
        decoder = velodyne_decoder.StreamDecoder(velodyne_decoder.Config())
        for each in coming():
            whole = decoder.decode(each.time, each.payload, True)
            if whole is not None:
                yield velodyne_sweep(whole[0].host, whole[1])
        rest = decoder.finish(True)
        if rest is not None:
            yield velodyne_sweep(rest[0].host, rest[1])


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

    return Sweep(stamp, columns, np.zeros(3))
