"""Roll, pitch and height over the ground, against the true plane of simulated places.

Each place has one LiDAR or two (their poses known to 0.05° and 8 mm, 1 σ), 1 to 6 m high and tilted
by up to 20° (one in ten hangs head down), with the errors of `FIELD`, or none in one of five. The
true plane is fitted to the heights of the scene's own surfaces in the disc. One line for each kind
of place, and for each sensor, prints

* places, how many are refused, and on how many another level than that below the LiDARs is taken;
* truths in the 95 % region of roll, pitch and height of a LiDAR (all three together);
* the median error of roll and pitch, and of the height, and for each the ratio of the median of
  what is stated (0.6745 σ, the median of a normal error) to it.

Seeds 0 to 199 tune, those from 3200 state; 3065, 3071 and 3181 showed what is no step.

    python benchmarks/leveling.py --seeds 3200:3340
    python benchmarks/leveling.py --seeds 3200:3340 --disc-m 6
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import Refusal
from retropole.base.sensors import Sensor, find_sensor
from retropole.base.systematic import sizes_of
from retropole.ground.level import level
from retropole.ground.surface import viewer_of
from retropole.simulation import FIELD, Rectangle, Surface, draw_device, scan
from retropole.simulation.scenes import (
    ASPHALT,
    BARK,
    SURROUNDINGS,
    Surroundings,
    _car,
    _roadside,
    _sloping,
)

SENSORS = ("VLP-16", "XT32", "OS1-64", "OS1", "AT128")
POSES = np.radians(0.05), 0.008
"""1 σ of the pose between two LiDARs, rad and m."""

SAME = 0.04
"""Ground that is nearer to that below the LiDARs than this, metres, within a step, is its level."""

CHI2_95 = 7.815


def ramp(rng: np.random.Generator) -> Surroundings:
    """Draw ground that changes its slope by 2 to 8 % along a line beside the LiDARs."""
    edge, slope = rng.uniform(-6, 12), rng.choice([-1, 1]) * rng.uniform(0.02, 0.08)
    along, y = np.array([1.0, 0.0, slope]) / np.hypot(1, slope), np.array([0.0, 1.0, 0.0])
    surfaces: list[Surface] = [
        Rectangle(np.array([edge - 60, 0, 0]), np.eye(3)[0], y, (60, 120), ASPHALT),
        Rectangle(np.array([edge, 0, 0]) + 60 * along, along, y, (60, 120), ASPHALT),
    ]
    for _ in range(3):
        at = np.r_[rng.uniform(-20, min(edge, 15)) - 2, rng.choice([-1, 1]) * rng.uniform(5, 12)]
        surfaces += _car(at, rng.uniform(0, np.pi))
    return Surroundings(surfaces, (4.0, 3.0))


def crown(rng: np.random.Generator) -> Surroundings:
    """Draw a road with a round crown, 0.05 to 0.2 m higher in the middle than at its edges."""
    half, rise, count = rng.uniform(4, 8), rng.uniform(0.05, 0.2), 12
    y = np.linspace(0, half, count + 1)
    profile = np.stack([y, -rise * (y / half) ** 2], axis=1)
    verge = profile[-1] + 50.0 * np.array([1.0, rng.uniform(-0.05, 0.05)])
    surfaces: list[Surface] = []
    for side in (-1, 1):
        for a, b in zip(profile, [*profile[1:], None], strict=True):
            far, material = (verge, BARK) if b is None else (b, ASPHALT)
            surfaces.append(_sloping(side, a, far, material))
    return Surroundings([*surfaces, *_roadside(rng, half + 1.0)], (6.0, 3.2))


KINDS = {name: SURROUNDINGS[name] for name in ("bare", "street", "harbor", "camber", "kerb")}
KINDS |= {"ramp": ramp, "crown": crown}


@dataclass
class Found:
    """Of one place: what was stated and what was wrong, of each LiDAR."""

    kind: str
    sensor: str
    seed: int
    exact: bool
    refused: str = ""
    mahalanobis: list[float] = field(default_factory=list)
    errors: list[Array] = field(default_factory=list)
    sigmas: list[Array] = field(default_factory=list)


def sensor_of(name: str) -> Sensor:
    """A model; of the OS1 with 64 rings every second of 128."""
    sensor = find_sensor("OS1" if name == "OS1-64" else name)
    assert sensor is not None
    if name == "OS1-64":
        sensor = replace(sensor, name=name, elevations=sensor.elevations[::2])
    return sensor


def heights(surfaces: Sequence[Surface], at: Array) -> Array:
    """(N,) height of the ground at places (N, 2), NaN where there is none of the level of z = 0."""
    down = np.tile([0.0, 0.0, -1.0], (len(at), 1))
    start = np.c_[at, np.full(len(at), 50.0)]
    found = np.full(len(at), -np.inf)
    for surface in surfaces:
        if isinstance(surface, Rectangle) and abs(np.cross(surface.u, surface.v)[2]) > 0.9:
            found = np.fmax(found, 50.0 - surface.intersect(start, down, 0.0).ranges)
    return found


def true_plane(
    surfaces: Sequence[Surface], origin: Array, radius: float, lidar: Array
) -> tuple[Array, Array]:
    """Normal (3,) and a point (3,) of the plane that fits the ground best about a foot.

    Of two levels it is that below the LiDARs (3,), wherever the origin (3,) of the disc is.
    """
    steps = (np.arange(-60, 60) + 0.5) * radius / 60
    x, y = (each.ravel() for each in np.meshgrid(steps, steps))
    disc = np.stack([x, y], axis=1)[np.hypot(x, y) < radius]
    foot, normal = origin[:2], np.array([0.0, 0.0, 1.0])
    below = heights(surfaces, lidar[None, :2])[0]
    for _ in range(3):
        z = heights(surfaces, foot + disc)
        own = np.isfinite(z)
        if np.unique(np.round(z[own], 6)).size == 2:
            # Level ground on two levels, as at a kerb.
            own &= np.abs(z - below) < SAME
        table = np.c_[np.ones(len(disc)), disc][own]
        (a, b, c), *_ = np.linalg.lstsq(table, z[own], rcond=None)
        normal = np.array([-b, -c, 1.0]) / np.sqrt(1 + b * b + c * c)
        point = np.r_[foot, a]
        foot = (origin - ((origin - point) @ normal) * normal)[:2]
    return normal, point


def truth(normal: Array, point: Array, T_world_lidar: Array, x: Array) -> Array:
    """Roll, pitch and height (3,), where x (3,) lies along the ground's x axis."""
    x = x - (x @ normal) * normal
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(normal, x), normal]) @ T_world_lidar[:3, :3]
    roll, pitch = Rotation.from_matrix(R).as_euler("ZYX")[[2, 1]]
    return np.array([roll, pitch, (T_world_lidar[:3, 3] - point) @ normal])


def run(seed: int, disc: float | None) -> Found:
    """Draw a place by a seed, and level its LiDARs."""
    rng = np.random.default_rng(seed)
    kind = list(KINDS)[seed % len(KINDS)]
    place, name = KINDS[kind](rng), SENSORS[seed % len(SENSORS)]
    exact = bool(rng.uniform() < 0.2)
    noise = FIELD
    if exact:
        noise = replace(FIELD, ring_bias=0.0, retro_bias=0.0, zero_offset=0.0, scale=0.0)
        noise = replace(noise, slant=0.0, ring_elevation=0.0, encoder=0.0, wobble=0.0)
    elif rng.uniform() < 0.5:
        noise = replace(FIELD, bend=float(np.radians(0.03 if name == "AT128" else 0.003)))
    count = 1 + int(rng.uniform() < 0.3)
    middle = rng.uniform(-1, 1, 2) * np.array(place.clear)
    poses, viewers, step = [], [], np.zeros(6)
    for k in range(count):
        tilt, toward = np.radians(rng.uniform(0, 20)), rng.uniform(0, 2 * np.pi)
        upright = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
        if rng.uniform() < 0.1:
            upright = Rotation.from_euler("x", np.pi) * upright
        lean = Rotation.from_rotvec(tilt * np.array([np.cos(toward), np.sin(toward), 0]))
        at = np.r_[middle + k * rng.uniform(-1, 1, 2), rng.uniform(1, 6)]
        at[2] += heights(place.surfaces, at[None, :2])[0]
        poses.append(se3.from_rt((lean * upright).as_matrix(), at))
    covariance = np.zeros((6 * count, 6 * count))
    for k, T in enumerate(poses):
        sensor = sensor_of(name)
        device = draw_device(sensor, noise, rng)
        cloud = scan(place.surfaces, sensor, T, rng, noise, device=device).cloud
        T_first = se3.inverse(poses[0]) @ T
        if k:
            own = np.repeat(POSES, 3)
            step = own * rng.normal(size=6)
            covariance[6:, 6:] = np.diag(own**2)
            T_first = se3.retract(T_first, step)
        viewers.append(viewer_of(f"{k}", cloud, T_first, sizes_of(sensor)))
    found = Found(kind, name, seed, exact)
    try:
        answer = level(viewers, covariance, disc)
    except Refusal as refusal:
        found.refused = refusal.message
        return found
    # About the foot of the LiDARs, or about what is seen where that is on one side alone.
    origin = np.mean([T[:3, 3] for T in poses], axis=0)
    about_foot = np.linalg.norm(answer.centre) == 0
    middle = se3.apply(poses[0], answer.middle[None])[0]
    normal, point = true_plane(
        place.surfaces, origin if about_foot else middle, answer.radius, origin
    )
    for lidar, T in zip(answer.lidars, poses, strict=True):
        off = np.array([lidar.roll, lidar.pitch, lidar.height])
        off -= truth(normal, point, T, poses[0][:3, 0])
        off[0] = (off[0] + np.pi) % (2 * np.pi) - np.pi
        found.errors.append(off)
        found.sigmas.append(np.sqrt(np.diag(lidar.roll_pitch_height)))
        found.mahalanobis.append(float(off @ np.linalg.solve(lidar.roll_pitch_height, off)))
    return found


def line(title: str, runs: Sequence[Found]) -> str:
    """One line of the table."""
    errors = np.array([e for run in runs for e in run.errors]).reshape(-1, 3)
    sigmas = np.array([s for run in runs for s in run.sigmas]).reshape(-1, 3)
    inside = np.array([m < CHI2_95 for run in runs for m in run.mahalanobis])
    refused = sum(bool(run.refused) for run in runs)
    if not len(errors):
        return f"{title:10} {len(runs):6} {refused:7}"
    # So far off is another level, not an error of this one.
    other = int(np.count_nonzero((np.abs(errors[:, 2]) > 0.05) & ~inside))
    tilt, stated = np.median(np.abs(errors[:, :2])), 0.6745 * np.median(sigmas[:, :2])
    high, said = np.median(np.abs(errors[:, 2])), 0.6745 * np.median(sigmas[:, 2])
    return (
        f"{title:10} {len(runs):6} {refused:7} {other:6} {len(errors):6} "
        f"{100 * inside.mean():7.1f} % {np.degrees(tilt):9.4f}° {stated / tilt:7.2f} "
        f"{1000 * high:7.1f} mm {said / high:7.2f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="0:200")
    parser.add_argument("--disc-m", type=float)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--show", action="store_true", help="those outside, and refusals")
    given = parser.parse_args()
    seeds = [
        seed
        for seed in range(*map(int, given.seeds.split(":")))
        if list(KINDS)[seed % len(KINDS)] in given.kinds
    ]
    with (
        threadpool_limits(1),
        ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool,
    ):
        runs = list(pool.map(run, seeds, [given.disc_m] * len(seeds)))
    print(
        "place      places refused  other lidars  in 95 %    roll, pitch  stated     height  stated"
    )
    for kind in KINDS:
        print(line(kind, [r for r in runs if r.kind == kind]))
    for sensor in SENSORS:
        print(line(sensor, [r for r in runs if r.sensor == sensor]))
    print(line("no errors", [r for r in runs if r.exact]))
    print(line("errors", [r for r in runs if not r.exact]))
    print(line("all", runs))
    if given.show:
        for each in runs:
            if each.refused:
                print(each.seed, each.kind, each.sensor, each.refused)
            for e, s, m in zip(each.errors, each.sigmas, each.mahalanobis, strict=True):
                if m > CHI2_95:
                    print(
                        each.seed,
                        each.kind,
                        each.sensor,
                        f"{m:.1f}",
                        *np.round(e / s, 1),
                        f"{1000 * e[2]:.0f} mm",
                        np.round(np.degrees(e[:2]), 3),
                    )


if __name__ == "__main__":
    main()
