"""What the pages of sites quote: more poles, more placements, and how far from a high LiDAR.

python benchmarks/sites.py --seeds 10

The first table has simulated recordings with all errors of a field, two LiDARs 0.5 to 2 m above
the ground, at any heading, and poles of 1.8 to 2.5 m; each run is one seed, the same for all
arrangements of a site. Errors are those of a point 30 m away, over all directions. The second is
geometry: from where on a pole that stands on the ground is in view down to its foot.
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from retropole.base import se3
from retropole.base.sensors import SENSORS, find_sensor
from retropole.base.uncertainty import predicted_error
from retropole.pipeline import Options, calibrate
from retropole.simulation import FIELD, place_again, simulate_pair

RANGE = 30.0
"""Where errors are compared, m."""

HEIGHTS = 1.0, 2.0, 3.0, 5.0
"""Of a LiDAR above the feet of the poles, m."""


class Site(NamedTuple):
    """A scene of the simulator, and sensors as such a site has them."""

    scene: str
    target: str
    source: str


SITES = {
    "lamppost": Site("street", "OS1", "OS1"),
    "harbour crane": Site("harbor", "Pandar64", "Pandar64"),
    "truck": Site("street", "XT32", "PandarQT"),
    "robot": Site("corridor", "VLP-16", "VLP-16"),
}
ARRANGEMENTS = {"2": (2, 1), "3": (3, 1), "2, placed twice": (2, 2)}
"""Number of poles, and of placements."""


class Run(NamedTuple):
    """The outcome of one calibration: its verdict, and both errors at `RANGE`, m."""

    status: str
    predicted: float
    made: float


def run(job: tuple[str, str, int]) -> Run:
    site, (poles, placements) = SITES[job[0]], ARRANGEMENTS[job[1]]
    rng = np.random.default_rng(job[2])
    pairs = [
        simulate_pair(
            site.scene,
            rng,
            sensor_target=site.target,
            sensor_source=site.source,
            poles=poles,
            noise=FIELD,
        )
    ]
    pairs += [place_again(pairs[0], rng, noise=FIELD) for _ in range(placements - 1)]
    answer = calibrate(
        [pair.target for pair in pairs],
        [pair.source for pair in pairs],
        options=Options(sensors=(find_sensor(site.target), find_sensor(site.source))),
    )
    T = answer.T_target_source
    if T is None or answer.covariance is None:
        return Run(answer.reasons[0].code, np.nan, np.nan)
    off = se3.local(T, pairs[0].T_target_source)
    predicted, made = (
        predicted_error(covariance, (RANGE,))[0].sigma_m
        for covariance in (answer.covariance, np.outer(off, off))
    )
    return Run(answer.status, predicted, made)


def row(arrangement: str, runs: list[Run]) -> str:
    """One line of a site's table; errors are of what was answered."""
    kept = [run for run in runs if np.isfinite(run.made)]
    ok = sum(run.status == "ok" for run in kept)
    codes = Counter(run.status for run in runs if not np.isfinite(run.made))
    made = 100 * np.array([run.made for run in kept] or [np.nan])
    predicted = 100 * np.median([run.predicted for run in kept] or [np.nan])
    worst = max(kept, key=lambda run: run.made, default=Run("", np.nan, np.nan))
    ratio = max((run.made / run.predicted for run in kept if run.status == "ok"), default=np.nan)
    return (
        f"| {arrangement} | {len(runs)} | {ok} | {len(kept) - ok} | {len(runs) - len(kept)} | "
        f"{np.median(made):.1f} cm | {made.max():.1f} cm | {worst.status} | "
        f"{100 * worst.predicted:.1f} cm | {predicted:.1f} cm | {ratio:.1f} | "
        + ", ".join(f"{code} {n}" for code, n in codes.most_common())
        + " |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    rows = [(site, arrangement) for site in SITES for arrangement in ARRANGEMENTS]
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        runs = list(pool.map(run, [(*own, seed) for own in rows for seed in seeds]))
    for k, (site, arrangement) in enumerate(rows):
        if seeds and arrangement == next(iter(ARRANGEMENTS)):
            print(
                f"\n| poles, {site} | runs | ok | warn | refused | error made at 30 m, median | "
                "largest | its verdict | predicted of it | predicted, median | "
                "largest error made over predicted, of ok | refused for |\n" + "| --- " * 12 + "|"
            )
        if seeds:
            print(row(arrangement, runs[k * len(seeds) : (k + 1) * len(seeds)]))
    print(
        "\n| LiDAR, level | lowest beam | "
        + " | ".join(f"{height:g} m up" for height in HEIGHTS)
        + " |\n"
        + "| --- " * (len(HEIGHTS) + 2)
        + "|"
    )
    for sensor in SENSORS.values():
        low = sensor.elevation_span[0]
        if low >= 0.0:
            continue
        nearest = " | ".join(f"{height / np.tan(-low):.1f} m" for height in HEIGHTS)
        print(f"| {sensor.name} | {np.degrees(low):.3g}° | {nearest} |")


if __name__ == "__main__":
    main()
