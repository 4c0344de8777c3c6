"""How good a transform is: against a known truth, or by how well it aligns the clouds.

Without a truth the entropy measures how sharp aligned clouds are: B. Sheehan, A. Harrison and P.
Newman, *Self-calibration for a 3D laser*, IJRR 2012; Xue et al. 2019 score their Table IV by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.errors import Refusal
from ..base.uncertainty.confirmation import Confirmation
from ..io.beams import with_beam_origin, with_trusted_rings
from ..surfaces.consistency import Line, consistency, objects_in
from ..surfaces.registration import CORES, prepare, voxel_downsample
from ..surfaces.visibility import OVERLAP_DISTANCE, overlap

PAPER_RANGES = 1.0, 60.0
"""Ends n and m of the ranges over which e_rt is averaged, metres (Xue et al. 2019, eq. 13)."""

E_RT_SAMPLES = 512
"""Ranges at which the integrand of e_rt is taken: it is smooth, and more change nothing."""

RQE_POINTS = 60_000
"""Points of both clouds together that the entropy is taken of: half a second of time."""

EVALUATION_VOXEL = 0.1
"""Clouds are downsampled to one point per cube of this side, metres, before they are scored."""

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
        −log of that: the entropy; smaller is sharper.
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
    Pairs of leaves are summed as blocks. Those whose boxes are so far from each other that all
    they can add together stays below the tolerance are left out.

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

    # Blocks are spread over threads here, so that BLAS needs none.
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


def e_rt(
    T: Array, T_true: Array, near: float = PAPER_RANGES[0], far: float = PAPER_RANGES[1]
) -> float:
    """Mean error of points on the source's y axis, metres (Xue et al. 2019, eq. 13).

    ``1/(m − n) ∫_n^m ‖R x e_y + t − R_gt x e_y − t_gt‖ dx``: the distance between where the two
    transforms put a point x metres out along y, averaged over x from ``near`` to ``far``.

    Parameters
    ----------
    T, T_true
        (4, 4) estimate and truth, target from source.
    near, far
        Ends n and m of the range, metres.
    """
    # NumPy names it differently by version. It loads the optimisers too: 0.2 s that few need.
    from scipy.integrate import trapezoid

    x = np.linspace(near, far, E_RT_SAMPLES)
    points = x[:, None] * np.array([0.0, 1.0, 0.0])
    gap = np.linalg.norm(se3.apply(T, points) - se3.apply(T_true, points), axis=1)
    return float(trapezoid(gap, x) / (far - near))


@dataclass(frozen=True, eq=False)
class Errors:
    """How far a transform is from the truth.

    Attributes
    ----------
    rotation
        Angle, rad.
    translation
        Metres.
    e_rt
        Metres (Xue et al. 2019, eq. 13).
    """

    rotation: float
    translation: float
    e_rt: float


def errors_of(T: Array, T_true: Array) -> Errors:
    """Measure a transform (4, 4) against the truth."""
    return Errors(*se3.difference(T_true, T), e_rt(T, T_true))


@dataclass(frozen=True)
class Alignment:
    """How two clouds lie together under a transform.

    Attributes
    ----------
    overlap
        Share of the downsampled points with a neighbour in the other cloud within
        `surfaces.visibility.OVERLAP_DISTANCE`, mean of both directions.
    plane_residual
        Median distance of overlapping source points from the target's surface, metres; None if
        nothing overlaps.
    entropy
        Of both downsampled clouds together.
    confirmation
        What the scene shows about the transform.
    """

    overlap: float
    plane_residual: float | None
    entropy: Entropy
    confirmation: Confirmation


def evaluate(
    target: PointCloud,
    source: PointCloud,
    T: Array,
    *,
    rng: np.random.Generator,
    sigma: float = KERNEL_WIDTH,
    poles: tuple[Sequence[Line], Sequence[Line]] = ((), ()),
) -> Alignment:
    """Score a transform by the clouds it aligns, without a truth.

    Parameters
    ----------
    target, source
        The clouds, each in the frame of its LiDAR.
    T
        (4, 4) target from source.
    rng
        Draws `RQE_POINTS` points where there are more. Give each transform that is compared the
        same seed, so that each is scored on the same points.
    sigma
        Width of the entropy's kernel, metres.
    poles
        Of the target and of the source, where they are known: the objects in the scene are counted
        without them, as a calibration does, since they agree with the pose that they gave.

    Raises
    ------
    Refusal
        ``too_few_points`` where the target is too small to estimate surfaces, or the source empty.
    """
    if len(source) == 0:
        raise Refusal("too_few_points", "the source cloud has no points", {"points": 0})
    surface = prepare(target.xyz, EVALUATION_VOXEL, threads=CORES)
    aligned = se3.apply(T, voxel_downsample(source.xyz, EVALUATION_VOXEL))
    distances, nearest = cKDTree(surface.xyz).query(aligned, workers=CORES)
    back, _ = cKDTree(aligned).query(surface.xyz, workers=CORES)
    near = distances <= OVERLAP_DISTANCE
    residual = None
    if near.any():
        normals = surface.cloud.normals()[nearest[near], :3]
        across = np.sum(normals * (aligned[near] - surface.xyz[nearest[near]]), axis=1)
        residual = float(np.median(np.abs(across)))
    # In the clouds as they are, the dense ground near each LiDAR would be most of the sum, and a
    # pose that puts one LiDAR on the other the sharpest.
    joint = np.concatenate([surface.xyz, aligned])
    if len(joint) > RQE_POINTS:
        joint = joint[rng.choice(len(joint), RQE_POINTS, replace=False)]
    shared = overlap([distances, back], OVERLAP_DISTANCE)
    confirmation = _confirmation(target, source, T, poles)
    return Alignment(shared, residual, rqe(joint, sigma), confirmation)


def _confirmation(
    target: PointCloud,
    source: PointCloud,
    T: Array,
    poles: tuple[Sequence[Line], Sequence[Line]],
) -> Confirmation:
    """Compare a pose with the objects in the scene, as a calibration does."""
    rng = np.random.default_rng(0)
    objects = [
        objects_in(with_beam_origin(with_trusted_rings(cloud)), rng, of_cloud)
        for cloud, of_cloud in zip((target, source), poles, strict=True)
    ]
    return consistency(objects[0], objects[1], T)
