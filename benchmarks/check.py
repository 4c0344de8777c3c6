"""How often a moved LiDAR is found, an unmoved one suspected, and neither can be told.

Each site is calibrated once, then recorded again: as it was, rotated by 0.3° about a random axis,
translated by 3 cm in a random direction, rotated by 40°, or with the LiDARs exchanged; with the
poles and without. Prints Markdown tables.

    python benchmarks/check.py --sites 100
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from retropole.datatypes import Array, PoseEstimate
from retropole.monitoring.drift import check
from retropole.pipeline import calibrate
from retropole.simulation import record_again, simulate_pair

SCENES = ("corridor", "street", "harbor")
SMALL = ("unmoved", "rotated 0.3°", "translated 3 cm")
GROSS = ("rotated 40°", "exchanged")
GROSS_EVERY = 4
"""Gross movements, which are never near the line, are tried on every so many sites."""

Row = tuple[str, int, str, bool, str, float, tuple[str, ...]]
"""Scene, seed, what was done, with poles, status, χ² of the answer, codes."""


def step(kind: str, rng: np.random.Generator) -> Array:
    """Draw the movement of a kind."""
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    angle = {"rotated 0.3°": np.radians(0.3), "rotated 40°": np.radians(40.0)}.get(kind, 0.0)
    return np.r_[angle * direction, (0.03 if kind == "translated 3 cm" else 0.0) * direction]


def run(job: tuple[str, int]) -> list[Row]:
    scene, seed = job
    rng = np.random.default_rng([7, seed])
    pair = simulate_pair(scene, rng)
    answer = calibrate(pair.target, pair.source)
    if answer.T_target_source is None:
        return [(scene, seed, "no calibration", True, "refused", np.nan, ())]
    stored = PoseEstimate(answer.T_target_source, answer.covariance, 0.0)
    rows: list[Row] = []
    for kind in (*SMALL, *(GROSS if seed % GROSS_EVERY == 0 else ())):
        for poles in (True, False):
            again = record_again(pair, rng, moved=step(kind, rng), poles=poles)
            clouds = (again.target, again.source)
            found = check(stored, *(clouds[::-1] if kind == "exchanged" else clouds))
            codes = tuple(reason.code for reason in found.reasons)
            chi2 = np.nan if found.chi2 is None else found.chi2
            rows.append((scene, seed, kind, poles, found.status, chi2, codes))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sites", type=int, default=100)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--verbose", action="store_true", help="print every wrong or missing answer"
    )
    arguments = parser.parse_args()
    jobs = [(SCENES[seed % 3], seed) for seed in range(arguments.sites)]
    rows: list[Row] = []
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        for found in pool.map(run, jobs):
            rows += found
            for row in found:
                right = "same" if row[2] == "unmoved" else "moved"
                if arguments.verbose and row[4] != right:
                    print(*row, flush=True)

    refused = sum(row[2] == "no calibration" for row in rows)
    print(f"{arguments.sites} sites, {refused} of them not calibrated in the first place\n")
    print("| recorded again | poles | scene | runs | same | moved | cannot tell |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for kind in (*SMALL, *GROSS):
        for poles in (True, False):
            for scene in (*SCENES, "all"):
                group = [
                    r for r in rows if r[2] == kind and r[3] == poles and scene in (r[0], "all")
                ]
                if not group:
                    continue
                count = Counter(r[4] for r in group)
                print(
                    f"| {kind} | {'yes' if poles else 'no'} | {scene} | {len(group)} | "
                    f"{count['same']} | {count['moved']} | {count['cannot_tell']} |"
                )
    for poles in (True, False):
        chi2 = np.array([r[5] for r in rows if r[2] == "unmoved" and r[3] == poles])
        chi2 = chi2[np.isfinite(chi2)]
        print(
            f"\nχ² of the unmoved, poles {'there' if poles else 'gone'}: "
            f"median {np.median(chi2):.1f}, 95 % {np.quantile(chi2, 0.95):.1f}, "
            f"largest {chi2.max():.1f} (χ² with 6 degrees of freedom: 5.3, 12.6)"
        )
    codes = Counter(code for r in rows if r[4] == "cannot_tell" for code in r[6])
    print("\ncannot tell:", ", ".join(f"{code} {n}" for code, n in codes.most_common()))


if __name__ == "__main__":
    main()
