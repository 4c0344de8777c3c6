"""The calibration before anyone drives out: poles are put into the recordings, and all is run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..adjustment.answer import SiteCalibration
from ..base.datatypes import Calibration, PointCloud
from ..base.description import Site, SiteLidar
from ..base.uncertainty.purpose import Need
from ..pipeline import calibrate
from ..pipeline_of_sites import calibrate_site
from ..simulation.raycast import Cylinder
from ..simulation.recorded import in_sensor_frame, range_noise, with_poles
from .information import divergences_of
from .place import Station

Rehearsal = Calibration | SiteCalibration
"""What two LiDARs answer, or a site of more."""


def recordings_with(
    stations: Sequence[Station],
    poles: Sequence[Cylinder],
    rng: np.random.Generator,
    *,
    again: bool = False,
) -> list[PointCloud]:
    """Put poles that stand in the place into the recording of each LiDAR.

    The place was recorded once. Recorded `again`, for another placement, its ranges have other
    noise: number for number the same, it would be refused as one recording given twice.
    """
    made = []
    for each, width in zip(stations, divergences_of(stations), strict=True):
        own = in_sensor_frame(poles, each.T)
        biases = np.zeros(int(each.beams.rings.max(initial=0)) + 2)
        cloud, _ = with_poles(each.cloud, each.beams, own, width, each.sensor, rng, biases)
        if again:
            ranges = np.linalg.norm(cloud.xyz, axis=1, keepdims=True)
            noise = range_noise(each.sensor) * rng.normal(size=ranges.shape)
            cloud = replace(cloud, xyz=cloud.xyz * (1.0 + noise / ranges))
        made.append(cloud)
    return made


def rehearse(
    stations: Sequence[Station],
    placements: Sequence[Sequence[Cylinder]],
    radius: float,
    need: Need | None = None,
) -> Rehearsal:
    """Calibrate with the poles of all placements, as if they stood there already."""
    rng = np.random.default_rng(0)
    clouds = [
        recordings_with(stations, poles, rng, again=p > 0) for p, poles in enumerate(placements)
    ]
    by_lidar = list(zip(*clouds, strict=True))
    if len(stations) == 2:
        sensors = stations[0].sensor, stations[1].sensor
        return calibrate(*by_lidar, radius=radius, sensors=sensors, need=need)
    lidars = tuple(
        SiteLidar(each.name, own, sensor=each.sensor)
        for each, own in zip(stations, by_lidar, strict=True)
    )
    names = tuple(str(p + 1) for p in range(len(placements)))
    return calibrate_site(Site("rehearsal", lidars, names, radius=radius, need=need))
