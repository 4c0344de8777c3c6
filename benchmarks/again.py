"""The place of a simulated pair, recorded again."""

from __future__ import annotations

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.simulation import NoiseModel, SimulatedPair
from retropole.simulation.pairs import (
    Arrangement,
    Recorders,
    record,
)


def record_again(
    pair: SimulatedPair,
    rng: np.random.Generator,
    *,
    moved: Array | None = None,
    poles: bool = True,
    noise: NoiseModel | None = None,
    frames: int = 1,
) -> SimulatedPair:
    """Record the same place again with the same LiDARs, after the source was moved.

    Parameters
    ----------
    pair
        From `simulate_pair`; everything in its scene stays, and the LiDARs keep their systematic
        errors. Only people and plants are elsewhere.
    rng
        As there.
    moved
        (6,) step ``[φ, δ]`` of the source's pose in the target's frame (`se3.retract`), rad and m;
        None leaves it where it was.
    poles
        Whether the taped poles still stand.
    noise
        As in `place_again`.
    frames
        How many sweeps each LiDAR records.
    """
    T = pair.T_target_source if moved is None else se3.retract(pair.T_target_source, moved)
    poses = pair.T_world_target, pair.T_world_target @ T
    at = Arrangement(pair.surroundings, pair.poles if poles else (), poses, pair.clear)
    recorders = Recorders(pair.sensors, pair.devices, noise or pair.noise, frames)
    return record(at, recorders, rng)
