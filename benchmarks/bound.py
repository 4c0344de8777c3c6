"""The poles alone at the paper's simulated set-up, beside what is possible (Sec. IV-A, eq. 13).

Each set-up is drawn at random and each trial draws its noise. Prints a Markdown table of e_rt of

- the paper's estimator;
- the beam model as `calibrate` runs it: the VLP-16 is named, so that its beams have their width,
  and range offsets and the radius have their priors;
- the beam model told that these LiDARs err by noise alone and have infinitely thin beams, which is
  true here and of no LiDAR;
- a draw from the bound of Cramér and Rao of the same set-up: radius known, no offsets. It is made
  of derivatives. That returns come from the whole facing side, evenly spaced, and from nowhere
  beside it, it does not count, so that an estimator may be better;
- the best that is possible: the mean of the posterior of pose and axes, everything else known, of
  the same ranges, of the beams that met the poles and of those that just did not. No estimator has
  a lesser mean square error over all poses. Under isotropic noise it still knows every beam's own
  direction, which an estimator can only guess: there nothing need come near it.

Where poles are so nearly parallel that the beam model refuses, its error counts as infinite.

    python benchmarks/bound.py --setups 40 --trials 2
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from retropole.alignment.adjustment import align_beams
from retropole.alignment.likelihood import arc_likelihood
from retropole.alignment.observations import Beams, beams_of
from retropole.alignment.posterior import SHARED, State, beam_geometry
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import Refusal
from retropole.base.systematic import sizes_of
from retropole.checking.metrics import e_rt
from retropole.simulation import SimulatedPair

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from studies.paper.estimator import (
    NOISE_KINDS,
    PAPER_SIGMA,
    NoiseKind,
    Poles,
    as_beams,
    poles_of,
    solve,
)
from studies.paper.trials import set_up

POLE_LENGTHS = (2.0, 6.0)
"""Poles that a person can carry, and such as end outside of the field of view, metres."""

DRAWS = 200
"""Noisy versions of each return over which its Fisher information is averaged."""

WALKERS, SWEEPS, BURNT = 60, 1500, 500
"""Of the sampler of the posterior (ensemble slice sampling, Karamanis and Beutler 2021)."""

FARTHEST, SHRINKS = 3.0, 60
"""Steps at most from the truth, rad and metres, and so often a slice is narrowed."""

COLUMNS = (
    "paper's estimator",
    "as `calibrate` runs",
    "without such priors",
    "Cramér–Rao",
    "best possible",
)


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


@dataclass(frozen=True, eq=False)
class Seen:
    """What beams say of a step (P,) of pose and axes from the truth, to first order.

    Attributes
    ----------
    depth, lateral_offset, slant
        (N,) of the returns at the truth, metres, and the sine of the angle between beam and pole.
    by_depth, by_lateral_offset
        (N, P) their derivatives.
    passed, by_passed
        (M,) and (M, P) lateral offset of beams that passed, and its derivative.
    """

    depth: Array
    lateral_offset: Array
    slant: Array
    by_depth: Array
    by_lateral_offset: Array
    passed: Array
    by_passed: Array


def beside(one: Beams, step: float, truth: State, lidar: int) -> tuple[Array, Array]:
    """Lateral offset and its derivative of the next beams of each ring beside each pole."""
    elevation = np.arcsin(one.directions[:, 2])
    azimuth = np.arctan2(one.directions[:, 1], one.directions[:, 0])
    ring = np.round(np.degrees(elevation)).astype(np.int64)
    directions, own = [], []
    for pole in np.unique(one.pole):
        centre = azimuth[one.pole == pole][0]
        for level in np.unique(ring[one.pole == pole]):
            run = np.flatnonzero((one.pole == pole) & (ring == level))
            turned = np.angle(np.exp(1j * (azimuth[run] - centre)))
            for end in (turned.min() - step, turned.max() + step):
                up = elevation[run[0]]
                flat = np.cos(up) * np.array([np.cos(centre + end), np.sin(centre + end)])
                directions.append(np.r_[flat, np.sin(up)])
                own.append(pole)
    rays, pole_of = np.array(directions), np.array(own)
    seen = beam_geometry(truth, lidar, one.origin, rays, np.zeros(len(rays)), pole_of)
    # Where another pole stands before this one, the next beam is none that passed.
    outside = np.abs(seen.lateral_offset) > truth.radius
    return seen.lateral_offset[outside], seen.jacobian[outside, 1]


def seen_by(pair: SimulatedPair, exact: tuple[Beams, Beams], noise: tuple[Array, Array]) -> Seen:
    """Linearise what both LiDARs see about the truth; noise is that of the ranges, metres."""
    truth = truth_of(pair)
    parts = []
    for lidar, one in enumerate(exact):
        ranges = one.ranges + noise[lidar]
        seen = beam_geometry(truth, lidar, one.origin, one.directions, ranges, one.pole)
        passed, by_passed = beside(one, pair.sensors[lidar].azimuth_step, truth, lidar)
        parts.append(
            (
                seen.depth,
                seen.lateral_offset,
                seen.sine,
                seen.jacobian[:, 0],
                seen.jacobian[:, 1],
                passed,
                by_passed,
            )
        )
    free = np.r_[0:6, SHARED : parts[0][3].shape[1]]
    joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
    return Seen(*(part[:, free] if part.ndim == 2 else part for part in joined))


def log_posterior(x: Array, seen: Seen, radius: float) -> Array:
    """(W,) logarithm of the posterior of steps (W, P) under which all beams hit that did."""
    m = seen.lateral_offset + x @ seen.by_lateral_offset.T
    chord = np.sqrt(np.maximum(radius**2 - m**2, 0.0))
    off = (seen.depth + x @ seen.by_depth.T - chord) / (PAPER_SIGMA * seen.slant)
    return -0.5 * np.sum(off**2, axis=1)


def possible(x: Array, way: Array, seen: Seen, radius: float) -> tuple[Array, Array]:
    """How far steps (W, P) can go along ways (W, P) both ways, until a beam hits or misses anew."""
    m, by_m = seen.lateral_offset + x @ seen.by_lateral_offset.T, way @ seen.by_lateral_offset.T
    side = np.sign(seen.passed)
    gap, by_gap = (
        side * (seen.passed + x @ seen.by_passed.T) - radius,
        side * (way @ seen.by_passed.T),
    )
    # Every limit is one room that must stay above zero.
    room = np.concatenate([radius - m, radius + m, gap], axis=1)
    by_room = np.concatenate([-by_m, by_m, by_gap], axis=1)
    with np.errstate(divide="ignore"):
        end = -room / by_room
    low = np.where(by_room > 0, end, -FARTHEST).max(axis=1)
    high = np.where(by_room < 0, end, FARTHEST).min(axis=1)
    return np.maximum(low, -FARTHEST), np.minimum(high, FARTHEST)


def posterior_mean(seen: Seen, radius: float, rng: np.random.Generator) -> Array:
    """Mean (P,) of the posterior, by slices along the differences of an ensemble of walkers."""
    size = seen.by_depth.shape[1]
    x = 1e-9 * rng.normal(size=(WALKERS, size))
    log = log_posterior(x, seen, radius)
    half, total = WALKERS // 2, np.zeros(size)
    for sweep in range(SWEEPS):
        for own, other in ((slice(half), slice(half, None)), (slice(half, None), slice(half))):
            first = rng.integers(half, size=half)
            second = (first + rng.integers(1, half, size=half)) % half
            way = x[other][first] - x[other][second]
            way /= np.linalg.norm(way, axis=1, keepdims=True)
            low, high = possible(x[own], way, seen, radius)
            level = log[own] + np.log(rng.uniform(size=half))
            start = x[own].copy()
            left = np.arange(half)
            for _ in range(SHRINKS):
                t = rng.uniform(low[left], high[left])
                new = start[left] + t[:, None] * way[left]
                new_log = log_posterior(new, seen, radius)
                inside = new_log >= level[left]
                x[own][left[inside]] = new[inside]
                log[own][left[inside]] = new_log[inside]
                low[left] = np.where(t < 0, t, low[left])
                high[left] = np.where(t < 0, high[left], t)
                left = left[~inside]
                if not len(left):
                    break
        if sweep >= BURNT:
            total += x.mean(axis=0)
    return total / (SWEEPS - BURNT)


def as_calibrate(pair: SimulatedPair, poles: Poles, start: Array) -> Array | None:
    """The pose (4, 4) that `calibrate` takes from these poles; None where it refuses."""
    beams = [
        beams_of([(pole, cloud) for pole in seen], sensor)
        for seen, cloud, sensor in zip(poles, (pair.target, pair.source), pair.sensors, strict=True)
    ]
    sizes = sizes_of(pair.sensors[0]), sizes_of(pair.sensors[1])
    try:
        found = align_beams(*beams, start, radius=pair.poles[0].radius, sizes=sizes)
    except Refusal:
        return None
    return found.pose.T_target_source


def run(job: tuple[int, NoiseKind, float, int]) -> list[list[float]]:
    """e_rt of each of `COLUMNS`, for each trial."""
    seed, noise, length, trials = job
    with threadpool_limits(1, user_api="blas"):
        rng, sampler = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 3])
        pair = set_up(seed, length)
        T, radius = pair.T_target_source, pair.poles[0].radius
        exact = as_beams(pair, poles_of(pair, "none", rng))
        limit = np.zeros((6, 6)) if noise == "none" else bound(pair, noise, rng)
        errors = []
        for _ in range(trials):
            poles = poles_of(pair, noise, rng)
            found = solve(pair, poles)
            ours = as_calibrate(pair, poles, found.paper.T_target_source)
            told = None if found.beam_model is None else found.beam_model.T_target_source
            drawn = se3.retract(T, rng.multivariate_normal(np.zeros(6), limit))
            best = T
            if noise != "none":
                along = along_beams(exact, as_beams(pair, poles))
                x = posterior_mean(seen_by(pair, exact, along), radius, sampler)
                best = se3.retract(T, x[:6])
            each = (found.paper.T_target_source, ours, told, drawn, best)
            errors.append([np.inf if one is None else e_rt(one, T) for one in each])
    return errors


def along_beams(exact: tuple[Beams, Beams], noisy: tuple[Beams, Beams]) -> tuple[Array, Array]:
    """How much farther along their own beams the returns lie than without noise, metres."""
    target, source = (
        np.sum(b.directions * b.ranges[:, None] * a.directions, axis=1) - a.ranges
        for a, b in zip(exact, noisy, strict=True)
    )
    return target, source


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--setups", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.setups)
    print(f"| noise, 6 mm | poles | e_rt m | {' | '.join(COLUMNS)} |")
    print("| --- " * (3 + len(COLUMNS)) + "|")
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        for noise in NOISE_KINDS:
            for length in POLE_LENGTHS:
                trials = 1 if noise == "none" else arguments.trials
                jobs = [(seed, noise, length, trials) for seed in seeds]
                errors = np.concatenate(list(pool.map(run, jobs, chunksize=4)))
                refused = ~np.isfinite(errors).all(axis=1)
                start = f"| {noise} | {length:g} m |"
                for name, row in (
                    ("median", np.median(errors, axis=0)),
                    ("mean of the answered", np.mean(errors[~refused], axis=0)),
                    ("90 %", np.quantile(errors, 0.9, axis=0)),
                ):
                    cells = " | ".join(f"{value:.4f}" for value in row)
                    print(f"{start} {name} | {cells} |", flush=True)
                counts = " | ".join(str(n) for n in np.count_nonzero(np.isinf(errors), axis=0))
                print(f"{start} refused, of {len(errors)} | {counts} |", flush=True)


if __name__ == "__main__":
    main()
