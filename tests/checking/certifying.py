"""Four poles before two LiDARs, as both recorded them."""

from functools import cache

import numpy as np

from retropole.base.datatypes import Placement
from retropole.simulation import TYPICAL, SimulatedPair, simulate_pair
from retropole.surfaces.scans import find_poles

RADIUS = 0.02


@cache
def four_poles(seed: int = 5, frames: int = 3, poles: int = 4) -> SimulatedPair:
    return simulate_pair(
        "corridor",
        np.random.default_rng(seed),
        sensor_target="XT32",
        sensor_source="XT32",
        poles=poles,
        noise=TYPICAL,
        frames=frames,
    )


def found_in(pair: SimulatedPair) -> Placement:
    target, source = (
        find_poles(cloud, sensor=sensor, threshold=None, radius=RADIUS)
        for cloud, sensor in zip((pair.target, pair.source), pair.sensors, strict=True)
    )
    return Placement(target, source)
