"""How often each rule picks the right hypothesis: the paper's, and the measures of the scene.

Simulates scenes with two poles at least 15° apart and both seen, and prints a Markdown table.

    python benchmarks/hypotheses.py --seeds 100
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from retropole.base import se3
from retropole.pipeline import calibrate
from retropole.simulation import simulate_pair

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from studies.paper.choosing import RULES, is_right

WRONG_DEG, WRONG_M = 5.0, 0.5
"""An answer further than either from the truth is of a wrong hypothesis: the pose of the right one
is better, and the others are rotated by 180°."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of one scene; errors are nan where there is no answer."""

    scene: str
    seed: int
    status: str
    codes: tuple[str, ...]
    right: dict[str, bool]
    margin: float
    error_deg: float
    error_m: float
    seconds: float


def run(job: tuple[str, int, tuple[str | None, str | None]]) -> Outcome:
    scene, seed, sensors = job
    pair = simulate_pair(
        scene, np.random.default_rng(seed), sensor_target=sensors[0], sensor_source=sensors[1]
    )
    start = time.perf_counter()
    answer = calibrate(pair.target, pair.source)
    seconds = time.perf_counter() - start
    exact = [h for h in answer.hypotheses if h.match.exact]
    right = dict.fromkeys(RULES, False)
    found = [pole.point for placement in answer.placements for pole in placement.source.poles]
    if exact and found:
        for name, key in RULES.items():
            right[name] = is_right(min(exact, key=key), pair.T_target_source, np.array(found))
    error_deg = error_m = np.nan
    if answer.T_target_source is not None:
        error = se3.difference(answer.T_target_source, pair.T_target_source)
        error_deg, error_m = float(np.degrees(error.rotation)), error.translation
    return Outcome(
        scene,
        seed,
        answer.status,
        tuple(reason.code for reason in answer.reasons),
        right,
        np.nan if answer.margin is None else answer.margin,
        error_deg,
        error_m,
        seconds,
    )


def table(outcomes: list[Outcome]) -> str:
    scenes = sorted({o.scene for o in outcomes})
    lines = [
        "| scene | " + " | ".join(RULES) + " | ok or warn | wrong but confident | least margin |",
        "| --- |" + " --- |" * (len(RULES) + 3),
    ]
    for scene in [*scenes, "all"]:
        group = [o for o in outcomes if scene in (o.scene, "all")]
        rights = [f"{sum(o.right[rule] for o in group)}/{len(group)}" for rule in RULES]
        answered = [o for o in group if o.status != "refused"]
        wrong = sum(o.error_deg > WRONG_DEG or o.error_m > WRONG_M for o in answered)
        least = min((o.margin for o in answered), default=np.nan)
        cells = [scene, *rights, f"{len(answered)}/{len(group)}", str(wrong), f"{least:.3f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scenes", nargs="+", default=["corridor", "street", "harbor"])
    parser.add_argument("--sensors", nargs=2, metavar=("TARGET", "SOURCE"))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--verbose", action="store_true", help="print every scene that failed")
    arguments = parser.parse_args()
    sensors = tuple(arguments.sensors or (None, None))
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    jobs = [(scene, seed, sensors) for scene in arguments.scenes for seed in seeds]
    # Spawned, not forked: the threads of small_gicp do not survive a fork.
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        outcomes = list(pool.map(run, jobs))
    if arguments.verbose:
        for o in outcomes:
            if not o.right["score"] or o.status == "refused":
                print(o)
    print(table(outcomes))
    errors = np.array([(o.error_deg, o.error_m) for o in outcomes if o.status != "refused"])
    if len(errors):
        half, most = np.quantile(errors, 0.5, axis=0), np.quantile(errors, 0.95, axis=0)
        print(f"\nerror, median: {half[0]:.3f} deg, {half[1]:.4f} m", end="; ")
        print(f"95 %: {most[0]:.3f} deg, {most[1]:.4f} m")
    print(f"calibrate, median: {np.median([o.seconds for o in outcomes]):.3f} s")


if __name__ == "__main__":
    main()
