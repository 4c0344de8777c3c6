"""What more placements of the poles, and more frames, gain: e_rt of the poles alone.

python benchmarks/repeats.py --seeds 20
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from retropole.checking.metrics import e_rt
from retropole.pipeline import Options, calibrate
from retropole.simulation import TYPICAL, NoiseModel, place_again, simulate_pair
from sweeps import first_sweeps

ONLY_NOISE = NoiseModel(2.0, 0.0, 0.02, True, 0.0, 0.0, 0.15)
"""Twice the sensors' noise along the beam and no bias: noise rules."""


def run(job: tuple[str, int]) -> tuple[float, float]:
    """e_rt of one placement or frame, and of all."""
    kind, seed = job
    rng = np.random.default_rng(seed)
    scene = ("corridor", "street", "harbor")[seed % 3]
    if kind == "placements":
        pairs = [simulate_pair(scene, rng)]
        pairs += [place_again(pairs[0], rng, noise=TYPICAL) for _ in range(3)]
        one = calibrate(pairs[0].target, pairs[0].source, options=Options(scene=False))
        all_of_them = calibrate(
            [p.target for p in pairs], [p.source for p in pairs], options=Options(scene=False)
        )
    else:
        pairs = [simulate_pair(scene, rng, noise=ONLY_NOISE, frames=10)]
        target, source = pairs[0].target, pairs[0].source
        one = calibrate(
            first_sweeps(target, 1), first_sweeps(source, 1), options=Options(scene=False)
        )
        all_of_them = calibrate(target, source, options=Options(scene=False))
    T = pairs[0].T_target_source
    errors = [
        np.nan if answer.T_target_source is None else e_rt(answer.T_target_source, T)
        for answer in (one, all_of_them)
    ]
    return errors[0], errors[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    print(
        "| poles alone | runs | median e_rt m, one | all | ratio |\n| --- | --- | --- | --- | --- |"
    )
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        for kind, name in (("placements", "four placements"), ("frames", "ten frames, noise only")):
            jobs = [(kind, seed) for seed in seeds]
            errors = np.array(list(pool.map(run, jobs)))
            errors = errors[np.isfinite(errors).all(axis=1)]
            one, every = np.median(errors, axis=0)
            print(
                f"| {name} | {len(errors)} of {arguments.seeds} | {one:.4f} | {every:.4f} | "
                f"{every / one:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
