"""How the CPU time of each method grows with the number of points, frames and poles.

Of this method also with the number of LiDARs of a site. Every run has a process of its own and ends
at a timeout, after which larger sizes are left out. Writes ``growth.csv`` and ``growth.png``, and
prints a Markdown table, with the power of the size by which the time grows from one row to the
next.

    python benchmarks/growth.py --methods poles+scene kiss --points 10000 100000
    python benchmarks/growth.py --methods poles+scene --points --frames --poles
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from multiprocessing import TimeoutError as TookTooLong
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from retropole.base.datatypes import PointCloud
from retropole.checking.methods import OURS
from retropole.io.recordings import MAX_POINTS, downsample
from retropole.pipeline import calibrate_site
from retropole.simulation import SimulationError, simulate_pair, simulate_site
from rivals import METHODS, installed, peak_megabytes, quiet, timed

REPEAT_NOISE = 0.005
"""1 σ of the noise on points that are drawn twice, because more are asked for than there are, m."""

MANY_POLES, MIN_ANGLE_DEG = 3, (15.0, 5.0)
"""Least angle between any two poles, up to so many and with more: for many poles there is no
arrangement in which all are 15° apart."""

SITE, PLACEMENTS, SEED, SITE_METHOD = "posts", 4, 7, "poles+scene"
"""Scene, placements of poles and seed of the sites, and the method that calibrates them."""


@dataclass(frozen=True)
class Growth:
    """CPU time of one method at one size; `refused` is empty where it answered."""

    what: str
    method: str
    size: int
    seconds: float
    refused: str
    megabytes: float
    points: int


def resized(cloud: PointCloud, count: int, rng: np.random.Generator) -> PointCloud:
    """Draw so many points of a cloud; of more than it has, some are drawn twice, with noise.

    The noise is that of the range: rings stay rings.
    """
    index = rng.choice(len(cloud), count, replace=count > len(cloud))
    drawn = cloud.select(index)
    if count > len(cloud):
        rays = drawn.xyz - drawn.origin
        noise = rng.normal(0, REPEAT_NOISE, len(rays)) / np.linalg.norm(rays, axis=1)
        drawn = replace(drawn, xyz=drawn.xyz + noise[:, None] * rays)
    return replace(drawn, frame=None)


def grow_site(size: int) -> Growth:
    """Calibrate a site of so many LiDARs on posts."""
    rng = np.random.default_rng(SEED)
    site = simulate_site(SITE, rng, lidars=size, placements=PLACEMENTS).as_site()
    points = sum(len(each) for lidar in site.lidars for each in lidar.clouds if each is not None)
    begun = time.process_time()
    found = calibrate_site(site)
    seconds = time.process_time() - begun
    refused = found.reasons[0].code if found.status == "refused" else ""
    return Growth("LiDARs", SITE_METHOD, size, seconds, refused, peak_megabytes(), points)


def grow(scene: str, what: str, method: str, size: int) -> Growth:
    if what == "LiDARs":
        return grow_site(size)
    rng = np.random.default_rng(0)
    many = what == "poles" and size > MANY_POLES
    pair = simulate_pair(
        scene,
        rng,
        poles=size if what == "poles" else 2,
        frames=size if what == "frames" else 1,
        min_pole_angle=float(np.radians(MIN_ANGLE_DEG[many])),
    )
    target, source = pair.target, pair.source
    if what == "points":
        target, source = resized(target, size, rng), resized(source, size, rng)
    points = len(target) + len(source)
    begun = time.process_time()
    if method in OURS:
        # As every cloud is when it is read.
        target, source = downsample(target, MAX_POINTS), downsample(source, MAX_POINTS)
    thinning = time.process_time() - begun
    found = timed(method, target, source)
    seconds = thinning + found.cpu_seconds
    return Growth(what, method, size, seconds, found.code, peak_megabytes(), points)


def alone(scene: str, what: str, method: str, size: int, timeout: float) -> Growth:
    """Run `grow` in a process of its own, which is ended after the timeout."""
    nan = float("nan")
    with get_context("spawn").Pool(1, initializer=quiet) as pool:
        try:
            return pool.apply_async(grow, (scene, what, method, size)).get(timeout)
        except TookTooLong:
            return Growth(what, method, size, timeout, "timeout", nan, 0)
        except SimulationError:
            return Growth(what, method, size, nan, "no_such_scene", nan, 0)


def table(runs: Sequence[Growth]) -> str:
    lines = ["| of | size | method | CPU s | grows by the power | MB | |", "| --- " * 7 + "|"]
    for before, run in zip([None, *runs], runs, strict=False):
        power = ""
        if before is not None and (before.what, before.method) == (run.what, run.method):
            power = f"{np.log(run.seconds / before.seconds) / np.log(run.size / before.size):.2f}"
        lines.append(
            f"| {run.what} | {run.size} | {run.method} | {run.seconds:.2f} | {power} "
            f"| {run.megabytes:.0f} | {run.refused} |"
        )
    return "\n".join(lines)


def draw(runs: Sequence[Growth], methods: Sequence[str], out: Path, scene: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    whats = list(dict.fromkeys(run.what for run in runs))
    figure, panels = pyplot.subplots(1, len(whats), figsize=(13, 4), sharey=True, squeeze=False)
    for panel, what in zip(panels[0], whats, strict=True):
        for k, method in enumerate(methods):
            own = [
                r for r in runs if (r.what, r.method) == (what, method) and np.isfinite(r.seconds)
            ]
            colour = f"C{k}"
            panel.plot([r.size for r in own], [r.seconds for r in own], color=colour, label=method)
            for answered, filled in ((True, colour), (False, "white")):
                some = [r for r in own if (r.refused == "") == answered]
                panel.plot(
                    [r.size for r in some],
                    [r.seconds for r in some],
                    linestyle="",
                    marker="o",
                    markeredgecolor=colour,
                    markerfacecolor=filled,
                )
        panel.set_xscale("log" if what == "points" else "linear")
        panel.set_yscale("log")
        panel.set_xlabel(f"{what}{' of each cloud' if what == 'points' else ''}")
        panel.grid(alpha=0.3)
    panels[0][0].set_ylabel("CPU time, s")
    panels[0][0].legend()
    figure.suptitle(f"CPU time on the scene {scene!r}; hollow: refused, or out of time")
    figure.tight_layout()
    figure.savefig(out, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("growth"), help="stem of .csv and .png")
    parser.add_argument("--scene", default="corridor")
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--points", type=int, nargs="*", default=[10**k for k in (4, 5, 6, 7)])
    parser.add_argument("--frames", type=int, nargs="*", default=[1, 2, 5, 10, 20])
    parser.add_argument("--poles", type=int, nargs="*", default=[2, 3, 4, 6, 8])
    parser.add_argument("--lidars", type=int, nargs="*", default=[2, 4, 6, 8, 12])
    parser.add_argument("--timeout", type=float, default=600.0, help="of one run, s")
    arguments = parser.parse_args()
    methods = installed(arguments.methods)
    runs: list[Growth] = []
    for what in ("points", "frames", "poles", "LiDARs"):
        for method in methods:
            if what == "LiDARs" and method != SITE_METHOD:
                continue
            for size in getattr(arguments, what.lower()):
                run = alone(arguments.scene, what, method, size, arguments.timeout)
                runs.append(run)
                print(f"{what} {size} {method}: {run.seconds:.2f} s {run.refused}", file=sys.stderr)
                if run.refused == "timeout":
                    break
    listed, picture = arguments.out.with_suffix(".csv"), arguments.out.with_suffix(".png")
    with listed.open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Growth)])
        writer.writeheader()
        writer.writerows(asdict(run) for run in runs)
    draw(runs, methods, picture, arguments.scene)
    print(table(runs))
    print(f"\nwritten: {listed}, {picture}")


if __name__ == "__main__":
    main()
