"""How accurate the whole method is, how honest its covariance, and what it refuses.

Prints Markdown tables: errors of the poles and of the refined answer by scene, how often the 95 %
region of each holds the truth, and what came of solvable and of hopeless scenes.

    python benchmarks/accuracy.py --seeds 100 --hopeless 100
    python benchmarks/accuracy.py --seeds 334 --scenes corridor street harbor
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
from scipy.stats import chi2

from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, PointCloud
from retropole.checking.metrics import e_rt
from retropole.pipeline import calibrate
from retropole.simulation import SimulatedPair, simulate_pair

WRONG_DEG, WRONG_M = 1.0, 0.3
HOPELESS = ("parallel poles", "a pole hidden", "no overlap", "two-fold symmetric")


@dataclass(frozen=True)
class Outcome:
    """What came of one scene; errors are nan where there is no answer."""

    scene: str
    seed: int
    status: str
    codes: tuple[str, ...]
    degrees: float
    metres: float
    poles: float
    refined: float
    poles_chi2: float
    refined_chi2: float


def outcome(scene: str, seed: int, answer: Calibration, T: Array) -> Outcome:
    codes = tuple(reason.code for reason in answer.reasons)
    if answer.T_target_source is None:
        return Outcome(scene, seed, answer.status, codes, *[np.nan] * 6)
    step = se3.local(answer.T_target_source, T)
    errors, squares = [], []
    for pose in (answer.poles, answer.refined or answer.poles):
        assert pose is not None
        assert pose.covariance is not None
        off = se3.local(pose.T_target_source, T)
        errors.append(e_rt(pose.T_target_source, T))
        squares.append(float(off @ np.linalg.solve(pose.covariance, off)))
    return Outcome(
        scene,
        seed,
        answer.status,
        codes,
        float(np.degrees(np.linalg.norm(step[:3]))),
        float(np.linalg.norm(step[3:])),
        *errors,
        *squares,
    )


def hidden(pair: SimulatedPair) -> PointCloud:
    """Give the source without the returns on its last pole."""
    return pair.source.select(pair.labels[1] != len(pair.surfaces) - 1)


def run(job: tuple[str, int]) -> Outcome:
    scene, seed = job
    rng = np.random.default_rng(seed)
    if scene not in HOPELESS:
        pair = simulate_pair(scene, rng)
        return outcome(scene, seed, calibrate(pair.target, pair.source), pair.T_target_source)
    place = ("corridor", "street", "harbor")[seed % 3]
    if scene == "parallel poles":
        pair = simulate_pair(place, rng, min_pole_angle=0.0, max_pole_angle=float(np.radians(3.0)))
    else:
        pair = simulate_pair(place, rng, symmetric=scene == "two-fold symmetric")
    target, source = pair.target, pair.source
    if scene == "a pole hidden":
        source = hidden(pair)
    elif scene == "no overlap":
        other = ("corridor", "street", "harbor")[(seed + 1) % 3]
        source = simulate_pair(other, rng).source
    return outcome(scene, seed, calibrate(target, source), pair.T_target_source)


def coverage(squares: Array) -> str:
    held = squares < chi2.ppf(0.95, 6)
    error = 1.96 * np.sqrt(0.05 * 0.95 / len(held))
    return f"{100 * held.mean():.1f} % (± {100 * error:.1f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scenes", nargs="+", default=["corridor", "street", "harbor", "bare"])
    parser.add_argument("--hopeless", type=int, default=0, help="how many of those, of all kinds")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--verbose", action="store_true", help="print refusals and large errors")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    jobs = [(scene, seed) for scene in arguments.scenes for seed in seeds]
    each = -(-arguments.hopeless // len(HOPELESS))
    jobs += [(kind, seed) for kind in HOPELESS for seed in range(each)]
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        outcomes = list(pool.map(run, jobs, chunksize=2))

    print(
        "| scene | poles: median e_rt m | 95 % | refined: median | 95 % | 95 % region, poles |",
        end="",
    )
    print(" refined |\n| --- | --- | --- | --- | --- | --- | --- |")
    for scene in [*arguments.scenes, "all but bare", "all"]:
        group = [
            o
            for o in outcomes
            if o.scene in arguments.scenes
            and o.status != "refused"
            and (scene in (o.scene, "all") or (scene == "all but bare" and o.scene != "bare"))
        ]
        if not group:
            continue
        cells = []
        for name in ("poles", "refined"):
            errors = np.array([getattr(o, name) for o in group])
            cells += [f"{np.median(errors):.4f}", f"{np.quantile(errors, 0.95):.4f}"]
        for name in ("poles_chi2", "refined_chi2"):
            cells.append(coverage(np.array([getattr(o, name) for o in group])))
        print(f"| {scene} | " + " | ".join(cells) + " |")

    print("\n| scene | runs | ok | warn | refused | ok or warn but off by > 1° or 0.3 m | codes |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for scene in [*arguments.scenes, *(HOPELESS if each else ())]:
        group = [o for o in outcomes if o.scene == scene]
        count = Counter(o.status for o in group)
        wrong = sum(o.degrees > WRONG_DEG or o.metres > WRONG_M for o in group)
        codes = Counter(code for o in group for code in o.codes)
        words = ", ".join(f"{code} {n}" for code, n in codes.most_common())
        print(
            f"| {scene} | {len(group)} | {count['ok']} | {count['warn']} | {count['refused']} | "
            f"{wrong} | {words} |"
        )
    if arguments.verbose:
        for o in outcomes:
            if o.scene in arguments.scenes and (
                o.status == "refused" or o.refined > 0.05 or max(o.poles_chi2, o.refined_chi2) > 30
            ):
                print(o)


if __name__ == "__main__":
    main()
