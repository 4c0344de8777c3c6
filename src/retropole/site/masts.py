"""LiDARs of a site that hang on one mast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..base.datatypes import Array
from ..scene.one_mast import Row, as_one
from .scans import SiteScans


def with_masts(scans: SiteScans, poses: Mapping[int, Array]) -> SiteScans:
    """Bring LiDARs that sway as one to rest as one.

    Parameters
    ----------
    scans
        Of all LiDARs.
    poses
        (4, 4) of those that are linked, to a few degrees.
    """
    by_lidar = list(scans.by_lidar)

    def asked(lidars: Sequence[int]) -> tuple[Sequence[Row], Sequence[Row]]:
        """Rows of some LiDARs, and the same brought to one rest."""
        rows = list(zip(*(by_lidar[k] for k in lidars), strict=True))
        return rows, as_one(rows, [poses[k] for k in lidars])

    def is_shared(first: int, other: int) -> bool:
        rows, moved = asked((first, other))
        return moved is not rows

    open_ = [
        k
        for k in poses
        if any(scan is not None and scan.motion is not None for scan in by_lidar[k])
    ]
    while open_:
        first, *others = open_
        mast = [first, *(k for k in others if is_shared(first, k))]
        if len(mast) > 1:
            _, moved = asked(mast)
            for k, row in zip(mast, zip(*moved, strict=True), strict=True):
                by_lidar[k] = tuple(row)
        open_ = [k for k in others if k not in mast]
    return replace(scans, by_lidar=tuple(by_lidar))
