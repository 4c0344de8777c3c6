"""How long it takes to tell what changed at many sites with a long history, and how much memory.

    python benchmarks/fleet_replay.py --sites 400
    python benchmarks/fleet_replay.py --sites 10000 --folder /scratch/history

Writes a history of sites that are checked daily for a year, as `fleet check` appends it: a file a
day for each 100 sites. Checks scatter by a law of benchmarks/fleet_history.py, with heavy tails and
lorries; one site in twenty has a step, one a drift. Then it is looked through and replayed as
`fleet check` does, by local workers. CPU times are of all processes, those of the workers too;
times are of this machine at this moment. A folder that has a history already is not written again.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import psutil

from fleet_history import TUNE, Law, drawn
from retropole.fleet.engine import connected, mapped
from retropole.fleet.history.run import FLUSH, replay
from retropole.fleet.history.store import CheckRow, columns_of, contents, flat, schema
from retropole.fleet.tables import parquet_of

SAMPLE = 0.2
"""Seconds between looks at the memory."""

BEGIN = datetime(2025, 1, 6, 3, 0, tzinfo=UTC)
CHANGES = ("step", "drift", *["none"] * 18)
FIRST_SEED = 7000


def rows_of(site: int, law: Law, checks: int) -> list[CheckRow]:
    """Draw the daily checks of a site as rows."""
    change = CHANGES[site % len(CHANGES)]
    found, _ = drawn(law, change, FIRST_SEED + site, checks, 1.0)
    name, stored = f"site-{site:05d}", f"{site:064x}"
    return [
        CheckRow(
            name,
            BEGIN + timedelta(microseconds=round(8.64e10 * float(one.days - found[0].days))),
            "same",
            "scene" if one.other else "poles",
            step=flat(one.step),
            covariance=flat(one.random + one.common),
            random=flat(one.random),
            chi2=0.0,
            power=1.0,
            stored_sha256=stored,
            target_sha256=f"{2 * k:064x}",
            source_sha256=f"{2 * k + 1:064x}",
            version="1",
        )
        for k, one in enumerate(found)
    ]


def write(first: int, folder: str, law: Law, sites: int, checks: int) -> None:
    """Write the history of some sites that are checked together."""
    together = [rows_of(site, law, checks) for site in range(first, min(first + FLUSH, sites))]
    for day in range(checks):
        months: dict[str, dict[str, CheckRow]] = {}
        for row in (rows[day] for rows in together if day < len(rows)):
            months.setdefault(f"month={row.time:%Y-%m}", {})[row.key] = row
        for month, fresh in months.items():
            path = Path(folder, month, f"{first:05d}-{day:04d}.parquet")
            path.parent.mkdir(parents=True, exist_ok=True)
            ordered = (columns_of(fresh[key]) for key in sorted(fresh))
            path.write_bytes(parquet_of(ordered, schema()))


def write_all(folder: str, law: Law, sites: int, checks: int) -> None:
    job = partial(write, folder=folder, law=law, sites=sites, checks=checks)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(job, range(0, sites, FLUSH)))


@contextmanager
def memory_sampled() -> Iterator[dict[str, int]]:
    """Sample the most memory of this process, and of one worker, bytes."""
    most = {"this process": 0, "a worker": 0}
    over = threading.Event()

    def look() -> None:
        here = psutil.Process()
        while not over.wait(SAMPLE):
            for process in (here, *here.children(recursive=True)):
                try:
                    kind = "this process" if process == here else "a worker"
                    most[kind] = max(most[kind], process.memory_info().rss)
                except psutil.Error:
                    continue

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield most
    finally:
        over.set()
        thread.join()


def cpu() -> dict[str, float]:
    """Give the seconds of CPU of this process, and of its workers that have ended."""
    kinds = {"this process": resource.RUSAGE_SELF, "the workers": resource.RUSAGE_CHILDREN}
    used = {name: resource.getrusage(kind) for name, kind in kinds.items()}
    return {name: each.ru_utime + each.ru_stime for name, each in used.items()}


def replay_all(folder: str, ids: list[str], workers: int) -> None:
    before, start = cpu(), time.perf_counter()
    with memory_sampled() as most, connected(workers=workers) as client:
        ready = time.perf_counter()
        files, _ = contents(folder)
        found, damaged = replay(folder, ids, partial(mapped, client), known=files)
        seconds = time.perf_counter() - ready
    used = {name: seconds - before[name] for name, seconds in cpu().items()}
    checks = sum(len(site.times) for site in found)
    changed = sum(bool(site.changes) for site in found)
    total = sum(used.values())
    print(f"{len(files)} files:")
    print(
        f"  {len(found)} sites, {checks} checks, {changed} sites changed, {len(damaged)} damaged: "
        f"{seconds:.1f} s with {workers} workers, {time.perf_counter() - start:.1f} s with their "
        f"start; CPU {total:.1f} s, {1e6 * total / checks:.0f} µs a check"
    )
    minutes = 1e4 * total / len(found) / 60.0 / workers
    print(f"  10,000 such sites: {minutes:.1f} min of {workers} cores, with their start")
    print("  CPU: " + ", ".join(f"{name} {each:.1f} s" for name, each in used.items()))
    print("  most memory: " + ", ".join(f"{k} {v / 2**20:.0f} MiB" for k, v in most.items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sites", type=int, default=400)
    parser.add_argument("--checks", type=int, default=365, help="of each, one a day")
    parser.add_argument("--law", choices=TUNE, default="tails")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="of the history; a temporary one without")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = str(arguments.folder or temporary)
        ids = [f"site-{site:05d}" for site in range(arguments.sites)]
        if not any(Path(folder).glob("month=*")):
            write_all(folder, TUNE[arguments.law], arguments.sites, arguments.checks)
        replay_all(folder, ids, arguments.workers)


if __name__ == "__main__":
    main()
