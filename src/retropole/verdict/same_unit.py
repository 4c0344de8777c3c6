"""Whether both clouds are in another unit than metres, by what poles are in each.

A cloud in feet looks like one in metres, where a pole of 4 cm is as thick as one of 13 cm. So what
was given of the poles tells the unit: where no poles of that radius are seen in metres, but in one
other unit both clouds show them, they are as wide as that, they fit each other and the scenes
agree, the coordinates are in that unit, or the poles are as many times thicker than was said. Which
of both it is, nobody can tell from the clouds: all is then as large as it would be.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import Placement, PointCloud, Scan
from ..base.sensors import SENSORS
from ..base.uncertainty.confirmation import Confirmation
from ..hypotheses.similarity_search import LEAST_CHANGE, find_change
from ..io.beams import guess_sensors, with_beam_origin
from ..io.coordinates import FARTHEST_HALF, NEAREST_HALF, oddity_of
from ..io.fields import METRES, Unit, in_metres
from ..surfaces.scans import find_poles

UNITS_TRIED: tuple[Unit, ...] = ("ft", "in", "cm", "mm")
"""Units that coordinates may be in."""

WIDTHS = 0.75, 2.0
"""Half the width of the returns of a pole, across the beam, of the radius that was given. In the
right unit it was 0.81 to 1.68 of it in 98 simulated clouds, since beams are wide, in another up to
0.70, and 0.71 to 0.94 where poles of 50 mm in metres were read in feet as 20 mm (corridors, streets
and harbors of `benchmarks/units.py`, seeds 0 to 11, and the street that `simulate --seed 1` draws).
"""

WIDTH_QUANTILES = 0.05, 0.95
"""Between these the returns of a pole are counted to its width: one beside it is no matter."""


class PolesInUnit(NamedTuple):
    """A cloud read in another unit, and the poles that it then shows.

    Attributes
    ----------
    unit
        The unit.
    scan
        With two poles or more, which are as wide as their radius.
    half_width
        Of their returns across the beam, metres once read so.
    """

    unit: Unit
    scan: Scan
    half_width: float

    @property
    def radius_before(self) -> float:
        """Radius of these poles as the cloud was read before."""
        return self.half_width / METRES[self.unit]


class InUnit(NamedTuple):
    """Both clouds read in another unit, and what the scene says of how they fit each other."""

    target: PolesInUnit
    source: PolesInUnit
    agreed: Confirmation


def common_unit(
    placement: Placement, radius: float, thresholds: tuple[float | None, float | None]
) -> InUnit | None:
    """Find the one other unit in which both clouds show poles that fit; None where none or two do.

    Parameters
    ----------
    placement
        What was found in metres.
    radius
        Of the poles, metres.
    thresholds
        Intensity from which a return counts as retro-reflective, in each cloud.
    """
    fitting = []
    for unit in UNITS_TRIED:
        target = _read_in(unit, placement.target, thresholds[0], radius)
        source = target and _read_in(unit, placement.source, thresholds[1], radius)
        if target is None or source is None:
            continue
        changed = replace(placement, target=target.scan, source=source.scan)
        fit = find_change(changed, (), is_changed=True)
        # Clouds that are in two units are told by what brings one to the other.
        if fit is not None and abs(np.log(fit[0].change.factor)) <= LEAST_CHANGE:
            fitting.append(InUnit(target, source, fit[0].agreed))
    return fitting[0] if len(fitting) == 1 else None


def unit_of_one(cloud: PointCloud, radius: float) -> PolesInUnit | None:
    """Find the unit of one cloud whose ranges are none in metres, by the poles that it shows in it.

    Poles alone do not tell it of one cloud: in feet, bollards and signs are as thin as poles. Of 72
    clouds in metres without poles, 4 showed two (`benchmarks/units.py`, seeds 1000 to 1035).

    Parameters
    ----------
    cloud
        As it was read.
    radius
        Of the poles, metres.

    Returns
    -------
    PolesInUnit or None
        None where its ranges may be metres, where it shows poles in metres, and where no unit or
        several show some.
    """
    if cloud.intensity is None or (oddity_of(cloud) is None and not beyond_sensors(cloud)):
        return None
    scan = find_poles(cloud, sensor=None, threshold=None, radius=radius)
    if len(scan.poles) > 1:
        return None
    read = [_read_in(unit, scan, None, radius) for unit in UNITS_TRIED]
    fitting = [each for each in read if each is not None]
    return fitting[0] if len(fitting) == 1 else None


def beyond_sensors(cloud: PointCloud) -> float | None:
    """The longest range of all sensors that fit, where 1 % of a cloud lies beyond; else None."""
    sensors = guess_sensors(cloud)
    if not sensors:
        return None
    longest = max(SENSORS[name].max_range for name in sensors)
    ranges = se3.lengths(cloud.xyz - with_beam_origin(cloud).origin)
    return longest if float(np.quantile(ranges, 0.99)) > longest else None


def _read_in(unit: Unit, scan: Scan, threshold: float | None, radius: float) -> PolesInUnit | None:
    """Read a cloud in a unit; None where the place or the poles are then of no likely size."""
    cloud = scan.cloud
    if len(cloud) == 0 or np.abs(cloud.xyz).max() > se3.FARTHEST:
        return None
    half = METRES[unit] * float(np.median(se3.lengths(cloud.xyz - cloud.origin)))
    if not NEAREST_HALF <= half <= FARTHEST_HALF:
        return None
    found = find_poles(
        in_metres(cloud, unit), sensor=scan.sensor, threshold=threshold, radius=radius
    )
    if len(found.poles) < 2:
        return None
    width = _half_width(found)
    is_likely = WIDTHS[0] <= width / radius <= WIDTHS[1]
    return PolesInUnit(unit, found, width) if is_likely else None


def _half_width(scan: Scan) -> float:
    """Half of the width of the returns of the poles, across the beam; the middle one of all."""
    widths = []
    for pole in scan.poles:
        side = np.cross(pole.direction, pole.point - scan.cloud.origin)
        across = (pole.xyz - pole.point) @ (side / np.linalg.norm(side))
        widths.append(float(np.ptp(np.quantile(across, WIDTH_QUANTILES))) / 2)
    return float(np.median(widths))
