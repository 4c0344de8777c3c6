"""Two LiDARs and taped poles in one scene: drawn, recorded, and recorded again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.errors import UsageError
from ..base.sensors import find_sensor
from . import paper
from .arrangement import draw_lidar, draw_poles, rotated_by_180, symmetric_poles
from .devices import TYPICAL, NoiseModel, draw_device
from .raycast import Cylinder
from .recording import (
    MIN_RETURNS,
    MIN_RINGS,
    Arrangement,
    Recorders,
    SimulatedPair,
    SimulationError,
    are_in_view,
    record,
    record_every_pole,
)
from .scenes import SURROUNDINGS

SCENES = (*SURROUNDINGS, "paper")
"""Names of the scenes; ``paper`` is the set-up of Xue et al. 2019 without surroundings."""

DEFAULT_SENSORS = {
    "corridor": ("XT32", "VLP-16"),
    "street": ("Pandar64", "OS1"),
    "harbor": ("Pandar64", "HDL-32E"),
    "bare": ("Pandar64", "HDL-32E"),
    "square": ("VLP-32C", "VLP-32C"),
    "camber": ("VLP-32C", "VLP-16"),
    "kerb": ("VLP-32C", "VLP-16"),
    "paper": ("VLP-16", "VLP-16"),
}
"""Target and source sensor of each scene; the paper's are its own, the others chosen."""

MIN_POLE_ANGLE, MAX_POLE_ANGLE = float(np.radians(15.0)), float(np.radians(60.0))
"""Between any two poles, rad: nearly parallel poles determine no pose, and people do not lean poles
further (chosen)."""

LIDAR_SPACING = 0.5, 6.0
"""Least and greatest distance between the two LiDARs, metres (chosen)."""

MAX_DRAWS = 400
"""Draws of an arrangement before a `SimulationError`; in 30 seeds no scene needed more than 32."""


def simulate_pair(
    scene: str,
    rng: np.random.Generator,
    *,
    sensor_target: str | None = None,
    sensor_source: str | None = None,
    poles: int = 2,
    radius: float = paper.PAPER_RADIUS,
    min_pole_angle: float = MIN_POLE_ANGLE,
    max_pole_angle: float = MAX_POLE_ANGLE,
    noise: NoiseModel | None = None,
    symmetric: bool = False,
    frames: int = 1,
) -> SimulatedPair:
    """Draw a scene with taped poles that two LiDARs see, and scan it.

    Parameters
    ----------
    scene
        One of `SCENES`. ``paper`` always has the two poles of Xue et al. 2019.
    rng
        Source of everything random; equal generators give equal pairs.
    sensor_target, sensor_source
        Names of sensors; None takes the scene's own.
    poles
        How many taped poles. 0 leaves those away that 2 would stand there: the same place, recorded
        before the poles are set up.
    radius
        Of the poles, metres.
    min_pole_angle, max_pole_angle
        Between any two poles, rad.
    noise
        How the scans differ from exact geometry; None takes `TYPICAL`, and for ``paper`` the
        paper's noise.
    symmetric
        Make surroundings and two poles that a rotation by 180° about the vertical maps onto
        themselves, so that nothing distinguishes the hypotheses.
    frames
        How many sweeps each LiDAR records.

    Raises
    ------
    UsageError
        An unknown scene or sensor.
    SimulationError
        No arrangement was found in `MAX_DRAWS` draws in which both LiDARs see every pole.
    """
    if scene not in SCENES:
        raise UsageError(f"no scene is called {scene!r}; there are {', '.join(SCENES)}")
    if poles == 0 and scene == "paper":
        raise UsageError("the paper's set-up has nothing but its poles")
    names = DEFAULT_SENSORS[scene]
    sensors = (find_sensor(sensor_target or names[0]), find_sensor(sensor_source or names[1]))
    if noise is None:
        noise = paper.PAPER_NOISE if scene == "paper" else TYPICAL
    # The arrangement comes from rng alone, all that the noise model changes from its children.
    *for_devices, for_recording = rng.spawn(3)
    target, source = (
        draw_device(sensor, noise, own) for sensor, own in zip(sensors, for_devices, strict=True)
    )
    recorders = Recorders(sensors, (target, source), noise, frames)
    for _ in range(MAX_DRAWS):
        at = (
            Arrangement([], paper.draw_poles(rng, radius), paper.lidar_poses(), (0.0, 0.0))
            if scene == "paper"
            else _draw(scene, rng, poles or 2, (min_pole_angle, max_pole_angle), radius, symmetric)
        )
        if at is not None and are_in_view(at, recorders, rng):
            if poles == 0:
                return record(replace(at, poles=()), recorders, for_recording)
            return record_every_pole(at, recorders, for_recording)
    raise SimulationError(
        f"{MAX_DRAWS} draws of {scene!r} gave none where {sensors[0].name} and {sensors[1].name} "
        f"both see {poles or 2} poles with {MIN_RETURNS} returns on {MIN_RINGS} rings"
    )


def _draw(
    scene: str,
    rng: np.random.Generator,
    poles: int,
    angles: tuple[float, float],
    radius: float,
    symmetric: bool,
) -> Arrangement | None:
    """Draw surroundings, poles and LiDARs; None where this draw has none."""
    place = SURROUNDINGS[scene](rng)
    if min(place.clear) <= 0:
        return None
    surfaces = place.surfaces
    if symmetric:
        surfaces = [*surfaces, *rotated_by_180(surfaces)]
        standing: list[Cylinder] | None = symmetric_poles(rng, radius)
    else:
        standing = draw_poles(rng, poles, place.clear, angles, radius)
    if standing is None:
        return None
    target, source = (draw_lidar(rng, standing, place.clear) for _ in range(2))
    if target is None or source is None:
        return None
    apart = np.linalg.norm(target[:3, 3] - source[:3, 3])
    if not LIDAR_SPACING[0] <= apart <= LIDAR_SPACING[1]:
        return None
    return Arrangement(surfaces, standing, (target, source), place.clear)


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
            else paper.draw_poles(rng, radius)
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
