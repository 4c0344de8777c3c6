"""Which poles of all possible ones: the best set by exchange on their information.

A set is begun by the best pole for what it lacks, one after the other, and then improved: each
pole in turn is exchanged for the best of all others, until none is better (Fedorov 1972, Theory of
optimal experiments). Nothing is drawn at random.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice, permutations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from ..alignment.solver import inverse_of
from ..alignment.unknowns import POSE, Unknowns
from ..base.datatypes import Array, BoolArray, IntArray
from .place import Candidates, leans_of

UNKNOWN_SIGMA = 0.3, 3.0
"""1 σ of an unknown pose, rad and m: poles are compared before they determine it."""

MOST_ROUNDS = 10
"""Of exchanges of all poles; most sets are at rest after two or three."""

GAIN = 0.999
"""An exchange must bring the error below this fraction."""


WALK = 0.005
"""Part of the error that one metre less between placements is worth."""

MOST_TRIED = 10
"""Poles, the best by the error, that are tried instead of each where a LiDAR depends on one."""

DEARER = 1.25
"""Factor by which the error may grow if one LiDAR fewer depends on a single pole."""

UNCONSTRAINED = 1.0
"""A LiDAR whose error by the poles alone is above this, metres, is not constrained by them."""

LEAST_SPACING, LEAST_ANGLE, LEAST_LEAN = 1.0, float(np.radians(15.0)), float(np.radians(10.0))
"""Of two poles: between their feet, metres; between their axes, rad; and between their leans where
there are two or three. A half turn about the vertical maps two of equal leans to each other: on
bare ground three poles that all leaned by 20° were refused as ambiguous (docs/poles.md)."""

DISTINGUISHABLE = float(np.radians(6.0)), 0.3
"""Angles between poles, rad, or distances, metres, that differ by this amount show which is which.
Two poles always fit in four ways; three whose exchange changes less were refused as ambiguous."""

NOT_BEHIND = float(np.radians(2.0))
"""No LiDAR sees two poles of one placement nearer to each other than this, rad: one might hide the
other."""


def unknown_precision(unknowns: Unknowns) -> Array:
    """(6 L,) precision of unknown poses."""
    return np.tile(np.repeat(UNKNOWN_SIGMA, 3) ** -2.0, unknowns.lidars)


@dataclass(frozen=True, eq=False)
class Rules:
    """Which poles may be in one placement (docs/poles.md).

    Attributes
    ----------
    pairs
        (C, C) which two do: at enough distance, not parallel, and none before the other.
    seen
        (C, L) which LiDAR sees which.
    differ
        (C, C) which two lean differently: up to three do.
    angle, gap
        (C, C) between the axes of every two: the angle, rad, and the least distance, metres.
    """

    pairs: BoolArray
    seen: BoolArray
    differ: BoolArray
    angle: Array
    gap: Array

    def allow(self, k: int, others: Sequence[int]) -> bool:
        """Whether one pole may be next to others."""
        if 0 < len(others) <= 2 and not self.differ[k, list(others)].all():
            return False
        # Two LiDARs are linked by two poles that both see.
        shared = np.count_nonzero(self.seen[k] & self.seen[list(others)], axis=1) >= 2
        joint = bool(self.pairs[k, list(others)].all() and (shared.any() or not others))
        return joint and (len(others) < 2 or self._is_distinguishable([*others, k]))

    def _is_distinguishable(self, poles: Sequence[int]) -> bool:
        """Whether three poles or more fit each other in one way: no exchange looks the same."""
        angle, gap = (each[np.ix_(poles, poles)] for each in (self.angle, self.gap))
        for order in list(permutations(range(len(poles))))[1:]:
            other = np.ix_(order, order)
            turned, away = np.abs(angle[other] - angle), np.abs(gap[other] - gap)
            if turned.max() < DISTINGUISHABLE[0] and away.max() < DISTINGUISHABLE[1]:
                return False
        return True


@dataclass(frozen=True, eq=False)
class Design:
    """What there is to choose from.

    Attributes
    ----------
    roots
        Of each pole, the indices of its unknowns and the root (P, R) of its information about them.
    informations
        (K, K) of all unknowns without any pole, with the surfaces and the poles alone: each with
        the priors of the errors.
    unknowns
        Their order.
    reach
        Range that the error is predicted at, metres.
    rules
        Which of them may be in one placement.
    feet
        (C, 2) where each is, metres.
    found
        What was found already with each additional pole: an exchange often needs it again.
    """

    roots: Sequence[tuple[IntArray, Array]]
    informations: tuple[Array, Array]
    unknowns: Unknowns
    reach: float
    rules: Rules
    feet: Array
    found: dict[tuple[int, ...], Array] = field(default_factory=dict, init=False)

    @property
    def weight(self) -> Array:
        """(6,) of the variances of a pose in the squared error at the reach (`predicted_error`)."""
        return np.array([2 / 3 * self.reach**2] * 3 + [1.0] * 3)

    def inverse(self, chosen: Sequence[int], *, alone: bool = False) -> Array:
        """(K, K) covariance of all unknowns under some poles, with the surfaces or without."""
        total = self.informations[int(alone)].copy()
        poses = np.arange(self.unknowns.poses)
        free = np.arange(POSE, self.unknowns.kept)
        total[poses, poses] += unknown_precision(self.unknowns)
        for k in chosen:
            place, root = self.roots[k]
            total[np.ix_(place, place)] += root @ root.T
        inverse = np.zeros_like(total)
        inverse[POSE:, POSE:] = inverse_of(total[np.ix_(free, free)])
        return inverse

    def squares(self, inverse: Array) -> Array:
        """(L - 1,) squared error at the reach of each LiDAR's pose but the first."""
        variance = np.diag(inverse)[POSE : self.unknowns.poses].reshape(-1, POSE)
        return np.asarray(variance @ self.weight)

    def change(self, inverse: Array, k: int, sign: float) -> Array:
        """(L - 1,) by how much one pole more (1), or less (-1), changes the squared errors.

        By the information ``u uᵀ`` of a pole the covariance ``C`` changes by
        ``C u (1 ± uᵀ C u)⁻¹ uᵀ C`` (Woodbury).
        """
        place, root = self.roots[k]
        own = inverse[: self.unknowns.poses, place] @ root
        inner = np.eye(root.shape[1]) + sign * (root.T @ (inverse[place][:, place] @ root))
        less = np.einsum("ij,ji->i", own, np.linalg.solve(inner, own.T))
        return np.asarray(-sign * (less[POSE:].reshape(-1, POSE) @ self.weight))

    def with_each(self, inverse: Array) -> Array:
        """(C,) error of all LiDARs, metres, with each pole more; see `error_of`."""
        squares = self.squares(inverse)
        changed = [squares + self.change(inverse, k, 1.0) for k in range(len(self.roots))]
        return np.asarray(np.sqrt(np.maximum(np.mean(changed, axis=1), 1e-18)))

    def error_with_each(self, chosen: Sequence[int]) -> Array:
        """(C,) the error of `error_of` with each pole more than those that are chosen."""
        key = tuple(sorted(chosen))
        if key not in self.found:
            joint, alone = (self.with_each(self.inverse(key, alone=each)) for each in (False, True))
            self.found[key] = np.sqrt(joint * alone)
        return self.found[key]


def choose(
    design: Design, poles: int, placements: int = 1, begun: Sequence[Sequence[int]] = ()
) -> list[list[int]] | None:
    """Choose the poles of each placement.

    Parameters
    ----------
    design
        What there is to choose from.
    poles, placements
        How many.
    begun
        Fewer that were chosen before.

    Returns
    -------
    list of list of int
        For each placement the numbers of its poles; None if that many may not be in one.
    """
    chosen = [list(own) for own in begun] + [[] for _ in range(placements - len(begun))]
    for count in range(poles):
        for p in range(placements):
            if len(chosen[p]) > count:
                continue
            best = _best(design, chosen, p)
            if best is None:
                return None
            chosen[p].append(best[0])
    for _ in range(MOST_ROUNDS):
        before = [list(own) for own in chosen]
        for p in range(placements):
            for _ in range(poles):
                # The longest there goes first.
                first, *others = chosen[p]
                own = error_of(design, chosen) * walk_factor(design, chosen, p)[first]
                chosen[p] = others
                best = _best(design, chosen, p)
                better = best is not None and best[1] < GAIN * own
                chosen[p] = [*others, best[0] if better and best is not None else first]
        if chosen == before:
            break
    return carried(design, constrained_twice(design, chosen))


def carried(design: Design, chosen: list[list[int]]) -> list[list[int]]:
    """Order the poles of each placement so that each is carried to the nearest place."""
    for p in range(1, len(chosen)):
        away = cdist(design.feet[chosen[p - 1]], design.feet[chosen[p]])
        chosen[p] = [chosen[p][k] for k in linear_sum_assignment(away)[1]]
    return chosen


def walk_factor(design: Design, chosen: Sequence[Sequence[int]], p: int) -> Array:
    """(C,) what carrying a pole to each place from the nearest of other placements costs."""
    others = [k for q, own in enumerate(chosen) if q != p for k in own]
    if not others:
        return np.ones(len(design.feet))
    return np.asarray(1.0 + WALK * cdist(design.feet, design.feet[others]).min(axis=1))


def count_dependent(design: Design, chosen: Sequence[Sequence[int]]) -> int:
    """Count, over all poles, the LiDARs that are not constrained if that pole is removed."""
    every = [k for own in chosen for k in own]
    inverse = design.inverse(every, alone=True)
    left = [design.squares(inverse) + design.change(inverse, k, -1.0) for k in every]
    return int(np.count_nonzero(np.array(left) > UNCONSTRAINED**2))


def constrained_twice(design: Design, chosen: list[list[int]]) -> list[list[int]]:
    """Exchange poles where LiDARs depend on one, as far as that helps.

    A blunder of a pole that no observation checks does not show. Two poles always depend on each
    other.
    """
    now = count_dependent(design, chosen) if sum(map(len, chosen)) > 2 else 0
    most = DEARER * error_of(design, chosen)
    for p, own in enumerate(chosen):
        for n in range(len(own)):
            if now == 0:
                return chosen
            rest = [*chosen[:p], own[:n] + own[n + 1 :], *chosen[p + 1 :]]
            for k, error in islice(_ranked(design, rest, p), MOST_TRIED):
                if error > most:
                    break
                other = [*rest[:p], [*own[:n], k, *own[n + 1 :]], *rest[p + 1 :]]
                count = count_dependent(design, other)
                if count < now:
                    chosen, own, now = other, other[p], count
    return chosen


def errors_of(design: Design, chosen: Sequence[Sequence[int]]) -> tuple[Array, Array]:
    """(L - 1,) errors of all LiDARs at the reach, metres, with the surfaces and without."""
    every = [k for own in chosen for k in own]
    joint, alone = (
        np.sqrt(design.squares(design.inverse(every, alone=each))) for each in (False, True)
    )
    return joint, alone


def error_of(design: Design, chosen: Sequence[Sequence[int]]) -> float:
    """Geometric mean of the errors with the surfaces and without, metres.

    Each is the root mean square over all LiDARs: the largest would not say which pole is the first
    step where several LiDARs are constrained by none yet. What the surfaces alone constrain shows
    the same of all poles. Then the poles decide: they are what the surfaces are checked by.
    """
    joint, alone = (float(np.sqrt((each**2).mean())) for each in errors_of(design, chosen))
    return float(np.sqrt(joint * alone))


def _best(design: Design, chosen: Sequence[Sequence[int]], p: int) -> tuple[int, float] | None:
    """Find the best further pole for a placement, and the error with it; None if there is none."""
    return next(_ranked(design, chosen, p), None)


def _ranked(design: Design, chosen: Sequence[Sequence[int]], p: int) -> Iterator[tuple[int, float]]:
    """Yield the poles that may join a placement, and the error with each, best first."""
    used = [k for each in chosen for k in each]
    error = design.error_with_each(used) * walk_factor(design, chosen, p)
    for k in np.argsort(error, kind="stable").tolist():
        if k not in used and design.rules.allow(k, chosen[p]):
            yield k, float(error[k])


def rules_of(candidates: Candidates, seen: BoolArray, lidars: Sequence[Array]) -> Rules:
    """Find which poles may be in one placement.

    Parameters
    ----------
    candidates, seen
        The poles, and (C, L) which LiDAR sees which.
    lidars
        (3,) where these are.
    """
    feet = candidates.foot[:, :2]
    distance = np.linalg.norm(feet[:, None] - feet, axis=2)
    angle = np.arccos(np.clip(np.abs(candidates.axis @ candidates.axis.T), 0.0, 1.0))
    pairs = (distance >= LEAST_SPACING) & (angle >= LEAST_ANGLE)
    for i, at in enumerate(lidars):
        pairs &= (_between(candidates, at) > NOT_BEHIND) | ~(seen[:, i, None] & seen[:, i])
    lean = leans_of(candidates.axis)
    differ = np.abs(lean[:, None] - lean) >= LEAST_LEAN
    return Rules(pairs, seen, differ, angle, _gaps(candidates))


def _gaps(candidates: Candidates) -> Array:
    """(C, C) least distance between the lines of every two poles; of parallel ones none is
    given."""
    axis, centre = candidates.axis, candidates.centre
    across = np.cross(axis[:, None], axis)
    length = np.linalg.norm(across, axis=2)
    distance = np.abs(np.einsum("ijk,ijk->ij", across, centre - centre[:, None]))
    return np.asarray(distance / np.maximum(length, 1e-9))


def _between(candidates: Candidates, at: Array) -> Array:
    """(C, C) least angle between every two poles as seen from a point (3,), rad."""
    steps = candidates.length * np.linspace(-0.5, 0.5, 9)
    along = candidates.centre[:, None] + steps[:, None] * candidates.axis[:, None] - at
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    cosine = np.full((len(candidates),) * 2, -1.0)
    for first in range(len(steps)):
        for second in range(len(steps)):
            np.maximum(cosine, along[:, first] @ along[:, second].T, out=cosine)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))
