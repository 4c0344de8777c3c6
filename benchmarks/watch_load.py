"""Does a watch keep up with two LiDARs of 100,000 points at 10 Hz, and does its memory stay flat?

Usage:
    python benchmarks/watch_load.py --minutes 10

Two publishers, processes of their own, send sweeps of a simulated street by DDS on loopback, one as
a Hesai driver lays them out and one as a Velodyne driver, one reliably and one not. Once a minute:
sweeps a second of each that were searched, how long ago the newest was, s, and memory, MB. The need
cannot be met, so that the watch goes on.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from again import record_again
from retropole.api.watching import Watch, Wish, open_sources
from retropole.result import RunConfig
from retropole.simulation import simulate_pair

SWEEPS, POINTS = 5, 100_000
DOMAIN = "87"


def memory() -> float:
    """Memory of this process, MB (Linux)."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmRSS")) / 1024


def stored(folder: Path) -> list[Path]:
    """Write sweeps for the publishers, points repeated up to `POINTS`."""
    pair = simulate_pair("street", np.random.default_rng(3))
    again = [record_again(pair, np.random.default_rng(k)) for k in range(SWEEPS)]
    paths = []
    for name in ("target", "source"):
        arrays = {}
        for k, one in enumerate(again):
            cloud = getattr(one, name)
            # The bright ones once: a pole has no more returns than it has.
            more = np.flatnonzero(cloud.intensity < np.median(cloud.intensity))
            index = np.r_[np.arange(len(cloud)), np.resize(more, POINTS - len(cloud))]
            arrays |= {f"xyz{k}": cloud.xyz[index], f"intensity{k}": cloud.intensity[index]}
            arrays[f"ring{k}"] = cloud.ring[index]
        paths.append(folder / f"{name}.npz")
        np.savez(paths[-1], count=SWEEPS, **arrays)
    return paths


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        paths = stored(Path(folder))
        kinds = (["--layout", "hesai"], ["--layout", "velodyne", "--best-effort"])
        publishers = [
            subprocess.Popen(
                [
                    *(sys.executable, "-m", "tests.io.live.publishing", f"/{path.stem}/points"),
                    *(str(60 * options.minutes + 60), "--clouds", str(path)),
                    *("--domain", DOMAIN, "--interface", "lo", *kind),
                ]
            )
            for path, kind in zip(paths, kinds, strict=True)
        ]
        try:
            texts = [f"ros2:/{path.stem}/points" for path in paths]
            wish = Wish(RunConfig(need_m=0.001, at_m=30.0))
            watch = Watch(
                open_sources(texts, domain=int(DOMAIN), interface="lo"), wish, Path(folder)
            )
            print("| minute | said | sweeps/s searched | age, s: median | most | MB |")
            print("| --- | --- | --- | --- | --- | --- |")
            for minute in range(round(options.minutes)):
                start = time.monotonic()
                ages, seen = [], 0
                last: list[float | None] = [None, None]
                while time.monotonic() - start < 60:
                    said = watch.step()
                    for k, lidar in enumerate(said.lidars):
                        if lidar.age_s is not None and (last[k] is None or lidar.age_s < last[k]):
                            seen += 1
                        last[k] = lidar.age_s
                        ages.append(lidar.age_s or 0.0)
                print(
                    f"| {minute + 1} | {said.code} | {seen / 120:.1f} | {np.median(ages):.2f} "
                    f"| {max(ages):.2f} | {memory():.0f} |",
                    flush=True,
                )
            watch.finish()
        finally:
            for each in publishers:
                each.kill()


if __name__ == "__main__":
    main()
