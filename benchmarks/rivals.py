"""Our method and every installed rival over scenes, seeds and sensors: how often right, how fast.

A run succeeds where e_rt (Xue et al. 2019, eq. 13) is at most 0.1 m. It is wrong but confident
where it answered, with a warning or without, and is off by more than 1° or 0.3 m. Errors are those
of the runs that answered. What counts as an answer of a rival: docs/evidence/compare.md.
Times are of one call with libraries imported and clouds in memory: CPU time is user and system time
of all threads of the process, wall time is what passes meanwhile. Both are of the same call. All
that a rival does counts: every voxel that it tries, and the GICP that ends it. Memory is the peak
of the process during the call, interpreter and clouds included. Prints Markdown. With more than
one process, runs share the machine, and wall times are longer than those of a single one.

    python benchmarks/rivals.py --seeds 25
    python benchmarks/rivals.py --seeds 3 --scenes corridor street harbor --methods poles+scene kiss
    python benchmarks/rivals.py --seeds 10 --scenes street --sensors VLP-16:VLP-16 Pandar64:OS1
    python benchmarks/rivals.py --seeds 34 --scenes street --methods kiss kiss+count
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import importlib
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from retropole.base.datatypes import Array, PointCloud
from retropole.base.errors import Refusal
from retropole.checking.methods import OURS as OWN
from retropole.checking.methods import RIVALS, missing_extra
from retropole.checking.metrics import Errors, errors_of
from retropole.checking.rivals import FUNCTIONS, fpfh_ransac, kiss_matcher
from retropole.pipeline import Options, calibrate
from retropole.simulation import simulate_pair
from retropole.surfaces.consistency import consistency, objects_in

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from studies.planes.planes import planar_surfaces

SUCCESS_M = 0.1
"""Largest e_rt of a success."""

WRONG_DEG, WRONG_M = 1.0, 0.3
"""An answer further than either from the truth is wrong."""

OURS, RIVAL, CPU_RATIO, WALL_RATIO = "poles+scene", "kiss", 0.6, 0.8
"""The target: ours succeeds in `MIN_SUCCESS` of the runs and more often than this rival, is never
wrong, and takes these parts of its CPU and wall time at most."""

MIN_SUCCESS = 0.98
"""Least share of the runs in which ours succeeds."""


@dataclass(frozen=True)
class Run:
    """The outcome of one method on one scene; errors are nan where there is no answer."""

    method: str
    scene: str
    seed: int
    sensors: str
    code: str
    degrees: float
    metres: float
    e_rt: float
    cpu_seconds: float
    wall_seconds: float
    megabytes: float

    @property
    def answered(self) -> bool:
        """Whether it gave a transform, right or wrong."""
        return self.code == ""

    @property
    def success(self) -> bool:
        """Whether that is right."""
        return self.e_rt <= SUCCESS_M

    @property
    def wrong(self) -> bool:
        """Whether it is far from the truth."""
        return self.degrees > WRONG_DEG or self.metres > WRONG_M


RUN = {"planes": planar_surfaces, **FUNCTIONS}
"""The rivals, and the planes of 2019, which are in no wheel."""

METHODS = (*OWN, *RUN)

COUNTED = {"kiss+count": kiss_matcher, "fpfh+count": fpfh_ransac}
"""Rivals at each of `COUNTED_VOXELS`, and the answer that our count of the scene finds best."""

COUNTED_VOXELS = (0.5, 0.7, 1.0)
"""Metres."""


def best_by_count(method: str, target: PointCloud, source: PointCloud) -> Array:
    """Run a rival at each voxel, and take the answer that most agrees less what conflicts with."""
    found, rng = [], np.random.default_rng(0)
    for voxel in COUNTED_VOXELS:
        with contextlib.suppress(Refusal):
            found.append(COUNTED[method](target, source, rng, (voxel,)).T_target_source)
    if not found:
        raise Refusal("unmatched", "no voxel gives an answer")
    standing = objects_in(target, rng), objects_in(source, rng)
    counts = [consistency(*standing, T) for T in found]
    best = max(range(len(found)), key=lambda k: counts[k].agreeing - counts[k].contradicting)
    return found[best]


def answer(method: str, target: PointCloud, source: PointCloud) -> Array:
    """Run one method; raises Refusal where it has no answer."""
    if method in COUNTED:
        return best_by_count(method, target, source)
    if method in RUN:
        return RUN[method](target, source, np.random.default_rng(0)).T_target_source
    found = calibrate(target, source, options=Options(scene=method != "poles"))
    if found.T_target_source is None:
        raise Refusal(found.reasons[0].code, found.reasons[0].message)
    return found.T_target_source


def quiet() -> None:
    """Keep what compiled libraries print out of the table on stdout."""
    os.dup2(2, 1)


def reset_peak() -> None:
    """Reset the process's peak memory (Linux)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_megabytes() -> float:
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return float("nan")
    return float(status.split("VmHWM:")[1].split()[0]) / 1024


class Timed(NamedTuple):
    """What one call gave, or the code of its refusal, and what it took."""

    T: Array | None
    code: str
    cpu_seconds: float
    wall_seconds: float


def timed(method: str, target: PointCloud, source: PointCloud) -> Timed:
    rival = method.removesuffix("+count")
    if rival in RIVALS:
        _, extra, module = RIVALS[rival]
        if extra is not None:
            importlib.import_module(module)
    reset_peak()
    cpu, wall = time.process_time(), time.perf_counter()
    try:
        T, code = answer(method, target, source), ""
    except Refusal as refusal:
        T, code = None, refusal.code
    return Timed(T, code, time.process_time() - cpu, time.perf_counter() - wall)


def run(job: tuple[str, str, int, str]) -> Run:
    method, scene, seed, sensors = job
    names = [None, None] if sensors == "default" else sensors.split(":")
    pair = simulate_pair(
        scene, np.random.default_rng(seed), sensor_target=names[0], sensor_source=names[1]
    )
    found = timed(method, pair.target, pair.source)
    megabytes = peak_megabytes()
    nan = float("nan")
    errors = Errors(nan, nan, nan) if found.T is None else errors_of(found.T, pair.T_target_source)
    return Run(
        method,
        scene,
        seed,
        sensors,
        found.code,
        degrees=float(np.degrees(errors.rotation)),
        metres=errors.translation,
        e_rt=errors.e_rt,
        cpu_seconds=found.cpu_seconds,
        wall_seconds=found.wall_seconds,
        megabytes=megabytes,
    )


def quantile(values: Sequence[float], q: float, digits: int) -> str:
    known = [value for value in values if np.isfinite(value)]
    return f"{np.quantile(known, q):.{digits}f}" if known else "–"


def row(name: str, runs: Sequence[Run]) -> str:
    errors = [r.e_rt for r in runs]
    cpu, wall = [r.cpu_seconds for r in runs], [r.wall_seconds for r in runs]
    cells = [
        name,
        str(len(runs)),
        f"{100 * np.mean([r.success for r in runs]):.0f} %",
        f"{100 * np.mean([r.wrong for r in runs]):.0f} %",
        f"{100 * np.mean([not r.answered for r in runs]):.0f} %",
        quantile(errors, 0.5, 4),
        quantile(errors, 0.95, 4),
        quantile(cpu, 0.5, 2),
        quantile(cpu, 0.95, 2),
        quantile(wall, 0.5, 2),
        quantile(wall, 0.95, 2),
        quantile([r.megabytes for r in runs], 0.5, 0),
    ]
    return "| " + " | ".join(cells) + " |"


HEADER = (
    f"runs | e_rt ≤ {SUCCESS_M} m | wrong but confident | refused | median e_rt m | 95 % | "
    "median CPU s | 95 % | median wall s | 95 % | peak MB |\n" + "| --- " * 12 + "|"
)


def report(runs: Sequence[Run], methods: Sequence[str]) -> None:
    print(f"| method | {HEADER}")
    for method in methods:
        print(row(method, [r for r in runs if r.method == method]))
    groups = sorted({(r.scene, r.sensors) for r in runs})
    if len(groups) > 1:
        print(f"\n| scene, sensors, method | {HEADER}")
        for scene, sensors in groups:
            for method in methods:
                group = [
                    r for r in runs if (r.method, r.scene, r.sensors) == (method, scene, sensors)
                ]
                print(row(f"{scene}, {sensors}, {method}", group))
    if {OURS, RIVAL} <= set(methods):
        compare_times([r for r in runs if r.method == OURS], [r for r in runs if r.method == RIVAL])


def compare_times(ours: Sequence[Run], rival: Sequence[Run]) -> None:
    """Print the target and whether it is met, a line for each of its parts."""
    right, its = (sum(r.success for r in runs) for runs in (ours, rival))
    verdict = {True: "met", False: "not met"}
    print(
        f"\n{OURS} against {RIVAL}:\n\n"
        f"- success {right} against {its} of {len(ours)} (target {100 * MIN_SUCCESS:.0f} % and "
        f"more than its): {verdict[right >= MIN_SUCCESS * len(ours) and right > its]}\n"
        f"- wrong but confident {sum(r.wrong for r in ours)} against "
        f"{sum(r.wrong for r in rival)} (target 0): {verdict[not any(r.wrong for r in ours)]}"
    )
    for name, target, field in (
        ("CPU", CPU_RATIO, "cpu_seconds"),
        ("wall", WALL_RATIO, "wall_seconds"),
    ):
        seconds = [[getattr(r, field) for r in runs] for runs in (ours, rival)]
        ratio = np.sum(seconds[0]) / np.sum(seconds[1])
        print(
            f"- {name} time of all runs {ratio:.2f} of its (target {target}): "
            f"{verdict[bool(ratio <= target)]}; median time "
            f"{np.median(seconds[0]) / np.median(seconds[1]):.2f} of its"
        )


def installed(names: Sequence[str]) -> list[str]:
    every = (*METHODS, *COUNTED)
    unknown = [name for name in names if name not in every]
    if unknown:
        raise SystemExit(f"no method is named {unknown[0]!r}; there are {', '.join(every)}")
    rivals = {name: name.removesuffix("+count") for name in names}
    missing = {name: missing_extra(rival) for name, rival in rivals.items() if rival in RIVALS}
    for name, extra in missing.items():
        if extra is not None:
            print(f"{name} is left out: pip install 'retropole[{extra}]'", file=sys.stderr)
    return [name for name in names if missing.get(name) is None]


def in_own_processes(
    jobs: Sequence[tuple[str, str, int, str]], methods: Sequence[str], count: int
) -> list[Run]:
    """Run so many jobs at a time, each method in processes that run nothing else.

    What one method leaves in memory must not count for the next.
    """
    with contextlib.ExitStack() as stack:
        pools = {
            method: stack.enter_context(
                ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=quiet)
            )
            for method in methods
        }

        def wait_for(job: tuple[str, str, int, str]) -> Run:
            return pools[job[0]].submit(run, job).result()

        runs = []
        with ThreadPoolExecutor(count) as waiting:
            for done in waiting.map(wait_for, jobs):
                runs.append(done)
                if done.method == methods[-1]:
                    print(f"{done.scene} {done.seed}, {done.sensors}: done", file=sys.stderr)
        return runs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=25)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scenes", nargs="+", default=["corridor", "street", "harbor", "bare"])
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument(
        "--sensors", nargs="+", default=["default"], help="TARGET:SOURCE, or default"
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--csv", type=Path, help="write every run to this file")
    arguments = parser.parse_args()
    methods = installed(arguments.methods)
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    # One after the other on each pair of clouds: a load that comes and goes meets every method.
    jobs = [
        (method, scene, seed, sensors)
        for scene in arguments.scenes
        for sensors in arguments.sensors
        for seed in seeds
        for method in methods
    ]
    runs = in_own_processes(jobs, methods, arguments.processes)
    if arguments.csv:
        with arguments.csv.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(Run.__dataclass_fields__)
            writer.writerows([getattr(r, name) for name in Run.__dataclass_fields__] for r in runs)
    report(runs, methods)


if __name__ == "__main__":
    main()
