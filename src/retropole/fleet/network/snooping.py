"""What does not fit is taken out, the worst of each neighbourhood first; what does is put back.

A wrong edge raises the tests of its neighbours too. So only that with the largest χ² around goes,
the rest is adjusted again, and everything tested anew (data snooping, Baarda 1968), those that are
out as well, until nothing changes.

Where only one loop leads through two observations, what does not close there is as well the one's
error as the other's. One was left out; nothing checks the other any more, and it joins what else is
apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order

from ...api import Array, BoolArray, IntArray, se3
from .adjustment import SETTLED, AdjustedNetwork, Layout, adjust
from .contests import Contest, find_contests
from .graph import (
    Component,
    Graph,
    connected,
    find_components,
    hanging_together,
)
from .observations import with_ground
from .testing import ObservationTests, all_tests, critical

AGREE = 10.0
"""By how much more than chance allows two may miss each other and still agree, as a multiple of
that χ²: the poses on either side of them, whose errors they also miss by, are taken as certain."""


def inseparable(graph: Graph, active: BoolArray, checked: IntArray) -> dict[int, tuple[int, ...]]:
    """Find for each observation that is left out the active ones that may be wrong in its stead.

    Parameters
    ----------
    graph
        The network.
    active
        (M,) which observations were adjusted.
    checked
        (M,) how many numbers of each the others check.

    Returns
    -------
    dict
        Only of those that have any, in the order in which they lead from one end to the other.
    """
    i, j = graph.observed.i, graph.observed.j
    lone = active & (checked == 0)
    label = hanging_together(graph, active & ~lone)
    bridges = np.flatnonzero(lone)
    left_out = np.flatnonzero(~active & (label[i] != label[j]))
    if not len(bridges) or not len(left_out):
        return {}
    size = int(label.max()) + 1
    a, b = label[i[bridges]], label[j[bridges]]
    # Its entries are numbers of observations, from 1 on.
    forest = csr_array((bridges + 1, (a, b)), shape=(size, size))
    forest = forest + forest.T
    found = {}
    for k in left_out.tolist():
        first, last = int(label[i[k]]), int(label[j[k]])
        _, before = breadth_first_order(forest, first)
        path, at = [], last
        while before[at] >= 0:
            path.append(int(forest[at, before[at]]) - 1)
            at = int(before[at])
        if at == first:
            found[k] = tuple(path[::-1])
    return found


def against_consensus(
    alone: dict[int, tuple[int, ...]], tried: set[int], agree: Callable[[int, int, int], bool]
) -> dict[int, list[int]]:
    """Find active observations that two or more which were left out agree to be wrong instead.

    Parameters
    ----------
    alone
        From `inseparable`.
    tried
        Those that were taken out for that before.
    agree
        Whether two agree where a third, the first given, is wrong: `agrees`.

    Returns
    -------
    dict
        For each the ones to put back in its stead, none of them twice.
    """
    against: dict[int, list[int]] = {}
    for k, path in alone.items():
        for rival in path:
            against.setdefault(rival, []).append(k)
    found: dict[int, list[int]] = {}
    used: set[int] = set()
    for rival, back in sorted(against.items(), key=lambda each: (-len(each[1]), each[0])):
        if len(back) > 1 and rival not in tried and used.isdisjoint(back):
            agreed = {frozenset(pair) for pair in combinations(back, 2) if agree(rival, *pair)}
            groups = ([k for k in back if k == one or {k, one} in agreed] for one in back)
            most = max(groups, key=len)
            if len(most) > 1:
                found[rival] = most
                used.update(most)
    return found


def agrees(graph: Graph, active: BoolArray, T: Array, rival: int, one: int, other: int) -> bool:
    """Whether two observations lay what hangs by a third in the same place.

    That whole side is laid by least squares of both; they agree if neither then misses by far more
    than chance (`AGREE`).

    Parameters
    ----------
    graph
        The network.
    active
        (M,) which observations were adjusted.
    T
        (N, 4, 4) poses.
    rival
        An active observation that nothing checks.
    one, other
        Two that join the same two sides.
    """
    both = np.sort([one, other])
    # A control point does not say how a side is turned: it comes last, and lays none.
    T = relaid(graph, active, T, rival, int(both[0]))
    label = hanging_together(graph, active, [rival])
    two = graph.observed.only(both)
    i, j = two.i[0], two.j[0]
    side = label == label[j if label[j] != label[-1] else i]
    # A turn of the side by φ moves a pose of it by φ × (t − about).
    away = with_ground(T)[:, :3, 3] - T[j, :3, 3]
    moves = np.tile(np.eye(6), (len(away), 1, 1))
    moves[:, 3:, :3] = -se3.hat(away)
    moves *= side[:, None, None]
    at = two.at(T)
    A = (at.by_i @ moves[two.i] + at.by_j @ moves[two.j]).reshape(-1, 6)
    e = at.residual.ravel()
    left = e - A @ np.linalg.lstsq(A, e)[0]
    return bool(left @ left <= AGREE * critical(two.freedom.sum() - 6))


def relaid(graph: Graph, active: BoolArray, T: Array, rival: int, instead: int) -> Array:
    """Move what hangs by one observation to where another puts it.

    Parameters
    ----------
    graph
        The network.
    active
        (M,) which observations were adjusted.
    T
        (N, 4, 4) poses.
    rival
        An active observation that nothing checks.
    instead
        An edge or a known pose that joins the same two sides.
    """
    of = graph.observed
    i, j, T_i_j = of.i[instead], of.j[instead], of.T_i_j[instead]
    label = hanging_together(graph, active, [rival])
    if of.freedom[instead] < 6 or label[i] == label[j]:
        return T
    # The side without the ground moves, or the smaller one.
    sizes = [np.count_nonzero(label == label[end]) for end in (i, j)]
    if label[j] == label[-1] or (label[i] != label[-1] and sizes[1] > sizes[0]):
        i, j, T_i_j = j, i, se3.inverse(T_i_j)
    T = with_ground(T)
    side = label == label[j]
    T[side] = T[i] @ T_i_j @ se3.inverse(T[j]) @ T[side]
    return T[:-1]


def hanging(
    graph: Graph, active: BoolArray, components: tuple[Component, ...], rivals: set[int]
) -> BoolArray:
    """Which poses (N,) are tied to their datum by observations that may be wrong alone."""
    label = hanging_together(graph, active, sorted(rivals))
    doubtful = np.zeros(graph.nodes, dtype=bool)
    for component in components:
        datum = graph.nodes if component.controls else component.nodes[0]
        doubtful[component.nodes] = label[component.nodes] != label[datum]
    return doubtful


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

SEPARABLE = 9.2
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
    active
        (M,) which observations were adjusted.
    tests
        Of all observations.
    rivals
        For some that were taken out, others that were as likely when it was.
    contests
        Of those left out that have as many votes as what stayed.
    rounds
        How often all was adjusted.
    settled
        Whether the last round changed nothing more.
    """

    adjusted: AdjustedNetwork
    components: tuple[Component, ...]
    active: BoolArray
    tests: ObservationTests
    rivals: dict[int, tuple[int, ...]]
    contests: list[Contest]
    rounds: int
    settled: bool


def snoop(graph: Graph, layout: Layout, T: Array) -> Snooped:
    """Adjust a network without the observations that do not fit.

    Parameters
    ----------
    graph, layout
        The network.
    T
        (N, 4, 4) poses that most observations agree with.
    """
    squares = graph.observed.squares(T)
    active = connected(graph, squares <= PLAIN * critical(graph.observed.freedom), squares)
    rivals: dict[int, tuple[int, ...]] = {}
    tried: set[int] = set()
    outvoted: set[frozenset[int]] = set()
    contests: list[Contest] = []
    back = np.zeros(len(active), dtype=np.int64)
    until = ROUGHLY
    for rounds in range(1, MOST_ROUNDS + 1):
        components = find_components(graph, active)
        until = SETTLED if rounds == MOST_ROUNDS else until
        adjusted = adjust(graph, layout, T, active, components, until)
        T = adjusted.T
        tests = all_tests(graph, layout, adjusted, active)
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
        out = against_consensus(alone, tried, partial(agrees, graph, active, T))
        contests = [] if out else find_contests(graph, active, T)
        likelier = [each for each in contests if each.likelier and each.key not in outvoted]
        if rounds == MOST_ROUNDS or (not out and not likelier and until == SETTLED):
            break
        until = until if out or likelier else SETTLED
        wanted = active.copy()
        if likelier:
            most = max(likelier, key=lambda each: each.votes)
            T, wanted[most.lost], wanted[most.back] = most.T, False, True
            outvoted.add(most.key)
        for rival, instead in out.items():
            T = relaid(graph, active, T, rival, instead[0])
            wanted[rival], wanted[instead] = False, True
        tried |= out.keys()
        active = wanted
    settled = adjusted.settled and bool((wanted == active).all())
    return Snooped(adjusted, components, active, tests, rivals, contests, rounds, settled)


def worst_around(graph: Graph, chi2: Array, wrong: BoolArray) -> BoolArray:
    """Which of the wrong observations (M,) have the largest χ² of all around.

    Around an edge are all that share one of its poses, or are one edge away from it.
    """
    i, j = graph.observed.i, graph.observed.j
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
    candidates = np.flatnonzero(active & (chi2 > chi2[taken_out].min() - SEPARABLE))
    ends = np.stack([graph.observed.i, graph.observed.j], axis=1)
    found = {}
    for k in taken_out.tolist():
        near = np.isin(ends[candidates], ends[k][ends[k] < graph.nodes]).any(axis=1)
        others = candidates[near & (candidates != k)]
        others = others[chi2[others] > chi2[k] - SEPARABLE]
        if len(others):
            found[k] = tuple(others.tolist())
    return found
