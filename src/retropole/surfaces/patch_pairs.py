"""Patches of both clouds that lie on one surface, and which directions of the pose they hold.

Each patch of the source is compared with the surface that its nearest patches of the target make
together. Every limit is a smooth weight, so that the sum of squares has one minimum where a hard
limit would leave many: an answer must not depend on where the search started.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray
from ..base.se3 import lengths
from ..base.systematic import DEVICE, RADIUS, RING, Layout
from ..base.uncertainty import SIGMAS
from .patches import SPAN, Patches, selected

GEMAN_HALF = 0.6120
"""The c for which ``x²/(x² + c²)`` of standard normal x has a mean of one half."""

START = float(np.log(GEMAN_HALF**2 * np.pi / 2.0))
"""Where the search for the scale begins, about the square of the mean: its place for normal ones,
logarithms."""

LEAST_SCATTER = 1e-6
"""Least that values are found to scatter by, and their variance in common, as a part of what is
predicted: less is rounding. And step of a logarithm at which its place is found: the next of
Newton's is its square."""


MOST_HALVINGS = 100
"""Of `_root`, which halves where it cannot step: enough for any bracket of logarithms."""


def robust_scale(values: Array, weights: Array) -> float:
    """Estimate the standard deviation of values (N,) about 0, half of which may be outliers.

    The s with ``Σ w x²/(x² + (cs)²) = ½ Σ w`` (an M-estimate of scale, Huber 1981, with the loss of
    Geman and McClure); c makes it 1 for standard normal values. Unlike a median it has a derivative
    everywhere: where it jumped, so would the pose.
    """
    return float(np.sqrt(_half_outside(values**2, weights))) / GEMAN_HALF


def common_scatter(values: Array, variance: Array, weights: Array) -> float:
    """Find the common variance of values (N,), in addition to that which is predicted of each.

    The τ² with which ``x²/(v + τ²)`` has the same `robust_scale` among those of small predicted
    variance v as among those of large v; zero if the small ones scatter no more as it is. Small
    and large are weights, ``m/(m + v)`` and the rest, about the geometric mean m, so that τ² has a
    derivative everywhere.
    """
    middle = float(np.exp(np.average(np.log(variance), weights=weights)))
    sharp = weights * middle / (middle + variance)
    half = 0.5 * float(sharp.sum())
    square = values**2

    def difference(log_common: float) -> tuple[float, float]:
        common = np.exp(log_common)
        total = variance + common
        q = square / total
        scale = _half_outside(q, weights)
        # By the scale of all, half of the small ones lie outside of their separate scale: and so do
        # half of the large ones.
        inside = 1.0 / (q + scale)
        outside = q * inside
        # By log τ²: of q itself, and of the scale, which keeps half of all outside.
        by_q = outside * inside * (common / total)
        by_scale = outside * inside
        moved = float(weights @ by_q) / float(weights @ by_scale)
        slope = scale * (moved * float(sharp @ by_scale) - float(sharp @ by_q))
        return float(sharp @ outside) - half, slope

    low, high = np.log(LEAST_SCATTER * middle), np.log(float(np.max(square)) + middle)
    if difference(low)[0] <= 0.0:
        return 0.0
    if difference(high)[0] >= 0.0:
        return float(np.exp(high))
    return float(np.exp(_root(difference, low, high, np.log(middle))))


def _half_outside(square: Array, weights: Array) -> float:
    """Find the S with ``Σ w q/(q + S) = ½ Σ w`` for squares q (N,)."""
    half = 0.5 * float(weights.sum())

    def excess(log_scale: float) -> tuple[float, float]:
        scale = np.exp(log_scale)
        inside = 1.0 / (square + scale)
        outside = square * inside
        return float(weights @ outside) - half, -scale * float(weights @ (outside * inside))

    low, high = float(np.log(1e-30)), float(np.log(float(square.max()) + 1e-30)) + 1e-9
    if excess(low)[0] <= 0:
        # Half of the values or more are zero.
        return float(np.exp(low))
    mean = float(weights @ np.sqrt(square)) / (2.0 * half)
    return float(np.exp(_root(excess, low, high, float(np.log(max(mean, 1e-15)) * 2.0) + START)))


def _root(
    function: Callable[[float], tuple[float, float]], low: float, high: float, start: float
) -> float:
    """Find where a function falls through zero between two places, by its slope (Newton).

    `scipy.optimize` has the same, but takes longer to import than all its calls to run.
    """
    x = min(max(start, low), high)
    for _ in range(MOST_HALVINGS):
        value, slope = function(x)
        low, high = (x, high) if value > 0.0 else (low, x)
        new = x - value / slope if slope < 0.0 else np.inf
        if not low <= new <= high:
            new = 0.5 * (low + high)
        if abs(new - x) < LEAST_SCATTER:
            return new
        x = new
    return x


MAX_NORMAL_ANGLE = np.radians(35.0)
"""Two patches lie on one surface only if their normals agree within this angle, rad."""

MIN_CORRESPONDENCE_DISTANCE, MAX_CORRESPONDENCE_DISTANCE = 0.10, 1.5
"""Distance across the surface within which patches correspond: the first, metres, beyond
`SIGMAS` of the pose, and at most the second."""

BLENDED = 4
"""Nearest patches of the target that make its surface; the next one beyond has no weight left."""

CLUSTER_SIDE, CLUSTER_RANGE = 2.0, 40.0
"""Residuals of patches within a cube of this side, metres, are treated as correlated, up to this
range, metres. From there on twice the side, four times from twice the range: what lies at such
distances is seen by rings and in patches whose spacing is as much wider."""

MAX_LEAN = 0.02
"""Patches that LiDARs see from different sides count the less the more they lean for the noise of
the beams' pointing, rad, and not at all from this on. Of a crane with five LiDARs (benchmarks/
site.py, tuning seed 1) rotations were off by 0.034° in the middle, 4 σ; with 0.02, 0.04 and 0.08
by 0.01°, 1.4 σ."""

PLANAR = 1.2762
"""`robust_scale` of lengths of normal vectors in the plane, half of whose squares have mean 1."""

MIN_PATCHES = 30
"""With fewer pairs of patches the scene has nothing to say: five for each parameter of the pose."""


@dataclass(frozen=True, eq=False)
class PatchPairs:
    """Patches of both clouds that lie on one surface under a pose, and their distances.

    Attributes
    ----------
    residuals
        (P,) signed distance along the normal, metres.
    jacobian
        (P, 6) derivative with respect to ``[φ, δ]``.
    by_lidar
        For each LiDAR, the derivative with respect to its errors: (P, 12) as those of `Patches`,
        and (P, bands) which part each band has of those of rings.
    layout
        Order of the errors.
    levers
        (P, 3, 6) derivative of where the source's patch lies.
    normal, tilt
        (P, 3) the mean normal, (P,) its variance, rad².
    variance
        (P,) of the residual by the scatter of the patches, m²: of their centres, and of their
        normals over the distance between the centres.
    agreement
        (P,) weight, 0 to 1: how far the limits of what corresponds allow the pair.
    cluster
        (P,) which residuals lie at one place.
    places
        (C,) which of the places of `PatchSets` each is.
    at
        (P, 3) where the source's patch lies in the target's frame, metres.
    """

    residuals: Array
    jacobian: Array
    by_lidar: tuple[tuple[Array, csr_matrix], tuple[Array, csr_matrix]]
    layout: Layout
    levers: Array
    normal: Array
    tilt: Array
    variance: Array
    agreement: Array
    cluster: IntArray
    places: IntArray
    at: Array

    def by_errors(self, errors: Array) -> Array:
        """(P, ...) change of the residuals by errors (B, ...), in the order of the layout."""
        moved = np.zeros((len(self.residuals), *errors.shape[1:]))
        for lidar, (by, share) in enumerate(self.by_lidar):
            moved += by[:, :DEVICE] @ errors[self.layout.device(lidar)]
            for kind in range(RING):
                of_rings = share @ errors[self.layout.rings(lidar, kind)]
                moved += (by[:, DEVICE + kind] * of_rings.T).T
        return moved

    def pull_of_errors(self, rows: Array) -> Array:
        """(B,) sum of the residuals' derivatives by all errors, each times its factor (P,)."""
        pull = np.zeros(self.layout.size)
        for lidar, (by, share) in enumerate(self.by_lidar):
            own = rows[:, None] * by
            pull[self.layout.device(lidar)] = own[:, :DEVICE].sum(axis=0)
            of_rings = share.T @ own[:, DEVICE:]
            for kind in range(RING):
                pull[self.layout.rings(lidar, kind)] = of_rings[:, kind]
        return pull

    def put_by_error(self, factor: Array, table: Array) -> None:
        """Put the derivative by all errors, rows times a factor (P,), into a table (P, B)."""
        for lidar, (by, share) in enumerate(self.by_lidar):
            own = factor[:, None] * by
            table[:, self.layout.device(lidar)] = own[:, :DEVICE]
            dense = share.toarray()
            for kind in range(RING):
                rings = table[:, self.layout.rings(lidar, kind)]
                np.multiply(dense, own[:, DEVICE + kind, None], out=rings)
        table[:, RADIUS] = 0.0


@dataclass(frozen=True, eq=False)
class PatchSets:
    """Patches of both clouds, made ready to be paired under one pose after the other.

    Attributes
    ----------
    target, source
        Each in the frame of its LiDAR.
    tree
        Of the target's centres.
    layout
        Order of the errors.
    shares
        For each LiDAR, (M, bands) share of a patch's points that lie in each band.
    clusters
        (M,) place of each patch of the source.
    """

    target: Patches
    source: Patches
    tree: cKDTree
    layout: Layout
    shares: tuple[csr_matrix, csr_matrix]
    clusters: IntArray


def prepare_patches(target: Patches, source: Patches, layout: Layout) -> PatchSets:
    """Prepare patches for `pair_patches`; the layout must have all bands of both."""
    shares = tuple(
        _share_of_bands(patches.bands, layout.bands[lidar])
        for lidar, patches in enumerate((target, source))
    )
    beyond = np.maximum(lengths(source.centres) / CLUSTER_RANGE, 1.0)
    level = np.ceil(np.log2(beyond))[:, None]
    cells = np.floor(source.centres / (CLUSTER_SIDE * 2.0**level))
    clusters = labels_of(np.hstack([level, cells]))
    return PatchSets(
        target, source, cKDTree(target.centres), layout, (shares[0], shares[1]), clusters
    )


def every_nth_patch(sets: PatchSets, every: int, first: int = 0) -> PatchSets:
    """Give the same with every n-th patch of the source only, from the first on."""
    return some_of(sets, slice(first, None, every))


def some_of(sets: PatchSets, some: slice | BoolArray) -> PatchSets:
    """Give the same with some patches of the source only."""
    return replace(
        sets,
        source=selected(sets.source, some),
        shares=(sets.shares[0], sets.shares[1][some]),
        clusters=sets.clusters[some],
    )


def by_objects(sets: PatchSets, objects: IntArray) -> PatchSets:
    """Give the same with all patches of the source on one object at one place.

    The objects (M,) are numbered from 1 on; 0 are patches on none, whose place stays.
    """
    beyond = objects + sets.clusters.max(initial=0)
    return replace(sets, clusters=np.where(objects > 0, beyond, sets.clusters))


def without_rings(sets: PatchSets) -> PatchSets:
    """Give the same without the errors of single rings."""
    target, source = sets.layout.bands
    shares = sets.shares[0][:, :0], sets.shares[1][:, :0]
    return replace(sets, layout=Layout((target[:0], source[:0])), shares=shares)


def _share_of_bands(bands: IntArray, known: IntArray) -> csr_matrix:
    rows = np.repeat(np.arange(len(bands)), bands.shape[1])
    columns = np.searchsorted(known, bands.reshape(-1))
    share = np.full(len(rows), 1.0 / max(bands.shape[1], 1))
    return csr_matrix((share, (rows, columns)), shape=(len(bands), len(known)))


def without_errors(sets: PatchSets, errors: Array) -> tuple[Patches, Patches]:
    """Give the patches of both clouds where they lie without the errors (B,) of their LiDARs."""
    found = []
    for lidar, patches in enumerate((sets.target, sets.source)):
        rings = [
            sets.shares[lidar] @ errors[sets.layout.rings(lidar, kind)] for kind in range(RING)
        ]
        devices = np.broadcast_to(errors[sets.layout.device(lidar)], (len(rings[0]), DEVICE))
        own = np.column_stack([devices, *rings])
        off = np.einsum("mij,mj->mi", patches.by_error, own)
        found.append(replace(patches, centres=patches.centres + off))
    return found[0], found[1]


def pair_patches(
    sets: PatchSets, T: Array, covariance: Array, origins_known: bool
) -> PatchPairs | None:
    """Pair each source patch with the surface of the target's patches near it.

    Parameters
    ----------
    sets
        Patches of both clouds.
    T, covariance
        (4, 4) and (6, 6) the pose and how far it may still be off: both steer how far a patch looks
        for its partner.
    origins_known
        As `refinement.refine` has it.

    Returns
    -------
    PatchPairs or None
        None if fewer than `MIN_PATCHES` pairs are found.
    """
    target, source = sets.target, sets.source
    rotated = source.centres @ T[:3, :3].T
    moved = rotated + T[:3, 3]
    # How far each patch may still be off, from the covariance of the pose: tr(J Σ Jᵀ).
    lever = np.concatenate([-se3.hat(rotated), np.broadcast_to(np.eye(3), (len(moved), 3, 3))], 2)
    # Where a pose is all but free, rounding may leave less than none.
    spread = np.sqrt(np.maximum(np.einsum("mik,mik->m", lever @ covariance, lever), 0.0))
    limit = np.minimum(MIN_CORRESPONDENCE_DISTANCE + SIGMAS * spread, MAX_CORRESPONDENCE_DISTANCE)
    own = np.maximum(np.maximum(limit, SPAN), source.extent)
    distance, near = sets.tree.query(
        moved, k=BLENDED + 1, distance_upper_bound=2.0 * float(own.max())
    )
    outside = near >= len(target.centres)
    near = np.where(outside, 0, near)
    # No farther than the blend reaches below: a pair must fade before it ends.
    span = np.clip(target.extent.take(near), own[:, None], 2.0 * own[:, None])
    s = np.flatnonzero((distance < span).any(axis=1))
    if len(s) < MIN_PATCHES:
        return None
    distance, near, outside, span = distance[s], near[s], outside[s], span[s]
    # The next patch beyond those that are blended sets the width, so that it has no weight itself.
    width = np.minimum(distance[:, -1], 2.0 * own[s])[:, None]
    kernel = _smooth(distance[:, :-1] / width)
    kernel[outside[:, :-1]] = 0.0
    near, span = near[:, :-1], span[:, :-1]
    normal_source = source.normals[s] @ T[:3, :3].T
    cosine = np.einsum("mi,mki->mk", normal_source, target.normals.take(near, axis=0))
    sign = np.ones_like(cosine)
    if not origins_known:
        sign, cosine = np.where(cosine < 0, -1.0, 1.0), np.abs(cosine)
    least = np.cos(MAX_NORMAL_ANGLE)
    same = np.maximum((cosine - least) / (1.0 - least), 0.0)
    weight = kernel * np.minimum(2.0 * same, 1.0) * _smooth(distance[:, :-1] / span)
    total = weight.sum(axis=1)
    used = total > 1e-6 * kernel.sum(axis=1)
    if np.count_nonzero(used) < MIN_PATCHES:
        return None
    s, near, weight, kernel, sign, normal_source, total, distance = (
        one[used] for one in (s, near, weight, kernel, sign, normal_source, total, distance)
    )
    agreement = total / kernel.sum(axis=1)
    weight = weight / total[:, None]

    def blended(values: Array) -> Array:
        return np.asarray(np.einsum("mk,mk...->m...", weight, values.take(near, axis=0)))

    normal_target = np.einsum("mk,mki->mi", weight * sign, target.normals.take(near, axis=0))
    normal_target /= np.linalg.norm(normal_target, axis=1, keepdims=True)
    normal = normal_source + normal_target
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    between = moved[s] - blended(target.centres)
    residuals = np.einsum("mi,mi->m", normal, between)
    agreement = agreement * _smooth(residuals / limit[s])
    apart = _lean_apart(source.lean[s] @ T[:3, :3].T, blended(target.lean))
    agreement = agreement * _smooth(apart / MAX_LEAN)
    if not agreement.any():
        # All lie near each other, and none on the other's surface.
        return None
    by_source = np.einsum("mi,mij->mj", normal @ T[:3, :3], source.by_error[s])
    stops = BLENDED * np.arange(len(s) + 1)
    blend = csr_matrix(
        (weight.reshape(-1), near.reshape(-1), stops), shape=(len(s), len(target.centres))
    )
    by_error_there = (blend @ target.by_error.reshape(len(target.centres), -1)).reshape(
        len(s), *target.by_error.shape[1:]
    )
    by_target = -np.einsum("mi,mij->mj", normal, by_error_there)
    tilt = (source.tilt[s] + blended(target.tilt)) / 4
    turned = lengths(normal_source - normal_target) / np.sqrt(8.0 * tilt)
    tilt = tilt * max(robust_scale(turned, agreement) / PLANAR, 1.0) ** 2
    along = np.einsum("mi,mi->m", between, between)
    places, cluster = np.unique(sets.clusters[s], return_inverse=True)
    return PatchPairs(
        residuals=residuals,
        jacobian=np.einsum("mi,mij->mj", normal, lever[s]),
        by_lidar=((by_target, blend @ sets.shares[0]), (by_source, sets.shares[1][s])),
        layout=sets.layout,
        levers=lever[s],
        normal=normal,
        tilt=tilt,
        variance=source.variance[s] + blended(target.variance) + tilt * along,
        agreement=agreement,
        cluster=cluster.astype(np.int64),
        places=places,
        at=moved[s],
    )


def _lean_apart(lean: Array, other: Array) -> Array:
    """How differently patches (M, 3) lean that are seen from different sides, rad.

    From one side they lean equally, and what they lean by cancels.
    """
    size, size_other = (np.maximum(lengths(each), 1e-12) for each in (lean, other))
    turned = lengths(lean / size[:, None] - other / size_other[:, None])
    return np.asarray(np.maximum(size, size_other) * turned)


def _smooth(x: Array) -> Array:
    """1 at 0, and 0 from 1 on, with a derivative everywhere (Tukey's biweight)."""
    return np.asarray(np.maximum(1.0 - x**2, 0.0) ** 2)


def labels_of(cells: Array) -> IntArray:
    """Number the rows of (P, D) cell coordinates: equal rows, equal numbers."""
    whole = cells.astype(np.int64) - cells.min(axis=0).astype(np.int64)
    flat = np.ravel_multi_index(tuple(whole.T), tuple(whole.max(axis=0) + 1))
    return np.unique(flat, return_inverse=True)[1].astype(np.int64)
