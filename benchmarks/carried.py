"""Walks with one carried pole: how many are answered, how far off, and within what is stated?

Usage:
    python benchmarks/carried.py --seeds 12
    python benchmarks/carried.py --seeds 12 --seconds 60 --sensors XT32 VLP-16 --noise field
    python benchmarks/carried.py --seeds 4 --deceive

A walk with all errors of a noise model in a street, a harbor or on bare ground, seed by seed. With
--deceive each is spoilt in one way: two poles are carried, the pole never leans, the source's clock
jumps. An answer is wrong where it is off by more than 5 σ and by 5 cm or more at 30 m. Seeds below
100 tune; seeds from 5000 state.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import Refusal
from retropole.base.uncertainty import predicted_error
from retropole.carried.walk import calibrate_walk
from retropole.simulation import NOISE_MODELS
from retropole.simulation.walks import SimulatedWalk, simulate_walk

SCENES = "street", "harbor", "bare"
DECEPTIONS = "two", "upright", "jump"
AT, WRONG, SIGMAS = 30.0, 0.05, 5.0
CHI2 = 12.592
"""95 % of χ² with six degrees of freedom."""

JUMP = 0.4
"""The clock of a source that deceives jumps by so much in the middle, s."""


def jumping(sweeps: Iterable[PointCloud], half: float) -> Iterator[PointCloud]:
    """Set the clock ahead after a number of sweeps."""
    for k, cloud in enumerate(sweeps):
        assert cloud.time is not None
        yield replace(cloud, time=cloud.time + JUMP * (k > half))


def metered(sweeps: Iterable[PointCloud], spent: list[float]) -> Iterator[PointCloud]:
    """Give sweeps, and note the CPU time that each took to be simulated, s."""
    begun = time.process_time()
    for cloud in sweeps:
        spent.append(time.process_time() - begun)
        yield cloud
        begun = time.process_time()


def draw(args: argparse.Namespace, seed: int, deception: str) -> SimulatedWalk:
    """Draw the walk of a seed."""
    return simulate_walk(
        args.scene or SCENES[seed % len(SCENES)],
        np.random.default_rng(seed),
        seconds=args.seconds,
        sensors=tuple(args.sensors),
        noise=NOISE_MODELS[args.noise],
        people=2 if deception == "two" else 1,
        lean=1e-3 if deception == "upright" else float(np.radians(14.0)),
    )


def main() -> None:
    """Print a line for each walk, and the sum of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--first", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--scene", choices=SCENES)
    parser.add_argument("--sensors", nargs=2, default=["VLP-16", "VLP-16"])
    parser.add_argument("--noise", choices=sorted(NOISE_MODELS), default="field")
    parser.add_argument("--deceive", action="store_true")
    args = parser.parse_args()
    rows, wrong = [], 0
    for seed in range(args.first, args.first + args.seeds):
        deception = DECEPTIONS[seed % len(DECEPTIONS)] if args.deceive else ""
        walk = draw(args, seed, deception)
        spent: list[float] = []
        sweeps = [
            metered(walk.record(lidar, np.random.default_rng([seed, lidar])), spent)
            for lidar in (0, 1)
        ]
        if deception == "jump":
            sweeps[1] = jumping(sweeps[1], 5 * args.seconds)
        begun = time.process_time()
        target, source = walk.recorders
        try:
            found = calibrate_walk(*sweeps, sensors=(target.sensor, source.sensor))
        except Refusal as refusal:
            print(f"{seed} {deception} refused, {refusal.reason.code}: {refusal}")
            continue
        seconds = time.process_time() - begun - sum(spent)
        step = se3.local(found.T_target_source, walk.T_target_source)
        error = predicted_error(np.outer(step, step), (AT,))[0].sigma_m
        stated = predicted_error(found.covariance, (AT,))[0].sigma_m
        squares = float(step @ np.linalg.solve(found.covariance, step))
        middle = found.middle
        clock = source.clock + source.drift * middle - found.offset
        is_wrong = error > max(SIGMAS * stated, WRONG)
        wrong += is_wrong
        rows.append((error, squares <= CHI2, abs(clock), seconds))
        print(
            f"{seed} {deception} {1e3 * error:.1f} mm ({1e3 * stated:.1f}) at {AT:g} m, "
            f"χ² {squares:.1f}, clock {1e3 * clock:+.2f} ms ({1e3 * found.offset_sigma:.2f}), "
            f"{seconds:.1f} s{' WRONG' * is_wrong}"
        )
    print(f"answered {len(rows)} of {args.seeds}, wrong {wrong}")
    if rows:
        error, covered, clock, seconds = np.array(rows, dtype=float).T
        print(
            f"median {1e3 * np.median(error):.1f} mm at {AT:g} m, largest {1e3 * error.max():.1f}; "
            f"within 95 %: {covered.mean():.0%}; clock, median {1e3 * np.median(clock):.2f} ms; "
            f"{np.mean(seconds):.1f} s of CPU"
        )


if __name__ == "__main__":
    main()
