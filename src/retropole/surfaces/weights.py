"""How much information each pair of patches gives about the pose, and what the surfaces do not
determine."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..alignment.unknowns import POSE
from ..base.datatypes import Array
from .patch_pairs import LEAST_SCATTER, PatchPairs, common_scatter, robust_scale

ROBUST_WIDTH = 2.0
"""Residuals of this many σ have a quarter of the weight (Geman and McClure 1987)."""


MIN_HOLD = 6.0
"""A direction of the pose is treated as constrained by the scene with this many times the
information that the noise of the normals alone would imitate."""


@dataclass(frozen=True, eq=False)
class Weighed:
    """Pairs of patches as the adjustment takes them.

    Of each pair of patches there is a row: its derivative by the pose and the errors, and its
    residual, each times the root of its weight, so that all have unit weight. All rows together
    would be most of what a site keeps in memory.

    Attributes
    ----------
    pairs, weights
        Those that correspond, and (P,) the weights of the residuals, 1/m².
    ways, left
        (P, 6) and (6,), as `constrained_directions` gives them: what the surfaces do not constrain
        is left to the poles, ``(1 − W diag(left) Wᵀ)`` times the rows.
    """

    pairs: PatchPairs
    weights: Array
    ways: Array
    left: Array

    def by(self, directions: Array) -> Array:
        """(P, ...) change of the residuals by directions (6 + B, ...) of pose and errors."""
        by_pose = self.pairs.jacobian @ directions[:POSE]
        rows = by_pose + self.pairs.by_errors(directions[POSE:])
        return self._held((np.sqrt(self.weights) * rows.T).T)

    @property
    def residuals(self) -> Array:
        """(P,) of unit weight."""
        return self._held(np.sqrt(self.weights) * self.pairs.residuals)

    def pull(self, residuals: Array) -> Array:
        """(6 + B,) derivative of half the sum of squares by pose and errors, of unit weight."""
        rows = np.sqrt(self.weights) * self._held(residuals)
        return np.concatenate([rows @ self.pairs.jacobian, self.pairs.pull_of_errors(rows)])

    @cached_property
    def square(self) -> Array:
        """(6 + B, 6 + B) of the derivatives of all residuals."""
        root = np.sqrt(self.weights)
        table = np.empty((len(root), POSE + self.pairs.layout.size))
        table[:, :POSE] = root[:, None] * self.pairs.jacobian
        self.pairs.put_by_error(root, table[:, POSE:])
        along = self.ways.T @ table
        # The square of one array: BLAS then computes one half alone.
        return np.asarray(table.T @ table - (along.T * (self.left * (2.0 - self.left))) @ along)

    def _held(self, rows: Array) -> Array:
        return np.asarray(rows - self.ways @ (self.left * (self.ways.T @ rows).T).T)


def weigh(pairs: PatchPairs, covariance: Array) -> Weighed:
    """Weigh the residuals, and leave out the directions of the pose that the surfaces do not hold.

    Parameters
    ----------
    pairs
        Patches that correspond.
    covariance
        (6, 6) how far the pose may still be off. That does not make a residual an
        outlier: a distant wall would be given up before the ground has let the pose turn towards
        it.
    """
    r = pairs.residuals
    spread = np.sqrt(pairs.variance + common_scatter(r, pairs.variance, pairs.agreement))
    spread = spread * max(robust_scale(r / spread, pairs.agreement), LEAST_SCATTER)
    still_off = np.sum(pairs.jacobian * (pairs.jacobian @ covariance), axis=1)
    outlying = r**2 / (ROBUST_WIDTH**2 * (spread**2 + still_off))
    weights = pairs.agreement / (spread * (1.0 + outlying)) ** 2
    return Weighed(pairs, weights, *constrained_directions(pairs, weights))


def constrained_directions(pairs: PatchPairs, weights: Array) -> tuple[Array, Array]:
    """Find which directions the surfaces hold, and which the noise of their normals imitates.

    The normal of flat ground errs by a degree here and there, and thousands of such errors seem to
    hold a pose along the ground: information of that kind is what ``H_n``, the sum over the two
    tangents of each patch by the variance of its normal, says. Of the generalised eigenvectors v of
    ``H_s v = λ H_n v``, those with λ below `MIN_HOLD` are left to the poles, those far above it to
    the scene, and what lies between to both, by ``λ²/(λ² + MIN_HOLD²)``. What is left to the poles
    is removed from the residuals as well, as if the surfaces could slide along it: with the
    derivative alone made smaller, the step would become larger.

    Returns
    -------
    ways, left
        (P, 6) what a step along each v does to the residuals times the roots of their weights,
        orthonormal, and (6,) the part of it to leave to the poles.
    """
    tangents = pairs.levers - pairs.normal[:, :, None] * pairs.jacobian[:, None, :]
    tangents *= np.sqrt(weights * pairs.tilt)[:, None, None]
    rows = tangents.reshape(-1, 6)
    noise = rows.T @ rows
    scale = 1.0 / np.sqrt(np.diag(noise) + 1e-300)
    root = np.linalg.cholesky(noise * np.outer(scale, scale) + 1e-9 * np.eye(6))
    # Singular values of the rows: as eigenvalues of their squares, which span twenty powers of
    # ten where few surfaces are seen, the small ones are lost in rounding.
    basis, scene = np.linalg.qr(pairs.jacobian * np.sqrt(weights)[:, None] * scale)
    turned, singular, _ = np.linalg.svd(np.linalg.solve(root, scene.T).T)
    return basis @ turned, MIN_HOLD**2 / (singular**4 + MIN_HOLD**2)
