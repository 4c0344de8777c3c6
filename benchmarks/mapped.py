"""A LiDAR in an existing map: how often it is found, how exactly, and what is said of a wrong map.

A place is recorded by 3 to 8 LiDARs, whose clouds are put together by the truth and thinned: the
map. Another LiDAR is calibrated to it from a rough place (2 m, 1 σ). In half of the draws cars were
moved since, in a tenth a façade was, in a fifth the map is of another place. Prints a Markdown
table.

    python benchmarks/mapped.py --draws 40

Seeds below 1000 are for setting constants; those from 1000 on state figures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.sensors import find_sensor
from retropole.simulation import FIELD, Box, Surface, draw_device, scan
from retropole.simulation.scenes import METAL, SURROUNDINGS
from retropole.surfaces.registration import voxel_downsample

SCENES = ("street", "harbor", "square")
MODELS = ("VLP-16", "XT32", "OS1", "HDL-32E")
ORIGIN = np.array([412_345.0, 5_654_321.0, 87.0])
THINNING = (0.05, 0.1, 0.2)
NOISE = (0.005, 0.03)
MOVED, FACADE, ELSEWHERE = 0.5, 0.1, 0.2


@dataclass(frozen=True, eq=False)
class Draw:
    scene: str
    kind: str
    map: PointCloud
    lidar: PointCloud
    T_map_lidar: Array
    rough: Array
    model: str


def pose_in(clear: Array, rng: np.random.Generator) -> Array:
    at = rng.uniform(-1, 1, 2) * np.maximum(np.array(clear) - 0.5, 1.0)
    tilt = Rotation.from_rotvec(np.r_[rng.normal(0, 0.05, 2), 0.0])
    R = (tilt * Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))).as_matrix()
    return se3.from_rt(R, np.r_[at, rng.uniform(2.0, 5.0)])


def cars(clear: Array, rng: np.random.Generator) -> list[Surface]:
    found: list[Surface] = []
    for _ in range(int(rng.integers(3, 7))):
        at = rng.uniform(-1, 1, 2) * np.array([25.0, clear[1]])
        yaw = Rotation.from_euler("z", rng.choice([0, np.pi]) + rng.normal(0, 0.05)).as_matrix()
        found.append(Box(np.r_[at, 0.8], yaw, np.array([2.2, 0.9, 0.7]), METAL))
    return found


def draw(seed: int) -> Draw:
    rng = np.random.default_rng([77, seed])
    scene = SCENES[seed % 3]
    place = SURROUNDINGS[scene](rng)
    clear = place.clear
    u = rng.uniform()
    kind = (
        "elsewhere"
        if u < ELSEWHERE
        else "facade"
        if u < ELSEWHERE + FACADE
        else ("cars moved" if rng.uniform() < MOVED else "same")
    )
    then = [*place.surfaces, *cars(clear, rng)]
    pieces = []
    for _ in range(int(rng.integers(3, 9))):
        sensor = find_sensor(str(rng.choice(MODELS)))
        pose = pose_in(clear, rng)
        device = draw_device(sensor, FIELD, rng)
        cloud = scan(then, sensor, pose, rng, noise=FIELD, device=device).cloud
        pieces.append(se3.apply(pose, cloud.xyz))
    xyz = voxel_downsample(np.concatenate(pieces), float(rng.choice(THINNING)))
    xyz = xyz + rng.normal(0, rng.uniform(*NOISE), xyz.shape)
    if kind == "elsewhere":
        now = [*SURROUNDINGS[scene](rng).surfaces, *cars(clear, rng)]
    elif kind == "facade":
        large = [k for k, each in enumerate(place.surfaces) if k and each.bounding_radius > 2.5]
        k = large[int(rng.integers(len(large)))]
        way = rng.uniform(0, 2 * np.pi)
        step = rng.uniform(0.5, 2.0) * np.array([np.cos(way), np.sin(way), 0.0])
        moved = replace(place.surfaces[k], centre=place.surfaces[k].centre + step)
        now = [*place.surfaces[:k], moved, *place.surfaces[k + 1 :], *cars(clear, rng)]
    elif kind == "cars moved":
        now = [*place.surfaces, *cars(clear, rng)]
    else:
        now = then
    model = str(rng.choice(MODELS))
    sensor = find_sensor(model)
    pose = pose_in(clear, rng)
    lidar = scan(now, sensor, pose, rng, noise=FIELD, device=draw_device(sensor, FIELD, rng)).cloud
    rough = pose[:3, 3] + rng.normal(0, 2.0, 3) * [1, 1, 0.5]
    return Draw(
        scene,
        kind,
        PointCloud(xyz + ORIGIN),
        lidar,
        se3.from_rt(np.eye(3), ORIGIN) @ pose,
        rough + ORIGIN,
        model,
    )
