"""How LiDARs swayed while they recorded, as the documents of a pair and of a site hold it."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from ..base.bounded import Count
from ..base.datatypes import Scan
from ..base.systematic import Sway


class SwayDoc(msgspec.Struct, frozen=True, eq=False):
    """How a LiDAR swayed while it recorded a placement: their indices, those of a pair 0 and 1."""

    lidar: Count
    placement: Count
    sway: Sway


def sway_documents(scans: Sequence[Sequence[Scan | None]]) -> list[SwayDoc]:
    """List what swayed of the scans of each LiDAR, one for each placement."""
    return [
        SwayDoc(i, p, scan.sway)
        for i, row in enumerate(scans)
        for p, scan in enumerate(row)
        if scan is not None and scan.sway is not None
    ]
