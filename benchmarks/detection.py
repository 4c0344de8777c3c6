"""How many taped poles are found, and how many other things are taken for one.

Simulates scenes whose every return has a label, and prints a Markdown table:

    python benchmarks/detection.py --seeds 50

With ``--staged`` it shows single things to five LiDARs: signs, vests and other things that are not
poles, and poles where they are hard to find:

    python benchmarks/detection.py --staged --seeds 10

With ``--sensitivity`` it changes each constant of the extraction by itself, to 0.7 and to 1.4 times
its value, and prints how many poles are found, and how many other things are taken for one, below,
at and above the value:

    python benchmarks/detection.py --sensitivity --seeds 8

Seeds below 1000 are for setting constants: look at them as often as you like. Seeds from 1000 on,
where this starts, state figures: set nothing by them. The recordings are too few to divide, and the
constants were set with them in view: what they show of a constant is why it has its value, and not
how well it does elsewhere.
"""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context

import numpy as np
from threadpoolctl import threadpool_limits

from detection_cases import (
    RECORDINGS,
    SHARED,
    STAGED_SENSORS,
    Case,
    Score,
    forgotten,
    recorded,
    score,
    simulated,
    simulated_case,
    staged,
)
from retropole.base.datatypes import DEFAULT_RADIUS, Detection, IntArray
from retropole.extraction.candidates import with_candidates
from retropole.extraction.poles import extract_poles
from retropole.simulation import simulate_pair

FIRST_STATED_SEED = 1000

MODULES = "lines", "acceptance_shape", "surroundings", "line_search", "poles"
"""Modules of the extraction, in the order in which they import each other."""

LOW, HIGH = 0.7, 1.4
"""Times its value, a constant of ``--sensitivity``; a whole number changes by one at least."""

NOT_VARIED = {"MAD_TO_SIGMA", "DEFAULT_RADIUS"}
"""Properties of numbers, not of poles; and what the caller gives."""


@dataclass(frozen=True)
class Job:
    """One simulated pair of scans, and how it is shown to the detector."""

    scene: str
    seed: int
    sensors: tuple[str, str] | None
    known: bool
    poles: int
    moved: bool


@dataclass(frozen=True)
class Outcome:
    """What came of one scan."""

    scene: str
    sensor: str
    name: str
    score: Score
    seconds: float


def run(job: Job) -> list[Outcome]:
    target, source = job.sensors or (None, None)
    rng = np.random.default_rng(job.seed)
    pair = simulate_pair(
        job.scene, rng, poles=job.poles, sensor_target=target, sensor_source=source
    )
    outcomes = []
    for side, sensor in enumerate(pair.sensors):
        case = simulated_case(pair, side, f"{job.scene} {job.seed}")
        if job.moved:
            case = forgotten(case, job.seed + side)
        start = time.perf_counter()
        detection = extract_poles(case.cloud, sensor=sensor if job.known else None)
        seconds = time.perf_counter() - start
        counted = score(case, detection)
        outcomes.append(Outcome(job.scene, sensor.name, case.name, counted, seconds))
    return outcomes


def table(clouds: str, outcomes: Sequence[Outcome]) -> str:
    lines = [
        "| scene | sensor | clouds | scans | poles seen | found | false | angle, median / 95 % | "
        "to the axis, median | time, median / most |",
        "| --- |" + " --- |" * 9,
    ]
    keys = sorted({(o.scene, o.sensor) for o in outcomes})
    for key in [*keys, ("all", "all")]:
        group = [o for o in outcomes if key == ("all", "all") or (o.scene, o.sensor) == key]
        visible, found = sum(o.score.visible for o in group), sum(o.score.found for o in group)
        false = sum(o.score.false for o in group)
        angles = np.degrees([a for o in group for a in o.score.angles])
        offsets = [1000 * a for o in group for a in o.score.offsets]
        seconds = [1000 * o.seconds for o in group]
        cells = [
            *key,
            clouds,
            *map(str, (len(group), visible, found, false)),
            f"{np.median(angles):.2f}° / {np.quantile(angles, 0.95):.2f}°" if found else "–",
            f"{np.median(offsets):.1f} mm" if found else "–",
            f"{np.median(seconds):.0f} / {max(seconds):.0f} ms",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def staged_scores(job: tuple[str, int]) -> list[tuple[str, bool, Score, Score]]:
    """Thing, whether it is forgotten, and the scores of the sure and of all poles."""
    scores = []
    for c in staged(*job):
        sure = extract_poles(c.cloud, threshold=c.threshold)
        wide = with_candidates(c.cloud, sure, DEFAULT_RADIUS)
        both = score(c, sure), score(c, with_all(wide))
        scores.append((c.thing, c.cloud.ring is None, *both))
    return scores


def with_all(detection: Detection) -> Detection:
    """Count the candidate poles among the poles."""
    return replace(detection, poles=(*detection.poles, *detection.candidates))


def staged_table(scores: Sequence[tuple[str, bool, Score, Score]]) -> str:
    heads = ["thing"]
    for kind in ("as recorded", "forgotten"):
        heads += [f"{kind}: poles to be seen", "found", "false", "doubtful: found", "false"]
    lines = ["| " + " | ".join(heads) + " |", "| --- |" + " --- |" * 10]
    for thing in dict.fromkeys(name for name, *_ in scores):
        cells = [thing]
        for kind in (False, True):
            own = [s for name, is_forgotten, *s in scores if (name, is_forgotten) == (thing, kind)]
            sure, both = ([s[k] for s in own] for k in (0, 1))
            counts = [sum(getattr(s, k) for s in sure) for k in ("visible", "found", "false")]
            wide = [sum(getattr(s, k) for s in both) for k in ("found", "false")]
            cells += map(str, (*counts, wide[0] - counts[1], wide[1] - counts[2]))
        lines.append("| " + " | ".join(cells) + " |")
    return f"{len(scores)} clouds\n\n" + "\n".join(lines)


def constants() -> dict[str, float]:
    """The numbers that the modules of the extraction name, in their order."""
    found: dict[str, float] = {}
    for module in MODULES:
        for name, value in vars(importlib.import_module(f"retropole.extraction.{module}")).items():
            if name.isupper() and isinstance(value, int | float) and name not in NOT_VARIED:
                found.setdefault(name, value)
    return found


def neighbours_of(name: str, value: float) -> tuple[float, float]:
    """The values below and above at which a constant is tried."""
    if isinstance(value, int):
        return min(round(LOW * value), value - 1), max(round(HIGH * value), value + 1)
    return LOW * value, HIGH * value


@contextmanager
def changed(name: str, value: float) -> Iterator[None]:
    """Give a constant another value, in every module that has it."""
    modules = [importlib.import_module(f"retropole.extraction.{module}") for module in MODULES]
    modules = [module for module in modules if hasattr(module, name)]
    before = getattr(modules[0], name)
    for module in modules:
        setattr(module, name, value)
    try:
        yield
    finally:
        for module in modules:
            setattr(module, name, before)


def counts_of(cases: Sequence[Case]) -> IntArray:
    """Poles to be seen, poles found and false poles (3,) in some clouds, thick ones included."""
    scores = [score(c, with_all(extract_poles(c.cloud, threshold=c.threshold))) for c in cases]
    counts = np.array([(s.visible, s.found, s.false) for s in scores], dtype=np.int64)
    return np.asarray(counts.sum(axis=0))


def sensitivity_of(job: tuple[str, str, int]) -> tuple[str, int, IntArray]:
    """Group and number of clouds, and what is counted in them (constants, 3, 3): low, at, high."""
    group, what, seed = job
    cases = list(
        simulated(what, seed)
        if group == "simulated"
        else staged(what, seed)
        if group == "staged"
        else recorded(what)
    )
    kept = counts_of(cases)
    counts = []
    for name, value in constants().items():
        low, high = neighbours_of(name, value)
        with changed(name, low):
            below = counts_of(cases)
        with changed(name, high):
            above = counts_of(cases)
        counts.append((below, kept, above))
    return group, len(cases), np.array(counts)


def sensitivity_table(results: Sequence[tuple[str, int, IntArray]]) -> str:
    groups = list(dict.fromkeys(group for group, *_ in results))
    total = {g: np.sum([c for group, _, c in results if group == g], axis=0) for g in groups}
    clouds = {g: sum(n for group, n, _ in results if group == g) for g in groups}
    lines = [
        f"{g}: {clouds[g]} clouds, {total[g][0, 1, 0]} poles to be seen, "
        f"{total[g][0, 1, 1]} found, {total[g][0, 1, 2]} false\n"
        for g in groups
    ]
    heads = [f"{g}: {what}" for g in groups for what in ("found", "false")]
    lines.append("| constant | low / value / high | " + " | ".join(heads) + " |")
    lines.append("| --- |" + " --- |" * (1 + len(heads)))
    for row, (name, value) in enumerate(constants().items()):
        low, high = neighbours_of(name, value)
        cells = [f"`{name}`", f"{low:.4g} / {value:.4g} / {high:.4g}"]
        for g in groups:
            for what in (1, 2):
                low_at_high = total[g][row, :, what]
                same = np.ptp(low_at_high) == 0
                cells.append("=" if same else " / ".join(str(n) for n in low_at_high))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=FIRST_STATED_SEED)
    parser.add_argument("--scenes", nargs="+", default=["corridor", "street", "harbor", "bare"])
    parser.add_argument("--sensors", nargs=2, metavar=("TARGET", "SOURCE"))
    parser.add_argument("--poles", type=int, default=2)
    parser.add_argument(
        "--moved", action="store_true", help="transform the clouds, forget origin and rings"
    )
    parser.add_argument(
        "--known", action="store_true", help="tell the sensor instead of asking the cloud"
    )
    parser.add_argument("--staged", action="store_true", help="show single things instead")
    parser.add_argument("--sensitivity", action="store_true", help="vary each constant instead")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--verbose", action="store_true", help="print every miss and false pole")
    arguments = parser.parse_args()
    sensors = tuple(arguments.sensors) if arguments.sensors else None
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    with ProcessPoolExecutor(
        arguments.processes,
        mp_context=get_context("spawn"),
        initializer=threadpool_limits,  # the processes share the cores already
        initargs=(1,),
    ) as pool:
        if arguments.sensitivity:
            tasks = [("recorded", name, 0) for name in RECORDINGS if SHARED.exists()]
            few = seeds[: max(1, len(seeds) // 4)]  # a draw of the stage shows 22 things
            many = range(arguments.first, arguments.first + 4 * len(seeds))
            tasks += [("staged", name, seed) for name in STAGED_SENSORS for seed in few]
            tasks += [("simulated", "rosette", seed) for seed in many]
            tasks += [("simulated", name, seed) for name in arguments.scenes for seed in seeds]
            results = list(pool.map(sensitivity_of, tasks))
            print(sensitivity_table(results[::-1]))
            return
        if arguments.staged:
            draws = [(name, seed) for name in STAGED_SENSORS for seed in seeds]
            print(staged_table([s for group in pool.map(staged_scores, draws) for s in group]))
            return
        jobs = [
            Job(scene, seed, sensors, arguments.known, arguments.poles, arguments.moved)
            for scene in arguments.scenes
            for seed in seeds
        ]
        outcomes = [o for group in pool.map(run, jobs, chunksize=4) for o in group]
    if arguments.verbose:
        for o in outcomes:
            for fault in o.score.faults:
                print(f"{o.name}: {fault}")
    clouds = "transformed, rings and origin forgotten" if arguments.moved else "as recorded"
    print(table(clouds, outcomes))


if __name__ == "__main__":
    main()
