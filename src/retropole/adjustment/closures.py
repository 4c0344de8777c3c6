"""Around loops: the poses that the pairs give by themselves must compose to the identity.

Each pair is solved alone, from its poles and its scene only, about the joint answer. Around a loop
the small steps by which the pairs differ from it add up to the misclosure. Pairs that share a LiDAR
share its returns and its errors: the common part is included once. A scene is weighted by the
scatter of its places, if that exceeds the effect of the noise of its patches, as in the tests of
observations: residuals at one place are correlated, within a pair and from pair to pair.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from ..alignment.adjustment import MAX_TRANSLATION_SIGMA
from ..alignment.certainty import excess
from ..alignment.network import Observation
from ..alignment.solver import ROUNDING, inverse_of
from ..alignment.unknowns import POSE
from ..base import se3
from ..base.datatypes import Array, IntArray
from ..base.uncertainty import floor
from .answer import LoopClosure
from .descent import End, SceneTerm
from .solved import Solved, labels_of_places, moved_by, places_of

MOST_LOOPS = 60
"""At most this many loops are closed: of 8 LiDARs that all see each other, all 56 triangles."""


@dataclass(frozen=True, eq=False)
class _Edge:
    """What a pair alone determines.

    Attributes
    ----------
    lidars
        Its indices.
    gain
        (6, P) from slopes of the unknowns at `place` to the step of the second's pose against the
        first, in the frame of the site.
    place
        (P,) which unknowns.
    sources
        What it rests on: observations by number, its scene, and the prior of the errors.
    step
        (6,) by which it differs from the joint answer.
    scatter
        (6, R) what each place of the scenes does to the step, and that it is not flat.
    """

    lidars: tuple[int, int]
    gain: Array
    place: IntArray
    sources: tuple[int, ...]
    scene: SceneTerm | None
    step: Array
    scatter: Array


def close_loops(at: Solved, end: End) -> Iterator[LoopClosure]:
    """Close the loops of all pairs that have a separate answer: triangles first."""
    edges = {each.lidars: each for each in _edges(at, end)}
    for loop in _loops(sorted({i for pair in edges for i in pair}), list(edges))[:MOST_LOOPS]:
        yield _closure(loop, edges, at, end)


def _loops(lidars: Sequence[int], edges: Sequence[tuple[int, int]]) -> list[tuple[int, ...]]:
    """All triangles; and for each edge in none of them its shortest loop."""
    known = set(edges)
    found: list[tuple[int, ...]] = [
        (a, b, c) for a, b, c in combinations(lidars, 3) if {(a, b), (b, c), (a, c)} <= known
    ]
    covered = {pair for loop in found for pair in combinations(loop, 2)}
    neighbours = {i: {b if a == i else a for a, b in known if i in (a, b)} for i in lidars}
    seen = {frozenset(loop) for loop in found}
    for a, b in sorted(known - covered):
        path = _shortest(a, b, neighbours)
        if path is not None and frozenset(path) not in seen:
            seen.add(frozenset(path))
            found.append(path)
    return found


def _shortest(a: int, b: int, neighbours: dict[int, set[int]]) -> tuple[int, ...] | None:
    """Shortest way from one LiDAR to another but for the edge between them."""
    ways: list[tuple[int, ...]] = [(a,)]
    reached = {a}
    while ways:
        further = []
        for way in ways:
            for i in sorted(neighbours[way[-1]] - reached):
                if (way[-1], i) == (a, b):
                    continue
                if i == b:
                    return (*way, b)
                reached.add(i)
                further.append((*way, i))
        ways = further
    return None


def _edges(at: Solved, end: End) -> Iterator[_Edge]:
    """Solve every pair by itself."""
    network = at.network
    places = labels_of_places(end) if end.scene else []
    scenes = {term.lidars: (term, own) for term, own in zip(end.scene, places, strict=True)}
    count = 1 + max((int(own.max()) for own in places), default=-1)
    returns: dict[int, list[int]] = {}
    for k, one in enumerate(network.observations):
        if one.poles is not None and one.lidar is not None:
            returns.setdefault(one.lidar, []).append(k)
    for i, j in combinations(sorted(returns), 2):
        sources = (*returns[i], *returns[j])
        edge = _edge((i, j), sources, scenes.get((i, j)), at, end, count)
        if edge is not None:
            yield edge


def _edge(
    lidars: tuple[int, int],
    sources: tuple[int, ...],
    seen: tuple[SceneTerm, IntArray] | None,
    at: Solved,
    end: End,
    count: int,
) -> _Edge | None:
    """Solve one pair with the first LiDAR fixed; None if its pose is not determined."""
    scene = None if seen is None else seen[0]
    unknowns = at.network.unknowns
    parts = [at.network.observations[k] for k in sources]
    places = [part.place for part in parts] + ([] if scene is None else [scene.place])
    place = np.unique(np.concatenate(places))
    place = place[~np.isin(place, unknowns.pose(lidars[0]))]
    information: Array = ROUNDING * np.eye(len(place))
    slope = np.zeros(len(place))
    for part in parts:
        _add(information, slope, place, part.place, part.information, at.slope(part))
    if scene is not None:
        by = scene.slope(at.values, unknowns.poses)
        _add(information, slope, place, scene.place, scene.information, by)
    errors = (place >= unknowns.poses) & (place < unknowns.kept)
    precision = end.precision[place[errors] - unknowns.poses]
    rows = np.flatnonzero(errors)
    information[rows, rows] += precision
    slope[rows] -= precision * end.errors[place[errors] - unknowns.poses]
    inverse = inverse_of(information)
    of_pose = np.flatnonzero(np.isin(place, unknowns.pose(lidars[1])))
    if np.sqrt(np.diag(inverse)[of_pose].max()) > MAX_TRANSLATION_SIGMA:
        return None
    gain = np.asarray(inverse[of_pose], dtype=np.float64)
    scatter = np.zeros((POSE, 2, count))
    if seen is not None:
        of_scene = np.zeros((POSE, unknowns.size))
        of_scene[:, place] = gain
        by_term = of_scene[:, seen[0].place]
        own = places_of(end, [seen[0]], [by_term], gain[:, of_pose], [seen[1]])
        for kind, each in enumerate(moved_by(own)):
            scatter[:, kind, : each.shape[1]] = each
    step = gain @ slope
    return _Edge(lidars, gain, place, sources, scene, step, scatter.reshape(POSE, -1))


def _add(
    information: Array, slope: Array, place: IntArray, own: IntArray, more: Array, by: Array
) -> None:
    kept = np.flatnonzero(np.isin(own, place))
    rows = np.searchsorted(place, own[kept])
    information[np.ix_(rows, rows)] += more[np.ix_(kept, kept)]
    np.add.at(slope, rows, by[kept])


def _closure(
    loop: tuple[int, ...],
    edges: dict[tuple[int, int], _Edge],
    at: Solved,
    end: End,
) -> LoopClosure:
    """Add up the steps around a loop, with their joint covariance.

    A step of the second LiDAR with the first fixed is moved to act at the origin of the site:
    ``[φ, δ − φ × t]`` is the same for all, so that they add.
    """
    size = at.network.unknowns.size
    misclosure = np.zeros(POSE)
    by_source: dict[int, Array] = {}
    by_prior = np.zeros((POSE, size))
    covariance, by_noise = np.zeros((POSE, POSE)), np.zeros((POSE, POSE))
    scatter = np.zeros_like(edges[min(loop[:2]), max(loop[:2])].scatter)
    for a, b in zip(loop, (*loop[1:], loop[0]), strict=True):
        sign = 1.0 if a < b else -1.0
        edge = edges[min(a, b), max(a, b)]
        to_origin = np.eye(POSE)
        to_origin[3:, :3] = se3.hat(end.T[edge.lidars[1]][:3, 3])
        gain = np.zeros((POSE, size))
        gain[:, edge.place] = sign * to_origin @ edge.gain
        misclosure += sign * to_origin @ edge.step
        for k in edge.sources:
            by_source[k] = by_source.get(k, np.zeros((POSE, size))) + gain
        by_prior += gain
        if edge.scene is not None:
            of_scene = gain[:, edge.scene.place]
            by_noise += of_scene @ edge.scene.information @ of_scene.T
        scatter += sign * to_origin @ edge.scatter
        covariance += to_origin @ floor() @ to_origin.T
    for k, gain in by_source.items():
        one: Observation = at.network.observations[k]
        of_source = gain[:, one.place]
        covariance += of_source @ one.information @ of_source.T
    unknowns = at.network.unknowns
    prior = by_prior[:, unknowns.poses : unknowns.kept] * end.precision * at.sigma
    covariance += prior @ prior.T + by_noise + excess(scatter @ scatter.T, by_noise)
    chi2 = float(misclosure @ np.linalg.solve(covariance, misclosure))
    centre = np.mean([end.T[i][:3, 3] for i in loop], axis=0)
    shift = misclosure[3:] + np.cross(misclosure[:3], centre)
    return LoopClosure(
        loop,
        float(np.linalg.norm(misclosure[:3])),
        float(np.linalg.norm(shift)),
        chi2,
        POSE,
        float(chdtrc(POSE, chi2)),
    )
