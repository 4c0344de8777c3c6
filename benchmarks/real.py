"""How far real scenes lead the refinement from the reference, and what becomes of planted poles.

Prints Markdown tables:

- From the reference of every real pair that has its own, with a prior so wide that it holds
  nothing: how far the refinement goes, and point-to-plane ICP and GICP (the least and the most of
  four settings), which share of the information along any direction the most decisive place holds,
  what is stated, and the Mahalanobis distance with the error of the reference added.
- Poles ray-cast into every pair (`semireal.py`): what is answered, how far off a point 30 m away
  lands, what was stated of that, answers to ``--need-cm`` that are untrue by more than the
  reference's own error, and the Mahalanobis distance.
- Three frames of one standing vehicle, poles elsewhere in each, the same LiDARs: how far the
  answers are from each other in units of what their random parts state, and both parts.

Pairs of pandar_0001 and pjlab_0003 tune, all others state figures; seeds of planted poles below
1000 tune, those from 1000 on state.

    python benchmarks/real.py data --draws 8 --first 1000
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from retropole.adjustment.refinement import refine
from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, PoseEstimate
from retropole.base.systematic import ErrorModel, sizes_of
from retropole.base.uncertainty import predicted_error
from retropole.base.uncertainty.purpose import Need
from retropole.pipeline import Options, calibrate
from retropole.simulation import SimulationError
from retropole.surfaces.registration import prepare, register
from semireal import PAIRS, Loaded, Pair, insert, load

WIDE = np.diag(np.r_[np.full(3, np.radians(3.0)), np.full(3, 0.3)] ** 2 / 3)
"""(6, 6) of the prior: 3° and 0.3 m in all, rad and m."""

SETTINGS = ((0.1, 0.3), (0.1, 1.0), (0.25, 0.5), (0.25, 1.0))
"""Voxel and distance of correspondences of the rivals, metres."""

AT, WITHIN = 30.0, 0.1
"""Range of the points, and the need that is asked about, metres."""

MORE = 1.3
"""Refinement may go so many times as far as point-to-plane ICP, and `BESIDE` more."""

BESIDE = np.radians(0.03), 0.01


def parts(step: Array) -> tuple[float, float]:
    """Rotation, rad, and translation, metres, of a step (6,)."""
    return float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))


def words(rotation: float, translation: float) -> str:
    return f"{np.degrees(rotation):.2f}° {100 * translation:.1f} cm"


def mahalanobis(off: Array, covariance: Array) -> float:
    return float(np.sqrt(off @ np.linalg.solve(covariance, off)))


def of_reference(pair: Pair) -> Array:
    """(6, 6) covariance of a pair's reference."""
    return np.diag(np.repeat(pair.sigma, 3) ** 2)


def registered(given: Loaded, start: Array, method: Literal["PLANE_ICP", "GICP"]) -> list[Array]:
    """How far a rival ends from the reference, a step (6,) with each of the settings."""
    found = []
    for voxel, distance in SETTINGS:
        surfaces = prepare(given.target.xyz, voxel), prepare(given.source.xyz, voxel)
        end = register(
            *surfaces,
            start,
            method=method,
            max_correspondence_distance=distance,
            max_iterations=100,
        )
        found.append(se3.local(given.T, end.T_target_source))
    return found


def from_reference(pairs: Sequence[Pair], data: Path) -> None:
    columns = "pair", "refinement", "point-to-plane ICP", "GICP", "within", "most decisive place"
    print("| " + " | ".join((*columns, "stated 1 σ", "Mahalanobis")) + " |")
    print("| --- " * 8 + "|")
    for pair in pairs:
        given = load(pair.name, data)
        model = ErrorModel(tuple(sizes_of(sensor) for sensor in given.sensors))
        refined = refine(given.target, given.source, PoseEstimate(given.T, WIDE, 0.01), model=model)
        cells = ["none"] * 2
        off: Array | None = None
        if refined is not None:
            off = se3.local(given.T, refined.pose.T_target_source)
            cells = [words(*parts(off))]
        by_method = [
            [parts(step) for step in registered(given, given.T, method)]
            for method in ("PLANE_ICP", "GICP")
        ]
        for found in by_method:
            least, most = np.min(found, axis=0), np.max(found, axis=0)
            cells.append(f"{words(*least)} to {words(*most)}")
        if refined is not None and off is not None:
            assert refined.pose.covariance is not None
            limits = MORE * np.max(by_method[0], axis=0) + BESIDE
            covariance = refined.pose.covariance
            sigma = np.sqrt([np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])])
            cells += [
                "yes" if np.all(np.array(parts(off)) <= limits) else "no",
                f"{refined.decisive[0].share:.0%}" if refined.decisive else "below 30 %",
                words(*sigma),
                f"{mahalanobis(off, covariance + of_reference(pair)):.1f}",
            ]
        print(f"| {pair.name} | " + " | ".join(cells) + " |", flush=True)


Answers = dict[tuple[str, int], Calibration]
"""By the pair and the seed of its poles."""

DEVICES = 3
"""Seeds of poles that leave the same remainder have LiDARs of the same errors."""


def displacement(covariance: Array) -> float:
    """1 σ at `AT`, metres."""
    return predicted_error(covariance, (AT,))[0].sigma_m


def planted(pairs: Sequence[Pair], data: Path, seeds: range) -> Answers:
    """Calibrate with planted poles, print what came of it, and give the answers.

    For comparison also plain ICP of the recordings without poles, started at the poles' pose.
    """
    need = Need(WITHIN, AT)
    columns = "pair", "draws", "ok", "warn", "refused", "off at 30 m, median", "largest"
    print("\n| " + " | ".join((*columns, "stated, median", "untrue ok or yes")), end="")
    print(" | Mahalanobis: median | largest |\n" + "| --- " * 11 + "|")
    answers: Answers = {}
    every: list[float] = []
    ours: list[float] = []
    rival: list[list[float]] = []
    for pair in pairs:
        own = of_reference(pair)
        given = load(pair.name, data)
        status: list[str] = []
        rows: list[tuple[float, float, float]] = []
        untrue = 0
        for seed in seeds:
            try:
                made = insert(pair.name, seed, data, seed % DEVICES)
            except SimulationError:
                continue
            answer = calibrate(
                made.target, made.source, options=Options(sensors=made.sensors, need=need)
            )
            status.append(answer.status)
            if answer.T_target_source is None or answer.covariance is None:
                continue
            answers[pair.name, seed] = answer
            off = se3.local(answer.T_target_source, made.T_target_source)
            far = displacement(np.outer(off, off))
            distance = mahalanobis(off, answer.covariance + own)
            rows.append((far, displacement(answer.covariance), distance))
            if answer.poles is not None:
                ours.append(far)
                start = answer.poles.T_target_source
                by_icp = registered(given, start, "PLANE_ICP")
                rival.append([displacement(np.outer(step, step)) for step in by_icp])
            # Three σ of the reference at that range, beyond what was said.
            beyond = far - 3.0 * displacement(own)
            says_yes = answer.fitness is not None and answer.fitness.answer == "yes"
            untrue += (says_yes and beyond > WITHIN) or (answer.status == "ok" and beyond > 0.3)
        count = [str(status.count(each)) for each in ("ok", "warn", "refused")]
        cells = [str(len(status)), *count]
        if rows:
            far_all, stated, distances = (np.array(each) for each in zip(*rows, strict=True))
            every += list(distances)
            cells += [f"{100 * np.median(far_all):.1f} cm", f"{100 * far_all.max():.1f} cm"]
            cells += [f"{100 * np.median(stated):.1f} cm", str(untrue)]
            cells += [f"{np.median(distances):.1f}", f"{distances.max():.1f}"]
        print(f"| {pair.name} | " + " | ".join(cells) + " |", flush=True)
    if every:
        print(
            f"\nMahalanobis distance of all {len(every)} answers: median {np.median(every):.1f}, "
            f"largest {max(every):.1f}."
        )
        print("\n| off at 30 m | median | 90 % | largest |\n| --- | --- | --- | --- |")
        names = [f"point-to-plane ICP, voxels {v:g} m, up to {d:g} m" for v, d in SETTINGS]
        for name, far_all in zip(
            ["retropole", *names], np.column_stack([ours, rival]).T, strict=True
        ):
            cells = [f"{100 * np.quantile(far_all, q):.1f} cm" for q in (0.5, 0.9, 1.0)]
            print(f"| {name} | " + " | ".join(cells) + " |")
    return answers


def compare_frames(answers: Answers) -> None:
    """Print how far frames of the standing vehicle are apart, in units of what is stated."""
    frames = [each for each in answers.items() if each[0][0].startswith("pandaset")]
    print(
        "\n| poles are | pairs of answers | distance by the random parts: median | largest | "
        "by both: median |\n" + "| --- " * 5 + "|"
    )
    for where, elsewhere in (("in the same places", False), ("relocated", True)):
        random, whole = [], []
        for ((name, seed), a), ((other, other_seed), b) in combinations(frames, 2):
            of_one_device = (seed - other_seed) % DEVICES == 0
            if name == other or (seed != other_seed) != elsewhere or not of_one_device:
                continue
            assert a.T_target_source is not None
            assert b.T_target_source is not None
            off = se3.local(a.T_target_source, b.T_target_source)
            parts = [each.uncertainty for each in (a, b) if each.uncertainty is not None]
            random.append(mahalanobis(off, sum_of([one.random for one in parts])))
            whole.append(mahalanobis(off, sum_of([one.covariance for one in parts])))
        if random:
            cells = [where, str(len(random)), f"{np.median(random):.1f}", f"{max(random):.1f}"]
            print("| " + " | ".join([*cells, f"{np.median(whole):.1f}"]) + " |")


def sum_of(parts: Sequence[Array]) -> Array:
    return np.asarray(np.sum(parts, axis=0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with the recordings")
    parser.add_argument("--pairs", nargs="+", help="names of pairs, or parts of them")
    parser.add_argument("--draws", type=int, default=8, help="of poles for each pair")
    parser.add_argument("--first", type=int, default=1000, help="first seed")
    arguments = parser.parse_args()
    pairs = [
        pair
        for pair in PAIRS
        if not pair.is_composed
        and (not arguments.pairs or any(part in pair.name for part in arguments.pairs))
    ]
    from_reference(pairs, arguments.data)
    if arguments.draws:
        seeds = range(arguments.first, arguments.first + arguments.draws)
        compare_frames(planted(pairs, arguments.data, seeds))


if __name__ == "__main__":
    main()
