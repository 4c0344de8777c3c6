"""CPU time of the import, of the command's start, and of the whole answer for 2 × 100,000 points.

    python benchmarks/speed.py
    python benchmarks/speed.py --against ../before

``--against`` names a checkout of another version: both take turns, and the ratio is printed. Times
are the least of all rounds, on this machine at this moment; compare ratios within one run. Of the
library call the steps are printed too, their shares by the clock.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from retropole.io import read_cloud, write_pcd
from retropole.pipeline import calibrate
from retropole.simulation import simulate_pair

REPEAT_NOISE = 0.005
"""1 σ of the range of points that are repeated, because more are asked for than there are, m."""

CALLS = 3
"""Calls of the library in each round, of which the first may warm up."""

WORDS = {
    "python itself": ["-c", "pass"],
    "import retropole": ["-c", "import retropole"],
    "retropole --version": ["-m", "retropole", "--version"],
    "retropole --help": ["-m", "retropole", "--help"],
    "retropole calibrate --help": ["-m", "retropole", "calibrate", "--help"],
    "retropole calibrate": ["-m", "retropole", "calibrate", "{0}", "{1}", "--out", "{2}", "-q"],
}


def write_sized(path: Path, scene: str, seed: int, points: int) -> list[Path]:
    """Simulate a pair, and write both clouds with so many points."""
    pair, rng = simulate_pair(scene, np.random.default_rng(seed)), np.random.default_rng(0)
    paths = []
    for name, cloud in (("target.pcd", pair.target), ("source.pcd", pair.source)):
        n = len(cloud)
        if n >= points:
            retro = cloud.intensity > np.quantile(cloud.intensity, 0.98)
            spare = rng.permutation(np.flatnonzero(~retro))[: n - points]
            sized = cloud.select(np.setdiff1d(np.arange(n), spare))
        else:
            sized = cloud.select(np.r_[np.arange(n), rng.integers(0, n, points - n)])
            rays = sized.xyz - sized.origin
            noise = rng.normal(0, REPEAT_NOISE, points) / np.linalg.norm(rays, axis=1)
            noise[:n] = 0.0
            sized = replace(sized, xyz=sized.xyz + noise[:, None] * rays)
        paths.append(path / name)
        write_pcd(paths[-1], sized)
    return paths


def print_library_seconds(target: str, source: str) -> None:
    """Print the CPU time of the library call as JSON, for the process that asked.

    And the shares of its steps, by the clock.
    """
    clouds, calls = (read_cloud(target), read_cloud(source)), []
    for _ in range(CALLS):
        start = time.process_time()
        steps = calibrate(*clouds).seconds
        calls.append((time.process_time() - start, steps))
    seconds, steps = min(calls, key=lambda call: call[0])
    total = sum(steps.values())
    print(json.dumps([seconds, {name: each / total for name, each in steps.items()}]))


def spawn(words: list[str], checkout: Path) -> tuple[float, str]:
    """Run Python on a checkout: the CPU time of the process, and what it printed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, *words],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(checkout / "src")},
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(done.stderr)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="street")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--against", type=Path, help="checkout of another version")
    parser.add_argument("--library", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.library:
        print_library_seconds(*given.library)
        return
    here = Path(__file__).parents[1]
    checkouts = [here] + ([] if given.against is None else [given.against.resolve()])
    least: dict[str, list[float]] = {}

    def note(what: str, which: int, seconds: float) -> None:
        row = least.setdefault(what, [np.inf] * len(checkouts))
        row[which] = min(row[which], seconds)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files, steps = {}, [dict[int, dict[str, float]]() for _ in checkouts]
        for seed in given.seeds:
            (folder / str(seed)).mkdir()
            files[seed] = write_sized(folder / str(seed), given.scene, seed, given.points)
        for _ in range(given.rounds):
            for which, checkout in enumerate(checkouts):
                for what, words in WORDS.items():
                    filled = [word.format(*files[given.seeds[0]], folder / "out") for word in words]
                    note(what, which, spawn(filled, checkout)[0])
                for seed in given.seeds:
                    library = [__file__, "--library", *map(str, files[seed])]
                    said = spawn(library, checkout)[1]
                    what, (seconds, parts) = f"library, {given.scene} {seed}", json.loads(said)
                    if seconds < least.get(what, [np.inf] * len(checkouts))[which]:
                        steps[which][seed] = {name: seconds * each for name, each in parts.items()}
                    note(what, which, seconds)
    print(f"2 × {given.points:,} points; the command on {given.scene} {given.seeds[0]}\n")
    print_table("what", least)
    seeds = given.seeds
    print_table(
        "step of the library, mean",
        {
            name: [float(np.mean([one[seed].get(name, 0.0) for seed in seeds])) for one in steps]
            for name in steps[0][seeds[0]]
        },
    )


def print_table(what: str, rows: dict[str, list[float]]) -> None:
    """Print CPU times of this version, and of another beside them if there are two."""
    against = all(len(row) > 1 for row in rows.values())
    print(f"| {what} | CPU s |{' against, CPU s | ratio |' if against else ''}")
    print(f"| --- | --- |{' --- | --- |' if against else ''}")
    for name, row in rows.items():
        ratio = f" {row[1]:.3f} | {row[0] / row[1]:.2f} |" if against else ""
        print(f"| {name} | {row[0]:.3f} |{ratio}")
    print()


if __name__ == "__main__":
    main()
