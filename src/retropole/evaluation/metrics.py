"""How good a transform is: against a known truth, or by how crisply the clouds lie together."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from .. import se3
from ..datatypes import Array, IntArray, PointCloud
from ..errors import Refusal
from ..scene.disambiguation import OVERLAP_DISTANCE
from ..scene.registration import CORES, prepare, voxel_downsample

KERNEL_WIDTH = 0.05
"""σ of the kernel of Rényi's entropy, metres."""

RQE_POINTS = 60_000
"""Points of both clouds together that the entropy is taken of."""

RQE_TOLERANCE = 1e-7
"""Largest relative error of the entropy's sum."""

LEAF = 256
"""Points of a leaf of the tree over which the double sum is taken, block by block."""

EVALUATION_VOXEL = 0.1
"""Clouds are thinned to one point per cube of this side before they are scored, metres."""


def e_rt(T: Array, T_true: Array, near: float = 1.0, far: float = 60.0) -> float:
    """Mean error of points on the source's y axis, metres (Xue et al. 2019, eq. 12).

    ``1/(m − n) ∫_n^m ‖R x e_y + t − R_gt x e_y − t_gt‖ dx``: the distance between where the two
    transforms put a point x metres out along y, averaged over x from ``near`` to ``far``.

    Parameters
    ----------
    T, T_true
        (4, 4) estimate and truth, target from source.
    near, far
        Ends n and m of the range, metres.
    """
    x = np.linspace(near, far, 512)
    points = x[:, None] * np.array([0.0, 1.0, 0.0])
    gap = np.linalg.norm(se3.apply(T, points) - se3.apply(T_true, points), axis=1)
    return float(np.trapezoid(gap, x) / (far - near))


@dataclass(frozen=True, eq=False)
class Errors:
    """How far a transform is from the truth: rad, metres, and e_rt in metres (eq. 12)."""

    rotation: float
    translation: float
    e_rt: float


def errors_of(T: Array, T_true: Array) -> Errors:
    """Measure a transform (4, 4) against the truth."""
    step = se3.local(T_true, T)
    return Errors(float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:])), e_rt(T, T_true))


@dataclass(frozen=True)
class Entropy:
    """Rényi's quadratic entropy of a cloud.

    Attributes
    ----------
    sum
        Argument of the logarithm, 1/m³; larger is crisper.
    log
        −log of it: the entropy; smaller is crisper.
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
    """Rényi's quadratic entropy of points, each taken for a Gaussian (Sheehan et al. 2012).

    ``−log [ 1/N² Σ_i Σ_j G(x_i − x_j; 2σ² I) ]``. Points are sorted into the leaves of a k-d tree.
    Pairs of leaves are summed as blocks; those whose boxes are so far apart that all they can add
    stays below the tolerance are left out.

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
    tree = cKDTree(xyz, leafsize=LEAF)
    points = np.asarray(xyz, dtype=float)[tree.indices]
    bounds = _leaf_bounds(tree)
    near, left_out = _near_leaves(points, bounds, sigma, tolerance)

    def row(a: int) -> float:
        """Sum the pairs of leaf ``a`` with itself and with the near leaves after it."""
        middle = points[bounds[a]]
        own = (points[bounds[a] : bounds[a + 1]] - middle) / (2 * sigma)
        # −‖x − y‖² = 2 x·y − ‖x‖² − ‖y‖² as one product of matrices, about a point of the leaf.
        left = np.column_stack([2 * own, -np.sum(own**2, axis=1), np.ones(len(own))])
        total = 0.0
        for b in np.flatnonzero(near[a]):
            other = (points[bounds[b] : bounds[b + 1]] - middle) / (2 * sigma)
            right = np.column_stack([other, np.ones(len(other)), -np.sum(other**2, axis=1)])
            block = left @ right.T
            total += (1.0 if a == b else 2.0) * float(np.exp(block, out=block).sum())
        return total

    # Blocks are spread over threads here, so that BLAS needs none of its own.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(CORES) as pool:
        total = sum(pool.map(row, range(len(near))))
    argument = total / len(points) ** 2 / (4 * np.pi * sigma**2) ** 1.5
    return Entropy(argument, -float(np.log(argument)), left_out / total, len(points))


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


def _near_leaves(
    points: Array, bounds: IntArray, sigma: float, tolerance: float
) -> tuple[Array, float]:
    """Which leaves (L, L; upper triangle) add to each other's sum, and a bound on all others' sum.

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
    return upper, float(dropped[len(far) - 1]) if len(far) else 0.0


@dataclass(frozen=True)
class Alignment:
    """How two clouds lie together under a transform.

    Attributes
    ----------
    overlap
        Share of the thinned points with a neighbour of the other cloud within `OVERLAP_DISTANCE`,
        mean of both directions.
    plane_residual
        Median distance of overlapping source points from the target's surface, metres; None where
        nothing overlaps.
    entropy
        Of both thinned clouds together.
    """

    overlap: float
    plane_residual: float | None
    entropy: Entropy


def evaluate(
    target: PointCloud,
    source: PointCloud,
    T: Array,
    *,
    rng: np.random.Generator,
    sigma: float = KERNEL_WIDTH,
) -> Alignment:
    """Score a transform by the clouds it aligns: no truth is needed, and none is told.

    Parameters
    ----------
    target, source
        The clouds, each in its own frame.
    T
        (4, 4) target from source.
    rng
        Draws `RQE_POINTS` points where there are more. Give each transform that is compared the
        same seed, so that each is scored on the same points.
    sigma
        Width of the entropy's kernel, metres.

    Raises
    ------
    Refusal
        ``too_few_points`` where a cloud is too small to tell surfaces.
    """
    surface = prepare(target.xyz, EVALUATION_VOXEL, threads=CORES)
    moved = se3.apply(T, voxel_downsample(source.xyz, EVALUATION_VOXEL))
    distance, at = cKDTree(surface.xyz).query(moved, workers=CORES)
    back, _ = cKDTree(moved).query(surface.xyz, workers=CORES)
    near = distance <= OVERLAP_DISTANCE
    overlap = 0.5 * (float(np.mean(near)) + float(np.mean(back <= OVERLAP_DISTANCE)))
    residual = None
    if near.any():
        normals = surface.cloud.normals()[at[near], :3]
        across = np.sum(normals * (moved[near] - surface.xyz[at[near]]), axis=1)
        residual = float(np.median(np.abs(across)))
    # Of the clouds as they are, the dense ground near each LiDAR would be most of the sum, and a
    # pose that lays one LiDAR on the other the crispest.
    together = np.concatenate([surface.xyz, moved])
    if len(together) > RQE_POINTS:
        together = together[rng.choice(len(together), RQE_POINTS, replace=False)]
    return Alignment(overlap, residual, rqe(together, sigma))
