"""What does not fit is taken out, the worst of each neighbourhood first; what does is put back.

A wrong edge raises the tests of its neighbours too. So only that with the largest χ² around goes,
the rest is adjusted again, and everything tested anew (data snooping, Baarda 1968), those that are
out as well, until nothing changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ...api import Array, BoolArray, IntArray
from .adjustment import SETTLED, AdjustedNetwork, Layout, adjust
from .components import Component, connected, find_components
from .doubtful import agrees, inseparable, outvoted, relaid
from .elimination import Blocks
from .graph import Graph
from .residuals import Model
from .testing import ObservationTests, all_tests, covariances, critical

MOST_ROUNDS = 30
"""So often the network is adjusted again; cities of 10,000 poses with 1 % wrong
edges took 3 to 6 (benchmarks/fleet_network.py, seeds 0 to 3)."""

ROUGHLY = 1e-2
"""Rounds that others follow end their steps where the next would change the sum of squares by less
than this, σ²: a χ² at the limit of chance then moves by 1 at most, where steps shrink tenfold by
less than 0.4. Only what the last round finds, adjusted to the end, stands."""

PUT_BACK = 1
"""So often an observation that was taken out may come back."""

PLAIN = 10.0
"""How far beyond chance an observation must miss at first to be out before any test, as a multiple
of the χ² that chance allows: the tests of nearer ones tell better which of two neighbours is
wrong. With 1 instead, 2 more of 147 detectable errors went unnamed (benchmarks/fleet_network.py,
seed 0)."""

TOLD_APART = 9.2
"""Of two edges either of which explains what does not fit, that whose χ² is less by no more than
this is not told apart: it is up to a hundred times less likely, 2 ln 100."""


@dataclass(frozen=True, eq=False)
class Snooped:
    """The network without what does not fit.

    Attributes
    ----------
    adjusted
        Its poses.
    components
        Its components, with the datum of each.
    covariance
        Of each pose, and of each two that share an edge.
    active
        (M,) which observations were adjusted.
    tests
        Of all observations.
    rivals
        For some that were taken out, others that were as likely when it was.
    rounds
        How often all was adjusted.
    settled
        Whether the last round changed nothing more.
    """

    adjusted: AdjustedNetwork
    components: tuple[Component, ...]
    covariance: Blocks
    active: BoolArray
    tests: ObservationTests
    rivals: dict[int, tuple[int, ...]]
    rounds: int
    settled: bool


def snoop(model: Model, layout: Layout, T: Array) -> Snooped:
    """Adjust a network without the observations that do not fit.

    Parameters
    ----------
    model, layout
        The network.
    T
        (N, 4, 4) poses that most observations agree with.
    """
    graph = model.graph
    squares = model.squares(T)
    active = connected(graph, squares <= PLAIN * critical(graph.freedom), squares)
    rivals: dict[int, tuple[int, ...]] = {}
    tried: set[int] = set()
    back = np.zeros(len(active), dtype=np.int64)
    until = ROUGHLY
    for rounds in range(1, MOST_ROUNDS + 1):
        components = find_components(graph, active)
        until = SETTLED if rounds == MOST_ROUNDS else until
        adjusted = adjust(model, layout, T, active, components, until)
        T = adjusted.T
        covariance = covariances(adjusted, components)
        tests = all_tests(model, layout, T, covariance, active)
        beyond = tests.chi2 > critical(tests.freedom)
        wrong, fits = active & beyond, ~active & ~beyond & (back < PUT_BACK)
        worst = worst_around(graph, tests.chi2, wrong)
        wanted = connected(graph, (active & ~worst) | fits, tests.chi2)
        if (wanted != active).any():
            if rounds < MOST_ROUNDS:
                rivals |= _as_likely(graph, tests.chi2, active, np.flatnonzero(active & ~wanted))
                back += wanted & ~active
                active = wanted
            continue
        # Two that are out and agree are more than the one that they contradict. Two that do not
        # are wrong themselves: put back, they would bend all that is around them.
        alone = inseparable(graph, active, tests.freedom)
        out = outvoted(alone, tried, partial(agrees, graph, active, T))
        if rounds == MOST_ROUNDS or (not out and until == SETTLED):
            break
        until = until if out else SETTLED
        wanted = active.copy()
        for rival, instead in out.items():
            T = relaid(graph, active, T, rival, instead[0])
            wanted[rival], wanted[instead] = False, True
        tried |= out.keys()
        active = wanted
    settled = adjusted.settled and bool((wanted == active).all())
    return Snooped(adjusted, components, covariance, active, tests, rivals, rounds, settled)


def worst_around(graph: Graph, chi2: Array, wrong: BoolArray) -> BoolArray:
    """Which of the wrong observations (M,) have the largest χ² of all around.

    Around an edge are all that share one of its poses, or are one edge away from it.
    """
    i, j = graph.ends
    score = np.where(wrong, chi2, 0.0)
    largest = np.zeros(graph.nodes + 1)
    np.maximum.at(largest, i, score)
    np.maximum.at(largest, j, score)
    # The ground is no neighbourhood: controls at two ends of a city do not meet there.
    largest[-1] = 0.0
    farther = largest.copy()
    np.maximum.at(farther, i, largest[j])
    np.maximum.at(farther, j, largest[i])
    farther[-1] = 0.0
    return wrong & (score >= np.maximum(farther[i], farther[j]))


def _as_likely(
    graph: Graph, chi2: Array, active: BoolArray, taken_out: IntArray
) -> dict[int, tuple[int, ...]]:
    """Observations that share a pose with one that is taken out, and are as likely to be wrong."""
    if not len(taken_out):
        return {}
    candidates = np.flatnonzero(active & (chi2 > chi2[taken_out].min() - TOLD_APART))
    ends = np.stack(graph.ends, axis=1)
    found = {}
    for k in taken_out.tolist():
        near = np.isin(ends[candidates], ends[k][ends[k] < graph.nodes]).any(axis=1)
        others = candidates[near & (candidates != k)]
        others = others[chi2[others] > chi2[k] - TOLD_APART]
        if len(others):
            found[k] = tuple(others.tolist())
    return found
