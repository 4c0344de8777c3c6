"""Taped poles in the recordings of three real LiDARs, calibrated as one site.

Placements of poles are ray-cast into the recordings of the three LiDARs of one vehicle. All see
all of them. The poles stand where the references say, or else (`--placed scene`) where the
recordings themselves have the LiDARs, to which GICP registers the references first. Prints how the
references and the scene differ, then a Markdown table, one line a seed, a line of all of them, and
what each was warned of. `data` is the folder with the recordings. Seeds below 1000 are for tuning,
those from 1000 on for figures to state.

    python benchmarks/real_site.py data --draws 20 --first 1000
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from insertion import InsertedSite, insert_into_site
from retropole import pipeline
from retropole.adjustment.answer import LoopClosure, SiteCalibration
from retropole.adjustment.closures import close_loops
from retropole.adjustment.descent import End
from retropole.adjustment.solved import Solved
from retropole.base import se3
from retropole.base.datatypes import DEFAULT_RADIUS, Array
from retropole.base.description import Site, SiteLidar
from retropole.simulation import SimulationError
from retropole.surfaces.registration import prepare, register
from retropole.verdict import statement
from semireal import PAIRS, WEAK, Loaded, load
from wrong_files import REACH, VOXEL, registered

NAMES = "top", "left", "right"
FOLDER = "pandar_0001"
PLACEMENTS, POLES = 2, 3

WRONG_DEG, WRONG_M = 1.0, 0.15
"""An answer further than this from the reference is wrong."""


@dataclass(frozen=True)
class Outcome:
    """What came of one seed; numbers are nan where there is no answer.

    The loop is rotation, translation, χ², degrees of freedom and probability; `by_poles` is the χ²
    of the same loop where each pair's pose comes from its poles alone. Squares are squared
    Mahalanobis distances of both poses from those by which the poles were placed, jointly: of the
    answer alone, and with the references' covariance added.
    """

    seed: int
    status: str
    codes: tuple[str, ...] = ()
    messages: tuple[str, ...] = ()
    found: tuple[int, ...] = ()
    loop: tuple[float, float, float, int, float] = (np.nan, np.nan, np.nan, 0, np.nan)
    off: tuple[tuple[float, float], ...] = ()
    squares: tuple[float, float] = (np.nan, np.nan)
    by_poles: float = np.nan


def loaded(data: Path) -> tuple[Loaded, Loaded]:
    """The top LiDAR with each of the others."""
    left, right = (load(f"0001 top {side}", data) for side in NAMES[1:])
    return left, right


@cache
def poses(placed: str, data: Path) -> tuple[Array, ...]:
    """(4, 4) each: the LiDARs in the frame of the first, by the references or by the scene."""
    if placed == "scene":
        return np.eye(4), *(registered(f"0001 top {side}", data) for side in NAMES[1:])
    return np.eye(4), *(each.T for each in loaded(data))


def insert(seed: int, placed: str, data: Path) -> InsertedSite:
    """Put the poles of a seed into all recordings."""
    left, right = loaded(data)
    return insert_into_site(
        (left.target, left.source, right.source),
        poses(placed, data),
        np.random.default_rng(seed),
        sensors=(*left.sensors, right.sensors[1]),
        poles=POLES,
        placements=PLACEMENTS,
    )


def site_of(made: InsertedSite) -> Site:
    """The site of all three, the first LiDAR being its frame."""
    return Site(
        "three LiDARs of a vehicle",
        tuple(map(SiteLidar, NAMES, made.clouds, made.sensors)),
        tuple(str(k + 1) for k in range(len(made.poles))),
        DEFAULT_RADIUS,
    )


def run(job: tuple[int, str, Path]) -> Outcome:
    seed, placed, data = job
    try:
        made = insert(seed, placed, data)
    except SimulationError as error:
        return Outcome(seed, "no place", messages=(str(error),))
    by_poles: list[float] = []

    def close(at: Solved, end: End) -> list[LoopClosure]:
        by_poles.extend(loop.chi2 for loop in close_loops(at, replace(end, scene=())))
        return list(close_loops(at, end))

    # The answer does not hold what its loops were closed with.
    statement.close_loops = close
    answer = outcome_of(seed, pipeline.calibrate_site(site_of(made)), made.poses)
    return replace(answer, by_poles=by_poles[0]) if by_poles else answer


def outcome_of(seed: int, answer: SiteCalibration, true: Sequence[Array]) -> Outcome:
    """Hold an answer against the poses by which the poles were placed."""
    found = tuple(sum(len(scan.poles) for scan in row if scan) for row in answer.scans)
    codes = tuple(reason.code for reason in answer.reasons)
    messages = tuple(reason.message for reason in answer.reasons)
    if answer.covariance is None:
        return Outcome(seed, answer.status, codes, messages, found)
    offs = [
        se3.local(pose.T_site_lidar, T) for pose, T in zip(answer.lidars[1:], true[1:], strict=True)
    ]
    off = np.concatenate(offs)
    own = answer.covariance[6:, 6:]
    reference = np.diag(np.tile(np.repeat(WEAK, 3), len(offs)) ** 2)
    loop = next(
        ((x.rotation, x.translation, x.chi2, x.freedom, x.probability) for x in answer.loops),
        Outcome.loop,
    )
    return Outcome(
        seed,
        answer.status,
        codes,
        messages,
        found,
        loop,
        tuple(_size(each) for each in offs),
        (
            float(off @ np.linalg.solve(own, off)),
            float(off @ np.linalg.solve(own + reference, off)),
        ),
    )


def _size(off: Array) -> tuple[float, float]:
    """Degrees and millimetres of ``[φ, δ]``."""
    return float(np.degrees(np.linalg.norm(off[:3]))), float(1e3 * np.linalg.norm(off[3:]))


def scene_lines(data: Path) -> list[str]:
    """Say how the scene, by GICP, differs from the references, and around its own loop."""
    by_scene, given = poses("scene", data), poses("reference", data)
    left, right = loaded(data)
    between = se3.inverse(by_scene[1]) @ by_scene[2]
    clouds = [prepare(each.source.xyz, VOXEL) for each in (left, right)]
    direct = register(*clouds, between, method="GICP", max_correspondence_distance=REACH)
    offs = [se3.local(T, R) for T, R in zip(by_scene[1:], given[1:], strict=True)]
    offs += [
        se3.local(direct.T_target_source, se3.inverse(given[1]) @ given[2]),
        se3.local(direct.T_target_source, between),
    ]
    said = (
        *("scene against reference, top to left", "the same, top to right"),
        *("left to right, the reference composed of both", "scene alone around the loop"),
    )
    return [
        f"- {name}: {degrees:.2f}°, {mm:.0f} mm"
        for name, (degrees, mm) in zip(said, map(_size, offs), strict=True)
    ]


def row(one: Outcome) -> str:
    degrees, metres, square, freedom, probability = one.loop
    cells = [str(one.seed), one.status, ", ".join(map(str, one.found))]
    if one.off:
        cells += [f"{np.degrees(degrees):.3f}", f"{1e3 * metres:.1f}"]
        cells += [f"{square:.1f} ({freedom})", f"{100 * probability:.2g} %", f"{one.by_poles:.1f}"]
        cells += [f"{deg:.2f}°, {mm:.0f} mm" for deg, mm in one.off]
        cells += [f"{np.sqrt(each):.1f}" for each in one.squares]
    else:
        cells += [""] * 9
    return "| " + " | ".join([*cells, ", ".join(one.codes)]) + " |"


HEADER = (
    *("poles placed by", "answered", "beyond 1° or 0.15 m", "left °, median", "left mm, median"),
    *("right °, median", "right mm, median", "loop: χ², median (6 to expect)", "within 5 %", "1 %"),
    *("0.001 %", "by poles alone: χ², median", "95 % region has the placing poses: alone"),
    *("with the references'", "warned of"),
)


def summary(placed: str, outcomes: Sequence[Outcome]) -> list[str]:
    """Count what was answered, closed, held and wrong, as the cells of a row."""
    drawn = [one for one in outcomes if one.status != "no place"]
    answered = [one for one in drawn if one.off]
    wrong = sum(any(d > WRONG_DEG or mm > 1e3 * WRONG_M for d, mm in one.off) for one in answered)
    cells = [f"the {placed}", f"{len(answered)} of {len(drawn)}", str(wrong)]
    if answered:
        off = np.array([one.off for one in answered])
        cells += [f"{x:.{2 - 2 * k}f}" for one in np.median(off, axis=0) for k, x in enumerate(one)]
        loops = np.array([one.loop for one in answered])
        cells.append(f"{np.nanmedian(loops[:, 2]):.1f}")
        closing = int(np.isfinite(loops[:, 4]).sum())
        cells += [f"{(loops[:, 4] > least).sum()} of {closing}" for least in (0.05, 0.01, 1e-5)]
        cells.append(f"{np.nanmedian([one.by_poles for one in answered]):.1f}")
        held = (np.array([one.squares for one in answered]) < chi2.ppf(0.95, 12)).sum(axis=0)
        cells += [f"{count} of {len(answered)}" for count in held]
        codes = Counter(code for one in drawn for code in one.codes)
        cells.append(", ".join(f"{code} {n}" for code, n in codes.most_common()))
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with the recordings")
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--placed", choices=("reference", "scene"), default="reference")
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    if not all((arguments.data / FOLDER / f"{name}.pcd").is_file() for name in NAMES):
        sys.exit(f"no recordings: {arguments.data / FOLDER}")
    assert all(any(pair.name == f"0001 top {side}" for pair in PAIRS) for side in NAMES[1:])
    seeds = range(arguments.first, arguments.first + arguments.draws)
    jobs = [(seed, arguments.placed, arguments.data) for seed in seeds]
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        outcomes = list(pool.map(run, jobs))
    print("\n".join([*scene_lines(arguments.data), ""]))
    columns = [
        "seed",
        "status",
        "poles found",
        "loop °",
        "mm",
        "χ² (freedom)",
        "probability",
        "χ² by poles",
    ]
    columns += ["left", "right", "distance, alone", "with the references'", "reasons"]
    print("| " + " | ".join(columns) + " |\n" + "| --- " * len(columns) + "|")
    print("\n".join(map(row, outcomes)))
    print("\n| " + " | ".join(HEADER) + " |\n" + "| --- " * len(HEADER) + "|")
    print("| " + " | ".join(summary(arguments.placed, outcomes)) + " |\n")
    for one in outcomes:
        for code, message in zip(one.codes, one.messages, strict=False):
            print(f"{one.seed}: {code}: {message}")


if __name__ == "__main__":
    main()
