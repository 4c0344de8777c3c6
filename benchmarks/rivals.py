"""Our method and every installed rival over scenes, seeds and sensors: how often right, how fast.

A run succeeds where e_rt (Xue et al. 2019, eq. 12) is at most 0.1 m. It is wrong but confident
where it answered, with a warning or without, and is off by more than 1° or 0.3 m. Errors are those
of the runs that answered. Times are of one call with libraries imported and clouds in memory.
Memory is the peak of the process during the call, interpreter and clouds included. The GICP that
ends a rival counts in its time. Where it has not converged after 30 steps the rival refuses, so the
table does not show how often its match alone would have been wrong. Prints Markdown.

    python benchmarks/rivals.py --seeds 25
    python benchmarks/rivals.py --seeds 3 --scenes corridor street harbor --methods poles+scene kiss
    python benchmarks/rivals.py --seeds 10 --scenes street --sensors VLP-16:VLP-16 Pandar64:OS1
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
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from retropole.datatypes import Array, PointCloud
from retropole.errors import Refusal
from retropole.evaluation.methods import ALL_METHODS
from retropole.evaluation.metrics import Errors, errors_of
from retropole.evaluation.rivals import RIVALS, load_rival, missing_extra
from retropole.pipeline import calibrate
from retropole.simulation import simulate_pair

SUCCESS_M = 0.1
"""Largest e_rt of a success."""

WRONG_DEG, WRONG_M = 1.0, 0.3
"""An answer further than either from the truth is wrong."""

OURS, RIVAL, TIME_RATIO = "poles+scene", "kiss", 0.6
"""The target: ours succeeds more often than this rival, is never wrong, and takes this part of its
time at most."""


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
    seconds: float
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


def answer(method: str, target: PointCloud, source: PointCloud) -> Array:
    """Run one method; raises Refusal where it has no answer."""
    if method in RIVALS:
        return load_rival(method)(target, source, np.random.default_rng(0)).T_target_source
    found = calibrate(target, source, scene=method != "poles")
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


def timed(method: str, target: PointCloud, source: PointCloud) -> tuple[Array | None, str, float]:
    if method in RIVALS:
        load_rival(method)
        extra = RIVALS[method].extra
        if extra is not None:
            importlib.import_module(extra.module)
    reset_peak()
    start = time.perf_counter()
    try:
        T, code = answer(method, target, source), ""
    except Refusal as refusal:
        T, code = None, refusal.code
    return T, code, time.perf_counter() - start


def run(job: tuple[str, str, int, str]) -> Run:
    method, scene, seed, sensors = job
    names = [None, None] if sensors == "default" else sensors.split(":")
    pair = simulate_pair(
        scene, np.random.default_rng(seed), sensor_target=names[0], sensor_source=names[1]
    )
    T, code, seconds = timed(method, pair.target, pair.source)
    megabytes = peak_megabytes()
    nan = float("nan")
    errors = Errors(nan, nan, nan) if T is None else errors_of(T, pair.T_target_source)
    return Run(
        method,
        scene,
        seed,
        sensors,
        code,
        degrees=float(np.degrees(errors.rotation)),
        metres=errors.translation,
        e_rt=errors.e_rt,
        seconds=seconds,
        megabytes=megabytes,
    )


def quantile(values: Sequence[float], q: float, digits: int) -> str:
    known = [value for value in values if np.isfinite(value)]
    return f"{np.quantile(known, q):.{digits}f}" if known else "–"


def row(name: str, runs: Sequence[Run]) -> str:
    errors, seconds = [r.e_rt for r in runs], [r.seconds for r in runs]
    cells = [
        name,
        str(len(runs)),
        f"{100 * np.mean([r.success for r in runs]):.0f} %",
        f"{100 * np.mean([r.wrong for r in runs]):.0f} %",
        f"{100 * np.mean([not r.answered for r in runs]):.0f} %",
        quantile(errors, 0.5, 4),
        quantile(errors, 0.95, 4),
        quantile(seconds, 0.5, 2),
        quantile(seconds, 0.95, 2),
        quantile([r.megabytes for r in runs], 0.5, 0),
    ]
    return "| " + " | ".join(cells) + " |"


HEADER = (
    f"runs | e_rt ≤ {SUCCESS_M} m | wrong but confident | refused | median e_rt m | 95 % | "
    "median time s | 95 % | peak MB |\n" + "| --- " * 10 + "|"
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
        ours, rival = ([r for r in runs if r.method == m] for m in (OURS, RIVAL))
        seconds = [[r.seconds for r in runs] for runs in (ours, rival)]
        ratio = np.sum(seconds[0]) / np.sum(seconds[1])
        middle = np.median(seconds[0]) / np.median(seconds[1])
        met = (
            sum(r.success for r in ours) > sum(r.success for r in rival)
            and not any(r.wrong for r in ours)
            and ratio <= TIME_RATIO
        )
        print(
            f"\n{OURS} against {RIVAL}: success {sum(r.success for r in ours)} against "
            f"{sum(r.success for r in rival)} of {len(ours)}, wrong but confident "
            f"{sum(r.wrong for r in ours)} against {sum(r.wrong for r in rival)}, time of all runs "
            f"{ratio:.2f} of its (target {TIME_RATIO}): {'met' if met else 'not met'}; median time "
            f"{middle:.2f} of its"
        )


def installed(names: Sequence[str]) -> list[str]:
    unknown = [name for name in names if name not in ALL_METHODS]
    if unknown:
        raise SystemExit(f"no method is called {unknown[0]!r}; there are {', '.join(ALL_METHODS)}")
    missing = {name: missing_extra(name) for name in names if name in RIVALS}
    for name, extra in missing.items():
        if extra is not None:
            print(f"{name} is left out: pip install 'retropole[{extra}]'", file=sys.stderr)
    return [name for name in names if missing.get(name) is None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=25)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scenes", nargs="+", default=["corridor", "street", "harbor", "bare"])
    parser.add_argument("--methods", nargs="+", default=list(ALL_METHODS))
    parser.add_argument(
        "--sensors", nargs="+", default=["default"], help="TARGET:SOURCE, or default"
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--csv", type=Path, help="write every run to this file")
    arguments = parser.parse_args()
    methods = installed(arguments.methods)
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    runs: list[Run] = []
    for method in methods:
        jobs = [
            (method, scene, seed, sensors)
            for scene in arguments.scenes
            for sensors in arguments.sensors
            for seed in seeds
        ]
        # Separate processes for each method: what one leaves in memory must not count for the next.
        with ProcessPoolExecutor(
            arguments.processes, mp_context=get_context("spawn"), initializer=quiet
        ) as pool:
            runs += pool.map(run, jobs)
        print(f"{method}: {len(jobs)} runs", file=sys.stderr)
    if arguments.csv:
        with arguments.csv.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(Run.__dataclass_fields__)
            writer.writerows([getattr(r, name) for name in Run.__dataclass_fields__] for r in runs)
    report(runs, methods)


if __name__ == "__main__":
    main()
