"""Rényi's quadratic entropy of a point cloud: how sharp aligned clouds are, without a truth.

B. Sheehan, A. Harrison and P. Newman, *Self-calibration for a 3D laser*, IJRR 2012; Xue et al. 2019
score their Table IV by it.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from ..base.datatypes import Array, BoolArray, IntArray
from ..base.errors import Refusal
from ..surfaces.registration import CORES

KERNEL_WIDTH = 0.05
"""σ of the kernel of Rényi's entropy, metres. Xue et al. 2019 state none; chosen: a few times the
range noise of a LiDAR."""

RQE_TOLERANCE = 1e-7
"""Largest relative error of the entropy's sum: below the digits that are printed."""

LEAF_SIZE = 256
"""Points of a leaf of the tree over which the double sum is taken, block by block: with fewer the
calls take the time, with more the pairs that add nothing. It decides the time alone."""


@dataclass(frozen=True)
class Entropy:
    """Rényi's quadratic entropy of a cloud.

    Attributes
    ----------
    sum
        Argument of the logarithm, 1/m³; larger is sharper.
    log
        −log of it: the entropy; smaller is sharper.
    error
        Bound on the relative error of ``sum`` by what was left out.
    points
        How many points it was taken of.
    """

    sum: float
    log: float
    error: float
    points: int


def rqe(xyz: Array, sigma: float = KERNEL_WIDTH, *, tolerance: float = RQE_TOLERANCE) -> Entropy:
    """Rényi's quadratic entropy of points, each the mean of a Gaussian.

    ``−log [ 1/N² Σ_i Σ_j G(x_i − x_j; 2σ² I) ]``. Points are sorted into the leaves of a k-d tree.
    Pairs of leaves are summed as blocks. Those whose boxes are so far apart that all they can add
    together stays below the tolerance are left out.

    Parameters
    ----------
    xyz
        (N, 3) points, metres.
    sigma
        Width of the kernel, metres.
    tolerance
        Largest relative error of the sum; 0 takes every pair.

    Raises
    ------
    Refusal
        ``too_few_points`` where there are none.
    """
    if len(xyz) == 0:
        raise Refusal("too_few_points", "the entropy of no points is not defined", {"points": 0})
    tree = cKDTree(xyz, leafsize=LEAF_SIZE)
    points = np.asarray(xyz, dtype=float)[tree.indices]
    bounds = _leaf_bounds(tree)
    pairs = _near_leaves(points, bounds, sigma, tolerance)

    def row(a: int) -> float:
        """Sum the pairs of leaf ``a`` with itself and with the near leaves after it."""
        middle = points[bounds[a]]
        own = (points[bounds[a] : bounds[a + 1]] - middle) / (2 * sigma)
        # −‖x − y‖² = 2 x·y − ‖x‖² − ‖y‖² as one product of matrices, about a point of the leaf.
        left = np.column_stack([2 * own, -np.sum(own**2, axis=1), np.ones(len(own))])
        total = 0.0
        for b in np.flatnonzero(pairs.near[a]):
            other = (points[bounds[b] : bounds[b + 1]] - middle) / (2 * sigma)
            right = np.column_stack([other, np.ones(len(other)), -np.sum(other**2, axis=1)])
            block = left @ right.T
            total += (1.0 if a == b else 2.0) * float(np.exp(block, out=block).sum())
        return total

    # Blocks are spread over threads here, so that BLAS needs none of its own.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(CORES) as pool:
        total = sum(pool.map(row, range(len(pairs.near))))
    argument = total / len(points) ** 2 / (4 * np.pi * sigma**2) ** 1.5
    return Entropy(argument, -float(np.log(argument)), pairs.left_out / total, len(points))


def _leaf_bounds(tree: cKDTree) -> IntArray:
    """Where each leaf of a tree starts in its order of the points, and where the last ends."""
    starts, open_nodes = [], [tree.tree]
    while open_nodes:
        node = open_nodes.pop()
        if node.lesser is None:
            starts.append(node.start_idx)
        else:
            open_nodes += [node.lesser, node.greater]
    return np.array([*sorted(starts), tree.n], dtype=np.int64)


class _LeafPairs(NamedTuple):
    """Which leaves (L, L; upper triangle) are summed, and a bound on the sum of all others."""

    near: BoolArray
    left_out: float


def _near_leaves(points: Array, bounds: IntArray, sigma: float, tolerance: float) -> _LeafPairs:
    """Choose the pairs of leaves that matter to the sum.

    The sum is N at least, by each point with itself: the farthest pairs of leaves are dropped for
    as long as what they can add together stays below ``tolerance`` N.
    """
    low = np.minimum.reduceat(points, bounds[:-1])
    high = np.maximum.reduceat(points, bounds[:-1])
    gap = np.maximum(low[:, None] - high, low - high[:, None]).clip(min=0.0)
    count = np.diff(bounds)
    most = count[:, None] * count * np.exp(-np.sum(gap**2, axis=2) / (4 * sigma**2))
    upper = np.triu(np.ones_like(most, dtype=bool))
    most = np.where(upper, most + np.triu(most, 1), np.inf)
    order = np.argsort(most, axis=None)
    dropped = np.cumsum(most.ravel()[order])
    far = order[: np.searchsorted(dropped, tolerance * len(points))]
    upper.ravel()[far] = False
    return _LeafPairs(upper, float(dropped[len(far) - 1]) if len(far) else 0.0)
