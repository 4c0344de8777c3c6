"""Where else a scene would fit: what stands in both clouds, correlated over shifts.

Poles that were carried along a corridor or a street leave walls on walls: hardly anything is
contradicted. What stands between the walls then lies beside itself, and fits better where it was.
All shifts are compared at once, as the cross-correlation of the occupied cells, layer by layer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..base import se3
from ..base.datatypes import Array, IntArray
from .disambiguation import SCORING_VOXEL

SHIFT_CELL, LAYER = SCORING_VOXEL, 0.75
"""Side and height of a cell, metres; where heights are compared, the height and the side."""

LARGEST_SHIFT = 6.0
"""Shifts that are tried, metres."""

SAME_SHIFT = 0.5
"""Shifts up to this are the same pose, metres."""

PEAKS = 4
"""So many shifts are found, farther from each other than `SAME_SHIFT`: where most cells coincide
need not be where most of the scene agrees."""

HALF_SIDE = 30.0
"""Cells so far about the middle of the source's points are compared, metres."""


@dataclass(frozen=True, eq=False)
class Shift:
    """The best shift away from a pose.

    Attributes
    ----------
    step
        (3,) of the source in the target's frame, metres.
    gain
        How many more cells coincide there than at the pose, or points with cells, as a ratio.
    """

    step: Array
    gain: float


def best_shifts(target: Array, source: Array, up: Array, T: Array) -> list[Shift]:
    """Find the shifts along the ground at which most cells coincide.

    Parameters
    ----------
    target, source
        (N, 3) and (M, 3) points off the ground, each in its own frame, metres.
    up
        (3,) normal of the ground, target's frame.
    T
        (4, 4) target from source.

    Returns
    -------
    list of Shift
        At most `PEAKS`, the best first; none where the clouds have nothing to compare.
    """
    if not len(target) or not len(source):
        return []
    axes, cells, shape = _cells(target, source, up, T, np.array([SHIFT_CELL, SHIFT_CELL, LAYER]))
    fast = [fft.next_fast_len(int(n), real=True) for n in shape[:2]]
    spectrum = np.zeros((fast[0], fast[1] // 2 + 1), dtype=np.complex64)
    for layer in range(int(shape[2])):
        grids = [_occupied(one, layer, fast) for one in cells]
        if all(grid.any() for grid in grids):
            # A cell's neighbours count half: surfaces are sampled at other points.
            grids[0] += _with_neighbours(grids[0].copy())
            spectrum += fft.rfft2(grids[0] / 2) * np.conj(fft.rfft2(grids[1]))
    total = fft.irfft2(spectrum, s=fast)
    # The shifts about the pose as it is, from one end to the other.
    reach = int(LARGEST_SHIFT / SHIFT_CELL)
    total = np.roll(total, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    return _peaks(total, axes[:2])


def best_lifts(target: Array, source: Array, up: Array, T: Array) -> list[Shift]:
    """Find the shifts along the ground's normal at which most points lie in cells of the target.

    Poles that were swapped may lift a pose by metres: walls agree with it all the same, and the
    ground is left out of the points. Arguments and result are those of `best_shifts`.
    """
    if not len(target) or not len(source):
        return []
    axes, (a, b), shape = _cells(target, source, up, T, np.array([LAYER, LAYER, SHIFT_CELL]))
    reach = int(LARGEST_SHIFT / SHIFT_CELL)
    # Room above and below for what is lifted.
    occupied = np.zeros((*shape[:2], shape[2] + 2 * reach), dtype=bool)
    occupied[a[:, 0], a[:, 1], a[:, 2] + reach] = True
    lifts = np.arange(2 * reach + 1)
    met = occupied[b[:, None, 0], b[:, None, 1], b[:, None, 2] + lifts]
    return _peaks(np.count_nonzero(met, axis=0).astype(np.float32), axes[2:])


def _cells(
    target: Array, source: Array, up: Array, T: Array, size: Array
) -> tuple[Array, list[IntArray], IntArray]:
    """Cells of a size (3,) that both clouds lie in under a pose, about the middle of the source.

    Gives the axes of the cells as rows, the last along the ground's normal, the cell (N, 3) and
    (M, 3) of every point that is not too far away, and how many there are along each axis.
    """
    level = np.linalg.svd(up[None, :])[2]
    axes = np.concatenate([level[1:], up[None, :]])
    a, b = target @ axes.T, se3.apply(T, source) @ axes.T
    middle = np.median(b, axis=0)
    low = np.maximum(np.minimum(a.min(axis=0), b.min(axis=0)), middle - HALF_SIDE) - LARGEST_SHIFT
    high = np.minimum(np.maximum(a.max(axis=0), b.max(axis=0)), middle + HALF_SIDE) + LARGEST_SHIFT
    shape = np.ceil((high - low) / size).astype(np.int64)
    cells = [np.floor((one - low) / size).astype(np.int64) for one in (a, b)]
    cells = [one[np.all((one >= 0) & (one < shape), axis=1)] for one in cells]
    return axes, cells, shape


def _peaks(total: NDArray[np.float32], axes: Array) -> list[Shift]:
    """The best shifts along some axes (rows), of the cells that coincide at each."""
    place = (
        np.moveaxis(np.indices(total.shape), 0, -1) - int(LARGEST_SHIFT / SHIFT_CELL)
    ) * SHIFT_CELL
    apart = np.abs(place).max(axis=-1)
    here = max(float(total[apart <= SHIFT_CELL].max()), 1.0)
    left = np.where(apart > SAME_SHIFT, total, -1.0)
    found = []
    for _ in range(PEAKS):
        best = np.unravel_index(int(np.argmax(left)), left.shape)
        if left[best] <= 0:
            break
        at = place[best] + SHIFT_CELL * _beside_peak(total, best)
        found.append(Shift(at @ axes, float(left[best]) / here))
        left[np.abs(place - place[best]).max(axis=-1) <= SAME_SHIFT] = -1.0
    return found


def _beside_peak(values: NDArray[np.float32], best: tuple[np.intp, ...]) -> Array:
    """Where between the cells a peak lies, in cells: the top of a parabola along each axis."""
    found = np.zeros(values.ndim)
    for k in range(values.ndim):
        if not 0 < best[k] < values.shape[k] - 1:
            continue
        before, at, after = (
            float(values[tuple(i + step * (j == k) for j, i in enumerate(best))])
            for step in (-1, 0, 1)
        )
        bend = before - 2 * at + after
        found[k] = 0.0 if bend >= 0 else np.clip((before - after) / (2 * bend), -0.5, 0.5)
    return found


def _occupied(cells: IntArray, layer: int, fast: list[int]) -> NDArray[np.float32]:
    """Grid of one layer, 1 where a point lies; single precision counts thousands exactly."""
    within = cells[cells[:, 2] == layer]
    grid = np.zeros(fast, dtype=np.float32)
    grid[within[:, 0], within[:, 1]] = 1.0
    return grid


def _with_neighbours(grid: NDArray[np.float32]) -> NDArray[np.float32]:
    """The largest of each cell and the eight about it.

    `scipy.ndimage` has the same, and takes longer to import than a calibration in all its calls.
    """
    for one in (grid, grid.T):
        before = one.copy()
        np.maximum(one[1:], before[:-1], out=one[1:])
        np.maximum(one[:-1], before[1:], out=one[:-1])
    return grid
