"""Time of the import, of the library call and of the command for 2 × 100,000 points.

    python benchmarks/speed.py

Times are of this machine at this moment; compare ratios within one run.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from retropole import se3
from retropole.evaluation.entropy import rqe
from retropole.evaluation.metrics import RQE_POINTS
from retropole.io import write_pcd
from retropole.pipeline import calibrate
from retropole.simulation import simulate_pair


def median_seconds(work: Callable[[], object], runs: int) -> float:
    """Run once to warm up, then take the median of ``runs``."""
    work()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="street")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--runs", type=int, default=7)
    arguments = parser.parse_args()
    pair = simulate_pair(arguments.scene, np.random.default_rng(arguments.seed))
    rng = np.random.default_rng(0)

    def sized(cloud):  # type: ignore[no-untyped-def]
        """Take away or repeat points, a hair aside, until there are so many as asked."""
        n, wanted = len(cloud), arguments.points
        if n >= wanted:
            retro = cloud.intensity > np.quantile(cloud.intensity, 0.98)
            spare = rng.permutation(np.flatnonzero(~retro))[: n - wanted]
            return cloud.select(np.setdiff1d(np.arange(n), spare))
        return cloud.select(np.r_[np.arange(n), rng.integers(0, n, wanted - n)])

    target, source = sized(pair.target), sized(pair.source)
    print(f"{len(target):,} + {len(source):,} points, {arguments.scene} {arguments.seed}")

    def spawn(*words: str) -> None:
        done = subprocess.run([sys.executable, *words], capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(done.stderr)

    bare = median_seconds(lambda: spawn("-c", "pass"), arguments.runs)
    imported = median_seconds(lambda: spawn("-c", "import retropole.pipeline"), arguments.runs)
    library = median_seconds(lambda: calibrate(target, source), arguments.runs)
    steps = calibrate(target, source).seconds
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / "target.pcd", Path(folder) / "source.pcd"]
        write_pcd(paths[0], target)
        write_pcd(paths[1], source)
        words = ["-m", "retropole", "calibrate", *map(str, paths), "--out", folder, "-q"]
        command = median_seconds(lambda: spawn(*words), arguments.runs)
    print("| what | s |\n| --- | --- |")
    print(f"| python itself | {bare:.3f} |")
    print(f"| import | {imported - bare:.3f} |")
    print(f"| library call | {library:.3f} |")
    for name, seconds in steps.items():
        print(f"| … {name} | {seconds:.3f} |")
    print(f"| command | {command:.3f} |")
    together = np.concatenate([target.xyz, se3.apply(pair.T_target_source, source.xyz)])
    together = rng.permutation(together)[:RQE_POINTS]
    entropy = median_seconds(lambda: rqe(together), arguments.runs)
    print(f"| entropy of {len(together):,} points | {entropy:.3f} |")


if __name__ == "__main__":
    main()
