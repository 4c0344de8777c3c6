"""What each observation says at some poses: residuals and derivatives, counted in their own σ.

Poses move by steps ``[φ, δ]`` in the axes of the network: ``Exp(φ) R`` and ``t + δ``. The
translation does not turn with the rotation, so that coordinates as large as a city's do no harm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...api import Array, se3
from ...base.relative import relative_jacobian
from .graph import Edges, Graph


@dataclass(frozen=True, eq=False)
class Whitened:
    """Observations of one kind at some poses, each number in σ.

    Attributes
    ----------
    residual
        (K, D) what was measured against what the poses say.
    by_i, by_j
        (K, D, 6) derivatives by a step of the first pose, and of the second.
    """

    residual: Array
    by_i: Array
    by_j: Array


@dataclass(frozen=True, eq=False)
class Model:
    """A network with the whitening of its observations, which is the same at all poses."""

    graph: Graph

    @cached_property
    def relative(self) -> Edges:
        """Edges, then known poses as edges from the ground."""
        return self.graph.relative

    @cached_property
    def roots(self) -> tuple[Array, Array]:
        """(K, D, D) by which the residuals of each kind are counted in σ: ``WᵀW = C⁻¹``."""
        first, second = (
            np.linalg.inv(np.linalg.cholesky(C))
            for C in (self.relative.covariance, self.graph.points.covariance)
        )
        return first, second

    def at(self, T: Array) -> tuple[Whitened, Whitened]:
        """Relative poses, known ones last, and control points at poses (N, 4, 4)."""
        return self._relative_poses(T), self._points(T)

    def _relative_poses(self, T: Array) -> Whitened:
        """How far relative poses are from the measured ones."""
        of, W = self.relative, self.roots[0]
        T = with_ground(T)
        T_i, T_j = T[of.i], T[of.j]
        step = se3.local(of.T_i_j, se3.inverse(T_i) @ T_j) if len(of) else np.zeros((0, 6))
        J = W @ se3.local_jacobian(step) @ relative_jacobian(T_i, T_j)
        return Whitened(np.einsum("kab,kb->ka", W, step), J[:, :, :6], J[:, :, 6:])

    def _points(self, T: Array) -> Whitened:
        """How far seen points are from where they were surveyed."""
        points, W = self.graph.points, self.roots[1]
        own = T[points.node]
        arm = np.einsum("kab,kb->ka", own[:, :3, :3], points.at)
        by_j = W @ np.concatenate([-se3.hat(arm), np.tile(np.eye(3), (len(points), 1, 1))], axis=2)
        residual = own[:, :3, 3] + arm - points.world
        return Whitened(np.einsum("kab,kb->ka", W, residual), np.zeros_like(by_j), by_j)

    def squares(self, T: Array) -> Array:
        """(M,) squared residuals of all observations, in σ²."""
        return np.concatenate([np.sum(one.residual**2, axis=1) for one in self.at(T)])


def with_ground(T: Array) -> Array:
    """Poses (N + 1, 4, 4) with the ground as the last: the frame of the network itself."""
    return np.concatenate([T, np.eye(4)[None]])
