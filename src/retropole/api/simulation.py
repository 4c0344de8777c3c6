"""`simulate`: two scans of taped poles whose true transform is known."""

from __future__ import annotations

import numpy as np

from ..result import DEFAULT_CONFIG
from ..simulation import SimulatedPair, simulate_pair


def simulate(
    scene: str,
    seed: int = 0,
    *,
    sensor_target: str | None = None,
    sensor_source: str | None = None,
    poles: int = 2,
    radius: float = DEFAULT_CONFIG.radius_m,
    frames: int = 1,
    symmetric: bool = False,
) -> SimulatedPair:
    """Draw a scene with taped poles that two LiDARs see, and scan it.

    Parameters
    ----------
    scene
        ``corridor``, ``street``, ``harbor``, ``bare`` or ``paper``.
    seed
        Of everything random; equal seeds give equal pairs.
    sensor_target, sensor_source
        Names of sensors; None takes the scene's own.
    poles
        How many taped poles.
    radius
        Of the poles, metres.
    frames
        How many sweeps each LiDAR records.
    symmetric
        Make surroundings that do not distinguish the hypotheses.

    Returns
    -------
    SimulatedPair
        Its `target` and `source` are clouds, its `T_target_source` is the truth.

    Raises
    ------
    UsageError
        For an unknown scene or sensor.
    SimulationError
        Where no arrangement is found in which both LiDARs see every pole.
    """
    return simulate_pair(
        scene,
        np.random.default_rng(seed),
        sensor_target=sensor_target,
        sensor_source=sensor_source,
        poles=poles,
        radius=radius,
        frames=frames,
        symmetric=symmetric,
    )
