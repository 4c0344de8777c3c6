"""Recordings without any pole: what the place alone gives, and what it is taken for elsewhere.

Every real pair that has a reference is calibrated with ``poles=0``, and by KISS-Matcher with GICP
(benchmarks/rivals.py) beside it. Then every two recordings of different places are, each once as
the target and once as the source: every answer is wrong. Nothing here is drawn. Times are left
out, which would tell. The pairs of `0001` and `0003` and every other mix-up tune; `pandaset`,
`scene1` and `planes` and the mix-ups between state the figures. `data` is the folder with the
recordings.

    python benchmarks/no_poles.py data
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import permutations
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from deception import interval
from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, PoseEstimate
from retropole.base.errors import Refusal
from retropole.checking.methods import missing_extra
from retropole.checking.rivals import FUNCTIONS
from retropole.pipeline import Options, calibrate
from semireal import PAIRS, distance, load
from wrong_files import recordings

RIVAL = "kiss"


@dataclass(frozen=True)
class Right:
    """What came of a pair: off by degrees and metres, 1 σ stated, and the same of the rival."""

    pair: str
    status: str
    codes: tuple[str, ...]
    off: tuple[float, float]
    stated: tuple[float, float]
    squared: float
    rival: tuple[float, float]


@dataclass(frozen=True)
class Wrong:
    """What came of two recordings of different places."""

    names: tuple[str, str]
    status: str
    codes: tuple[str, ...]


def codes_of(answer: Calibration) -> tuple[str, ...]:
    return tuple(reason.code for reason in answer.reasons)


def run_right(job: tuple[str, Path]) -> Right:
    name, data = job
    given = load(name, data)
    nothing = np.nan, np.nan
    off, stated, squared, rival = nothing, nothing, np.nan, nothing
    answer = calibrate(given.target, given.source, options=Options(sensors=given.sensors, poles=0))
    if answer.T_target_source is not None:
        assert answer.covariance is not None
        off = apart(answer.T_target_source, given.T)
        sigma = np.sqrt(np.diag(answer.covariance))
        stated = float(np.degrees(np.linalg.norm(sigma[:3]))), float(np.linalg.norm(sigma[3:]))
        of_reference = next(pair.sigma for pair in PAIRS if pair.name == name)
        reference = np.diag(np.repeat(of_reference, 3) ** 2)
        found = PoseEstimate(answer.T_target_source, answer.covariance, 0.0)
        squared = distance(found, given.T, reference)
    if missing_extra(RIVAL) is None:
        with suppress(Refusal):
            match = FUNCTIONS[RIVAL](given.target, given.source, np.random.default_rng(0))
            rival = apart(match.T_target_source, given.T)
    return Right(name, answer.status, codes_of(answer), off, stated, squared, rival)


def apart(T: Array, truth: Array) -> tuple[float, float]:
    gap = se3.difference(T, truth)
    return float(np.degrees(gap.rotation)), gap.translation


def run_wrong(job: tuple[tuple[str, str], Path]) -> Wrong:
    names, data = job
    target, source = (recordings(data)[name] for name in names)
    sensors = target.sensor, source.sensor
    answer = calibrate(target.cloud, source.cloud, options=Options(sensors=sensors, poles=0))
    return Wrong(names, answer.status, codes_of(answer))


def words(off: tuple[float, float]) -> str:
    return "none" if np.isnan(off[0]) else f"{off[0]:.2f}° {100 * off[1]:.1f} cm"


def right_table(outcomes: Sequence[Right], ours: str = "without poles") -> str:
    lines = [
        f"| pair | {ours} | off | stated 1 σ | Mahalanobis | KISS-Matcher + GICP |",
        "| --- |" + " --- |" * 5,
    ]
    for o in outcomes:
        said = o.status + (f": {', '.join(o.codes)}" if o.codes else "")
        cells = [o.pair, said, words(o.off), words(o.stated)]
        cells += ["" if np.isnan(o.squared) else f"{np.sqrt(o.squared):.1f}", words(o.rival)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def wrong_table(outcomes: Sequence[Wrong]) -> str:
    lines = [
        "| of different places | pairs | ok | warn | refused | ok, % (95 %) | of refusals |",
        "| --- |" + " --- |" * 6,
    ]
    for name, own in (
        ("every other, which tunes", outcomes[::2]),
        ("those between, which state the figure", outcomes[1::2]),
        ("all", outcomes),
    ):
        count = Counter(o.status for o in own)
        codes = Counter(o.codes[0] for o in own if o.status == "refused")
        said = ", ".join(f"{code} {times}" for code, times in codes.most_common())
        cells = [name, len(own), *(count[kind] for kind in ("ok", "warn", "refused"))]
        cells += [interval(count["ok"], len(own)), said]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with the recordings")
    parser.add_argument("--every", type=int, default=1, help="take every n-th pair only")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--verbose", action="store_true", help="print every pair as it ends")
    arguments = parser.parse_args()
    data, every = arguments.data, arguments.every
    if extra := missing_extra(RIVAL):
        print(f"{RIVAL} is left out: pip install 'retropole[{extra}]'", file=sys.stderr)
    own = recordings(data)
    mixed = [names for names in permutations(own, 2) if own[names[0]].place != own[names[1]].place]
    right, wrong = [], []
    with ProcessPoolExecutor(
        arguments.processes,
        mp_context=get_context("spawn"),
        initializer=threadpool_limits,
        initargs=(1,),
    ) as pool:
        for one in pool.map(run_right, [(pair.name, data) for pair in PAIRS[::every]]):
            right.append(one)
            if arguments.verbose:
                print(one, flush=True)
        for other in pool.map(run_wrong, [(names, data) for names in mixed[::every]]):
            wrong.append(other)
            if arguments.verbose:
                print(other, flush=True)
    print(right_table(right), wrong_table(wrong), sep="\n\n")


if __name__ == "__main__":
    main()
