"""The network of a city on one page: from relative poses to poses, with covariances and tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from ...api import Array, BoolArray
from .adjustment import Layout, find_layout
from .graph import Component, Graph
from .snooping import Snooped, hanging, inseparable, snoop
from .start import find_start, narrowed
from .testing import ObservationTests, critical

Kind = Literal["edge", "known pose", "control point"]


@dataclass(frozen=True, eq=False)
class LeftOut:
    """An observation that does not fit.

    Attributes
    ----------
    kind, index
        Which: its number among those of its kind.
    w
        Its χ² against all that were adjusted, as a standard normal number.
    chi2, freedom
        That χ², and of how many numbers.
    rivals
        Others, by kind and number, that may be wrong in its stead: nothing tells which.
    """

    kind: Kind
    index: int
    w: float
    chi2: float
    freedom: int
    rivals: tuple[tuple[Kind, int], ...]

    @property
    def reason(self) -> str:
        """In words."""
        return self.reason_of(lambda kind, index: f"{kind} {index}")

    def reason_of(self, named: Callable[[Kind, int], str]) -> str:
        """In words, with observations by their names."""
        words = f"{named(self.kind, self.index)}: w {self.w:.1f} against all others"
        if self.rivals:
            others = ", ".join(named(*rival) for rival in self.rivals)
            words += f"; {others} may be wrong in its stead"
        return words


@dataclass(frozen=True, eq=False)
class NetworkAdjustment:
    """A network adjusted.

    Attributes
    ----------
    T_world_node
        (N, 4, 4) poses: map points of each node into the frame of the network.
    covariance
        (N, 6, 6) over ``[φ, δ]``, rad and m, axes of the network; zero where the datum holds.
    cross
        (E, 6, 6) covariance between the first and the second pose of each edge.
    edges, known, points
        ObservationTests of the relative poses, the known poses and the control points.
    left_out
        What does not fit and was not adjusted, by kind and number.
    components
        Nodes that are connected, and the datum of each component.
    doubtful
        (N,) poses that are tied to their datum by what may be wrong in the stead of what was left
        out: they may be elsewhere by as much as that misses.
    unit_variance
        Sum of squares for each degree of freedom: 1 where the covariances given are right.
    rounds
        How often all was adjusted.
    settled
        Whether steps and rounds ended by themselves.
    """

    T_world_node: Array
    covariance: Array
    cross: Array
    edges: ObservationTests
    known: ObservationTests
    points: ObservationTests
    left_out: tuple[LeftOut, ...]
    components: tuple[Component, ...]
    doubtful: BoolArray
    unit_variance: float
    rounds: int
    settled: bool

    def joint(self, graph: Graph, edge: int) -> Array:
        """(12, 12) covariance of both poses of an edge, ``[φ_i, δ_i, φ_j, δ_j]``."""
        i, j = graph.edges.i[edge], graph.edges.j[edge]
        cross = self.cross[edge]
        return np.block([[self.covariance[i], cross], [cross.T, self.covariance[j]]])


def adjust_network(
    graph: Graph, progress: Callable[[str], None] = lambda _: None
) -> NetworkAdjustment:
    """Adjust all poses of a network together, without what does not fit.

    Parameters
    ----------
    graph
        Relative poses, and what ties them to the ground. No pose need be known before.
    progress
        Is told each step as it begins.

    Raises
    ------
    RetropoleError
        Where the normal equations cannot be solved.
    """
    with threadpool_limits(1, user_api="blas"):
        progress("order")
        layout = find_layout(graph)
        progress("start")
        T = find_start(graph, layout)
        T = narrowed(graph, layout, T, critical(graph.observed.freedom))
        progress("tests")
        found = snoop(graph, layout, T)
        progress("end")
        return _summed_up(graph, layout, found)


def _summed_up(graph: Graph, layout: Layout, found: Snooped) -> NetworkAdjustment:
    active, tests = found.active, found.tests
    alone = inseparable(graph, active, tests.freedom)
    doubtful = hanging(graph, active, found.components, set(chain.from_iterable(alone.values())))
    rivals = {**found.rivals}
    for contest in found.contests:
        # What fits either way holds no side where it is.
        stiff = active.copy()
        stiff[contest.pliant] = False
        doubtful |= hanging(graph, stiff, found.components, set(contest.rivals.tolist()))
        for k in contest.back.tolist():
            rivals[k] = (*contest.rivals.tolist(), *rivals.get(k, ()))
    cross = layout.turn(found.adjusted.covariance.pairs[layout.pair])
    shares = np.sum((tests.redundancy * graph.observed.freedom)[active])
    squares = graph.observed.squares(found.adjusted.T)[active].sum()
    counts: dict[Kind, int] = {
        "edge": len(graph.edges),
        "known pose": len(graph.known),
        "control point": len(graph.points),
    }
    named = [(kind, k) for kind, count in counts.items() for k in range(count)]
    edges, known, points = tests.split(counts.values())
    left_out = []
    for k in np.flatnonzero(~active).tolist():
        others = dict.fromkeys((*alone.get(k, ()), *rivals.get(k, ())))
        others_named = tuple(named[rival] for rival in others if active[rival])
        w, chi2, freedom = float(tests.w[k]), float(tests.chi2[k]), int(tests.freedom[k])
        left_out.append(LeftOut(*named[k], w, chi2, freedom, others_named))
    return NetworkAdjustment(
        found.adjusted.T,
        found.adjusted.covariance.diagonal,
        cross,
        edges,
        known,
        points,
        tuple(left_out),
        found.components,
        doubtful,
        float(squares / shares) if shares > 0 else 1.0,
        found.rounds,
        found.settled,
    )
