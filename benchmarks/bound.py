"""The poles alone at the paper's simulated set-up, beside the Cramér–Rao bound (Sec. IV-A, eq. 12).

Each set-up is drawn at random and each trial draws its noise: the paper's estimator, the beam
model, and errors drawn from the bound of the same set-up. Where poles are so nearly parallel that
the beam model refuses, its error counts as infinite. Prints a Markdown table of e_rt.

    python benchmarks/bound.py --setups 200 --trials 10
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from retropole import se3
from retropole.alignment.likelihood import arc_likelihood
from retropole.alignment.posterior import SHARED, State, beam_geometry
from retropole.datatypes import Array
from retropole.evaluation.metrics import e_rt
from retropole.evaluation.paper.estimator import (
    NOISE_KINDS,
    PAPER_SIGMA,
    NoiseKind,
    as_beams,
    poles_of,
    solve,
)
from retropole.simulation import EXACT, SimulatedPair, simulate_pair

DRAWS = 200
"""Noisy versions of each return over which its Fisher information is averaged."""


def truth_of(pair: SimulatedPair) -> State:
    T = se3.inverse(pair.T_world_target)
    return State(
        pair.T_target_source,
        np.zeros(2),
        pair.poles[0].radius,
        se3.apply(T, np.array([pole.centre for pole in pair.poles])),
        np.array([pole.axis for pole in pair.poles]) @ T[:3, :3].T,
    )


def bound(pair: SimulatedPair, noise: NoiseKind, rng: np.random.Generator) -> Array:
    """Cramér–Rao bound (6, 6) of the pose; radius known, axes estimated, no offsets.

    Noise along the beam: the beams are known, a return tells its range. Isotropic noise: which beam
    a return came from is not known, so its place on the facing side is integrated out.
    """
    truth = truth_of(pair)
    beams = as_beams(pair, poles_of(pair, "none", rng))
    information = np.zeros((SHARED + 4 * len(pair.poles),) * 2)
    for lidar, one in enumerate(beams):
        if noise == "along the beam":
            seen = beam_geometry(truth, lidar, one.origin, one.directions, one.ranges, one.pole)
            m = seen.lateral_offset[:, None]
            chord = np.sqrt(np.maximum(truth.radius**2 - m**2, 1e-12))
            gradient = seen.jacobian[:, 0] + m / chord * seen.jacobian[:, 1]
            gradient /= (PAPER_SIGMA * seen.sine)[:, None]
            information += gradient.T @ gradient
            continue
        for _ in range(DRAWS):
            xyz = one.ranges[:, None] * one.directions
            xyz = xyz + PAPER_SIGMA * rng.normal(size=xyz.shape)
            ranges = np.linalg.norm(xyz, axis=1)
            directions = xyz / ranges[:, None]
            seen = beam_geometry(truth, lidar, one.origin, directions, ranges, one.pole)
            sigma = np.full(len(ranges), PAPER_SIGMA)
            arc = arc_likelihood(seen.depth, seen.lateral_offset, sigma, sigma, truth.radius)
            gradient = np.einsum("na,nai->ni", arc.score[:, :2], seen.jacobian)
            information += gradient.T @ gradient / DRAWS
    free = np.r_[0:6, SHARED : len(information)]
    return np.asarray(np.linalg.inv(information[np.ix_(free, free)])[:6, :6])


def run(job: tuple[int, NoiseKind, int]) -> list[tuple[float, float, float]]:
    """e_rt of the paper's estimator, of ours, and of a draw from the bound, for each trial."""
    seed, noise, trials = job
    rng = np.random.default_rng([seed, 1])
    pair = simulate_pair("paper", np.random.default_rng(seed), noise=EXACT)
    T = pair.T_target_source
    limit = np.zeros((6, 6)) if noise == "none" else bound(pair, noise, rng)
    errors = []
    for _ in range(trials):
        found = solve(pair, poles_of(pair, noise, rng))
        drawn = se3.retract(T, rng.multivariate_normal(np.zeros(6), limit))
        model = found.beam_model
        ours = np.inf if model is None else e_rt(model.T_target_source, T)
        errors.append((e_rt(found.paper.T_target_source, T), ours, e_rt(drawn, T)))
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--setups", type=int, default=200)
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    print("| noise, 6 mm | e_rt m | paper's estimator | beam model | bound | beam model / bound |")
    print("| --- | --- | --- | --- | --- | --- |")
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        for noise in NOISE_KINDS:
            trials = 1 if noise == "none" else arguments.trials
            jobs = [(seed, noise, trials) for seed in range(arguments.setups)]
            errors = np.concatenate(list(pool.map(run, jobs, chunksize=4)))
            refused = ~np.isfinite(errors[:, 1])
            for name, row in (
                ("median", np.median(errors, axis=0)),
                ("mean of the answered", np.mean(errors[~refused], axis=0)),
                ("90 %", np.quantile(errors, 0.9, axis=0)),
            ):
                ratio = "" if noise == "none" else f"{row[1] / row[2]:.2f}"
                cells = " | ".join(f"{value:.4f}" for value in row)
                print(f"| {noise} | {name} | {cells} | {ratio} |", flush=True)
            print(f"| {noise} | refused | | {np.count_nonzero(refused)} of {len(errors)} | | |")


if __name__ == "__main__":
    main()
