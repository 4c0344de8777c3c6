"""Points that are one and the same number for number: given twice, or to both LiDARs.

Two measurements never agree to the last digit. What is there twice was measured once: counted twice
it would make an answer surer than it is, and as both clouds a perfect one.
"""

from __future__ import annotations

import numpy as np

from ..datatypes import Array, PointCloud
from ..errors import Refusal
from .ordering import order_of

SAMPLE = 5_000
"""Points of the source, evenly taken, that are looked for in the target."""

MIX = np.uint64(0x9E3779B97F4A7C15)
"""Multiplier of the hash: 2⁶⁴ over the golden ratio, odd (Knuth 1998, TAOCP 3, 6.4)."""

MAX_SHARED = 0.5
"""Largest share of the points that may be the same number for number. Two sweeps of one LiDAR
at rest share what its steps of range leave equal: 9 % with a noise of three steps, 28 % with one
(1 / (2 √π) over the noise in steps)."""


def without_copies(cloud: PointCloud) -> PointCloud:
    """Keep the first of points that are equal number for number within a sweep.

    A LiDAR that is set to report the strongest and the last return gives most points twice.

    Parameters
    ----------
    cloud
        Returned as it is where no point is there twice.
    """
    keys = _keys(cloud.xyz)
    if cloud.frame is not None:
        keys = keys ^ (cloud.frame.astype(np.uint64) * MIX)
    order = order_of(keys)
    ordered = keys[order]
    starts = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1])[: len(ordered)])
    if len(starts) == len(cloud):
        return cloud
    return cloud.select(np.sort(np.minimum.reduceat(order, starts)))


def check_two_recordings(target: PointCloud, source: PointCloud) -> None:
    """Refuse a recording, or parts of it in whatever order, as both target and source.

    Raises
    ------
    Refusal
        ``same_recording``.
    """
    if len(target) == 0 or len(source) == 0:
        return
    part = source.xyz[:: 1 + (len(source) - 1) // SAMPLE]
    keys, ordered = _keys(part), np.sort(_keys(target.xyz))
    place = np.minimum(np.searchsorted(ordered, keys), len(ordered) - 1)
    shared = float(np.mean(ordered[place] == keys))
    if shared > MAX_SHARED:
        raise Refusal(
            "same_recording",
            f"{shared:.0%} of the source's points are, number for number, in the target, too: both "
            "are one recording; give the other LiDAR's",
            {"shared": shared},
        )


def _keys(xyz: Array) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    """(N,) one number for each point, by its bits: unequal ones hardly ever have the same."""
    bits = (np.ascontiguousarray(xyz) + 0.0).view(np.uint64)
    key = np.zeros(len(xyz), dtype=np.uint64)
    for axis in range(3):
        key = (key ^ bits[:, axis]) * MIX
        key ^= key >> np.uint64(32)
    return key
