"""How often a moved LiDAR is found, an unmoved one suspected, and neither can be told.

Each simulated site is calibrated once, then recorded again by the same devices: as it was, rotated
by 0.3° about a random axis, translated by 3 cm in a random direction, rotated by 40°, or with the
LiDARs swapped; with the poles where they were, relocated, and without. With `--data`, the same of
PandaSet's standing vehicle, from one recording to another of its own, with poles ray-cast into
them, and of surroundings alone, and how long a check without poles takes on every pair of
recordings that there is. Prints Markdown tables. Seeds below 1000 are for tuning, those from 1000
on for figures to state.

    python benchmarks/check.py --sites 100 --first 1000 --data DATA
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import permutations
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from again import record_again
from insertion import insert_poles
from retropole.adjustment.refinement import refine
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud, PoseEstimate
from retropole.base.sensors import Sensor
from retropole.base.systematic import ErrorModel, sizes_of
from retropole.base.uncertainty import Uncertainty
from retropole.checking.drift import check, search_covariance
from retropole.checking.movement import CheckResult
from retropole.checking.tolerance import DEFAULT_TOLERANCE, Tolerance
from retropole.pipeline import Options, calibrate
from retropole.simulation import NOISE_MODELS, SimulationError, place_again, simulate_pair
from semireal import PAIRS, Loaded, load

SCENES = ("corridor", "street", "harbor")
SMALL = ("unmoved", "rotated 0.3°", "translated 3 cm")
GROSS = ("rotated 40°", "swapped")
GROSS_EVERY = 4
"""Gross movements, which are never near the line, are tried on every so many sites."""

POLES = ("there", "relocated", "gone")
FRAMES = ("00", "01", "05")
"""PandaSet's recordings of a standing vehicle."""

MOVED = {"rotated 0.3°": (np.radians(0.3), 0.0), "rotated 40°": (np.radians(40.0), 0.0)}
MOVED["translated 3 cm"] = (0.0, 0.03)


class Answer(NamedTuple):
    """What came of a check: of *same* what it was said within, rad and m, and CPU seconds."""

    status: str
    chi2: float = np.nan
    codes: tuple[str, ...] = ()
    within: Tolerance | None = None
    cpu: float = np.nan


class Row(NamedTuple):
    """An answer: where, what was done, how the poles stood, what came of it."""

    where: str
    seed: int
    kind: str
    poles: str
    answer: Answer

    @property
    def moved(self) -> tuple[float, float]:
        """How far it was moved, rad and m."""
        return MOVED.get(self.kind, (0.0, 0.0))


class Site(NamedTuple):
    """A stored calibration, and whose it is."""

    pose: PoseEstimate
    uncertainty: Uncertainty | None
    sensors: tuple[Sensor | None, Sensor | None]


class Simulated(NamedTuple):
    """A site to simulate."""

    noise: str
    scene: str
    seed: int


class Alone(NamedTuple):
    """A pair of recordings, stored and checked by its scene alone, for the time that it takes."""

    data: Path
    name: str


class Real(NamedTuple):
    """A recording to store, and one to check."""

    data: Path
    stored: str
    new: str
    seed: int


def step(kind: str, rng: np.random.Generator) -> Array:
    """Draw the movement of a kind."""
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    angle, distance = MOVED.get(kind, (0.0, 0.0))
    return np.asarray(np.r_[angle * direction, distance * direction])


def calibrated(
    target: PointCloud, source: PointCloud, sensors: tuple[Sensor | None, Sensor | None]
) -> Site | None:
    answer = calibrate(target, source, options=Options(sensors=sensors))
    if answer.T_target_source is None:
        return None
    pose = PoseEstimate(answer.T_target_source, answer.covariance, 0.0)
    return Site(pose, answer.uncertainty, sensors)


def answered(site: Site, clouds: Iterable[PointCloud]) -> Answer:
    target, source = clouds
    begun = time.process_time()
    found = check(
        site.pose,
        target,
        source,
        options=Options(sensors=site.sensors),
        uncertainty=site.uncertainty,
    )
    cpu = time.process_time() - begun
    chi2 = np.nan if found.chi2 is None else found.chi2
    codes = tuple(reason.code for reason in found.reasons)
    return Answer(found.status, chi2, codes, named(found), cpu)


def named(found: CheckResult) -> Tolerance | None:
    return found.tolerance if found.status == "same" else None


REFUSED = Answer("refused")


def run(job: Simulated | Real | Alone) -> list[Row]:
    if isinstance(job, Simulated):
        return list(simulated(job))
    return list(real(job) if isinstance(job, Real) else alone(job))


def simulated(job: Simulated) -> Iterator[Row]:
    rng = np.random.default_rng([7, job.seed])
    pair = simulate_pair(job.scene, rng, noise=NOISE_MODELS[job.noise])
    where = f"{job.noise} {job.scene}"
    site = calibrated(pair.target, pair.source, pair.sensors)
    if site is None:
        yield Row(where, job.seed, "no calibration", "there", REFUSED)
        return
    for kind in (*SMALL, *(GROSS if job.seed % GROSS_EVERY == 0 else ())):
        for poles in POLES:
            at = pair
            if poles == "relocated":
                try:
                    at = place_again(pair, rng)
                except SimulationError:
                    continue
            again = record_again(at, rng, moved=step(kind, rng), poles=poles != "gone")
            clouds = again.target, again.source
            turned = clouds[::-1] if kind == "swapped" else clouds
            yield Row(where, job.seed, kind, poles, answered(site, turned))


def real(job: Real) -> Iterator[Row]:
    """Store what one recording of the vehicle gives, and check another."""
    first, second = (load(f"pandaset {frame}", job.data) for frame in (job.stored, job.new))
    T = consensus(job.data)
    rng = np.random.default_rng([job.seed, FRAMES.index(job.stored), FRAMES.index(job.new)])
    try:
        made = insert_poles(first.target, first.source, T, rng, sensors=first.sensors, up=first.up)
    except SimulationError:
        return
    where = "pandaset"
    sites = {
        "poles": calibrated(made.target, made.source, first.sensors),
        "no poles": by_scene(first),
    }
    for kind in SMALL:
        moved = step(kind, rng)
        for poles in POLES:
            clouds = second.target, second.source
            if poles != "gone":
                standing = made.poles if poles == "there" else len(made.poles)
                try:
                    again = insert_poles(
                        *clouds, T, rng, sensors=second.sensors, poles=standing, up=second.up
                    )
                except SimulationError:
                    continue
                clouds = again.target, again.source
            back = se3.inverse(se3.retract(T, moved)) @ T
            there = clouds[0], replace(clouds[1], xyz=se3.apply(back, clouds[1].xyz))
            for name, site in sites.items():
                answer = REFUSED if site is None else answered(site, there)
                yield Row(f"{where}, stored with {name}", job.seed, kind, poles, answer)


def alone(job: Alone) -> Iterator[Row]:
    """Check a pair of recordings against what their scene itself gives."""
    pair = load(job.name, job.data)
    site = by_scene(pair)
    if site is not None:
        answer = answered(site, (pair.target, pair.source))
        yield Row(f"itself, {job.name}", 0, "itself", "gone", answer)


def by_scene(pair: Loaded) -> Site | None:
    """Let the scene alone say what is stored, from about the reference."""
    model = ErrorModel((sizes_of(pair.sensors[0]), sizes_of(pair.sensors[1])))
    start = PoseEstimate(pair.T, search_covariance(), 0.0)
    found = refine(pair.target, pair.source, start, model=model)
    return None if found is None else Site(found.pose, found.uncertainty, pair.sensors)


@cache
def consensus(data: Path) -> Array:
    """Give the mean pose that the scene has in all recordings: there the poles are put.

    The reference is off from it by 0.2° and 2 cm: poles there would contradict their surroundings.
    """
    pairs = [load(f"pandaset {frame}", data) for frame in FRAMES]
    sites = [by_scene(pair) for pair in pairs]
    steps = [se3.local(pairs[0].T, site.pose.T_target_source) for site in sites if site is not None]
    return np.asarray(se3.retract(pairs[0].T, np.mean(steps, axis=0)))


def groups_of(rows: list[Row], wheres: list[str]) -> Iterator[tuple[str, str, str, list[Row]]]:
    """Give what was done, how the poles stood and where, with the checks of it, if any."""
    for kind in (*SMALL, *GROSS):
        for poles in POLES:
            for where in wheres:
                group = [
                    row
                    for row in rows
                    if (row.kind, row.poles) == (kind, poles)
                    and row.where.startswith(where)
                    and row.answer.status != "refused"
                ]
                if group:
                    yield kind, poles, where, group


def table(rows: list[Row], wheres: list[str]) -> None:
    print(
        "\n| recorded again | poles | where | runs | same | of these within more than 0.3°, 3 cm",
        end=" | ",
    )
    print("moved | cannot tell | χ²: median, 95 %, largest |\n" + "| --- " * 9 + "|")
    for kind, poles, where, group in groups_of(rows, wheres):
        answers = [row.answer for row in group]
        count = Counter(one.status for one in answers)
        wide = sum(one.within is not None and one.within != DEFAULT_TOLERANCE for one in answers)
        chi2 = np.array([one.chi2 for one in answers if np.isfinite(one.chi2)])
        words = ""
        if kind == "unmoved" and len(chi2):
            words = f"{np.median(chi2):.1f}, {np.quantile(chi2, 0.95):.1f}, {chi2.max():.1f}"
        print(
            f"| {kind} | {poles} | {where} | {len(group)} | {count['same']} | {wide} | "
            f"{count['moved']} | {count['cannot_tell']} | {words} |"
        )


def tolerances(rows: list[Row], wheres: list[str]) -> None:
    """Print what *same* was said within of what had not moved, median and largest."""
    print("\n| unmoved, poles | where | runs | same | within °: median | largest | ", end="")
    print("within cm: median | largest |\n" + "| --- " * 8 + "|")
    for kind, poles, where, group in groups_of(rows, wheres):
        within = [row.answer.within for row in group if row.answer.within is not None]
        if kind != "unmoved" or not within:
            continue
        degrees = np.degrees([one.rotation for one in within])
        centimetres = 100 * np.array([one.translation for one in within])
        print(
            f"| {poles} | {where} | {len(group)} | {len(within)} | {np.median(degrees):.2f} | "
            f"{degrees.max():.2f} | {np.median(centimetres):.1f} | {centimetres.max():.1f} |"
        )


def summary(rows: list[Row], wheres: list[str]) -> None:
    """Print the shares that count, and how long a check takes."""
    for where in wheres:
        own = [r for r in rows if r.where.startswith(where) and r.answer.status != "refused"]
        still = [r.answer.status for r in own if r.kind == "unmoved"]
        poles = [r.answer.status for r in own if r.kind == "unmoved" and r.poles != "gone"]
        turned = [r.answer.status for r in own if r.kind == "rotated 0.3°"]
        moved = [r for r in own if any(r.moved)]
        less = [
            r
            for r in moved
            if r.answer.within is not None
            and (r.moved[0] > r.answer.within.rotation or r.moved[1] > r.answer.within.translation)
        ]
        if not still:
            continue
        print(
            f"\n{where}: unmoved with poles, same: {poles.count('same')} of {len(poles)}; unmoved, "
            f"called moved: {still.count('moved')} of {len(still)}; rotated by 0.3°, found: "
            f"{turned.count('moved')} of {len(turned)}; moved by more than *same* was said within: "
            f"{len(less)} of {len(moved)}"
        )
    print("\n| check | runs | CPU s, median | CPU s, largest |\n| --- | --- | --- | --- |")
    for where in (*wheres, "itself"):
        for words, gone in (("with poles", False), ("without", True)):
            cpu = [
                r.answer.cpu
                for r in rows
                if r.where.startswith(where)
                and (r.poles == "gone") == gone
                and np.isfinite(r.answer.cpu)
                and r.kind not in GROSS
            ]
            if cpu:
                print(f"| {where}, {words} | {len(cpu)} | {np.median(cpu):.1f} | {max(cpu):.1f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sites", type=int, default=100, help="of each noise")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--noise", nargs="*", default=["typical", "field"])
    parser.add_argument("--data", type=Path, help="folder with the recordings")
    parser.add_argument("--draws", type=int, default=2, help="poles for each two recordings")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument(
        "--verbose", action="store_true", help="print every wrong or missing answer"
    )
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.sites)
    jobs: list[Simulated | Real | Alone] = [
        Simulated(noise, SCENES[seed % 3], seed) for noise in arguments.noise for seed in seeds
    ]
    if arguments.data is not None:
        draws = range(arguments.first, arguments.first + arguments.draws)
        jobs += [
            Real(arguments.data, *frames, draw)
            for draw in draws
            for frames in permutations(FRAMES, 2)
        ]
        jobs += [Alone(arguments.data, pair.name) for pair in PAIRS]
    rows: list[Row] = []
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        for done, found in enumerate(pool.map(run, jobs), start=1):
            rows += found
            for row in found:
                right = "same" if row.kind == "unmoved" else "moved"
                if arguments.verbose and row.answer.status != right:
                    print(*row, flush=True)
            unmoved = Counter(r.answer.status for r in rows if r.kind == "unmoved")
            print(f"{done} of {len(jobs)}, unmoved: {dict(unmoved)}", file=sys.stderr, flush=True)

    refused = Counter(r.where for r in rows if r.answer.status == "refused")
    print("not calibrated in the first place:", dict(refused))
    groups = [
        *arguments.noise,
        *(f"pandaset, stored with {what}" for what in ("poles", "no poles")),
    ]
    groups.append("pandaset")
    wheres = [f"{noise} {scene}" for noise in arguments.noise for scene in SCENES]
    table(rows, groups)
    table(rows, wheres)
    tolerances(rows, groups)
    summary(rows, groups)
    codes = Counter(
        code for r in rows if r.answer.status == "cannot_tell" for code in r.answer.codes
    )
    print("\ncannot tell:", ", ".join(f"{code} {n}" for code, n in codes.most_common()))


if __name__ == "__main__":
    main()
