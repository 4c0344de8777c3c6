"""Masts that sway while they record: is the rest within what is stated, and how far off is it?

Usage:
    python benchmarks/sway.py --runs 12
    python benchmarks/sway.py --runs 12 --one-mast
    python benchmarks/sway.py --runs 12 --modes
    python benchmarks/sway.py --runs 20 --one-sweep

Each run is a street, a harbor or a square with all errors of the field. Both LiDARs stand on masts
of 4 to 8 m, one each or both on one, which turns about its foot at one frequency; the axis and the
phase are drawn. With --modes it turns about two axes, at five frequencies of a narrow band and in a
second mode, three times as fast and about a quarter as large. In half of the runs the returns have
no times. Beside it the same with the masts at rest, and with all sweeps taken for one, so that
nothing is known of the sway. Seeds from 1000 state; seeds 0 to 299 and a hall
(tests/surfaces/swaying.py) tuned.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context

import numpy as np
from threadpoolctl import threadpool_limits

from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, PointCloud
from retropole.base.uncertainty import predicted_error
from retropole.pipeline import Options, calibrate
from retropole.simulation import FIELD, SimulatedPair, SimulationError, simulate_pair
from retropole.simulation.scanning import Sway, scan

KINDS = "street", "harbor", "square"
SIZES_DEG, FREQUENCIES, FRAMES = (0.02, 0.05, 0.1), (0.3, 1.0), (10, 30, 100)
AT = 30.0
CHI2 = 12.592
"""95 % of χ² with six degrees of freedom."""


@dataclass(frozen=True)
class Found:
    """One run: the error and 1 σ at `AT`, whether the truth is within the region of 95 %, the
    verdict; error and region with the masts at rest, and without what the sweeps show."""

    row: tuple[float, float, int]
    status: str
    error: float = np.nan
    stated: float = np.nan
    covered: bool = False
    said: bool = False
    still: float = np.nan
    still_covered: bool = False
    blind: float = np.nan
    blind_covered: bool = False


@dataclass(frozen=True)
class Modes(Sway):
    """A mast that moves at several frequencies, Hz (M,), about level axes (M, 3), with amplitudes,
    rad, and phases (M,)."""

    every: tuple[Array, Array, Array, Array] | None = None

    def turn(self, rays: Array, times: Array) -> Array:
        """Turn rays (N, 3) of the world as the mast stands at times (N,), s."""
        assert self.every is not None
        hz, axes, amplitudes, phases = self.every
        turn = (amplitudes * np.sin(2 * np.pi * np.multiply.outer(times, hz) + phases)) @ axes
        once = np.cross(turn, rays)
        return np.asarray(rays + once + np.cross(turn, once) / 2)


@dataclass(frozen=True)
class Masts:
    """How masts sway: 1 σ of the angle, rad, at a frequency, Hz; both LiDARs on one; in modes."""

    sigma: float
    hz: float
    one: bool = False
    modes: bool = False

    def draw(self, pair: SimulatedPair, rng: np.random.Generator) -> tuple[Sway, Sway]:
        """Draw those of both LiDARs."""
        target, source = (
            self._draw(T[:3, 3], rng) for T in (pair.T_world_target, pair.T_world_source)
        )
        return target, target if self.one else source

    def _draw(self, rest: Array, rng: np.random.Generator) -> Sway:
        heading, phase = rng.uniform(0, 2 * np.pi, 2)
        foot = rest - np.array([0.0, 0.0, rng.uniform(4.0, 8.0)])
        axis = np.array([np.cos(heading), np.sin(heading), 0.0])
        largest = float(np.sqrt(2) * self.sigma)
        if not self.modes:
            return Sway(axis, largest, float(phase), self.hz, foot)
        aside = np.array([-axis[1], axis[0], 0.0])
        band = self.hz * (1 + 0.1 * rng.normal(size=5))
        amplitudes = np.concatenate(
            [
                rng.rayleigh(size=5),
                rng.uniform(0, 0.7) * rng.rayleigh(size=5),
                0.2 * np.sqrt(5) * rng.rayleigh(size=2),
            ]
        )
        every = (
            np.concatenate([band, band, 3 * np.full(2, self.hz)]),
            np.stack([axis] * 5 + [aside] * 5 + [axis, aside]),
            amplitudes * largest / np.linalg.norm(amplitudes),
            rng.uniform(0, 2 * np.pi, 12),
        )
        return Modes(axis, largest, float(phase), self.hz, foot, every)


def recorded(
    pair: SimulatedPair,
    frames: int,
    sways: Sequence[Sway | None],
    seed: Sequence[int],
    *,
    times: bool,
) -> list[PointCloud]:
    """Record with both LiDARs, at the same time."""
    clouds = []
    poses = pair.T_world_target, pair.T_world_source
    for k, (sensor, T, device, sway) in enumerate(
        zip(pair.sensors, poses, pair.devices, sways, strict=True)
    ):
        made = scan(
            pair.surfaces,
            sensor,
            T,
            np.random.default_rng([*seed, k]),
            FIELD,
            frames,
            device=device,
            sway=sway,
        ).cloud
        clouds.append(made if times else replace(made, time=None))
    return clouds


def error_of(answer: Calibration, truth: Array) -> float:
    """Root mean square over all directions of how far a point `AT` away is off, metres; NaN where
    there is no answer."""
    if answer.T_target_source is None:
        return np.nan
    step = se3.local(answer.T_target_source, truth)
    return float(np.sqrt(2 / 3 * AT**2 * (step[:3] @ step[:3]) + step[3:] @ step[3:]))


def holds(answer: Calibration, truth: Array) -> bool:
    """Whether the stated region of 95 % holds the truth."""
    if answer.T_target_source is None or answer.covariance is None:
        return False
    step = se3.local(answer.T_target_source, truth)
    return float(step @ np.linalg.solve(answer.covariance, step)) <= CHI2


def run(job: tuple[Sequence[tuple[float, float]], int, int, bool, bool]) -> list[Found]:
    """Record one scene with masts at rest and swaying in several ways, and calibrate."""
    ways, frames, seed, one_mast, modes = job
    times = seed // 3 % 2 == 0
    with threadpool_limits(1, user_api="blas"):
        try:
            pair = simulate_pair(KINDS[seed % 3], np.random.default_rng(seed), noise=FIELD)
        except SimulationError:
            return []
        record = partial(recorded, pair, frames, seed=(seed, 1), times=times)
        truth = pair.T_target_source
        at_rest = calibrate(*record((None, None)), options=Options(sensors=pair.sensors))
        found = []
        for sigma_deg, hz in ways:
            rng = np.random.default_rng([seed, round(1e3 * sigma_deg), round(10 * hz)])
            masts = Masts(float(np.radians(sigma_deg)), hz, one_mast, modes)
            clouds = record(masts.draw(pair, rng))
            stated = np.radians(sigma_deg) if frames == 1 else None
            answer = calibrate(*clouds, options=Options(sensors=pair.sensors, mast_sway=stated))
            row = sigma_deg, hz, frames
            if answer.T_target_source is None or answer.covariance is None:
                found.append(Found(row, answer.reasons[0].code))
                continue
            blind = calibrate(
                *(replace(c, frame=None) for c in clouds), options=Options(sensors=pair.sensors)
            )
            found.append(
                Found(
                    row,
                    answer.status,
                    error_of(answer, truth),
                    predicted_error(answer.covariance, (AT,))[0].sigma_m,
                    holds(answer, truth),
                    "sways" in [note.code for note in answer.notes],
                    error_of(at_rest, truth),
                    holds(at_rest, truth),
                    error_of(blind, truth),
                    holds(blind, truth),
                )
            )
    return found


def table(every: Sequence[Found]) -> str:
    """Write a row for each kind of recording."""
    columns = (
        "sway 1 σ",
        "frequency",
        "sweeps",
        "answered",
        "said",
        "error",
        "stated",
        "at rest",
        "as one sweep",
        "within the region of 95 %",
        "at rest",
        "as one sweep",
    )
    lines = [" | ".join(columns), " | ".join(["---"] * len(columns))]
    rows = sorted({one.row for one in every}, key=lambda row: (row[2], *row))
    for row in [*rows, None]:
        own = [one for one in every if row in (None, one.row)]
        done = [one for one in own if np.isfinite(one.error)]
        if not done:
            continue

        def middle(name: str, done: Sequence[Found] = done) -> str:
            return f"{1e3 * np.nanmedian([getattr(one, name) for one in done]):.1f}"

        def within(name: str, error: str, done: Sequence[Found] = done) -> str:
            answered = [one for one in done if np.isfinite(getattr(one, error))]
            return f"{sum(getattr(one, name) for one in answered)} of {len(answered)}"

        name = ("all", "", "") if row is None else (f"{row[0]}°", f"{row[1]:g} Hz", str(row[2]))
        cells = (
            *name,
            f"{len(done)} of {len(own)}",
            str(sum(one.said for one in done)),
            *(middle(n) for n in ("error", "stated", "still", "blind")),
            within("covered", "error"),
            within("still_covered", "still"),
            within("blind_covered", "blind"),
        )
        lines.append(" | ".join(cells))
    return "\n".join(f"| {line} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--sizes", type=float, nargs="+", default=list(SIZES_DEG))
    parser.add_argument("--frequencies", type=float, nargs="+", default=list(FREQUENCIES))
    parser.add_argument("--frames", type=int, nargs="+", default=list(FRAMES))
    parser.add_argument("--one-mast", action="store_true", help="both LiDARs on one")
    parser.add_argument("--modes", action="store_true", help="masts that move in several modes")
    parser.add_argument("--one-sweep", action="store_true", help="one sweep, and the sway stated")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    ways = [(size, hz) for size in options.sizes for hz in options.frequencies]
    jobs = [
        (ways, frames, seed, options.one_mast, options.modes)
        for frames in ([1] if options.one_sweep else options.frames)
        for seed in range(options.first, options.first + options.runs)
    ]
    every: list[Found] = []
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for job, own in zip(jobs, pool.map(run, jobs), strict=True):
            every.extend(own)
            print(f"seed {job[2]}, {job[1]} sweeps", file=sys.stderr, flush=True)
    print(table(every))
    refused = sorted({one.status for one in every if not np.isfinite(one.error)})
    print("\nrefused as: " + (", ".join(refused) or "–"))


if __name__ == "__main__":
    sys.exit(main())
