"""When a scene was recorded: two LiDARs that look at other times may look at other scenes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ..base import quantities
from ..base.datatypes import Placement
from ..base.errors import Reason
from ..io.recordings import time_of_recording

MAX_APART = 60.0
"""Recordings that lie further apart than this were made at other times, seconds. Clocks that are
set differ by less: GPS and atomic time by 18 and 37 s from that of computers."""


def recorded_together(placements: Sequence[Placement]) -> bool:
    """Whether both LiDARs recorded every placement at the same time, as far as their clocks say.

    Nobody carries poles between recordings that overlap.
    """
    return all(apart is not None and apart < 0.0 for apart in (_apart(each) for each in placements))


def _apart(placement: Placement) -> float | None:
    """Seconds from the end of one recording to the start of the other; None where not known."""
    target, source = (time_of_recording(scan.cloud) for scan in placement.scans)
    if target is None or source is None:
        return None
    return max(target[0] - source[1], source[0] - target[1])


def other_times(placements: Sequence[Placement]) -> Iterator[Reason]:
    """Tell of placements that the two LiDARs recorded at other times, as far as their clocks say.

    What was moved in between looks the same as another pose.
    """
    for k, placement in enumerate(placements, 1):
        apart = _apart(placement)
        if apart is not None and apart > MAX_APART:
            of = "" if len(placements) == 1 else f" of placement {k}"
            yield Reason(
                "other_times",
                f"by their timestamps the two recordings{of} lie {quantities.duration(apart)} "
                f"apart ({quantities.duration(MAX_APART)} are allowed): the answer is right only "
                "if the poles and the LiDARs stood still in between",
                {"placement": k, "apart_s": apart, "allowed_s": MAX_APART},
            )
