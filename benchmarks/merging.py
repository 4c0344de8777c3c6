"""How far apart surfaces lie that two LiDARs see, as `merge --surfels` states it, and the pose off.

Simulated pairs at the true pose, and turned from it about axes drawn at random: the figure must
grow as the pose is turned. Printed are, for each scene, kind of surface and angle, the median over
seeds of the median distance; and in how many pairs the figure of all surfaces, and the larger of
those of its kinds, is larger than at the true pose. ``typical`` LiDARs have noise and errors of
ranges, ``field`` ones every error that a real one has, which shows at the true pose, too.

Seeds 0 to 9 may set constants (``--seeds 0 10``); those from 100 on state figures.

    python benchmarks/merging.py
    python benchmarks/merging.py --seeds 0 10 --cell 0.5 --sweeps 5
    python benchmarks/merging.py --speed
    python benchmarks/merging.py --memory 10 40
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import chain
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import retropole as rp
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.export.clouds import About, cloud_writer
from retropole.fusion.merging import Points, fused
from retropole.fusion.surfels import (
    DEFAULT_CELL,
    KINDS,
    distances,
    moments_of,
    surface_distances,
    surfels_of,
)
from retropole.simulation import NOISE_MODELS, simulate_pair, simulate_site, write_site

SCENES = "corridor", "street", "harbor"
ANGLES = 0.0, 0.02, 0.05, 0.1
"""By which the pose is turned, degrees."""

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Run:
    """Of one pair: for each angle, the median distance of all surfaces, and of each kind, metres;
    NaN where there are fewer than `ENOUGH` surfels."""

    scene: str
    every: list[float]
    kinds: list[dict[str, float]]


ENOUGH = 20


def sweeps_of(cloud: PointCloud, T: Array, lidar: int) -> Iterator[Points]:
    """Fuse the sweeps of a recording one by one."""
    frame = np.zeros(len(cloud), np.int64) if cloud.frame is None else cloud.frame
    for k in np.unique(frame):
        yield fused(cloud.select(frame == k), T, lidar)


def run(case: tuple[str, int], *, cell: float, sweeps: int, noise: str) -> Run:
    scene, seed = case
    pair = simulate_pair(
        scene, np.random.default_rng(seed), frames=sweeps, noise=NOISE_MODELS[noise]
    )
    axis = np.random.default_rng(seed + 10_000).normal(size=3)
    axis /= np.linalg.norm(axis)
    every, kinds = [], []
    for angle in ANGLES:
        T = pair.T_target_source.copy()
        T[:3, :3] = se3.exp_so3(np.radians(angle) * axis) @ T[:3, :3]
        parts = [*sweeps_of(pair.target, np.eye(4), 0), *sweeps_of(pair.source, T, 1)]
        origins = np.stack([np.zeros(3), T[:3, 3]])
        apart = list(surface_distances(moments_of(parts, cell), origins, UP))
        off = np.concatenate([np.zeros(0), *(each.distances for each in apart)])
        every.append(float(np.median(np.abs(off))) if len(off) >= ENOUGH else np.nan)
        found = {each.kind: each for each in distances(apart) if each.surfels >= ENOUGH}
        kinds.append({k: found[k].median_m if k in found else np.nan for k in KINDS})
    return Run(scene, every, kinds)


def table(runs: list[Run]) -> Iterator[str]:
    yield "| scene | surfaces | " + " | ".join(f"{angle:g}°" for angle in ANGLES) + " |"
    yield "| --- | --- |" + " --- |" * len(ANGLES)
    for scene in dict.fromkeys(each.scene for each in runs):
        own = [each for each in runs if each.scene == scene]
        for kind in (*KINDS[:2], "all"):
            found = np.array(
                [each.every if kind == "all" else [k[kind] for k in each.kinds] for each in own]
            )
            known = np.isfinite(found).all(axis=1)
            if known.any():
                row = np.median(1000 * found[known], axis=0)
                cells = " | ".join(f"{value:.1f} mm" for value in row)
                yield f"| {scene} ({known.sum()}) | {kind} | {cells} |"
    every = np.array([each.every for each in runs])
    worst = np.array(
        [[max(filter(np.isfinite, k.values()), default=np.nan) for k in r.kinds] for r in runs]
    )
    for name, found in (("all", every), ("the worse kind", worst)):
        found = found[np.isfinite(found).all(axis=1)]
        larger = " | ".join(
            f"{(found[:, k] > found[:, 0]).mean():.0%}" for k in range(1, len(ANGLES))
        )
        yield f"| larger than at 0° ({len(found)}) | {name} |  | {larger} |"


def speed() -> Iterator[str]:
    """CPU time of what a live picture of four LiDARs takes for each sweep of 100,000 points."""
    pair = simulate_pair("street", np.random.default_rng(0), frames=1)
    clouds = [pair.target.select(np.arange(100_000) % len(pair.target)) for _ in range(4)]
    poses = [se3.from_rt(np.eye(3), np.array([0.1 * k, 0, 0])) for k in range(4)]
    origins = np.array([pose[:3, 3] for pose in poses])
    steps = {"fuse": 0.0, "moments": 0.0, "surfels": 0.0, "distances": 0.0}
    for _ in range(5):
        start = [time.process_time()]
        parts = [fused(c, T, k) for k, (c, T) in enumerate(zip(clouds, poses, strict=True))]
        start.append(time.process_time())
        moments = moments_of(parts)
        start.append(time.process_time())
        surfels_of(moments, origins)
        start.append(time.process_time())
        list(surface_distances(moments, origins, UP))
        start.append(time.process_time())
        steps = {name: t for name, t in zip(steps, np.diff(start), strict=True)}
    for name, taken in steps.items():
        yield f"{name}: {1000 * taken:.0f} ms for 4 sweeps of 100,000 points"


def memory(sweeps: int) -> str:
    """Merge so many made-up sweeps of four LiDARs, 100,000 points each, of a simulated site."""
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(100_000, 3)) * [1.0, 1.0, 0.3]
    rays *= (20.0 / np.linalg.norm(rays, axis=1))[:, None]
    about = About(["l"], "l", [], True, True, True, False, np.zeros(3), True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        site = simulate_site("posts", np.random.default_rng(1), lidars=4, placements=1)
        write_site(site, folder / "s")
        rp.calibrate_site(folder / "s").save(folder / "out")
        for k in range(4):
            with cloud_writer(folder / f"{k}.mcap", about) as write:
                for n in range(sweeps):
                    when = 1.7e9 + 0.1 * n
                    xyz = rays * rng.normal(1, 5e-4, (len(rays), 1))
                    ring, at = rng.integers(0, 128, len(rays)), np.full(len(rays), when)
                    cloud = PointCloud(xyz, rng.uniform(0, 255, len(rays)), ring, at)
                    write(fused(cloud, np.eye(4)), when)
        words = [
            ["--recording", f"{own}={folder / f'{k}.mcap'}"] for k, own in enumerate(site.names)
        ]
        code = (
            "import resource, sys; from retropole.cli import run; run(sys.argv[1:]); "
            "used = resource.getrusage(resource.RUSAGE_SELF); "
            "print(f'{used.ru_maxrss / 1000:.0f} MB, {used.ru_utime + used.ru_stime:.0f} s of CPU')"
        )
        command = [sys.executable, "-c", code, "merge", str(folder / "out"), *chain(*words)]
        done = []
        for more in (["-o", "a.laz"], ["-o", "a.mcap"], ["-o", "a.ply", "--voxel", "0.1"]):
            ran = subprocess.run(
                [*command, *more, "-q"], cwd=folder, capture_output=True, text=True
            )
            done.append(f"{' '.join(more[1:])}: {ran.stdout.strip()}")
    return f"{sweeps} sweeps of 4 LiDARs of 100,000 points: {'; '.join(done)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs=2, default=(100, 120))
    parser.add_argument("--cell", type=float, default=DEFAULT_CELL)
    parser.add_argument("--sweeps", type=int, default=1)
    parser.add_argument("--noise", nargs="+", default=["typical", "field"], choices=NOISE_MODELS)
    parser.add_argument("--scenes", nargs="+", default=SCENES)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--memory", type=int, nargs="+", default=(), metavar="SWEEPS")
    args = parser.parse_args()
    for sweeps in args.memory:
        print(memory(sweeps))
    if args.memory:
        return
    if args.speed:
        print("\n".join(speed()))
        return
    cases = [(scene, seed) for scene in args.scenes for seed in range(*args.seeds)]
    for noise in args.noise:
        own = partial(run, cell=args.cell, sweeps=args.sweeps, noise=noise)
        with ProcessPoolExecutor(args.workers, mp_context=get_context("spawn")) as pool:
            runs = list(pool.map(own, cases))
        print(f"\n{noise}, {args.sweeps} sweeps, cells of {args.cell:g} m\n")
        print("\n".join(table(runs)))


if __name__ == "__main__":
    main()
