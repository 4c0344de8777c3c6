"""`simulate` and `insert`: scans of taped poles whose true transform is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..datatypes import MAX_POLES, Array
from ..errors import UsageError
from ..export import read_transform
from ..result import DEFAULT_CONFIG
from ..simulation import NOISE_MODELS, InsertedPair, SimulatedPair, insert_poles, simulate_pair
from .inputs import CloudSource, check_radius, read_input


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
    nuisances: str | None = None,
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
    nuisances
        What the recordings suffer from: ``field``, ``typical`` or ``none``
        (`retropole.simulation.noise`); None takes ``typical``, and for ``paper`` the paper's noise.

    Returns
    -------
    SimulatedPair
        Its `target` and `source` are clouds, its `T_target_source` is the truth.

    Raises
    ------
    UsageError
        For an unknown scene, sensor or set of nuisances, and for poles that nobody has.
    SimulationError
        Where no arrangement is found in which both LiDARs see every pole.
    """
    if nuisances is not None and nuisances not in NOISE_MODELS:
        raise UsageError(f"no nuisances {nuisances!r}; there are {', '.join(NOISE_MODELS)}")
    _check_poles(poles, radius)
    return simulate_pair(
        scene,
        np.random.default_rng(seed),
        sensor_target=sensor_target,
        sensor_source=sensor_source,
        poles=poles,
        radius=radius,
        noise=None if nuisances is None else NOISE_MODELS[nuisances],
        frames=frames,
        symmetric=symmetric,
    )


def insert(
    target: CloudSource,
    source: CloudSource,
    transform: str | Path | Array,
    seed: int = 0,
    *,
    sensors: tuple[str, str] = ("auto", "auto"),
    poles: int = 2,
    radius: float = DEFAULT_CONFIG.radius_m,
) -> InsertedPair:
    """Put taped poles into two real recordings, along the recordings' own beams.

    Parameters
    ----------
    target, source
        Files, clouds or arrays, each in its sensor's frame. The z axis of the target points up.
    transform
        ``T_target_source``, (4, 4), or a file that `export.read_transform` reads.
    seed
        Of everything random; equal seeds give equal pairs.
    sensors
        Names of the sensors of the target and the source; ``auto`` where they are not known.
    poles
        How many taped poles.
    radius
        Of the poles, metres.

    Returns
    -------
    InsertedPair
        Its `target` and `source` are clouds, its `T_target_source` is the given transform.

    Raises
    ------
    ReadError, UsageError
        For a file that cannot be read, an unknown sensor, and poles that nobody has.
    SimulationError
        Where no poles are found that both LiDARs see on the ground of the recordings.
    """
    _check_poles(poles, radius)
    given = read_input(target, sensor=sensors[0]), read_input(source, sensor=sensors[1])
    if isinstance(transform, str | Path):
        transform = read_transform(Path(transform)).T_parent_child
    return insert_poles(
        given[0].cloud,
        given[1].cloud,
        np.asarray(transform, dtype=float),
        np.random.default_rng(seed),
        sensors=(given[0].sensor, given[1].sensor),
        poles=poles,
        radius=radius,
    )


def _check_poles(poles: int, radius: float) -> None:
    """Refuse numbers and radii of poles that nobody has."""
    if not 1 <= poles <= MAX_POLES:
        raise UsageError(f"poles is {poles}, expected a number from 1 to {MAX_POLES}")
    check_radius(radius)
