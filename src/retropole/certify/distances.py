"""Distances between poles that need no transform, and how certain they are.

A line has no points of its own, and its taped part ends for each LiDAR elsewhere. So each pole gets
a point that only the poles themselves define: the place on its axis from which the squared
distances to all other axes are least. It may lie metres above the ground; from there both LiDARs go
the same way along the axis, to the middle of what they see of it. What is compared is the distance
of two such points. Where on the axis they lie is only as certain as the poles lean against each
other, but it hardly changes a distance across them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..adjustment.axes import OwnAxes
from ..alignment.posterior import SHARED, State
from ..base.datatypes import Array, IntArray, Pole

STEP = 1e-6
"""Of an axis, metres and rad, over which derivatives are taken as differences."""


@dataclass(frozen=True, eq=False)
class Targets:
    """The poles of one placement as one LiDAR has them: K axes among those of all its placements.

    Attributes
    ----------
    index
        (K,) which of the LiDAR's axes they are.
    signs
        (K,) 1 or -1: the sense of each axis that both LiDARs agree on.
    offsets
        (K,) how far from its place on the axis each point lies, metres: the same for both LiDARs.
    """

    index: IntArray
    signs: Array
    offsets: Array


@dataclass(frozen=True, eq=False)
class Measured:
    """The distances of one LiDAR.

    Attributes
    ----------
    lengths
        (D,) metres.
    random
        (D, D) covariance from the scatter of its returns.
    systematic
        (D, B) how far 1 σ of each of its errors changes them, metres.
    radius
        (D,) how far 1 σ of the poles' radius does.
    """

    lengths: Array
    random: Array
    systematic: Array
    radius: Array

    @property
    def standard_uncertainty(self) -> Array:
        """(D,) standard uncertainty of each distance, metres."""
        square = np.diag(self.random) + (self.systematic**2).sum(axis=1) + self.radius**2
        return np.asarray(np.sqrt(square))


def places(points: Array, directions: Array) -> Array:
    """Find on each axis the place from which the squared distances to all others are least.

    Parameters
    ----------
    points, directions
        (K, 3) each: a point on each axis, and its unit direction; not all parallel.

    Returns
    -------
    Array
        (K, 3), metres.
    """
    between = points[None] - points[:, None]
    cosine = directions @ directions.T
    along_own = np.einsum("ijk,ik->ij", between, directions)
    along_other = np.einsum("ijk,jk->ij", between, directions)
    pull = (along_own - cosine * along_other).sum(axis=1)
    return np.asarray(points + (pull / (1.0 - cosine**2).sum(axis=1))[:, None] * directions)


def distances(points: Array, directions: Array, offsets: Array) -> Array:
    """Give the distances between all pairs of K poles: 1 and 2, 1 and 3, …, 2 and 3, …

    Parameters
    ----------
    points, directions
        (K, 3) each: a point on each axis, and its unit direction; not all parallel.
    offsets
        (K,) from its place on the axis to the point that is measured from, metres.
    """
    at = places(points, directions) + offsets[:, None] * directions
    i, j = np.triu_indices(len(at), 1)
    return np.asarray(np.linalg.norm(at[i] - at[j], axis=1))


def middles(state: State, poles: Sequence[Pole], index: IntArray, signs: Array) -> Array:
    """Say how far from its place on each axis (K,) the middle of what a LiDAR saw of it lies."""
    directions = signs[:, None] * state.directions[index]
    seen = np.array([pole.point for pole in poles]) - places(state.points[index], directions)
    return np.asarray(np.einsum("ki,ki->k", seen, directions))


def measure(axes: OwnAxes, placements: Sequence[Targets]) -> Measured:
    """Measure all distances between poles of the same placement."""
    lengths, by_axes = distances_of(axes.state, placements)
    return Measured(
        lengths,
        by_axes @ axes.random @ by_axes.T,
        by_axes @ axes.systematic,
        by_axes @ axes.radius,
    )


def distances_of(state: State, placements: Sequence[Targets]) -> tuple[Array, Array]:
    """Give the distances (D,), and their derivatives (D, 4 K) by the steps of all K axes."""

    def at(step: Array) -> Array:
        moved = state.moved(np.r_[np.zeros(SHARED), step])
        return np.concatenate(
            [
                distances(
                    moved.points[each.index],
                    each.signs[:, None] * moved.directions[each.index],
                    each.offsets,
                )
                for each in placements
            ]
        )

    steps = STEP * np.eye(4 * len(state.points))
    by_axes = np.stack([(at(step) - at(-step)) / (2 * STEP) for step in steps], axis=1)
    return at(np.zeros(len(steps))), by_axes
