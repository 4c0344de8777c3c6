"""What the page of fleets quotes: same bytes after kills, throughput, overhead, memory.

    python benchmarks/fleet.py kills --pairs 2000 --kills 10
    python benchmarks/fleet.py speed --pairs 2000

Pairs are simulated recordings of two VLP-16 in a street, each of another seed. ``kills`` calibrates
them on two local workers, and again on a cluster of its own whose workers are killed (SIGKILL) at
random so many times, the processes that calibrate besides, and whose scheduler is killed and
started again once; a third run finds nothing to do. ``speed`` calibrates them on one worker and on
two.

Overhead is the time from the first start to the last end on one worker, less the steps of the
calibrations themselves (reading included), for each pair. Times are of this machine at this moment.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from datetime import datetime
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import psutil

from retropole.fleet.batch import calibrate_fleet
from retropole.fleet.dataset import Run, partitions_in, read_runs
from retropole.fleet.engine import connected, outcomes
from retropole.fleet.sites import find_sites
from retropole.io import write_pcd
from retropole.simulation import simulate_pair

SENSOR = "VLP-16"
SAMPLE = 0.2
"""Seconds between looks at the memory."""


def write_simulated(folder: Path, seed: int) -> None:
    """Write one pair, unless it is there."""
    own = folder / f"post-{seed:05d}"
    if (own / "source.pcd").exists():
        return
    own.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    pair = simulate_pair("street", rng, sensor_target=SENSOR, sensor_source=SENSOR)
    write_pcd(own / "target.pcd", pair.target)
    write_pcd(own / "source.pcd", pair.source)


def write_all(folder: Path, pairs: int) -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(partial(write_simulated, folder), range(pairs), chunksize=8))


def bytes_of(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((out / "answers").iterdir())}


def runs_of(out: Path) -> list[Run]:
    parts = partitions_in(str(out))
    return [run for part in parts for run in read_runs(str(out), part).values()]


def ends(run: Run) -> tuple[float, float]:
    """Give when a run began and ended, seconds."""
    start = datetime.fromisoformat(run.started).timestamp()
    return start, start + run.seconds


@contextmanager
def memory_sampled() -> Iterator[list[tuple[str, float, int]]]:
    """Sample the memory of the workers and of the processes that calibrate: kind, when, bytes."""
    samples: list[tuple[str, float, int]] = []
    over = threading.Event()

    def look() -> None:
        here = psutil.Process()
        while not over.wait(SAMPLE):
            for process in here.children(recursive=True):
                try:
                    words = " ".join(process.cmdline())
                    kind = "calibrating" if "fleet.process" in words else "Dask's worker"
                    if kind == "calibrating" or "spawn_main" in words:
                        samples.append((kind, time.monotonic(), process.memory_info().rss))
                except psutil.Error:
                    continue

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield samples
    finally:
        over.set()
        thread.join()


def print_memory(samples: Sequence[tuple[str, float, int]]) -> None:
    """Print the most that one process had in each quarter of the run, after it has started."""
    first, last = (pick(when for _, when, _ in samples) for pick in (min, max))
    for kind in sorted({kind for kind, _, _ in samples}):
        quarters = [0] * 4
        for each, when, size in samples:
            if each == kind:
                k = min(3, int(4 * (when - first) / (last - first)))
                quarters[k] = max(quarters[k], size)
        words = ", ".join(f"{each / 2**20:.0f}" for each in quarters)
        print(f"  most memory of one process, {kind}, by quarter of the run: {words} MiB")


def run_here(pairs: Path, out: Path, workers: int) -> float:
    """Calibrate on local workers, print what it took, and give the seconds of the whole."""
    start = time.perf_counter()
    with connected(workers=workers) as client, memory_sampled() as samples:
        summary = calibrate_fleet(
            find_sites([str(pairs)]), str(out), lambda tasks: outcomes(client, tasks)
        )
    seconds = time.perf_counter() - start
    print(f"{workers} workers: {summary.done} of {summary.sites} calibrated in {seconds:.1f} s")
    print(f"  {summary.statuses}")
    print_memory(samples)
    return seconds


SPEED = (
    "| workers | pairs | pairs per wall second | of each pair: seconds of calibration | wall ms of "
    "hashing and writing rows | wall ms between |"
)


def speed(pairs: Path, folder: Path) -> None:
    """Compare one worker with two."""
    rows = []
    for workers in (1, 2):
        out = folder / f"out-{workers}"
        run_here(pairs, out, workers)
        runs = runs_of(out)
        times = [ends(run) for run in runs]
        span = max(end for _, end in times) - min(start for start, _ in times)
        steps = sum(step.seconds for run in runs for step in run.steps)
        inside = sum(run.seconds for run in runs)
        rows.append(
            f"| {workers} | {len(runs)} | {len(runs) / span:.2f} | {steps / len(runs):.3f} | "
            f"{1e3 * (inside - steps) / len(runs):.1f} | "
            f"{1e3 * (workers * span - inside) / len(runs):.1f} |"
        )
    same = bytes_of(folder / "out-1") == bytes_of(folder / "out-2")
    print(f"same bytes: {same}\n\n{SPEED}\n" + "| --- " * 6 + "|", *rows, sep="\n")


class OwnCluster:
    """A scheduler and two workers as processes; whatever ends is started again, as a service is."""

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.started = -3
        self.tend()

    def tend(self) -> None:
        """Start what is not there."""
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        scheduler = ["dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port)]
        worker = ["dask_worker", self.address, "--no-dashboard", "--no-nanny", "--nthreads", "1"]
        words = {
            "scheduler": [*scheduler, "--no-dashboard"],
            "worker a": worker,
            "worker b": worker,
        }
        for name, (module, *options) in words.items():
            process = self.processes.get(name)
            if process is None or process.poll() is not None:
                command = [sys.executable, "-m", f"distributed.cli.{module}", *options]
                self.processes[name] = subprocess.Popen(command, **quiet)
                self.started += 1

    def kill(self, name: str, *, calibrating: bool) -> bool:
        """Kill one process, or the one that calibrates for it; whether there was one."""
        victims = [psutil.Process(self.processes[name].pid)]
        try:
            if calibrating:
                victims = victims[0].children()
            for victim in victims[:1]:
                victim.send_signal(signal.SIGKILL)
        except psutil.Error:
            return False
        return bool(victims)

    def end(self) -> None:
        """End all of it."""
        for process in self.processes.values():
            process.kill()
            process.wait()


def kills(pairs: Path, folder: Path, count: int, seed: int) -> None:
    """Compare a run that nothing disturbs with one of which processes are killed."""
    run_here(pairs, folder / "calm", 2)
    out, rng = folder / "killed", random.Random(seed)
    cluster = OwnCluster()
    command = ["fleet", "calibrate", str(pairs), "--out", str(out), "-q"]
    start = time.perf_counter()
    run = subprocess.Popen(
        [sys.executable, "-m", "retropole", *command, "--scheduler", cluster.address]
    )
    whole = len(bytes_of(folder / "calm"))
    done = {"workers": 0, "calibrating": 0, "scheduler": 0}
    try:
        while run.poll() is None:
            time.sleep(0.1)
            cluster.tend()
            written = len(partitions_in(str(out)))
            if not done["scheduler"] and written > whole / 2:
                done["scheduler"] += cluster.kill("scheduler", calibrating=False)
            elif done["workers"] < count * min(1.0, written / (0.9 * whole)):
                calibrating = rng.random() < 0.3
                which = "calibrating" if calibrating else "workers"
                name = rng.choice(["worker a", "worker b"])
                done[which] += cluster.kill(name, calibrating=calibrating)
    finally:
        run.kill()
        cluster.end()
    print(f"with kills: exit {run.returncode}, {time.perf_counter() - start:.1f} s")
    print(f"  processes started again: {cluster.started}")
    again = sum(run.attempts > 1 for run in runs_of(out))
    print(f"  pairs of which the process died, and that were tried again: {again}")
    same = bytes_of(out) == bytes_of(folder / "calm")
    times = [path.stat().st_mtime_ns for path in sorted(out.rglob("*.parquet"))]
    run_here(pairs, out, 2)
    nothing = times == [path.stat().st_mtime_ns for path in sorted(out.rglob("*.parquet"))]
    print("\n| pairs | kills | seed | killed | the same bytes | a further run writes nothing |")
    print("| --- " * 6 + "|")
    killed = ", ".join(f"{name} {number}" for name, number in done.items())
    print(f"| {len(runs_of(out))} | {count} | {seed} | {killed} | {said(same)} | {said(nothing)} |")


def said(holds: bool) -> str:
    return "yes" if holds else "no"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("kills", "speed"):
        command = commands.add_parser(name)
        command.add_argument("--pairs", type=int, default=40)
        command.add_argument("--folder", type=Path, help="keep the simulated pairs here")
    commands.choices["kills"].add_argument("--kills", type=int, default=10, help="of workers")
    commands.choices["kills"].add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # Whoever ends it ends the processes that it has started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pairs = (given.folder or folder) / f"pairs-{given.pairs}"
        write_all(pairs, given.pairs)
        size = sum(path.stat().st_size for path in pairs.rglob("*.pcd"))
        print(f"{given.pairs} pairs, {size / 2**20:.0f} MiB")
        if given.command == "kills":
            kills(pairs, folder, given.kills, given.seed)
        else:
            speed(pairs, folder)


if __name__ == "__main__":
    main()
