"""How good a transform is: against a known truth, or by how well it aligns the clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..base import se3
from ..base.datatypes import Array, PointCloud
from ..base.errors import Refusal
from ..base.uncertainty.confirmation import Confirmation
from ..io.beams import with_beam_origin, with_trusted_rings
from ..surfaces.consistency import Line, consistency, standing_in
from ..surfaces.registration import CORES, prepare, voxel_downsample
from ..surfaces.visibility import OVERLAP_DISTANCE, overlap
from .entropy import KERNEL_WIDTH, Entropy, rqe

PAPER_RANGES = 1.0, 60.0
"""Ends n and m of the ranges over which e_rt is averaged, metres (Xue et al. 2019, eq. 13)."""

E_RT_SAMPLES = 512
"""Ranges at which the integrand of e_rt is taken: it is smooth, and more change nothing."""

RQE_POINTS = 60_000
"""Points of both clouds together that the entropy is taken of: half a second of time."""

EVALUATION_VOXEL = 0.1
"""Clouds are downsampled to one point per cube of this side, metres, before they are scored."""


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
        Median distance of overlapping source points from the target's surface, metres; None where
        nothing overlaps.
    entropy
        Of both downsampled clouds together.
    confirmation
        What stands in the scene says of the transform.
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
        The clouds, each in its own frame.
    T
        (4, 4) target from source.
    rng
        Draws `RQE_POINTS` points where there are more. Give each transform that is compared the
        same seed, so that each is scored on the same points.
    sigma
        Width of the entropy's kernel, metres.
    poles
        Of the target and of the source, where they are known: what stands in the scene is counted
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
    together = np.concatenate([surface.xyz, aligned])
    if len(together) > RQE_POINTS:
        together = together[rng.choice(len(together), RQE_POINTS, replace=False)]
    shared = overlap([distances, back], OVERLAP_DISTANCE)
    confirmation = _confirmation(target, source, T, poles)
    return Alignment(shared, residual, rqe(together, sigma), confirmation)


def _confirmation(
    target: PointCloud,
    source: PointCloud,
    T: Array,
    poles: tuple[Sequence[Line], Sequence[Line]],
) -> Confirmation:
    """Hold a pose against what stands in the scene, as a calibration does."""
    rng = np.random.default_rng(0)
    standing = [
        standing_in(with_beam_origin(with_trusted_rings(cloud)), rng, of_cloud)
        for cloud, of_cloud in zip((target, source), poles, strict=True)
    ]
    return consistency(standing[0], standing[1], T)
