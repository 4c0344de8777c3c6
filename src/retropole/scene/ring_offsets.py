"""Range offsets of single rings, estimated and taken out of the residuals of the patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..datatypes import Array, IntArray
from .patch_pairs import PatchPairs

RANGE_BIAS, RANGE_BIAS_WEIGHT, RANGE_BIAS_LIMITS = 0.0035, 10.0, (0.001, 0.03)
"""1 σ of the range error that all returns of one ring share, metres: what is assumed, the number of
rings it counts for beside those that show theirs, and the bounds of the outcome. Manufacturers
state an accuracy of 10 to 30 mm; part of it is common to all rings of both LiDARs and cancels."""


@dataclass(frozen=True, eq=False)
class RingOffsets:
    """Range offsets of the single rings of both LiDARs.

    Attributes
    ----------
    jacobian
        (P, 6) derivative of the residuals by the pose, the offsets following along.
    residuals
        (P,) without what the offsets explain.
    prior_information
        (6, 6) what the offsets' own prior adds to the information, since following costs; and as
        much is the variance of the gradient that comes of the offsets.
    sigma
        1 σ of an offset, metres.
    """

    jacobian: Array
    residuals: Array
    prior_information: Array
    sigma: float


def ring_offsets(pairs: PatchPairs, J: Array, weights: Array, sigma: float) -> RingOffsets:
    """Take the range offsets of single rings out of the problem.

    With an offset b for each ring of either LiDAR, ``b ~ N(0, σ_b²)``, the residuals are
    ``r + J x + D b``. The best b is linear in x and put in its place: ``M = DᵀWD + σ_b⁻²``,
    ``J' = J − D M⁻¹ DᵀWJ``. σ_b is what the offsets themselves show (expectation-maximisation).
    """
    D = np.concatenate(
        [
            share_of_rings(pairs.rings_target) * pairs.range_target[:, None],
            share_of_rings(pairs.rings_source) * pairs.range_source[:, None],
        ],
        axis=1,
    )
    count = D.shape[1]
    DW = (D * weights[:, None]).T
    M = DW @ D + np.eye(count) / sigma**2
    inverse = np.linalg.inv(M)
    by_pose, by_residual = inverse @ (DW @ J), inverse @ (DW @ pairs.residuals)
    # Rings that hardly any patch has points of keep their prior, and say nothing of its width.
    known = 1.0 - np.diag(inverse) / sigma**2
    square = float(np.sum(by_residual**2) + np.sum(known * np.diag(inverse)))
    assumed = RANGE_BIAS_WEIGHT * RANGE_BIAS**2
    new = np.sqrt((assumed + square) / (RANGE_BIAS_WEIGHT + float(np.sum(known))))
    return RingOffsets(
        J - D @ by_pose,
        pairs.residuals - D @ by_residual,
        by_pose.T @ by_pose / sigma**2,
        float(np.clip(new, *RANGE_BIAS_LIMITS)),
    )


def share_of_rings(rings: IntArray) -> Array:
    """Share (P, B) of each patch's points (P, PATCH_NEIGHBOURS) that came from each ring."""
    found, label = np.unique(rings, return_inverse=True)
    rows = np.arange(len(rings))[:, None] * len(found) + label.reshape(rings.shape)
    counts = np.bincount(rows.reshape(-1), minlength=len(rings) * len(found))
    return np.asarray(counts.reshape(len(rings), len(found)) / rings.shape[1])
