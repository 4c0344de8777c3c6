"""Simulated pairs of scans whose true transform is known."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .. import se3
from ..datatypes import Array, IntArray, PointCloud
from ..errors import RetropoleError, UsageError
from ..files import write_atomically
from ..io import write_pcd
from ..sensors import Sensor, find_sensor
from . import paper
from .raycast import Box, Cylinder, Material, Rectangle, Surface
from .scanning import EXACT, TYPICAL, NoiseModel, Scan, scan
from .scenes import SURROUNDINGS, draw_lidar, draw_poles, half_turned, symmetric_poles

__all__ = [
    "EXACT",
    "SCENES",
    "TYPICAL",
    "Box",
    "Cylinder",
    "Material",
    "NoiseModel",
    "Rectangle",
    "SimulatedPair",
    "SimulationError",
    "place_again",
    "record_again",
    "scan",
    "simulate_pair",
    "write_pair",
]

SCENES = (*SURROUNDINGS, "paper")

DEFAULT_SENSORS = {
    "corridor": ("XT32", "VLP-16"),
    "street": ("Pandar64", "OS1"),
    "harbor": ("Pandar64", "HDL-32E"),
    "bare": ("Pandar64", "HDL-32E"),
    "paper": ("VLP-16", "VLP-16"),
}

MIN_RETURNS, MIN_RINGS = 6, 3
"""What makes a pole seen by a LiDAR."""

MAX_DRAWS = 400


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
        Everything there is, in the world's frame; the poles come last.
    poles
        The taped poles.
    labels
        For the target and the source, the surface that each point lies on.
    returns_on_poles
        Per pole, how many points the target and the source have on it.
    sensors
        The two models.
    clear
        Half sides of the ground, about the world's origin, where poles may stand, metres.
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


def _seen(scanned: Scan, label: int) -> tuple[int, bool]:
    """How many points lie on a surface, and whether they are enough to find a pole."""
    on_it = scanned.labels == label
    count = int(np.count_nonzero(on_it))
    ring = scanned.cloud.ring
    rings = count if ring is None else len(np.unique(ring[on_it]))
    return count, count >= MIN_RETURNS and rings >= MIN_RINGS


def _pair(
    surfaces: list[Surface],
    poles: list[Cylinder],
    poses: tuple[Array, Array],
    sensors: tuple[Sensor, Sensor],
    rng: np.random.Generator,
    nuisances: NoiseModel,
    frames: int,
) -> tuple[SimulatedPair, bool]:
    """Scan a scene from two poses, and tell whether both see every pole."""
    everything: list[Surface] = [*surfaces, *poles]
    scans = [
        scan(everything, sensor, pose, rng, nuisances, frames)
        for sensor, pose in zip(sensors, poses, strict=True)
    ]
    first = len(surfaces)
    seen = [[_seen(s, first + k) for s in scans] for k in range(len(poles))]
    pair = SimulatedPair(
        target=scans[0].cloud,
        source=scans[1].cloud,
        T_target_source=se3.inverse(poses[0]) @ poses[1],
        T_world_target=poses[0],
        T_world_source=poses[1],
        surfaces=tuple(everything),
        poles=tuple(poles),
        labels=(scans[0].labels, scans[1].labels),
        returns_on_poles=tuple((target[0], source[0]) for target, source in seen),
        sensors=sensors,
    )
    return pair, all(enough for pole in seen for _, enough in pole)


def simulate_pair(
    scene: str,
    rng: np.random.Generator,
    *,
    sensor_target: str | None = None,
    sensor_source: str | None = None,
    poles: int = 2,
    radius: float = 0.02,
    min_pole_angle: float = float(np.radians(15)),
    max_pole_angle: float = float(np.radians(60)),
    nuisances: NoiseModel | None = None,
    symmetric: bool = False,
    frames: int = 1,
) -> SimulatedPair:
    """Draw a scene with taped poles that two LiDARs see, and scan it.

    Parameters
    ----------
    scene
        One of `SCENES`. ``paper`` is the set-up of Xue et al. 2019 without surroundings.
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
    nuisances
        How real the scans are; None takes `TYPICAL`, and for ``paper`` the paper's noise.
    symmetric
        Make surroundings and poles that a half turn about the vertical lays on themselves, so that
        nothing tells the hypotheses apart.
    frames
        How many sweeps each LiDAR records.

    Raises
    ------
    UsageError
        An unknown scene or sensor.
    SimulationError
        No arrangement was found in which both LiDARs see every pole.
    """
    if scene not in SCENES:
        raise UsageError(f"no scene is called {scene!r}; there are {', '.join(SCENES)}")
    names = DEFAULT_SENSORS[scene]
    sensors = (find_sensor(sensor_target or names[0]), find_sensor(sensor_source or names[1]))
    if scene == "paper":
        noise = paper.PAPER_NOISE if nuisances is None else nuisances
        for _ in range(MAX_DRAWS):
            drawn = paper.draw_poles(rng, radius)
            pair, enough = _pair([], drawn, paper.lidar_poses(), sensors, rng, noise, frames)
            if enough:
                return pair
        raise SimulationError(f"{MAX_DRAWS} draws gave no two poles that both LiDARs see")
    noise = TYPICAL if nuisances is None else nuisances
    for _ in range(MAX_DRAWS):
        place = SURROUNDINGS[scene](rng)
        if min(place.clear) <= 0:
            continue
        surfaces = place.surfaces
        if symmetric:
            surfaces = [*surfaces, *half_turned(surfaces)]
            standing: list[Cylinder] | None = symmetric_poles(rng, radius)
        else:
            angles = (min_pole_angle, max_pole_angle)
            standing = draw_poles(rng, poles, place.clear, angles, radius)
        if standing is None:
            continue
        target_pose = draw_lidar(rng, standing, place.clear)
        source_pose = draw_lidar(rng, standing, place.clear)
        if target_pose is None or source_pose is None:
            continue
        if not 0.5 <= np.linalg.norm(target_pose[:3, 3] - source_pose[:3, 3]) <= 6.0:
            continue
        poses = (target_pose, source_pose)
        pair, enough = _pair(surfaces, standing, poses, sensors, rng, noise, frames)
        if enough:
            return replace(pair, clear=place.clear)
    raise SimulationError(
        f"{MAX_DRAWS} draws of {scene!r} gave none where {sensors[0].name} and {sensors[1].name} "
        f"both see {poles} poles with {MIN_RETURNS} returns on {MIN_RINGS} rings"
    )


def place_again(
    pair: SimulatedPair,
    rng: np.random.Generator,
    *,
    nuisances: NoiseModel = TYPICAL,
    frames: int = 1,
) -> SimulatedPair:
    """Set the poles of a pair anew, before the same LiDARs in the same surroundings.

    Parameters
    ----------
    pair
        From `simulate_pair`; its poles are taken away.
    rng, nuisances, frames
        As there.

    Raises
    ------
    SimulationError
        No arrangement was found in which both LiDARs see every pole.
    """
    count, radius = len(pair.poles), pair.poles[0].radius
    surroundings = list(pair.surfaces[:-count])
    angles = float(np.radians(15)), float(np.radians(60))
    for _ in range(MAX_DRAWS):
        standing = (
            draw_poles(rng, count, pair.clear, angles, radius)
            if min(pair.clear) > 0
            else paper.draw_poles(rng, radius)
        )
        if standing is None:
            continue
        poses = pair.T_world_target, pair.T_world_source
        again, enough = _pair(surroundings, standing, poses, pair.sensors, rng, nuisances, frames)
        if enough:
            return replace(again, clear=pair.clear)
    raise SimulationError(f"{MAX_DRAWS} draws gave no other place for {count} poles")


def record_again(
    pair: SimulatedPair,
    rng: np.random.Generator,
    *,
    moved: Array | None = None,
    poles: bool = True,
    nuisances: NoiseModel = TYPICAL,
    frames: int = 1,
) -> SimulatedPair:
    """Record the same place anew, after the source was moved.

    Parameters
    ----------
    pair
        From `simulate_pair`; what stands there stays.
    rng, nuisances, frames
        As there. The biases of the single beams are drawn anew, too, as if the LiDARs had been
        changed for others of their kind: real ones keep theirs.
    moved
        (6,) step ``[φ, δ]`` of the source's pose in the target's frame (`se3.retract`), rad and m;
        None leaves it where it was.
    poles
        Whether the taped poles still stand.
    """
    T = pair.T_target_source if moved is None else se3.retract(pair.T_target_source, moved)
    standing = list(pair.poles) if poles else []
    surroundings = list(pair.surfaces[: len(pair.surfaces) - len(pair.poles)])
    poses = pair.T_world_target, pair.T_world_target @ T
    again, _ = _pair(surroundings, standing, poses, pair.sensors, rng, nuisances, frames)
    return replace(again, clear=pair.clear)


def write_pair(pair: SimulatedPair, out: Path) -> None:
    """Write ``lidar0.pcd`` (target), ``lidar1.pcd`` (source) and ``truth.json`` to a folder."""
    out.mkdir(parents=True, exist_ok=True)
    write_pcd(out / "lidar0.pcd", pair.target)
    write_pcd(out / "lidar1.pcd", pair.source)
    truth = {
        "T_target_source": pair.T_target_source.tolist(),
        "T_world_target": pair.T_world_target.tolist(),
        "T_world_source": pair.T_world_source.tolist(),
        "target": "lidar0.pcd",
        "source": "lidar1.pcd",
        "sensors": [sensor.name for sensor in pair.sensors],
        "poles": [
            {
                "point_world_m": pole.centre.tolist(),
                "direction_world": pole.axis.tolist(),
                "radius_m": pole.radius,
                "length_m": pole.length,
                "returns_target": returns[0],
                "returns_source": returns[1],
            }
            for pole, returns in zip(pair.poles, pair.returns_on_poles, strict=True)
        ],
    }
    write_atomically(out / "truth.json", json.dumps(truth, indent=1).encode() + b"\n")
