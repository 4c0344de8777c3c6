"""Fit the weights of the log-odds that a line is a pole (`retropole.extraction.odds`).

Draws the staged things of `detection` and the hard scenes of `hard_scenes`, takes every line that
is judged in the search for candidate poles, and whether its returns are those of a pole. Lines of
one thing in one cloud count together as one: a plate has a hundred. Posts with tape count as
neither. Prints the weights, and of how many poles, and of how many other things, a line passes
a limit.

    python benchmarks/odds.py --seeds 10

Seeds below 1000, where this starts, set constants; do not take others.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from detection_cases import (
    PURE,
    STAGED_SENSORS,
    WHOLE,
    Case,
    Truth,
    simulated_case,
    staged,
)
from hard_arrangements import draw_pair
from retropole.base.datatypes import DEFAULT_RADIUS, Array, BoolArray, Detection
from retropole.base.sensors import Sensor
from retropole.extraction import odds
from retropole.extraction.candidates import with_candidates
from retropole.extraction.odds import measures_of
from retropole.extraction.poles import extract_poles
from retropole.extraction.surroundings import Surroundings

PARTLY = 0.3
"""A line with so much of itself on a pole, and yet not one, is neither."""

RIDGE = 1.0
"""Weight of the squares of the standardised weights: that of one line."""

MISSED = 10.0
"""A pole that is missed costs as much as so many things taken for one, which must still match."""

LIMITS = -2.0, -1.0, 0.0, 1.0, 2.0


class Judged(NamedTuple):
    """A line: the thing that it is on, whether that is a pole, and its measures (8,)."""

    thing: str
    is_pole: bool
    measures: Array


def cases_of(kind: str, seed: int) -> Iterator[tuple[Case, Sensor | None]]:
    if kind in STAGED_SENSORS:
        # Forgotten clouds show the rings that the others have.
        yield from ((case, None) for case in staged(kind, seed) if case.cloud.ring is not None)
        return
    drawn = draw_pair(seed)
    if drawn is not None:
        pair = drawn[1]
        for side, sensor in enumerate(pair.sensors):
            yield simulated_case(pair, side, f"hard {seed}"), sensor


def judged_in(job: tuple[str, int]) -> list[Judged]:
    """Every line that is judged as a candidate in the clouds of one draw."""
    found: list[Judged] = []
    for case, sensor in cases_of(*job):
        sure = extract_poles(case.cloud, sensor=sensor, threshold=case.threshold)

        def record(
            around: Surroundings, radius: float, case: Case = case, sure: Detection = sure
        ) -> Array:
            measures = measures_of(around, radius)
            judged = labelled(case, sure, around, measures)
            found.extend([] if judged is None else [judged])
            return measures

        with patch.object(odds, "measures_of", record):
            with_candidates(case.cloud, sure, DEFAULT_RADIUS, sensor)
    return found


def labelled(case: Case, sure: Detection, around: Surroundings, measures: Array) -> Judged | None:
    """Say whether a line is on a pole; None where it is on a part of one, or on a post."""
    truth = case.truth
    assert isinstance(truth, Truth)
    assert case.cloud.intensity is not None
    on, counts = np.unique(truth.labels[around.line.index], return_counts=True)
    poles = {pole.label for pole in truth.poles}
    own = dict(zip(on.tolist(), counts.tolist(), strict=True))
    label, most = max(own.items(), key=lambda each: each[1])
    thing = f"{case.name}, {truth.surfaces[label]} {label}"
    if label in poles:
        bright = (truth.labels == label) & (case.cloud.intensity >= sure.threshold)
        if most >= PURE * counts.sum() and most >= WHOLE * np.count_nonzero(bright):
            return Judged(thing, True, measures)
    if sum(own.get(pole, 0) for pole in poles) >= PARTLY * counts.sum():
        return None
    is_post = case.thing == "pair" and truth.surfaces[label].startswith("Cylinder")
    return None if is_post else Judged(thing, False, measures)


def fitted(measures: Array, is_pole: BoolArray, shares: Array) -> Array:
    """Weights (8,) of measures (N, 8) by logistic regression, each line with its share (N,)."""
    scale = np.maximum(measures.std(axis=0), 1e-9)
    scale[0] = 1.0  # the constant
    signed = np.where(is_pole, 1.0, -1.0)[:, None] * measures / scale

    def loss(weights: Array) -> tuple[float, Array]:
        margin = signed @ weights
        slope = -shares * np.exp(-np.logaddexp(0.0, margin))
        ridge = RIDGE * np.r_[0.0, weights[1:]]
        value = shares @ np.logaddexp(0.0, -margin) + ridge @ weights / 2
        return float(value), slope @ signed + ridge

    start = np.zeros(measures.shape[1])
    return np.asarray(minimize(loss, start, jac=True, method="BFGS").x / scale)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    kinds = {**dict.fromkeys(STAGED_SENSORS, 1), "hard": 10}
    parser.add_argument("--seeds", type=int, default=10, help="of each LiDAR; ten times hard ones")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", choices=kinds, default=kinds)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    jobs = [
        (kind, seed)
        for kind in arguments.kinds
        for seed in range(arguments.first, arguments.first + kinds[kind] * arguments.seeds)
    ]
    with ProcessPoolExecutor(
        arguments.processes,
        mp_context=get_context("spawn"),
        initializer=threadpool_limits,
        initargs=(1,),
    ) as pool:
        lines = [each for group in pool.map(judged_in, jobs) for each in group]
    _, member = np.unique([each.thing for each in lines], return_inverse=True)
    measures = np.array([each.measures for each in lines])
    is_pole = np.array([each.is_pole for each in lines])
    # A pole and another line on it are one thing, but not one of one kind.
    member = 2 * member + is_pole
    counts = np.bincount(member)
    weights = fitted(measures, is_pole, np.where(is_pole, MISSED, 1.0) / counts[member])
    print(f"{len(lines)} lines; weights {', '.join(f'{each:.1f}' for each in weights)}")
    for name, values in (("fitted", weights), ("as they are", np.array(odds.WEIGHTS))):
        best = np.full(len(counts), -np.inf)
        np.maximum.at(best, member, measures @ values)
        for kind, what in ((1, "poles"), (0, "other things")):
            own = best[kind::2][np.isfinite(best[kind::2])]
            kept = ", ".join(f"{np.mean(own >= limit):.0%} from {limit:g}" for limit in LIMITS)
            print(f"{name}: of {len(own)} {what} {kept}")


if __name__ == "__main__":
    main()
