"""A simulated pair once more: its poles put elsewhere, or the same place recorded again."""

from __future__ import annotations

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.simulation import NoiseModel, SimulatedPair, SimulationError
from retropole.simulation.pairs import (
    MAX_DRAWS,
    MAX_POLE_ANGLE,
    MIN_POLE_ANGLE,
    Arrangement,
    Recorders,
    are_in_view,
    record,
    record_every_pole,
)
from retropole.simulation.scenes import draw_paper_poles, draw_poles


def place_again(
    pair: SimulatedPair,
    rng: np.random.Generator,
    *,
    noise: NoiseModel | None = None,
    frames: int = 1,
) -> SimulatedPair:
    """Put the poles of a pair in other places, with the same LiDARs and surroundings.

    Parameters
    ----------
    pair
        From `simulate_pair`; its poles are taken away.
    rng
        As there.
    noise
        As there, but the LiDARs are the pair's and keep their systematic errors; None takes the
        pair's.
    frames
        How many sweeps each LiDAR records.

    Raises
    ------
    SimulationError
        No arrangement was found in `MAX_DRAWS` draws in which both LiDARs see every pole.
    """
    count, radius = len(pair.poles), pair.poles[0].radius
    angles = MIN_POLE_ANGLE, MAX_POLE_ANGLE
    poses = pair.T_world_target, pair.T_world_source
    recorders = Recorders(pair.sensors, pair.devices, noise or pair.noise, frames)
    (for_recording,) = rng.spawn(1)
    for _ in range(MAX_DRAWS):
        standing = (
            draw_poles(rng, count, pair.clear, angles, radius)
            if min(pair.clear) > 0
            else draw_paper_poles(rng, radius)
        )
        if standing is None:
            continue
        at = Arrangement(pair.surroundings, standing, poses, pair.clear)
        if are_in_view(at, recorders, rng):
            return record_every_pole(at, recorders, for_recording)
    raise SimulationError(f"{MAX_DRAWS} draws gave no other place for {count} poles")


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
