"""Coordinates that cannot be metres about a LiDAR: in another unit, or in the frame of a map.

Nothing is converted unasked. A cloud in feet looks like one in metres; a cloud in millimetres or
centimetres has ranges that no LiDAR measures in metres, and one in the frame of a map lies in a
heap far from its origin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..base.datatypes import PointCloud
from ..base.se3 import lengths
from .beams import with_beam_origin, with_trusted_rings
from .fields import METRES, NAMES, SMALL, Unit

SAMPLE = 20_000
"""Points, evenly taken, whose ranges are looked at."""

FARTHEST_HALF = 100.0
"""Half of the returns lie within this of the LiDAR, metres: no pole is seen beyond it, and the
medians of 18 real recordings are 1.2 to 26 m."""

FARTHEST_RETURN, NEAREST_HALF = 300.0, 1.0
"""A unit is possible where all but 1 % of the returns lie within the first of the LiDAR, metres,
and half of them beyond the second: the longest range of the table of sensors is 245 m."""

NEAREST_PLACE = 0.5
"""Where all but 5 % of the returns are nearer than this, metres, there is no place around the LiDAR
to set up poles in; a lone sensor's shortest range is 0.05 to 1 m."""


@dataclass(frozen=True)
class Oddity:
    """What is odd about the coordinates of a cloud, in words, and the units that would explain it.

    `half` is the range within which half of the points are, as the file counts. `units` is empty
    for coordinates of a map, and for those that no unit explains.
    """

    text: str
    half: float
    units: tuple[Unit, ...] = ()
    is_map: bool = False
    is_tiny: bool = False

    @property
    def candidates(self) -> str:
        """The units in words, and what half of the ranges would be in each."""
        return " or ".join(f"{NAMES[u]} ({self.half * METRES[u]:.2g} m)" for u in self.units)


def oddity_of(cloud: PointCloud) -> Oddity | None:
    """State why coordinates cannot be metres about the LiDAR; None if they can.

    A hint, and no proof: a LiDAR of long range on open ground may look the same.

    Parameters
    ----------
    cloud
        In any frame; where its rings show where the beams start, that is taken.
    """
    if len(cloud) == 0:
        return None
    half, most, farthest = _ranges(cloud)
    if most > NEAREST_PLACE and half <= FARTHEST_HALF:
        return None
    cloud = with_beam_origin(with_trusted_rings(cloud))
    half, most, farthest = _ranges(cloud)
    if most <= NEAREST_PLACE:
        return Oddity(
            f"95 % of the points are within {most:.2g} m of the origin, too near for "
            "poles: the coordinates are not metres, or the given unit is wrong",
            half,
            is_tiny=True,
        )
    if half <= FARTHEST_HALF:
        return None
    if _is_heap(cloud):
        las = cloud.source.lower().endswith((".las", ".laz"))
        return Oddity(
            f"all points are close together {half:,.0f} m from the origin, as in the frame of a "
            "map; "
            + ("a LAS file does not store" if las else "the file does not store")
            + " where the LiDAR was, so that the origin of the beams is unknown",
            half,
            is_map=True,
        )
    units = tuple(
        unit
        for unit in SMALL
        if NEAREST_HALF <= half * METRES[unit] <= FARTHEST_HALF
        and farthest * METRES[unit] <= FARTHEST_RETURN
    )
    if not units:
        text = f"half of the points are beyond {half:,.0f} m, farther than poles can be seen"
        return Oddity(text, half)
    text = f"half of the points are beyond {half:,.0f}, too far for a LiDAR if these are metres"
    odd = Oddity(text, half, units)
    return replace(odd, text=f"{text}: they look like {odd.candidates}")


def _ranges(cloud: PointCloud) -> tuple[float, float, float]:
    """Ranges within which 50, 95 and 99 % of the points are."""
    part = slice(None, None, 1 + (len(cloud) - 1) // SAMPLE)
    found = np.quantile(lengths(cloud.xyz[part] - cloud.origin), [0.5, 0.95, 0.99])
    return float(found[0]), float(found[1]), float(found[2])


def _is_heap(cloud: PointCloud) -> bool:
    part = cloud.xyz[:: 1 + (len(cloud) - 1) // SAMPLE]
    middle = np.median(part, axis=0)
    spread = float(np.quantile(lengths(part - middle), 0.9))
    away = float(np.linalg.norm(middle - cloud.origin))
    # From a LiDAR, points lie around it, or before it and as wide as they are far.
    return away > (3.0 if spread <= FARTHEST_RETURN else 30.0) * spread
