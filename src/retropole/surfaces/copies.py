"""Points that are one and the same number for number: given twice, or to both LiDARs.

Two measurements never agree to the last digit. What is there twice was measured once: counted twice
it would make an answer surer than it is, and as both clouds a perfect one.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from ..base.datatypes import Array, BoolArray, IntArray, Placement, PointCloud
from ..base.errors import Refusal
from .ordering import numbered, order_of
from .registration import SAMPLE

MIX = np.uint64(0x9E3779B97F4A7C15)
"""Multiplier of the hash: 2⁶⁴ over the golden ratio, odd (Knuth 1998, TAOCP 3, 6.4)."""

MAX_SHARED = 0.5
"""Largest share of the points that may be the same number for number. Two sweeps of one LiDAR
at rest share what its steps of range leave equal: 9 % with a noise of three steps, 28 % with one
(1 / (2 √π) over the noise in steps)."""

Keys = np.ndarray[tuple[int], np.dtype[np.uint64]]


def without_copies(cloud: PointCloud) -> PointCloud:
    """Keep the first of points that are equal number for number within a sweep, and of sweeps that
    are equal as a whole.

    A LiDAR that is set to report the strongest and the last return gives most points twice. One
    never gives a sweep twice: who repeats it has recorded no more.

    Parameters
    ----------
    cloud
        Returned as it is where no point is there twice.
    """
    keys = _keys(cloud.xyz)
    if cloud.frame is not None:
        repeated = _repeated(keys, cloud.frame)
        if repeated.any():
            cloud, keys = cloud.select(~repeated), keys[~repeated]
        assert cloud.frame is not None
        keys = keys ^ (cloud.frame.astype(np.uint64) * MIX)
    ordered = np.sort(keys)
    if not (ordered[1:] == ordered[:-1]).any():
        return cloud
    order = order_of(keys)
    starts = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))
    return cloud.select(np.sort(np.minimum.reduceat(order, starts)))


def _repeated(keys: Keys, frame: IntArray) -> BoolArray:
    """Find the points (N,) of sweeps whose points are those of a sweep before, in any order."""
    frames, own = numbered(frame)
    sums = np.zeros(len(frames), np.uint64)
    np.add.at(sums, own, keys * MIX)
    both = np.stack([np.bincount(own).astype(np.uint64), sums], axis=1)
    first = np.unique(both, axis=0, return_index=True)[1]
    return ~np.isin(own, first)


def check_recordings(placements: Sequence[Placement]) -> None:
    """Refuse a recording, or a part of it in whatever order, that is given twice.

    It may be both target and source, or be in two placements.

    Raises
    ------
    Refusal
        ``same_recording``.
    """
    scans = [
        (k, lidar, scan.cloud.xyz)
        for k, placement in enumerate(placements, 1)
        for lidar, scan in (("target", placement.target), ("source", placement.source))
        if len(scan.cloud)
    ]
    # Equal points have equal hashes: a sample by the hash is one of the same points of all clouds.
    fewest = min((len(xyz) for _, _, xyz in scans), default=0)
    most = np.uint64(np.iinfo(np.uint64).max // max(fewest // SAMPLE, 1))
    each = [(k, lidar, _sampled(_keys(xyz), most)) for k, lidar, xyz in scans]
    for (k, first, of_first), (n, second, of_second) in combinations(each, 2):
        shared = max(_shared(of_first, of_second), _shared(of_second, of_first))
        if shared <= MAX_SHARED:
            continue
        several = len(placements) > 1
        names = (
            f"the {first}{f' of placement {k}' if several else ''}",
            f"the {second}{f' of placement {n}' if several else ''}",
        )
        raise Refusal(
            "same_recording",
            f"{names[0]} and {names[1]} are one recording: {shared:.0%} of the points of one are, "
            f"number for number, in the other, too; {what_to_give(k, n)}",
            {"shared": shared},
        )


def what_to_give(first: int, second: int) -> str:
    """Say what to give instead where recordings of two placements, or of one, are the same."""
    if first == second:
        return "give the recording of one LiDAR as TARGET and that of the other as SOURCE"
    return "give each placement recordings of its own, made after the poles were moved"


def _sampled(keys: Keys, most: np.uint64) -> Keys:
    """Those that are no larger, sorted; all where that is none."""
    kept = keys[keys <= most]
    return np.sort(kept if len(kept) else keys)


def _shared(part: Keys, whole: Keys) -> float:
    """Share of the first keys that are among the second, both sorted."""
    place = np.minimum(np.searchsorted(whole, part), len(whole) - 1)
    return float(np.mean(whole[place] == part))


def _keys(xyz: Array) -> Keys:
    """(N,) one number for each point, by its bits: unequal ones hardly ever have the same."""
    key = np.zeros(len(xyz), dtype=np.uint64)
    for column in xyz.T:
        # No zero is negative then.
        key ^= (column + 0.0).view(np.uint64)
        key *= MIX
        key ^= key >> np.uint64(32)
    return key
