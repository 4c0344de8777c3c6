"""LiDARs of a site that hang on one mast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..base.datatypes import Array
from ..hypotheses.scans import SiteScans
from .one_mast import Row, as_one


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

    def shared_by(*lidars: int) -> Sequence[Row] | None:
        """Rows of some LiDARs, brought to one rest; None where they do not sway as one."""
        rows = list(zip(*(by_lidar[k] for k in lidars), strict=True))
        shared = as_one(rows, [poses[k] for k in lidars])
        return None if shared is rows else shared

    left = [
        k
        for k in poses
        if any(scan is not None and scan.motion is not None for scan in by_lidar[k])
    ]
    while left:
        first, *others = left
        pairs = {k: rows for k in others if (rows := shared_by(first, k)) is not None}
        rows = shared_by(first, *pairs) if len(pairs) > 1 else next(iter(pairs.values()), None)
        if rows is not None:
            for k, row in zip((first, *pairs), zip(*rows, strict=True), strict=True):
                by_lidar[k] = row
        left = [k for k in others if k not in pairs]
    return replace(scans, by_lidar=tuple(by_lidar))
