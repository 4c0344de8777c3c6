"""What was left out, but agrees with others that were, may be right and what stayed wrong.

A motion of one side of the network makes what was left out fit; what else it makes fit agrees. The
fewest active observations that would then have to go are a least cut between both sides (Ford and
Fulkerson 1956). Where they are no more than those that agree, nothing tells which are wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow
from scipy.spatial import cKDTree

from ...api import Array, BoolArray, IntArray, se3
from .graph import LEAST_LEVER, Graph
from .observations import Observations, with_ground
from .start import laid
from .testing import critical

NEAREST = 64
"""Of so many nearest ones that were left out it is asked whether they agree. Not tuned."""

TRIED_POINTS = 12
"""Any two of so many nearest control points may tell with a third how a side lies: 66 motions."""

AGREE = 0.01
"""Part of its square that one may miss by still and agree: the poses of either side, which bend,
are taken as certain."""

HELPS = 0.25
"""Part of its square that one may miss by where the motion is taken as it is. Not tuned."""

NONE = np.zeros((6, 6))
"""Covariance of a motion that is taken as it is."""

PLAIN = 10.0
"""By how much more than chance allows a control point must miss for turns of its side to be tried,
as a multiple of that χ²: turns that are no larger than chance fit everything."""


@dataclass(frozen=True, eq=False)
class Contest:
    """Some that were left out, against as many active ones or fewer.

    Attributes
    ----------
    back
        Those left out that agree with each other.
    rivals
        Active ones that may be wrong in their stead.
    pliant
        Active control points that fit either way.
    lost
        Those of the rivals that would go, had all that was left out come back.
    T
        (N, 4, 4) poses with the one side where those left out put it.
    likelier
        Whether they are more, or agree better with each other than those that would go.
    """

    back: IntArray
    rivals: IntArray
    pliant: IntArray
    lost: IntArray
    T: Array
    likelier: bool

    @property
    def key(self) -> frozenset[int]:
        """Names it in later rounds."""
        return frozenset(self.back.tolist())

    @property
    def votes(self) -> int:
        """By how many more those are that agree."""
        return len(self.back) - len(self.lost)


@dataclass(frozen=True, eq=False)
class _Network:
    """Observations (M,), which are active, what they miss (M,), poses with the ground behind."""

    of: Observations
    active: BoolArray
    squares: Array
    T: Array


@dataclass(frozen=True, eq=False)
class _Motion:
    """A motion ``G`` (4, 4) of one side, with its covariance (6, 6) about a point (3,).

    Only several control points tell how a side is `turned`.
    """

    G: Array
    about: Array
    covariance: Array
    turned: bool


@dataclass(frozen=True, eq=False)
class _Moved:
    """Observations (K,) with one end moved: residuals in σ, and derivatives by the motion."""

    residual: Array
    by_motion: Array

    @property
    def covariance(self) -> Array:
        """(6, 6) of the motion that these tell; zero of what they do not."""
        A = self.by_motion.reshape(-1, 6)
        return np.asarray(np.linalg.pinv(A.T @ A, hermitian=True))

    @property
    def least(self) -> float:
        """The sum of squares that no motion takes away."""
        A, e = self.by_motion.reshape(-1, 6), self.residual.ravel()
        left = e - A @ np.linalg.lstsq(A, e)[0]
        return float(left @ left)

    def squares(self, covariance: Array) -> Array:
        """(K,) squares in σ² where the motion has a covariance of its own."""
        A, e = self.by_motion, self.residual[:, :, None]
        S = np.eye(6) + A @ covariance @ np.swapaxes(A, 1, 2)
        return np.asarray((np.swapaxes(e, 1, 2) @ np.linalg.solve(S, e)).ravel())


def _moved(network: _Network, some: IntArray, G: Array, about: Array, first: BoolArray) -> _Moved:
    """Hold observations (K,) against the poses, with the second end of each moved, or the first."""
    of, T, count = network.of.only(some), network.T, len(some)
    which = first[:, None, None]
    T_i, T_j = np.where(which, G, np.eye(4)) @ T[of.i], np.where(which, np.eye(4), G) @ T[of.j]
    ends = np.arange(count)
    at = replace(of, i=ends, j=ends + count).at(np.concatenate([T_i, T_j]))
    # A turn of the side by φ moves a pose of it by φ × (t − about).
    moves = np.tile(np.eye(6), (count, 1, 1))
    moves[:, 3:, :3] = -se3.hat(np.where(first[:, None], T_i[:, :3, 3], T_j[:, :3, 3]) - about)
    return _Moved(at.residual, np.where(which, at.by_i, at.by_j) @ moves)


def find_contests(graph: Graph, active: BoolArray, T: Array) -> list[Contest]:
    """Find what was left out and has as many votes as what contradicts it.

    Parameters
    ----------
    graph
        The network.
    active
        (M,) which observations were adjusted.
    T
        (N, 4, 4) their poses.
    """
    out, of = np.flatnonzero(~active), graph.observed
    if not len(out):
        return []
    # Where each lies: at the end that is a node for sure.
    place = T[of.j, :3, 3]
    network = _Network(of, active, of.squares(T), with_ground(T))
    tree, found, done = cKDTree(place[out]), [], set[int]()
    for k in out.tolist():
        if k not in done:
            near = out[np.atleast_1d(tree.query(place[k], min(NEAREST, len(out)))[1])]
            motions = _motions(network, k)
            contests = [_contest(network, k, near, motion) for motion in motions]
            some = [contest for contest in contests if contest is not None]
            if some:
                found.append(max(some, key=lambda each: each.votes))
                done.update(found[-1].back.tolist())
    return found


def _motions(network: _Network, k: int) -> Iterator[_Motion]:
    """Motions of the second end of an observation that make it fit."""
    of, T, some = network.of, network.T, np.array([k])
    T_j = T[of.j[k]]
    if of.freedom[k] == 6:
        T_moved = T[of.i[k]] @ of.T_i_j[k]
        G, about = T_moved @ se3.inverse(T_j), T_moved[:3, 3]
        yield _Motion(
            G, about, _moved(network, some, G, about, np.array([False])).covariance, False
        )
        return
    points = np.flatnonzero(of.freedom == 3)
    node = T[of.j[points]]
    seen = np.einsum("kab,kb->ka", node[:, :3, :3], of.seen[points]) + node[:, :3, 3]
    world, own = of.T_i_j[points, :3, 3], int(np.searchsorted(points, k))
    shift, about = se3.from_rt(np.eye(3), world[own] - seen[own]), world[own]
    moved = _moved(network, some, shift, about, np.array([False]))
    moved.by_motion[:, :, :3] = 0.0
    yield _Motion(shift, about, moved.covariance, False)
    if network.squares[k] <= PLAIN * critical(of.freedom[some])[0]:
        return
    order = np.argsort(np.sum((seen - seen[own]) ** 2, axis=1), kind="stable")
    near = order[order != own][:TRIED_POINTS].tolist()
    for others in (*combinations(near, 1), *combinations(near, 2)):
        some = np.array([own, *others])
        G = _laid_by(seen[some], world[some])
        moved = _moved(network, points[some], G, about, np.zeros(len(some), dtype=bool))
        if moved.least <= critical(np.array([3]))[0]:
            yield _Motion(G, about, moved.covariance, True)


def _laid_by(seen: Array, world: Array) -> Array:
    """Lay two points (2, 3) or three onto others, by the least turn where they leave one open."""
    spread = np.linalg.svd(seen - seen.mean(axis=0), compute_uv=False)
    if spread[1] > LEAST_LEVER:
        return laid(seen, world)
    a, b = (
        (points[1] - points[0]) / np.linalg.norm(points[1] - points[0]) for points in (seen, world)
    )
    axis = np.cross(a, b)
    angle = np.arctan2(np.linalg.norm(axis), a @ b)
    R = se3.exp_so3(axis * angle / max(np.linalg.norm(axis), 1e-12))
    return se3.from_rt(R, world.mean(axis=0) - R @ seen.mean(axis=0))


def _contest(network: _Network, k: int, near: IntArray, motion: _Motion) -> Contest | None:
    """Find what agrees with one that was left out, and the least cut that contradicts them."""
    of, active, now, size = network.of, network.active, network.squares[near], len(network.T)
    G, about, covariance = motion.G, motion.about, motion.covariance
    limit = np.maximum(critical(of.freedom[near]), AGREE * now)
    # Of each end whether it is moved, 1, or stays, 2.
    side = np.zeros(size, dtype=np.int64)
    side[of.j[k]], side[of.i[k]] = 1, 2
    back = {k: False}
    for is_first in (False, True):
        first = np.full(len(near), is_first)
        moved = _moved(network, near, G, about, first)
        # What lies far off any small turn would make fit: the motion itself must help.
        fits = (moved.squares(covariance) <= limit) & (moved.squares(NONE) <= HELPS * now)
        for o in near[fits].tolist():
            moves, stays = (of.i[o], of.j[o]) if is_first else (of.j[o], of.i[o])
            if side[moves] != 2 and side[stays] != 1:
                side[moves], side[stays] = 1, 2
                back.setdefault(o, is_first)
    if len(back) < 2 and not motion.turned:
        return None
    stiff, pliant = active.copy(), np.zeros(0, dtype=np.int64)
    if motion.turned:
        points = np.flatnonzero(active & (of.freedom == 3))
        second = np.zeros(len(points), dtype=bool)
        squares = _moved(network, points, G, about, second).squares(covariance)
        pliant = points[squares <= critical(np.array([3]))[0]]
        stiff[pliant] = False
    # All that is moved is one, and all that stays.
    label = np.arange(size)
    label[side == 1], label[side == 2] = of.j[k], of.i[k]
    i, j = label[of.i], label[of.j]
    rivals, is_moved = _least_cut(stiff, i, j, (int(of.j[k]), int(of.i[k])), size)
    lost = rivals[is_moved[i[rivals]] != is_moved[j[rivals]]]
    if len(lost) > len(back):
        return None
    agreeing, first = np.array([*back]), np.array([*back.values()])
    likelier = len(back) > len(lost)
    if len(back) == len(lost) == len(rivals) > 1:
        before = _moved(network, lost, np.eye(4), about, is_moved[i[lost]]).least
        likelier = _moved(network, agreeing, G, about, first).least < before
    T, is_moved = network.T.copy(), is_moved[label]
    # The ground stays where it is.
    if is_moved[-1]:
        is_moved, G = ~is_moved, se3.inverse(G)
    T[is_moved] = G @ T[is_moved]
    return Contest(agreeing, rivals, pliant, lost, T[:-1], likelier)


def _least_cut(
    kept: BoolArray, i: IntArray, j: IntArray, ends: tuple[int, int], size: int
) -> tuple[IntArray, BoolArray]:
    """Find the fewest observations without which two nodes do not hang together.

    Parameters
    ----------
    kept
        (M,) which there are.
    i, j
        (M,) ends of each.
    ends
        The two nodes.
    size
        How many nodes there are.

    Returns
    -------
    IntArray
        Those that are in any least cut.
    BoolArray
        (size,) nodes that hang together with the first one in the least cut next to it.
    """
    one_way = csr_array((np.ones(kept.sum(), dtype=np.int32), (i[kept], j[kept])), (size, size))
    capacity = (one_way + one_way.T).tocsr()
    flow = maximum_flow(capacity, *ends).flow
    left = (capacity - flow).tocsr()
    left.eliminate_zeros()
    part = connected_components(left, directed=True, connection="strong")[1]
    hangs = np.zeros(size, dtype=bool)
    hangs[breadth_first_order(left, ends[0], return_predecessors=False)] = True
    return np.flatnonzero(kept & (part[i] != part[j])), hangs
