"""Two LiDARs and taped poles in one scene: drawn, recorded, and recorded again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import se3
from ..datatypes import Array, BoolArray, IntArray, PointCloud
from ..errors import RetropoleError, UsageError
from ..sensors import Sensor, find_sensor
from . import paper
from .raycast import Cylinder, Surface
from .scanning import TYPICAL, LabelledScan, NoiseModel, scan
from .scenes import SURROUNDINGS, draw_lidar, draw_poles, rotated_by_180, symmetric_poles

SCENES = (*SURROUNDINGS, "paper")
"""Names of the scenes; ``paper`` is the set-up of Xue et al. 2019 without surroundings."""

DEFAULT_SENSORS = {
    "corridor": ("XT32", "VLP-16"),
    "street": ("Pandar64", "OS1"),
    "harbor": ("Pandar64", "HDL-32E"),
    "bare": ("Pandar64", "HDL-32E"),
    "paper": ("VLP-16", "VLP-16"),
}
"""Target and source sensor of each scene; the paper's are its own, the others chosen."""

MIN_POLE_ANGLE, MAX_POLE_ANGLE = float(np.radians(15.0)), float(np.radians(60.0))
"""Between any two poles, rad: nearly parallel poles determine no pose, and people do not lean poles
further (chosen)."""

MIN_RETURNS, MIN_RINGS = 6, 3
"""A LiDAR sees a pole with at least so many returns on so many rings: fewer give no line."""

LIDAR_SPACING = 0.5, 6.0
"""Least and greatest distance between the two LiDARs, metres (chosen)."""

MAX_DRAWS = 400
"""Draws of an arrangement before a `SimulationError`; in 30 seeds no scene needed more than 32."""


class SimulationError(RetropoleError):
    """No arrangement of poles and LiDARs was found that meets the demands."""


@dataclass(frozen=True, eq=False)
class SimulatedPair:
    """Two scans and the truth about them.

    Attributes
    ----------
    target, source
        Clouds, each in its sensor's frame.
    T_target_source, T_world_target, T_world_source
        (4, 4) true poses.
    surfaces
        Everything in the scene, in the world frame; the poles come last.
    poles
        The taped poles.
    labels
        For the target and the source, the index of the surface that each point lies on.
    returns_on_poles
        Per pole, how many points the target and the source have on it.
    sensors
        The two models.
    clear
        Half extents of the ground around the world's origin where poles may stand, metres.
    """

    target: PointCloud
    source: PointCloud
    T_target_source: Array
    T_world_target: Array
    T_world_source: Array
    surfaces: tuple[Surface, ...]
    poles: tuple[Cylinder, ...]
    labels: tuple[IntArray, IntArray]
    returns_on_poles: tuple[tuple[int, int], ...]
    sensors: tuple[Sensor, Sensor]
    clear: tuple[float, float] = (0.0, 0.0)

    @property
    def surroundings(self) -> tuple[Surface, ...]:
        """Everything but the poles."""
        return self.surfaces[: len(self.surfaces) - len(self.poles)]

    @property
    def sees_every_pole(self) -> bool:
        """Whether both LiDARs see every pole, with `MIN_RETURNS` on `MIN_RINGS`."""
        first = len(self.surroundings)
        return all(
            _sees(cloud, labels == first + k)
            for cloud, labels in zip((self.target, self.source), self.labels, strict=True)
            for k in range(len(self.poles))
        )


def _sees(cloud: PointCloud, on_pole: BoolArray) -> bool:
    """Whether a pole's points in a cloud are enough to find it."""
    count = int(np.count_nonzero(on_pole))
    rings = count if cloud.ring is None else len(np.unique(cloud.ring[on_pole]))
    return count >= MIN_RETURNS and rings >= MIN_RINGS


def _record(
    surroundings: Sequence[Surface],
    poles: Sequence[Cylinder],
    poses: tuple[Array, Array],
    sensors: tuple[Sensor, Sensor],
    rng: np.random.Generator,
    noise: NoiseModel,
    frames: int,
) -> SimulatedPair:
    """Scan a scene from the poses (4, 4) of the target and the source in the world frame."""
    everything: list[Surface] = [*surroundings, *poles]
    target, source = (
        scan(everything, sensor, pose, rng, noise, frames)
        for sensor, pose in zip(sensors, poses, strict=True)
    )
    first = len(surroundings)
    return SimulatedPair(
        target=target.cloud,
        source=source.cloud,
        T_target_source=se3.inverse(poses[0]) @ poses[1],
        T_world_target=poses[0],
        T_world_source=poses[1],
        surfaces=tuple(everything),
        poles=tuple(poles),
        labels=(target.labels, source.labels),
        returns_on_poles=tuple(
            (_returns_on(target, first + k), _returns_on(source, first + k))
            for k in range(len(poles))
        ),
        sensors=sensors,
    )


def _returns_on(scanned: LabelledScan, label: int) -> int:
    return int(np.count_nonzero(scanned.labels == label))


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
        How many taped poles.
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
    names = DEFAULT_SENSORS[scene]
    sensors = (find_sensor(sensor_target or names[0]), find_sensor(sensor_source or names[1]))
    if scene == "paper":
        noise = paper.PAPER_NOISE if noise is None else noise
        for _ in range(MAX_DRAWS):
            drawn = paper.draw_poles(rng, radius)
            pair = _record([], drawn, paper.lidar_poses(), sensors, rng, noise, frames)
            if pair.sees_every_pole:
                return pair
        raise SimulationError(f"{MAX_DRAWS} draws gave no two poles that both LiDARs see")
    noise = TYPICAL if noise is None else noise
    for _ in range(MAX_DRAWS):
        place = SURROUNDINGS[scene](rng)
        if min(place.clear) <= 0:
            continue
        surfaces = place.surfaces
        if symmetric:
            surfaces = [*surfaces, *rotated_by_180(surfaces)]
            standing: list[Cylinder] | None = symmetric_poles(rng, radius)
        else:
            angles = (min_pole_angle, max_pole_angle)
            standing = draw_poles(rng, poles, place.clear, angles, radius)
        if standing is None:
            continue
        poses = _draw_lidars(rng, standing, place.clear)
        if poses is None:
            continue
        pair = _record(surfaces, standing, poses, sensors, rng, noise, frames)
        if pair.sees_every_pole:
            return replace(pair, clear=place.clear)
    raise SimulationError(
        f"{MAX_DRAWS} draws of {scene!r} gave none where {sensors[0].name} and {sensors[1].name} "
        f"both see {poles} poles with {MIN_RETURNS} returns on {MIN_RINGS} rings"
    )


def _draw_lidars(
    rng: np.random.Generator, poles: list[Cylinder], clear: tuple[float, float]
) -> tuple[Array, Array] | None:
    """Draw the poses (4, 4) of both LiDARs; None where this draw has none."""
    target, source = draw_lidar(rng, poles, clear), draw_lidar(rng, poles, clear)
    if target is None or source is None:
        return None
    apart = np.linalg.norm(target[:3, 3] - source[:3, 3])
    return (target, source) if LIDAR_SPACING[0] <= apart <= LIDAR_SPACING[1] else None


def place_again(
    pair: SimulatedPair,
    rng: np.random.Generator,
    *,
    noise: NoiseModel = TYPICAL,
    frames: int = 1,
) -> SimulatedPair:
    """Put the poles of a pair in other places, with the same LiDARs and surroundings.

    Parameters
    ----------
    pair
        From `simulate_pair`; its poles are taken away.
    rng, noise, frames
        As there.

    Raises
    ------
    SimulationError
        No arrangement was found in `MAX_DRAWS` draws in which both LiDARs see every pole.
    """
    count, radius = len(pair.poles), pair.poles[0].radius
    angles = MIN_POLE_ANGLE, MAX_POLE_ANGLE
    poses = pair.T_world_target, pair.T_world_source
    for _ in range(MAX_DRAWS):
        standing = (
            draw_poles(rng, count, pair.clear, angles, radius)
            if min(pair.clear) > 0
            else paper.draw_poles(rng, radius)
        )
        if standing is None:
            continue
        again = _record(pair.surroundings, standing, poses, pair.sensors, rng, noise, frames)
        if again.sees_every_pole:
            return replace(again, clear=pair.clear)
    raise SimulationError(f"{MAX_DRAWS} draws gave no other place for {count} poles")


def record_again(
    pair: SimulatedPair,
    rng: np.random.Generator,
    *,
    moved: Array | None = None,
    poles: bool = True,
    noise: NoiseModel = TYPICAL,
    frames: int = 1,
) -> SimulatedPair:
    """Record the same place again, after the source was moved.

    Parameters
    ----------
    pair
        From `simulate_pair`; everything in its scene stays.
    rng, noise, frames
        As there. The biases of the rings are drawn again, too, as if the LiDARs had been replaced
        by others of their kind: real ones keep theirs.
    moved
        (6,) step ``[φ, δ]`` of the source's pose in the target's frame (`se3.retract`), rad and m;
        None leaves it where it was.
    poles
        Whether the taped poles still stand.
    """
    T = pair.T_target_source if moved is None else se3.retract(pair.T_target_source, moved)
    poses = pair.T_world_target, pair.T_world_target @ T
    standing = pair.poles if poles else ()
    again = _record(pair.surroundings, standing, poses, pair.sensors, rng, noise, frames)
    return replace(again, clear=pair.clear)
