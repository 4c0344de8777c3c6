"""What more sweeps of stationary LiDARs gain: the whole method, at the same places.

Streets, harbours and squares with all errors of a field; the first sweeps of one recording are
taken, so that LiDARs, poles and surroundings are the same in every row. The last column is χ² of
the poles' returns alone at the true pose and the LiDARs' true errors: its median is 5.3 where their
scatter is stated right. Prints a Markdown table. Seeds below 100 may set constants, those from 1000
on state figures.

    python benchmarks/sweeps.py --places 40

With ``--pairs`` LiDARs that do not see all around, or never repeat their pattern, are paired with
an XT32 and with each other, each pair at places of its own. The table says of every pair, and of
every number of sweeps, how many are answered where both LiDARs see both poles (`ENOUGH` returns on
each), how many are wrong (beyond `WRONG_ANGLE` or `WRONG_DISTANCE`), and how many say that a LiDAR
moved: none did. Seeds to 5 were used to mend what was wrong; those from 1000 on state the figures,
which was written here before they were run.

    python benchmarks/sweeps.py --pairs --places 30 --frames 1 5 20
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain, combinations
from multiprocessing import get_context

import numpy as np

from detection_hard import WRONG_ANGLE, WRONG_DISTANCE
from retropole.alignment.network import PoleFactor, steps_to
from retropole.base import se3
from retropole.base.datatypes import DEFAULT_RADIUS, Array, Calibration, PointCloud
from retropole.base.quantities import counted
from retropole.base.sensors import Sensor
from retropole.base.systematic import BAND, TAPE
from retropole.base.uncertainty import predicted_error
from retropole.hypotheses.placements import PairedPlacement, align
from retropole.pipeline import Options, calibrate
from retropole.simulation import FIELD, SimulatedPair, SimulationError, simulate_pair
from retropole.simulation.devices import Device
from sway import AT, error_of, holds

KINDS = "street", "harbor", "square"

LIMITED = "Mid-360", "Avia", "HAP", "AT128", "RS-LiDAR-M1"
PAIRS = [("XT32", name) for name in LIMITED] + list(combinations(LIMITED, 2))
"""Of LiDARs, for ``--pairs``."""

ENOUGH, SHORTEST = 10, 0.4
"""A LiDAR sees a pole with so many returns on such a length of it, metres: shorter ones are none
(docs/reasons.md, too_short)."""


@dataclass(frozen=True)
class Run:
    """Error and 1 σ at `AT`, m; whether the truth is within the region of 95 %; χ² of the poles at
    the truth; CPU seconds."""

    status: str
    seconds: float
    error: float = np.nan
    stated: float = np.nan
    covered: bool = False
    poles: float = np.nan


def first_sweeps(cloud: PointCloud, count: int) -> PointCloud:
    """Give the first sweeps of a recording."""
    some = cloud.select(np.asarray(cloud.frame) < count)
    return replace(some, frame=None) if count == 1 else some


def errors_of(device: Device, sensor: Sensor, bands: Array) -> Array:
    """Errors of a simulated LiDAR in the order of `systematic`: the whole LiDAR's, then its rings'.

    Rings of one band have their mean.
    """
    whole = np.zeros(TAPE + 2)
    whole[:TAPE] = [
        device.zero_offset,
        device.scale,
        device.slant,
        *device.encoder,
        *device.wobble,
        *device.bend,
        device.elevation,
    ]
    whole[TAPE] = device.tape_offset
    own = np.floor(np.asarray(sensor.elevations) / BAND + 1e-6).astype(int)
    kinds = device.ring_range, device.ring_elevation, device.ring_azimuth
    rings = [
        [float(np.mean(kind[own == band])) if (own == band).any() else 0.0 for band in bands]
        for kind in kinds
    ]
    return np.concatenate([whole, *rings])


def poles_at_truth(factor: PoleFactor, pair: SimulatedPair) -> float:
    """χ² of what the poles say of the pose, at the true pose and the true errors."""
    unknowns = factor.unknowns
    true = np.zeros(unknowns.kept)
    T = np.stack([np.eye(4), pair.T_target_source])
    true[: unknowns.poses] = steps_to(factor.T, T)[0]
    for lidar, (device, sensor) in enumerate(zip(pair.devices, pair.sensors, strict=True)):
        bands = unknowns.bands[lidar]
        errors = errors_of(device, sensor, bands)
        place = np.r_[unknowns.device(lidar)]
        true[place] = errors[: len(place)]
        for kind, part in enumerate(np.split(errors[len(place) :], 3)):
            true[unknowns.rings(lidar, kind, bands)] = part
    pose = unknowns.pose(1)
    score = (factor.vector - factor.information @ true)[pose]
    return float(score @ np.linalg.solve(factor.information[np.ix_(pose, pose)], score))


def poles_of(answer: Calibration) -> PoleFactor:
    assert answer.T_target_source is not None
    paired = [PairedPlacement(answer.placements[0], answer.hypotheses[0])]
    return align(paired, answer.T_target_source, radius=DEFAULT_RADIUS, radius_sigma=0.0).factor


def answers(pair: SimulatedPair, counts: Sequence[int]) -> Iterator[tuple[int, Calibration, float]]:
    """Calibrate by the first sweeps of one recording, so many at a time: how many, the answer, and
    its CPU seconds."""
    for count in counts:
        clouds = [first_sweeps(cloud, count) for cloud in (pair.target, pair.source)]
        start = time.process_time()
        answer = calibrate(*clouds, options=Options(sensors=pair.sensors))
        yield count, answer, time.process_time() - start


def run(job: tuple[int, tuple[int, ...]]) -> list[Run]:
    """Calibrate by the first sweeps of one recording, so many at a time; nothing where nothing
    possible was drawn."""
    seed, counts = job
    try:
        pair = simulate_pair(
            KINDS[seed % len(KINDS)],
            np.random.default_rng(seed),
            noise=FIELD,
            frames=max(counts),
        )
    except SimulationError:
        return []
    found = []
    for _, answer, seconds in answers(pair, counts):
        if answer.T_target_source is None or answer.covariance is None:
            found.append(Run(answer.reasons[0].code, seconds))
            continue
        T = pair.T_target_source
        found.append(
            Run(
                answer.status,
                seconds,
                error_of(answer, T),
                predicted_error(answer.covariance, (AT,))[0].sigma_m,
                holds(answer, T),
                poles_at_truth(poles_of(answer), pair),
            )
        )
    return found


@dataclass(frozen=True)
class PairRun:
    """What came of a pair at one place with so many sweeps."""

    names: tuple[str, str]
    seed: int
    count: int
    is_seen: bool
    status: str
    codes: tuple[str, ...]
    is_wrong: bool = False
    covered: bool = False
    error: float = np.nan
    seconds: float = 0.0


def extent(xyz: Array) -> float:
    """Greatest distance of points (N, 3) along an axis, metres: of a pole, its length in view."""
    return float(np.linalg.norm(np.ptp(xyz, axis=0)))


def run_pair(job: tuple[tuple[str, str], int, tuple[int, ...]]) -> list[PairRun]:
    """Calibrate a pair of LiDARs by the first sweeps of one recording, so many at a time."""
    names, seed, counts = job
    try:
        pair = simulate_pair(
            KINDS[seed % len(KINDS)],
            np.random.default_rng([seed, PAIRS.index(names)]),
            sensor_target=names[0],
            sensor_source=names[1],
            noise=FIELD,
            frames=max(counts),
        )
    except SimulationError:
        return []
    found = []
    for count, answer, seconds in answers(pair, counts):
        first = len(pair.surroundings)
        sights = [
            cloud.xyz[(np.asarray(cloud.frame) < count) & (labels == first + k)]
            for cloud, labels in zip((pair.target, pair.source), pair.labels, strict=True)
            for k in range(len(pair.poles))
        ]
        is_seen = all(len(xyz) >= ENOUGH and extent(xyz) > SHORTEST for xyz in sights)
        codes = tuple(reason.code for reason in answer.reasons)
        one = PairRun(names, seed, count, is_seen, answer.status, codes)
        if answer.T_target_source is not None:
            off = se3.local(answer.T_target_source, pair.T_target_source)
            angle, distance = np.linalg.norm(off[:3]), np.linalg.norm(off[3:])
            one = replace(
                one,
                is_wrong=bool(angle > WRONG_ANGLE or distance > WRONG_DISTANCE),
                covered=holds(answer, pair.T_target_source),
                error=error_of(answer, pair.T_target_source),
            )
        found.append(replace(one, seconds=seconds))
        print(found[-1], flush=True)
    return found


def pair_row(name: str, runs: Sequence[PairRun]) -> str:
    seen = [one for one in runs if one.is_seen]
    answered = [one for one in runs if one.status != "refused"]
    refused = [one.codes[0] for one in seen if one.status == "refused"]
    cells = [
        name,
        f"{len(runs)}",
        f"{len(answered)}",
        f"{len(seen) - len(refused)} of {len(seen)}",
        " ".join(f"{code} {refused.count(code)}" for code in sorted(set(refused))) or "0",
        f"{sum(one.is_wrong for one in answered)}",
        f"{sum(one.covered for one in answered)} of {len(answered)}",
        f"{sum('moving_lidar' in one.codes for one in runs)}",
        f"{1000 * np.median([one.error for one in answered]):.1f}" if answered else "",
        f"{np.mean([one.seconds for one in runs]):.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


def pairs_table(runs: Sequence[PairRun], counts: Sequence[int]) -> str:
    lines = [
        "| pair | runs | answered | where both see both poles | of those refused | wrong "
        "| within 95 % | `moving_lidar` | error at 30 m, median, mm | CPU s |",
        "| --- " * 10 + "|",
    ]
    for names in PAIRS:
        own = [one for one in runs if one.names == names]
        lines += [pair_row(" and ".join(names), own)] if own else []
    for count in counts:
        own = [one for one in runs if one.count == count]
        lines.append(pair_row(counted(count, "sweep"), own))
    return "\n".join([*lines, pair_row("all", runs)])


def row(count: int, runs: Sequence[Run]) -> str:
    kept = [one for one in runs if np.isfinite(one.error)]
    made = 1000 * np.array([one.error for one in kept])
    ratio = [one.stated / one.error for one in kept]
    cells = [
        f"{count}",
        f"{len(kept)} of {len(runs)}",
        f"{np.median(made):.1f}",
        f"{np.sqrt(np.mean(made**2)):.1f}",
        f"{made.max():.1f}",
        f"{1000 * np.median([one.stated for one in kept]):.1f}",
        f"{np.median(ratio):.2f}",
        f"{sum(one.covered for one in kept)} of {len(kept)}",
        f"{np.median([one.poles for one in kept]):.1f}",
        f"{np.mean([one.seconds for one in runs]):.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--places", type=int, default=40)
    parser.add_argument("--first", type=int, default=1000, help="first seed")
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 3, 10, 30])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--pairs", action="store_true", help="of LiDARs with a limited view")
    arguments = parser.parse_args()
    counts = tuple(arguments.frames)
    seeds = range(arguments.first, arguments.first + arguments.places)
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        if arguments.pairs:
            jobs = [(names, seed, counts) for seed in seeds for names in PAIRS]
            print(pairs_table(list(chain.from_iterable(pool.map(run_pair, jobs))), counts))
            return
        places = [found for found in pool.map(run, [(seed, counts) for seed in seeds]) if found]
    print(
        "| sweeps | answered | error at 30 m, median, mm | rms | largest | stated, median | "
        "stated / made, median | within 95 % | poles' χ² at the truth, median | CPU s |\n"
        + "| --- " * 10
        + "|"
    )
    for k, count in enumerate(counts):
        print(row(count, [found[k] for found in places]))
    refused = [
        f"place {place} with {count} ({found[k].status})"
        for place, found in enumerate(places)
        for k, count in enumerate(counts)
        if not np.isfinite(found[k].error)
    ]
    if refused:
        print(
            "\nRefused, by the number of the place from 0 and of the sweeps: " + ", ".join(refused)
        )
    ratios = [found[-1].error / found[0].error for found in places]
    logs = np.log([ratio for ratio in ratios if np.isfinite(ratio)])
    if len(logs) > 1:
        print(
            f"\nFrom {counts[0]} to {counts[-1]} sweeps the error of a place changes by the factor "
            f"{np.exp(logs.mean()):.2f} in the geometric mean "
            f"(± {np.exp(logs.mean()) * logs.std(ddof=1) / np.sqrt(len(logs)):.2f})."
        )


if __name__ == "__main__":
    main()
