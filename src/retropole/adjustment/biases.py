"""A bias of its own that one observation gets, or several in common, beside all unknowns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ..alignment.network import Observation
from ..alignment.unknowns import POSE
from ..base.datatypes import Array, IntArray
from .solved import Solved


@dataclass(frozen=True, eq=False)
class Bias:
    """A bias of its own that some observations get.

    Attributes
    ----------
    cross
        (Z, M) how its information goes with that of the unknowns.
    own
        (M, M) its information.
    slope
        (M,) of the log-likelihood by it.
    wide
        (M, R) what errors that are considered do to that slope.
    metres
        (M', ) which of its parameters are lengths: what is told of it is told for these.
    freedom
        How many of its parameters no unknown can take up.
    """

    cross: Array
    own: Array
    slope: Array
    wide: Array
    metres: IntArray
    freedom: int


def of_columns(
    at: Solved, parts: Sequence[tuple[Observation, IntArray]]
) -> tuple[Array, Array, Array, Array]:
    """Errors in place of some unknowns (positions in each observation's place)."""
    size = at.network.unknowns.size
    cross, own, slopes, wide = [], [], [], []
    for one, columns in parts:
        block = np.zeros((size, len(columns)))
        block[one.place] = one.information[:, columns]
        cross.append(block)
        own.append(one.information[np.ix_(columns, columns)])
        slopes.append(at.slope(one)[columns])
        wide.append(block.T @ at.wide)
    total = sum(len(each) for each in own)
    joint = np.zeros((total, total))
    first = 0
    for each in own:
        joint[first : first + len(each), first : first + len(each)] = each
        first += len(each)
    return np.concatenate(cross, axis=1), joint, np.concatenate(slopes), np.concatenate(wide)


def pole_moved(at: Solved, pole: int) -> Bias | None:
    """A pole that stands elsewhere for each LiDAR; None where fewer than two see it."""
    parts = [
        (one, _axis_columns(one, pole))
        for one in at.network.observations
        if one.poles is not None and pole in one.poles
    ]
    if len(parts) < 2:
        return None
    metres = np.concatenate([4 * k + np.arange(2) for k in range(len(parts))])
    return Bias(*of_columns(at, parts), metres, 4 * (len(parts) - 1))


def pole_seen_elsewhere(at: Solved, some: Sequence[Observation], pole: int) -> Bias:
    """A pole that stands elsewhere, at one place, for some LiDARs than for all others."""
    each = [of_columns(at, [(one, _axis_columns(one, pole))]) for one in some]
    cross, own, slope, wide = (np.sum(parts, axis=0) for parts in zip(*each, strict=True))
    return Bias(cross, own, slope, wide, np.arange(2), 4)


def splits(count: int) -> Iterator[tuple[int, ...]]:
    """Give all ways to part so many LiDARs in two, each of two or more: the fewer of both."""
    for size in range(2, count // 2 + 1):
        for part in combinations(range(count), size):
            if 2 * size < count or 0 in part:
                yield part


def placement_moved(at: Solved, one: Observation) -> Bias:
    """A LiDAR that stood elsewhere in one placement."""
    return Bias(*of_columns(at, [(one, np.arange(POSE))]), np.arange(3, 6), POSE)


def lidar_apart(at: Solved, lidar: int) -> Bias | None:
    """A LiDAR for which all poles stand elsewhere, but for its pose."""
    parts = [
        (one, np.concatenate([_axis_columns(one, int(pole)) for pole in one.poles]))
        for one in at.network.observations
        if one.poles is not None and one.lidar == lidar
    ]
    count = sum(len(columns) for _, columns in parts)
    if count <= POSE:
        return None
    metres = np.flatnonzero(np.arange(count) % 4 < 2)
    return Bias(*of_columns(at, parts), metres, count - POSE)


def value_wrong(at: Solved, one: Observation) -> Bias:
    """A single measurement with a bias of its own, metres or rad."""
    assert one.by_value is not None
    J, residual, _ = one.by_value
    size = at.network.unknowns.size
    cross = np.zeros((size, len(residual)))
    cross[one.place] = -J.T
    away = (at.values - at.network.start)[one.place]
    count = len(residual)
    own = np.eye(count)
    return Bias(cross, own, residual + J @ away, cross.T @ at.wide, np.arange(count), count)


def _axis_columns(one: Observation, pole: int) -> IntArray:
    """Where a pole's four parameters stand in an observation."""
    assert one.poles is not None
    first = len(one.place) - 4 * len(one.poles)
    return np.asarray(first + 4 * int(np.flatnonzero(one.poles == pole)[0]) + np.arange(4))
