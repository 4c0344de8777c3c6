"""A recording searched for poles, without what moved."""

from __future__ import annotations

import numpy as np

from ..base.datatypes import PointCloud, Scan
from ..base.errors import Refusal
from ..base.quantities import counted
from ..base.sensors import LITTLE, SWEEP_SECONDS, Sensor
from ..extraction.extent import located
from ..extraction.poles import extract_poles
from .static import remove_dynamic_points, without_copies
from .sway import steadied

SWEEP = 50_000
"""Largest number of returns of one sweep of a LiDAR that does not repeat its pattern."""


def why_few_poles(scan: Scan) -> str:
    """Say why a scan shows too few poles, other than their tape; empty if unknown.

    What shines in no place is not tape, whatever the threshold; and one sweep of a LiDAR that does
    not repeat its pattern has too few returns on a pole.
    """
    cloud, found, sensor = scan.cloud, scan.detection, scan.sensor
    if found is not None and found.threshold_source.endswith(LITTLE):
        return (
            "nothing there is distinctly brighter than the rest: wrap the tape, or record the "
            "intensity as the LiDAR measures it"
        )
    if sensor is None:
        if cloud.frame is not None or len(cloud) > SWEEP or cloud.ring is not None:
            return ""
        return "one sweep of a LiDAR without rings shows little of a pole: record some seconds"
    sweeps = 1 if cloud.frame is None else len(np.unique(cloud.frame))
    # Sweeps may have been put together before.
    if max(sweeps, len(cloud) / sensor.points) >= sensor.sweeps:
        return ""
    return (
        f"{counted(sweeps, 'sweep')} of the {sensor.name}, too few to show a pole well: record "
        f"{sensor.seconds:g} s or more, {round(sensor.seconds / SWEEP_SECONDS)} sweeps"
    )


def find_poles(
    cloud: PointCloud,
    *,
    sensor: Sensor | None,
    threshold: float | None,
    radius: float,
    search: bool = True,
    mast_sway: float | None = None,
) -> Scan:
    """Find the poles in a cloud, if requested; of several frames, without what moved, at rest.

    `mast_sway` is 1 σ of the angle that the LiDAR's mast is said to sway by, rad.

    Never raises a refusal: the scan stores it, and `static.check_poles` raises it, so that what was
    found in other scans is not lost. A map is taken as it is.
    """
    if cloud.is_map:
        return Scan(cloud, sensor)
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
