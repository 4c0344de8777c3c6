"""Our method and every installed rival over scenes, seeds and sensors: how often right, how fast.

A run succeeds where e_rt (eq. 12) is at most 0.1 m. It is wrong but confident where it answered,
with a warning or without, and is off by more than 1° or 0.3 m. Errors are of the runs that
answered; times of one call, libraries imported and clouds in memory; memory is the largest that the
process held during the call, the interpreter and the clouds included. The GICP that ends a rival
counts in its time, and where that has not come to rest after 30 steps the rival has refused: how
often its match alone would have been wrong the table does not tell. Prints Markdown.

    python benchmarks/rivals.py --seeds 25
    python benchmarks/rivals.py --seeds 3 --scenes corridor street harbor --methods poles+scene kiss
    python benchmarks/rivals.py --seeds 10 --scenes street --sensors VLP-16:VLP-16 Pandar64:OS1
    python benchmarks/rivals.py --growth growth --methods poles+scene kiss --points 10000 100000

``--growth`` instead measures time against the number of points, frames and poles, and writes
``growth.csv`` and ``growth.png``.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import importlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import TimeoutError as TookTooLong
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from retropole.datatypes import Array, PointCloud
from retropole.errors import Refusal
from retropole.evaluation.comparison import ALL_METHODS
from retropole.evaluation.metrics import errors_of
from retropole.evaluation.rivals import ALL_METHODS as RIVALS
from retropole.evaluation.rivals import EXTRAS, missing_extra
from retropole.pipeline import calibrate
from retropole.simulation import SimulationError, simulate_pair

SUCCESS_M = 0.1
WRONG_DEG, WRONG_M = 1.0, 0.3
OURS, RIVAL, TIME_RATIO = "poles+scene", "kiss", 0.6
"""The target: ours succeeds more often than this rival, is never wrong, and takes so much of its
time at most."""

JITTER = 0.005
"""Noise on points where more are asked for than there are, and some are drawn twice, metres."""


@dataclass(frozen=True)
class Run:
    """What came of one method on one scene; errors are nan where there is no answer."""

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
        return RIVALS[method](target, source, np.random.default_rng(0)).T_target_source
    found = calibrate(target, source, scene=method != "poles")
    if found.T_target_source is None:
        raise Refusal(found.reasons[0].code, found.reasons[0].message)
    return found.T_target_source


def quiet() -> None:
    """Keep what compiled libraries print out of the table on stdout."""
    os.dup2(2, 1)


def reset_peak() -> None:
    """Start the process's peak memory anew (Linux)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_megabytes() -> float:
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return float("nan")
    return float(status.split("VmHWM:")[1].split()[0]) / 1024


def timed(method: str, target: PointCloud, source: PointCloud) -> tuple[Array | None, str, float]:
    if method in EXTRAS:
        importlib.import_module(EXTRAS[method][1])
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
    if T is None:
        return Run(*job, code, *[float("nan")] * 3, seconds, megabytes)
    errors = errors_of(T, pair.T_target_source)
    return Run(
        *job,
        code,
        float(np.degrees(errors.rotation)),
        errors.translation,
        errors.e_rt,
        seconds,
        megabytes,
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


def resized(cloud: PointCloud, count: int, rng: np.random.Generator) -> PointCloud:
    """Draw so many points of a cloud; more than it has are drawn again with a little noise."""
    index = rng.choice(len(cloud), count, replace=count > len(cloud))
    drawn = cloud.select(index)
    if count > len(cloud):
        drawn = replace(drawn, xyz=drawn.xyz + rng.normal(0, JITTER, drawn.xyz.shape))
    return replace(drawn, frame=None)


def grow(job: tuple[str, str, str, int]) -> tuple[float, str, float, int]:
    """Time one method at one size: seconds, code of the refusal, megabytes, points."""
    method, scene, what, size = job
    rng = np.random.default_rng(0)
    pair = simulate_pair(
        scene,
        rng,
        poles=size if what == "poles" else 2,
        frames=size if what == "frames" else 1,
        # Many poles that all lean 15° against each other find no place.
        min_pole_angle=float(np.radians(15 if what != "poles" or size <= 3 else 5)),
    )
    target, source = pair.target, pair.source
    if what == "points":
        target, source = resized(target, size, rng), resized(source, size, rng)
    _, code, seconds = timed(method, target, source)
    return seconds, code, peak_megabytes(), len(target) + len(source)


def alone(job: tuple[str, str, str, int], timeout: float) -> tuple[float, str, float, int]:
    """Grow in a process of its own, which ends with its time."""
    with get_context("spawn").Pool(1, initializer=quiet) as pool:
        try:
            return pool.apply_async(grow, (job,)).get(timeout)
        except TookTooLong:
            return timeout, "timeout", float("nan"), 0
        except SimulationError:
            return float("nan"), "no_such_scene", float("nan"), 0


def growth(arguments: argparse.Namespace, methods: Sequence[str]) -> None:
    sizes = {"points": arguments.points, "frames": arguments.frames, "poles": arguments.poles}
    scene = arguments.scenes[0]
    rows: list[tuple[str, str, int, float, str, float, int]] = []
    for what, each in sizes.items():
        for method in methods:
            for size in each:
                done = alone((method, scene, what, size), arguments.timeout)
                rows.append((what, method, size, *done))
                print(f"{what} {size} {method}: {done[0]:.2f} s {done[1]}", file=sys.stderr)
                if done[1] == "timeout":
                    break
    out = Path(arguments.growth)
    with out.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["what", "method", "size", "seconds", "refused", "megabytes", "points"])
        writer.writerows(rows)
    draw_growth(rows, sizes, methods, out.with_suffix(".png"), scene)
    print(f"written: {out.with_suffix('.csv')}, {out.with_suffix('.png')}")


def draw_growth(
    rows: Sequence[tuple[str, str, int, float, str, float, int]],
    sizes: dict[str, list[int]],
    methods: Sequence[str],
    out: Path,
    scene: str,
) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(sizes), figsize=(13, 4), sharey=True)
    for panel, what in zip(panels, sizes, strict=True):
        for k, method in enumerate(methods):
            mine = [r for r in rows if r[:2] == (what, method) and np.isfinite(r[3])]
            colour = f"C{k}"
            panel.plot([r[2] for r in mine], [r[3] for r in mine], color=colour, label=method)
            for answered, filled in ((True, colour), (False, "white")):
                some = [r for r in mine if (r[4] == "") == answered]
                panel.plot(
                    *([r[i] for r in some] for i in (2, 3)),
                    linestyle="",
                    marker="o",
                    markeredgecolor=colour,
                    markerfacecolor=filled,
                )
        panel.set_xscale("log" if what == "points" else "linear")
        panel.set_yscale("log")
        panel.set_xlabel(f"{what}{' of each cloud' if what == 'points' else ''}")
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("time, s")
    panels[0].legend()
    figure.suptitle(f"Time on the scene {scene!r}; hollow: refused, or out of time")
    figure.tight_layout()
    figure.savefig(out, dpi=120)


def installed(names: Sequence[str]) -> list[str]:
    unknown = [name for name in names if name not in ALL_METHODS]
    if unknown:
        raise SystemExit(f"no method is called {unknown[0]!r}; there are {', '.join(ALL_METHODS)}")
    missing: Callable[[str], str | None] = missing_extra
    for name in names:
        if missing(name):
            print(f"{name} is left out: pip install 'retropole[{missing(name)}]'", file=sys.stderr)
    return [name for name in names if missing(name) is None]


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
    parser.add_argument("--growth", help="write NAME.csv and NAME.png", metavar="NAME")
    parser.add_argument("--points", type=int, nargs="*", default=[10**k for k in (4, 5, 6, 7)])
    parser.add_argument("--frames", type=int, nargs="*", default=[1, 2, 5, 10, 20])
    parser.add_argument("--poles", type=int, nargs="*", default=[2, 3, 4, 6, 8])
    parser.add_argument("--timeout", type=float, default=600.0, help="of a run of --growth, s")
    arguments = parser.parse_args()
    methods = installed(arguments.methods)
    if arguments.growth:
        growth(arguments, methods)
        return
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    runs: list[Run] = []
    for method in methods:
        jobs = [
            (method, scene, seed, sensors)
            for scene in arguments.scenes
            for sensors in arguments.sensors
            for seed in seeds
        ]
        # Processes of its own for each method: what one leaves in memory is not the next one's.
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
