"""CPU time of a refusal where there is nothing to find: every two real recordings without poles.

Takes every PCD file in the folders of real recordings (`formats` is left out), calibrates every two
of them, of one place and of different places, and prints the slowest as a Markdown table. What two
recordings of one LiDAR at rest are answered with is not judged here.

    python benchmarks/refusals.py ../shared/data
    python benchmarks/refusals.py ../shared/data --every 10

*In steps* is the share of the call that its steps account for, by the clock.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from types import FrameType

import numpy as np

from retropole.base.datatypes import PointCloud
from retropole.io import read_cloud
from retropole.pipeline import calibrate


class OutOfTime(BaseException):
    """A call took more CPU time than it was given; no step takes it for a bias of its own."""


@dataclass(frozen=True)
class Outcome:
    """What came of two recordings: CPU and wall seconds, and the seconds of each step."""

    names: tuple[str, str]
    verdict: str
    cpu: float
    wall: float
    steps: dict[str, float]

    @property
    def in_steps(self) -> float:
        """Share of the call that its steps account for."""
        return sum(self.steps.values()) / self.wall


def out_of_time(number: int, frame: FrameType | None) -> None:
    raise OutOfTime


def outcome_of(names: tuple[str, str], clouds: Sequence[PointCloud], limit: float) -> Outcome:
    """Calibrate two clouds, for so many CPU seconds at most."""
    cpu, wall = time.process_time(), time.perf_counter()
    signal.setitimer(signal.ITIMER_PROF, limit)
    try:
        found = calibrate(*clouds)
        signal.setitimer(signal.ITIMER_PROF, 0)
    except OutOfTime:
        return Outcome(names, f"more than {limit:g} s", limit, time.perf_counter() - wall, {})
    codes = " ".join(reason.code for reason in found.reasons)
    return Outcome(
        names,
        f"{found.status}: {codes}",
        time.process_time() - cpu,
        time.perf_counter() - wall,
        dict(found.seconds),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with the recordings")
    parser.add_argument("--every", type=int, default=1, help="take every n-th two only")
    parser.add_argument("--limit", type=float, default=300.0, help="CPU seconds for each two")
    parser.add_argument("--rows", type=int, default=12, help="of the table, the slowest first")
    given = parser.parse_args()
    files = {
        f"{path.parent.name}/{path.stem}": path
        for path in sorted(given.data.glob("*/*.pcd"))
        if path.parent.name != "formats"
    }
    if len(files) < 2:
        sys.exit(f"no recordings in {given.data}")
    signal.signal(signal.SIGPROF, out_of_time)
    clouds = {name: read_cloud(path) for name, path in files.items()}
    outcomes = []
    for names in list(combinations(files, 2))[:: given.every]:
        outcomes.append(outcome_of(names, [clouds[name] for name in names], given.limit))
        print(*names, f"{outcomes[-1].cpu:.1f} s", file=sys.stderr, flush=True)
    print("| target | source | verdict | CPU s | wall s | in steps | longest step |")
    print("| --- " * 7 + "|")
    for o in sorted(outcomes, key=lambda o: -o.cpu)[: given.rows]:
        longest = max(o.steps, key=lambda name: o.steps[name], default="")
        cells = (*o.names, o.verdict, f"{o.cpu:.1f}", f"{o.wall:.1f}", f"{o.in_steps:.1%}", longest)
        print("| " + " | ".join(cells) + " |")
    cpu = [o.cpu for o in outcomes]
    verdicts = Counter(o.verdict.partition(":")[0] for o in outcomes)
    print(
        f"\n{len(outcomes)} of two ({', '.join(f'{n} {what}' for what, n in verdicts.items())}): "
        f"CPU s {np.median(cpu):.1f} in the median, {max(cpu):.1f} at most, {sum(cpu):.0f} in all; "
        f"in steps {min(o.in_steps for o in outcomes):.1%} at least."
    )


if __name__ == "__main__":
    main()
