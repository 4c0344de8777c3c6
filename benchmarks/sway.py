"""Masts that sway while they record: is the rest within what is stated, and how far off is it?

Usage:
    python benchmarks/sway.py --runs 12
    python benchmarks/sway.py --runs 20 --one-sweep

Each run is a street, a harbor or a square with all errors of the field. Both LiDARs stand on masts
of 4 to 8 m, one each or, in every third run, both on one, which turns about its foot at one
frequency; the axis and the phase are drawn. In every other run the returns have no times. Beside
it the same with the masts at rest, and with all sweeps taken for one, so that nothing is known of
the sway. Seeds from 1000 state; seeds 0 to 3 and a hall (tests/scene/swaying.py) tuned.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import numpy as np
from threadpoolctl import threadpool_limits

from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, PointCloud
from retropole.base.uncertainty import predicted_error
from retropole.pipeline import calibrate
from retropole.simulation import FIELD, SimulatedPair, SimulationError, simulate_pair
from retropole.simulation.environment import Sway
from retropole.simulation.scanning import scan

KINDS = "street", "harbor", "square"
SIZES_DEG, FREQUENCIES, FRAMES = (0.02, 0.05, 0.1), (0.3, 1.0), (10, 30, 100)
AT = 30.0
CHI2 = 12.592
"""95 % of χ² with six degrees of freedom."""


@dataclass(frozen=True)
class Found:
    """One run: the error and 1 σ at `AT`, whether the rest is within the region of 95 %, the
    verdict; the errors of masts at rest, and without what the sweeps show."""

    row: tuple[float, float, int]
    status: str
    error: float = np.nan
    stated: float = np.nan
    covered: bool = False
    said: bool = False
    still: float = np.nan
    blind: float = np.nan
    blind_covered: bool = False


def draw_masts(
    sigma: float, hz: float, pair: SimulatedPair, one: bool, rng: np.random.Generator
) -> tuple[Sway, Sway]:
    """Draw how both masts sway: 1 σ of the angle, rad, and the frequency, Hz."""
    found = []
    for T in (pair.T_world_target, pair.T_world_source):
        heading, phase = rng.uniform(0, 2 * np.pi, 2)
        foot = T[:3, 3] - np.array([0.0, 0.0, rng.uniform(4.0, 8.0)])
        axis = np.array([np.cos(heading), np.sin(heading), 0.0])
        found.append(Sway(axis, float(np.sqrt(2) * sigma), float(phase), hz, foot))
    if one:
        found[1] = found[0]
    return found[0], found[1]


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


def error_of(T: Array, truth: Array) -> float:
    """Root mean square over all directions of how far a point `AT` away is off, metres."""
    step = se3.local(T, truth)
    return float(np.sqrt(2 / 3 * AT**2 * (step[:3] @ step[:3]) + step[3:] @ step[3:]))


def holds(answer: Calibration, truth: Array) -> bool:
    """Whether the stated region of 95 % holds the truth."""
    assert answer.T_target_source is not None
    assert answer.covariance is not None
    step = se3.local(answer.T_target_source, truth)
    return float(step @ np.linalg.solve(answer.covariance, step)) <= CHI2


def run(job: tuple[float, float, int, int]) -> Found | None:
    """Record one scene on swaying masts, and calibrate."""
    sigma_deg, hz, frames, seed = job
    row = sigma_deg, hz, frames
    rng = np.random.default_rng([seed, round(1e3 * sigma_deg), round(10 * hz), frames])
    with threadpool_limits(1, user_api="blas"):
        try:
            pair = simulate_pair(KINDS[seed % 3], rng, noise=FIELD)
        except SimulationError:
            return None
        truth = pair.T_target_source
        sways = draw_masts(np.radians(sigma_deg), hz, pair, seed % 3 == 2, rng)
        times = seed % 2 == 0
        clouds = recorded(pair, frames, sways, (seed, 1), times=times)
        stated = np.radians(sigma_deg) if frames == 1 else None
        found = calibrate(*clouds, sensors=pair.sensors, mast_sway=stated)
        if found.T_target_source is None or found.covariance is None:
            return Found(row, found.reasons[0].code)
        at_rest = calibrate(
            *recorded(pair, frames, (None, None), (seed, 1), times=times), sensors=pair.sensors
        )
        blind = calibrate(*(replace(c, frame=None) for c in clouds), sensors=pair.sensors)
        rest, other = at_rest.T_target_source, blind.T_target_source
        return Found(
            row,
            found.status,
            error_of(found.T_target_source, truth),
            predicted_error(found.covariance, (AT,))[0].sigma_m,
            holds(found, truth),
            "sways" in [note.code for note in found.notes],
            np.nan if rest is None else error_of(rest, truth),
            np.nan if other is None else error_of(other, truth),
            other is not None and holds(blind, truth),
        )


def table(every: Sequence[Found]) -> str:
    """Write a row for each kind of recording."""
    lines = [
        "sway 1 σ | frequency | sweeps | answered | within the region of 95 % | said | error "
        "| stated | at rest | as one sweep | within",
        " | ".join(["---"] * 11),
    ]
    rows = sorted({one.row for one in every})
    for row in [*rows, None]:
        own = [one for one in every if row in (None, one.row)]
        done = [one for one in own if np.isfinite(one.error)]
        if not done:
            continue
        blind = [one for one in done if np.isfinite(one.blind)]

        def middle(name: str, done: Sequence[Found] = done) -> str:
            return f"{1e3 * np.nanmedian([getattr(one, name) for one in done]):.1f}"

        name = ("all", "", "") if row is None else (f"{row[0]}°", f"{row[1]:g} Hz", row[2])
        lines.append(
            " | ".join(
                map(
                    str,
                    (
                        *name,
                        f"{len(done)} of {len(own)}",
                        f"{sum(one.covered for one in done)} of {len(done)}",
                        sum(one.said for one in done),
                        *(middle(n) for n in ("error", "stated", "still", "blind")),
                        f"{sum(one.blind_covered for one in blind)} of {len(blind)}",
                    ),
                )
            )
        )
    return "\n".join(f"| {line} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--sizes", type=float, nargs="+", default=list(SIZES_DEG))
    parser.add_argument("--frequencies", type=float, nargs="+", default=list(FREQUENCIES))
    parser.add_argument("--frames", type=int, nargs="+", default=list(FRAMES))
    parser.add_argument("--one-sweep", action="store_true", help="one sweep, and the sway stated")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    frames = [1] if options.one_sweep else options.frames
    seeds = range(options.first, options.first + options.runs)
    jobs = [
        (size, hz, n, seed)
        for n in frames
        for size in options.sizes
        for hz in options.frequencies
        for seed in seeds
    ]
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        every = [one for one in pool.map(run, jobs) if one is not None]
    print(table(every))
    refused = sorted({one.status for one in every if not np.isfinite(one.error)})
    print("\nrefused as: " + (", ".join(refused) or "–"))


if __name__ == "__main__":
    sys.exit(main())
