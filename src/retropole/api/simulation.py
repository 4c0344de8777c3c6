"""`simulate`: scans of taped poles whose true transform is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..base.datatypes import MAX_POLES
from ..base.errors import UsageError
from ..base.sensors import SWEEP_SECONDS
from ..result import DEFAULT_CONFIG, RunConfig
from ..simulation import (
    NOISE_MODELS,
    NoiseModel,
    SimulatedPair,
    SimulatedSite,
    SimulatedWalk,
    Survey,
    simulate_pair,
)
from ..simulation import simulate_site as draw_site
from ..simulation import simulate_walk as draw_walk
from ..simulation import write_pair as write_pair
from ..simulation import write_site as write_site
from ..simulation import write_walk as write_walk
from ..simulation.scenes import SURROUNDINGS
from .options import checked_options


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
        Names of sensors; None takes those of the scene.
    poles
        How many taped poles; 0 for the scene of 2 before they are set up.
    radius
        Of the poles, metres.
    frames
        How many sweeps each LiDAR records.
    symmetric
        Make surroundings that do not distinguish the hypotheses.
    nuisances
        What the recordings suffer from: ``field``, ``typical`` or ``none``
        (`retropole.simulation.devices`); None takes ``typical``, and for ``paper`` the noise of the
        paper.

    Returns
    -------
    SimulatedPair
        Its `target` and `source` are clouds, its `T_target_source` is the truth.

    Raises
    ------
    UsageError
        For an unknown scene, sensor or set of nuisances, and for poles that nobody has.
    SimulationError
        If no arrangement is found in which both LiDARs see every pole.
    """
    noise = None if nuisances is None else _noise(nuisances)
    if not 0 <= poles <= MAX_POLES:
        raise UsageError(f"poles is {poles}, expected a number from 0 to {MAX_POLES}")
    checked_options(RunConfig(radius_m=radius))
    return simulate_pair(
        scene,
        np.random.default_rng(seed),
        sensor_target=sensor_target,
        sensor_source=sensor_source,
        poles=poles,
        radius=radius,
        noise=noise,
        frames=frames,
        symmetric=symmetric,
    )


def simulate_walk(
    scene: str,
    seed: int = 0,
    *,
    sensor_target: str | None = None,
    sensor_source: str | None = None,
    radius: float = DEFAULT_CONFIG.radius_m,
    frames: int = 400,
    lidars: int = 2,
    nuisances: str | None = None,
) -> SimulatedWalk:
    """Draw a place where a person carries one taped pole before two LiDARs or more.

    Parameters
    ----------
    scene, seed, sensor_target, sensor_source, radius, frames, nuisances
        As `simulate` takes them, but for the scene of the paper. Without their names, both LiDARs
        are a VLP-16.
    lidars
        How many there are: a third and more are of the source's model.

    Raises
    ------
    UsageError
        As `simulate`.
    SimulationError
        If no arrangement is found in which both LiDARs see the walk.
    """
    if scene not in SURROUNDINGS:
        raise UsageError(f"no walk in {scene!r}; there are {', '.join(SURROUNDINGS)}")
    checked_options(RunConfig(radius_m=radius))
    return draw_walk(
        scene,
        np.random.default_rng(seed),
        seconds=SWEEP_SECONDS * frames,
        sensors=[sensor_target or "VLP-16", *(lidars - 1) * [sensor_source or "VLP-16"]],
        noise=_noise(nuisances or "typical"),
        radius=radius,
    )


def simulate_site(
    kind: str,
    seed: int = 0,
    *,
    lidars: int = 4,
    placements: int | None = None,
    poles: int | None = None,
    sensors: Sequence[str] = (),
    radius: float = DEFAULT_CONFIG.radius_m,
    nuisances: str = "typical",
    survey: bool = False,
    frames: int = 1,
) -> SimulatedSite:
    """Draw a site of several LiDARs with taped poles, and scan it.

    Parameters
    ----------
    kind
        ``posts``, ``crane``, ``truck`` or ``ring``.
    seed, radius, nuisances
        As `simulate` takes them.
    lidars
        How many.
    placements, poles
        How many placements, and poles in each; None takes as many as the kind needs.
    sensors
        Names of sensors, used in turn; none takes those of the kind.
    survey
        Survey the poles of the first placement and four control points.
    frames
        How many sweeps each LiDAR records.

    Raises
    ------
    UsageError
        For an unknown kind, sensor or set of nuisances, and numbers that the kind does not have.
    SimulationError
        If no arrangement is found in which poles link all LiDARs.
    """
    return draw_site(
        kind,
        np.random.default_rng(seed),
        lidars=lidars,
        placements=placements,
        poles=poles,
        sensors=sensors or None,
        radius=radius,
        noise=_noise(nuisances),
        survey=Survey(placements=(0,), points=4) if survey else None,
        frames=frames,
    )


def _noise(nuisances: str) -> NoiseModel:
    """Find the noise model of a name, or raise a `UsageError`."""
    if nuisances not in NOISE_MODELS:
        raise UsageError(f"no nuisances {nuisances!r}; there are {', '.join(NOISE_MODELS)}")
    return NOISE_MODELS[nuisances]
