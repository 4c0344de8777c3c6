"""Distances between poles that need no transform: how certain they are, and how well they repeat.

A line has no distinct points, and its taped part ends differently for each LiDAR. So each pole gets
a point that only the poles themselves define: the point on its axis from which the squared
distances to all other axes are least. It may lie metres above the ground; from there both LiDARs go
the same way along the axis, to the middle of the part they see. What is compared is the distance
of two such points. Where on the axis they lie is only as certain as the poles lean against each
other, but it hardly changes a distance across them.

Each sweep of a recording measures all distances again. Their scatter is compared with what the
returns of a sweep allow, since a LiDAR that is nearer, or has more beams, repeats a distance
better without being better than stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtr, fdtri

from ..adjustment.axes import LidarAxes, maximise_alone
from ..alignment.expansion import find_view
from ..alignment.observations import beams_of
from ..alignment.posterior import SHARED, State
from ..base.bounded import Count, Share, Size
from ..base.datatypes import Array, IntArray, Pole, Scan

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
    """Find on each axis the point from which the squared distances to all others are least.

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
    """Distance on each axis (K,) of its point from the middle of the part that a LiDAR saw."""
    directions = signs[:, None] * state.directions[index]
    seen = np.array([pole.point for pole in poles]) - places(state.points[index], directions)
    return np.asarray(np.einsum("ki,ki->k", seen, directions))


def measure(axes: LidarAxes, placements: Sequence[Targets]) -> Measured:
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


MIN_SWEEPS, MAX_SWEEPS = 3, 12
"""Sweeps from which variances are compared, and how many are looked at, evenly."""

MIN_RETURNS = 8
"""A sweep with fewer returns on one of the poles is left out: its axis is uncertain by
centimetres."""


class Spread(msgspec.Struct, frozen=True, rename={"sigma": "sigma_m"}):
    """How far the distances of one LiDAR scatter from sweep to sweep.

    Attributes
    ----------
    sweeps
        How many were compared, of all placements.
    sigma
        1 σ of a distance in one sweep, root mean square over all distances, metres.
    variance, freedom
        Its square in units of what the returns of a sweep allow, and its degrees of freedom.
    """

    sweeps: Count
    sigma: Size
    variance: Size
    freedom: Size


class SpreadTest(msgspec.Struct, frozen=True):
    """Whether both LiDARs repeat distances equally well (F-test, two-sided).

    Attributes
    ----------
    target, source
        What each does.
    ratio, low, high
        F, the target's variance over the source's, and between which bounds it passes.
    probability, passed
        Of a ratio as far from 1, or farther, where the variances are equal; and whether they may
        be.
    """

    target: Spread
    source: Spread
    ratio: Size
    low: Size
    high: Size
    probability: Share
    passed: bool


def compare_spread(target: Spread | None, source: Spread | None, alpha: float) -> SpreadTest | None:
    """Test whether two LiDARs repeat equally well; None if one repeats nothing."""
    if target is None or source is None:
        return None
    low, high = (
        float(fdtri(target.freedom, source.freedom, p)) for p in (alpha / 2, 1 - alpha / 2)
    )
    ratio = target.variance / source.variance
    tail = float(fdtr(target.freedom, source.freedom, ratio))
    probability = 2.0 * min(tail, 1.0 - tail)
    return SpreadTest(target, source, ratio, low, high, probability, low <= ratio <= high)


def spread_of_sweeps(
    seen: Sequence[tuple[Scan, Sequence[Pole]]], axes: LidarAxes, placements: Sequence[Targets]
) -> Spread | None:
    """Measure the distances of every placement in each sweep alone; None if none has several.

    Parameters
    ----------
    seen
        For each placement, the LiDAR's scan and its poles, in the order of the axes.
    axes
        What all sweeps together have.
    placements
        Which axes belong together.
    """
    sweeps, square, variance, count, spread = 0, 0.0, 0.0, 0, 0.0
    for (scan, poles), targets in zip(seen, placements, strict=True):
        found = _of_placement(scan, poles, axes, targets)
        if len(found) < MIN_SWEEPS:
            continue
        lengths = np.array([each for each, _ in found])
        allowed = np.mean([each for _, each in found], axis=0)
        scatter = lengths.var(axis=0, ddof=1)
        sigma = np.sqrt(np.diag(allowed))
        # Distances that share a pole are correlated: fewer degrees of freedom than distances.
        correlation = allowed / np.outer(sigma, sigma)
        sweeps += len(found)
        count += len(sigma)
        square += float(scatter.sum())
        variance += float((scatter / sigma**2).sum())
        spread += 2.0 * float((correlation**2).sum()) / (len(found) - 1)
    if not count:
        return None
    # Two moments of a sum of correlated χ² (Satterthwaite 1946).
    return Spread(sweeps, float(np.sqrt(square / count)), variance / count, 2.0 * count**2 / spread)


def _of_placement(
    scan: Scan, poles: Sequence[Pole], axes: LidarAxes, targets: Targets
) -> list[tuple[Array, Array]]:
    """Distances (D,) of each sweep of a placement, and the covariance (D, D) its returns allow."""
    frames = scan.cloud.frame
    if frames is None:
        return []
    numbers = np.unique(frames)
    if len(numbers) > MAX_SWEEPS:
        numbers = numbers[np.linspace(0, len(numbers) - 1, MAX_SWEEPS).astype(np.int64)]
    own = Targets(np.arange(len(poles)), targets.signs, targets.offsets)
    start = replace(
        axes.state,
        points=axes.state.points[targets.index],
        directions=axes.state.directions[targets.index],
    )
    found = []
    for number in numbers:
        part = [_within(pole, frames[pole.index] == number) for pole in poles]
        if min(len(pole.xyz) for pole in part) < MIN_RETURNS:
            continue
        cloud = scan.cloud.select(frames == number)
        beams = beams_of([(pole, cloud) for pole in part], scan.sensor)
        state, noise = maximise_alone(start, beams, np.log(axes.noise))
        view = find_view(state, 1, beams, noise)
        state = state.moved(np.r_[np.zeros(SHARED), view.shift.reshape(-1)])
        lengths, by_axes = distances_of(state, [own])
        found.append((lengths, by_axes @ block_diag(*view.covariance) @ by_axes.T))
    return found


def _within(pole: Pole, of_sweep: Array) -> Pole:
    return replace(pole, xyz=pole.xyz[of_sweep], index=pole.index[of_sweep])
