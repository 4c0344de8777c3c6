"""A recording searched for poles, without what moved."""

from __future__ import annotations

from ..base.datatypes import PointCloud, Scan
from ..base.errors import Refusal
from ..base.sensors import Sensor
from ..extraction.extent import located
from ..extraction.poles import extract_poles
from .copies import without_copies
from .static import remove_dynamic_points
from .sway import steadied


def find_poles(
    cloud: PointCloud,
    *,
    sensor: Sensor | None,
    threshold: float | None,
    radius: float,
    search: bool = True,
    mast_sway: float | None = None,
) -> Scan:
    """Find the poles in a cloud, if asked to; of several frames, without what moved, at rest.

    `mast_sway` is 1 σ of the angle that the LiDAR's mast is said to sway by, rad.

    Never raises a refusal: the scan holds it, and `static.check_poles` raises it, so that what was
    found elsewhere is not lost.
    """
    sway = motion = None
    try:
        cloud = remove_dynamic_points(located(without_copies(cloud), radius))
        cloud, sway, motion = steadied(cloud, mast_sway)
        if not search:
            return Scan(cloud, sensor, sway=sway, motion=motion)
        detection = extract_poles(cloud, sensor=sensor, threshold=threshold, radius=radius)
    except Refusal as refusal:
        return Scan(cloud, sensor, None, refusal, sway, motion)
    return Scan(cloud, sensor, detection, sway=sway, motion=motion)
