"""Does a merge of live LiDARs keep up?

    python benchmarks/merge_live.py --lidars 2 4 --minutes 10

So many publishers, processes of their own, send 100,000 points at 10 Hz each by DDS on loopback,
and they are merged. One publisher starts 20 s late, and one is killed halfway and starts again 20 s
later. Once a minute: clouds a second, how long ago the oldest sweep of a cloud was made when the
cloud had been published, s, CPU seconds a second, and memory, MB. Then what was said.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time

import numpy as np

from retropole.api.live_merging import LiveLidar, LiveMerge
from retropole.export.clouds import About, columns_of
from retropole.export.recording import cloud_publisher
from retropole.fusion.merging import Points
from retropole.io.fields import USUAL, records_of
from retropole.io.live import open_sources
from watch_load import memory

DOMAIN, INTERFACE = 88, "lo"
LATE = 20.0
"""A publisher starts so late, s."""


def publisher(k: int, seconds: float) -> subprocess.Popen[bytes]:
    command = [
        *(sys.executable, "-m", "tests.io.live.publishing", f"/lidar{k}/points", str(seconds)),
        *("--layout", "hesai", "--domain", str(DOMAIN), "--interface", INTERFACE),
    ]
    return subprocess.Popen(command)


def run(count: int, minutes: float) -> None:
    seconds = 60 * minutes
    names = [f"lidar{k}" for k in range(count)]
    running = {k: publisher(k, seconds + 30) for k in range(count - 1)}
    opened = open_sources(
        [f"ros2:/{name}/points" for name in names],
        domain=DOMAIN,
        interface=INTERFACE,
        wanted=[USUAL] * count,
    )
    write = cloud_publisher("/merged/points", "site", domain=DOMAIN, interface=INTERFACE)
    known = About(names, "site", (), True, True, True, False, np.zeros(3), True)

    def give(points: Points, when: float) -> None:
        write(records_of(columns_of(points, known)), when)

    lidars = [LiveLidar(name, own, np.eye(4)) for name, own in zip(names, opened, strict=True)]
    merge = LiveMerge(lidars, give)
    start, said = time.monotonic(), list[str]()
    is_late = is_killed = True
    print(
        "| LiDARs | minute | clouds a second | oldest sweep, s: median | 99 % | most | CPU | MB |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    try:
        for minute in range(round(minutes)):
            cpu, merge_start = time.process_time(), time.monotonic()
            while (now := time.monotonic() - start) < 60 * (minute + 1):
                merge.step()
                said += [f"{now:.0f} s: {words}" for words in merge.new_messages()]
                if is_late and now > LATE:
                    is_late, running[count - 1] = False, publisher(count - 1, seconds + 30)
                if is_killed and now > seconds / 2:
                    is_killed = False
                    running[0].kill()
                    again = now + LATE
                if not is_killed and running[0].poll() is not None and now > again:
                    running[0] = publisher(0, seconds)
            pace = merge.pace()
            ages = np.array(pace.ages or [np.nan])
            used = (time.process_time() - cpu) / (time.monotonic() - merge_start)
            print(
                f"| {count} | {minute + 1} | {len(pace.ages) / pace.seconds:.1f} "
                f"| {np.median(ages):.2f} | {np.quantile(ages, 0.99):.2f} | {ages.max():.2f} "
                f"| {used:.2f} | {memory():.0f} |",
                flush=True,
            )
    finally:
        merge.close()
        for each in running.values():
            each.kill()
    print("\nIt says:\n")
    print("\n".join(f"- {each}" for each in said), end="\n\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lidars", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--minutes", type=float, default=10.0)
    arguments = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for count in arguments.lidars:
        run(count, arguments.minutes)


if __name__ == "__main__":
    main()
