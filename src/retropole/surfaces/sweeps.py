"""How the LiDAR moved, from the sweeps of one recording, on surfaces that all of them saw.

The returns are put into cells of space. In a flat one, a sweep that was turned by ω and shifted by
τ leaves residuals ``−n·(ω × p + τ)`` from the plane of the cell, whose height and two slopes are
unknown. They are eliminated: what the cell looks like in the mean is not taken from sweeps that
moved. A cell that beams of one elevation alone hit then gives no information: on a slanted
surface such returns move along their beam, and any plane through it fits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..base.datatypes import Array, IntArray, PointCloud
from ..base.se3 import lengths

DIGIT = np.iinfo(np.uint16).bits
"""Bits by which numbers are sorted at once: NumPy sorts so short ones in linear time."""


def order_of(keys: np.ndarray[tuple[int], np.dtype[np.int64 | np.uint64]]) -> IntArray:
    """Give the order (N,) that sorts keys (N,), none negative; equal ones stay in their order.

    Digit by digit from the last (Knuth 1998, TAOCP 3, 5.2.5): for the cubes of 100,000 points, in
    a quarter of the time of np.argsort.
    """
    if (keys[1:] >= keys[:-1]).all():
        # As the sweeps of most recordings are.
        return np.arange(len(keys))
    order = np.argsort(keys.astype(np.uint16), kind="stable")
    for shift in range(DIGIT, int(keys.max()).bit_length(), DIGIT):
        digit = (keys >> keys.dtype.type(shift)).astype(np.uint16)
        order = order[np.argsort(digit[order], kind="stable")]
    return order


def numbered(values: IntArray) -> tuple[IntArray, IntArray]:
    """Give the different values (M,) in their order, and for each of (N,) which it is.

    As np.unique does, in a tenth of the time where they lie close to each other, as sweeps do.
    """
    least = int(values.min(initial=0))
    if int(values.max(initial=0)) - least > len(values):
        found, own = np.unique(values, return_inverse=True)
        return found, own.reshape(-1)
    apart = values - least
    is_there = np.bincount(apart) > 0
    return np.flatnonzero(is_there) + least, (np.cumsum(is_there) - 1)[apart]


CELL_SIDES = (2.0, 1.0, 6.0)
"""Of the cells, metres, in turn: small ones take what lies next to a corner, large ones ground
where rings are too sparse for a smaller one to have two."""

CORNERS = 2 ** np.array([0, 21, 42])
"""One number for each cell, where none is 2²⁰ from the origin."""

CUTS = 20
"""Parts of a side, in one of which cells begin."""

RETURNS = 90_000
"""Returns that are used, evenly of all sweeps: with this many a sweep's turn is known to 0.002°."""

LEAST_RETURNS = 30
"""Of a cell."""

THICKEST, LEAST_WIDTH, FLATNESS = 0.05, 0.2, 0.02
"""A cell is flat where the RMS of its returns across the plane is less, metres, that along the
plane's lesser extent more, and the ratio of both variances less."""

USUAL = 3.0
"""A cell is no more than this many times as thick as most: a plane through a bush is not used.
On a square one such cell gave the turn about the vertical alone, 0.07° off."""

LEAST_TURN, ROUND = float(np.radians(0.2)), 0.02
"""RMS of the beams' directions across the longer extent of what they cover, rad, and the least
ratio of both variances: below, a single ring hits the cell."""

FAR = 4.0
"""Residuals of this many σ of their cell have no weight (Tukey's biweight)."""

FINEST = 0.003
"""Least σ of the residuals of a cell, metres."""

PARTS = 8
"""Parts of a sweep that the motion is resolved in, where returns have times."""

PERIOD = 0.1
"""Of a sweep, s, where it is unknown."""

LONGEST = 0.5
"""Times of returns that spread further over one sweep are not times of a sweep, s."""


@dataclass(frozen=True, eq=False)
class Timed:
    """The returns that are used, and when they came.

    Attributes
    ----------
    index
        (N,) which of the cloud's.
    part
        (N,) the part of the recording that each came in.
    times
        (B,) middle of each part, s from the start.
    of_all
        For all points of the cloud the part of each.
    """

    index: IntArray
    part: IntArray
    times: Array
    of_all: IntArray


@dataclass(frozen=True, eq=False)
class Observed:
    """Least-squares equations of the motion of B parts and the planes of C cells.

    Attributes
    ----------
    motion
        (B, 6, 6) information of the turn and shift of each part.
    both
        (3 C, 6 B) of planes and motions together.
    plane
        (C, 3, 3) inverse of that of each cell's height and slopes.
    pull, pull_of_plane
        (B, 6) and (C, 3) gradients at no motion.
    """

    motion: Array
    both: sparse.csr_matrix
    plane: Array
    pull: Array
    pull_of_plane: Array

    def about(self, features: Array) -> tuple[Array, Array]:
        """Information and gradient of the coefficients of some motions.

        Parameters
        ----------
        features
            (B, F) how each moves over the parts; each has six coefficients.

        Returns
        -------
        (6 F, 6 F), (6 F,)
            With the planes eliminated.
        """
        parts, count = features.shape
        size = 6 * count
        H = features.T @ (features[:, :, None] * self.motion.reshape(parts, 1, 36)).reshape(
            parts, -1
        )
        H = H.reshape(count, count, 6, 6).transpose(0, 2, 1, 3).reshape(size, size)
        spread = np.zeros((parts, 6, count, 6))
        for k in range(6):
            spread[:, k, :, k] = features
        shared = np.asarray(self.both @ spread.reshape(-1, size))
        gone = (self.plane @ shared.reshape(-1, 3, size)).reshape(-1, size)
        pull = (features.T @ self.pull).reshape(-1)
        return H - shared.T @ gone, pull - self.pull_of_plane.reshape(-1) @ gone


def timed(cloud: PointCloud) -> Timed:
    """Choose returns evenly of all sweeps, and give their times.

    Parameters
    ----------
    cloud
        With `frame`.
    """
    assert cloud.frame is not None
    frames, own = numbered(cloud.frame)
    by_sweep = np.split(order_of(own), np.cumsum(np.bincount(own))[:-1])
    period = _period(cloud, frames, by_sweep)
    start = (frames - frames[0]) * period
    within = _within(cloud, own, by_sweep)
    if within is None:
        middles = start + period / 2
        of_all = own
    else:
        later = np.minimum((within / period * PARTS).astype(np.int64), PARTS - 1)
        middles = (start[:, None] + (np.arange(PARTS) + 0.5) * period / PARTS).reshape(-1)
        of_all = own * PARTS + later
    most = RETURNS // len(frames)
    index = np.concatenate([each[:: max(1, -(-len(each) // most))] for each in by_sweep])
    return Timed(index, of_all[index], middles, of_all)


def _within(cloud: PointCloud, own: IntArray, by_sweep: Sequence[IntArray]) -> Array | None:
    """(N,) time of each return since the start of its sweep, s; None if not known.

    The returns of each sweep are given, and the sweep of each return.
    """
    if cloud.time is None or not np.isfinite(cloud.time).all():
        return None
    times = [cloud.time[each] for each in by_sweep]
    first, last = (np.array([ask(each) for each in times]) for ask in (np.min, np.max))
    spread = float(np.median(last - first))
    return cloud.time - first[own] if 0 < spread < LONGEST else None


def _period(cloud: PointCloud, frames: IntArray, by_sweep: Sequence[IntArray]) -> float:
    """Time from one sweep to the next, s: by the returns' times, the recorder's, or the usual."""
    numbers = float(frames[-1] - frames[0])
    if cloud.time is not None and np.isfinite(cloud.time).all():
        ends = [float(np.median(cloud.time[by_sweep[k]])) for k in (0, -1)]
        # Some drivers give the times of each sweep from its start.
        if ends[1] - ends[0] > PERIOD / 4 * numbers:
            return (ends[1] - ends[0]) / numbers
    if cloud.recorded is not None and cloud.recorded[1] > cloud.recorded[0]:
        return (cloud.recorded[1] - cloud.recorded[0]) / numbers
    return PERIOD


def observe(xyz: Array, origin: Array, when: Timed, motion: Array) -> Observed:
    """State what returns show of the motion, about the motion as it is known.

    Parameters
    ----------
    xyz
        (N, 3) the returns of `when`, as they were recorded.
    origin
        (3,) where the beams start.
    when
        Which part each came in.
    motion
        (B, 6) turn and shift of each part as they are known: cells are made of returns without it.
    """
    still = without(xyz, origin, motion, when.part)
    parts = list(_cells(still, origin))
    rows = np.concatenate([index for index, _, _, _ in parts])
    first = np.cumsum([0] + [len(middle) for _, _, middle, _ in parts])
    cell = np.concatenate([own + at for (_, own, _, _), at in zip(parts, first, strict=False)])
    middle = np.concatenate([each for _, _, each, _ in parts])
    axes = np.concatenate([each for _, _, _, each in parts])[cell]
    part, count, cells = when.part[rows], len(when.times), len(middle)
    from_middle = still[rows] - middle[cell]
    normal = axes[:, :, 0]
    plane = np.einsum("ni,nij->nj", from_middle, axes)
    residual = plane[:, 0].copy()
    plane[:, 0] = 1.0
    by_motion = -np.concatenate([np.cross(still[rows] - origin, normal), normal], axis=1)
    weights = _weights(residual, plane, cell, cells)
    square = _sums(cell, cells, plane, plane, weights) + _ridge(weights)
    # About no motion, whatever is known.
    pull = weights * (residual + np.einsum("ni,ni->n", by_motion, motion[part]))
    key, place = np.unique(cell * count + part, return_inverse=True)
    blocks = _sums(place.reshape(-1), len(key), plane, by_motion, weights)
    at_row = (3 * (key // count))[:, None, None] + np.arange(3)[:, None] + np.zeros((1, 6), int)
    at_column = (6 * (key % count))[:, None, None] + np.arange(6) + np.zeros((3, 1), int)
    both = sparse.csr_matrix(
        (blocks.reshape(-1), (at_row.reshape(-1), at_column.reshape(-1))),
        shape=(3 * cells, 6 * count),
    )
    return Observed(
        _sums(part, count, by_motion, by_motion, weights),
        both,
        np.asarray(np.linalg.inv(square)),
        _sums(part, count, by_motion, pull[:, None], np.ones(len(pull)))[:, :, 0],
        _sums(cell, cells, plane, pull[:, None], np.ones(len(pull)))[:, :, 0],
    )


def without(xyz: Array, origin: Array, motion: Array, part: IntArray) -> Array:
    """Take small motions (B, 6), turn and shift of the LiDAR in each part of a recording, out of
    its returns (N, 3), which came in some part (N,)."""
    # Column by column: the motion of each return would take twice the memory of the returns.
    turn, x = motion[:, :3].T, [column - start for column, start in zip(xyz.T, origin, strict=True)]
    still = np.empty_like(xyz)
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        turned = xyz[:, k] + (turn[i].take(part) * x[j] - turn[j].take(part) * x[i])
        still[:, k] = turned + motion[:, 3 + k].take(part)
    return still


def _cells(xyz: Array, origin: Array) -> Iterator[tuple[IntArray, IntArray, Array, Array]]:
    """Yield flat cells of each size: returns, the cell of each, (C, 3) middles, (C, 3, 3) axes.

    The first axis of each is its normal.
    """
    left = np.arange(len(xyz))
    rays = xyz - origin
    rays /= lengths(rays)[:, None]
    for side in CELL_SIDES:
        if len(left) < LEAST_RETURNS:
            return
        corner = np.floor((xyz[left] - _free(xyz[left], side)) / side).astype(np.int64)
        _, own = np.unique(corner @ CORNERS, return_inverse=True)
        returns = np.bincount(own)
        middle, size, axes = _spread(xyz[left], own, returns)
        _, beams, _ = _spread(rays[left], own, returns)
        flat = (returns >= LEAST_RETURNS) & (size[:, 0] < THICKEST**2)
        flat &= (size[:, 1] > LEAST_WIDTH**2) & (size[:, 0] < FLATNESS * size[:, 1])
        flat &= (beams[:, 1] > LEAST_TURN**2) & (beams[:, 1] > ROUND * beams[:, 2])
        thickness = np.sqrt(np.maximum(size[:, 0], 0.0))
        flat &= thickness <= USUAL * np.median(thickness[flat]) if flat.any() else False
        kept = flat[own]
        yield left[kept], np.cumsum(flat)[own[kept]] - 1, middle[flat], axes[flat]
        left = left[~kept]


def _free(xyz: Array, side: float) -> Array:
    """(3,) where cells of a side may begin along each axis: where the fewest returns are.

    Ground that lies between two cells would be cut by its noise, and by the motion.
    """
    step = side / CUTS
    place = np.floor(np.mod(xyz, side) / step).astype(np.int64) % CUTS
    fewest = [int(np.argmin(np.bincount(own, minlength=CUTS))) for own in place.T]
    return np.asarray((np.array(fewest) + 0.5) * step)


def _spread(xyz: Array, own: IntArray, returns: IntArray) -> tuple[Array, Array, Array]:
    """Mean (C, 3) of the points of each cell, variances (C, 3), the least first, and their axes."""
    ones = np.ones(len(xyz))
    mean = _sums(own, len(returns), xyz, ones[:, None], ones)[:, :, 0] / returns[:, None]
    apart = xyz - mean[own]
    spread = _sums(own, len(returns), apart, apart, ones) / returns[:, None, None]
    size, axes = np.linalg.eigh(spread)
    return mean, size, axes


def _weights(residual: Array, plane: Array, cell: IntArray, cells: int) -> Array:
    """(N,) weights of residuals by the scatter of their cell, none for what lies far off."""
    returns = np.bincount(cell, minlength=cells)
    weights = np.ones(len(residual))
    for _ in range(3):
        square = _sums(cell, cells, plane, plane, weights) + _ridge(weights)
        pull = _sums(cell, cells, plane, (weights * residual)[:, None], np.ones(len(residual)))
        left = residual - np.einsum("ni,ni->n", plane, np.linalg.solve(square, pull)[cell, :, 0])
        counted = weights > 0
        scatter = np.bincount(cell, left**2 * counted, cells) / np.maximum(returns - 3, 1)
        sigma = np.sqrt(np.maximum(scatter, FINEST**2))[cell]
        weights = np.maximum(1 - (left / (FAR * sigma)) ** 2, 0.0) ** 2 / sigma**2
    return weights


def _ridge(weights: Array) -> Array:
    """(3, 3) that keeps a cell solvable whose returns do not span it."""
    return 1e-6 * float(weights.sum() + 1.0) / (len(weights) + 1) * np.eye(3)


def _sums(own: IntArray, count: int, left: Array, right: Array, weights: Array) -> Array:
    """(count, I, J) sums of weighted products of columns (N, I) and (N, J), group by group."""
    found = np.empty((count, left.shape[1], right.shape[1]))
    for i in range(left.shape[1]):
        for j in range(right.shape[1]):
            found[:, i, j] = np.bincount(own, weights * left[:, i] * right[:, j], count)
    return found
