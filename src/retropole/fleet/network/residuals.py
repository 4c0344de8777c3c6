"""What each observation says at some poses: residuals and derivatives, counted in their own σ.

Poses move by steps ``[φ, δ]`` in the axes of the network: ``Exp(φ) R`` and ``t + δ``. The
translation does not turn with the rotation, so that coordinates as large as a city's do no harm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...api import Array, se3
from .graph import Graph


@dataclass(frozen=True, eq=False)
class Whitened:
    """Observations of one kind at some poses, each number in σ.

    Attributes
    ----------
    residual
        (K, D) what was measured against what the poses say.
    by_i
        (K, D, 6) derivative by a step of the first pose; None where that is the ground.
    by_j
        (K, D, 6) derivative by a step of the second.
    """

    residual: Array
    by_i: Array | None
    by_j: Array


@dataclass(frozen=True, eq=False)
class Model:
    """A network with the whitening of its observations, which is the same at all poses."""

    graph: Graph

    @cached_property
    def roots(self) -> tuple[Array, Array, Array]:
        """(K, D, D) by which the residuals of each kind are counted in σ: ``WᵀW = C⁻¹``."""
        graph = self.graph
        kinds = (graph.edges.covariance, graph.known.covariance, graph.points.covariance)
        first, second, third = (np.linalg.inv(np.linalg.cholesky(C)) for C in kinds)
        return first, second, third

    def at(self, T: Array) -> tuple[Whitened, Whitened, Whitened]:
        """Edges, known poses and control points at poses (N, 4, 4)."""
        return self.edges(T), self.known(T), self.points(T)

    def edges(self, T: Array) -> Whitened:
        """How far relative poses are from the measured ones."""
        edges, W = self.graph.edges, self.roots[0]
        to_i = np.swapaxes(T[edges.i, :3, :3], 1, 2)
        arm = T[edges.j, :3, 3] - T[edges.i, :3, 3]
        R = to_i @ T[edges.j, :3, :3]
        turned = _log(R @ np.swapaxes(edges.T_i_j[:, :3, :3], 1, 2))
        away = np.einsum("kab,kb->ka", to_i, arm) - edges.T_i_j[:, :3, 3]
        by_j = np.zeros((len(edges), 6, 6))
        by_j[:, :3, :3] = _log_jacobian(turned) @ to_i
        by_j[:, 3:, 3:] = to_i
        by_i = -by_j
        by_i[:, 3:, :3] = to_i @ se3.hat(arm)
        residual = np.concatenate([turned, away], axis=1)
        return Whitened(np.einsum("kab,kb->ka", W, residual), W @ by_i, W @ by_j)

    def known(self, T: Array) -> Whitened:
        """How far poses are from where they are known to be."""
        known, W = self.graph.known, self.roots[1]
        own = T[known.node]
        turned = _log(own[:, :3, :3] @ np.swapaxes(known.T_world_node[:, :3, :3], 1, 2))
        away = own[:, :3, 3] - known.T_world_node[:, :3, 3]
        by_j = np.zeros((len(known), 6, 6))
        by_j[:, :3, :3] = _log_jacobian(turned)
        by_j[:, 3:, 3:] = np.eye(3)
        residual = np.concatenate([turned, away], axis=1)
        return Whitened(np.einsum("kab,kb->ka", W, residual), None, W @ by_j)

    def points(self, T: Array) -> Whitened:
        """How far seen points are from where they were surveyed."""
        points, W = self.graph.points, self.roots[2]
        own = T[points.node]
        arm = np.einsum("kab,kb->ka", own[:, :3, :3], points.at)
        by_j = np.concatenate([-se3.hat(arm), np.broadcast_to(np.eye(3), (len(points), 3, 3))], 2)
        residual = own[:, :3, 3] + arm - points.world
        return Whitened(np.einsum("kab,kb->ka", W, residual), None, W @ by_j)

    def squares(self, T: Array) -> Array:
        """(M,) squared residuals of all observations, in σ²."""
        return np.concatenate([np.sum(one.residual**2, axis=1) for one in self.at(T)])


def _log(R: Array) -> Array:
    return se3.log_so3(R) if len(R) else np.zeros((0, 3))


def _log_jacobian(turned: Array) -> Array:
    """(K, 3, 3) derivative of the rotation vector of ``Exp(ε) Exp(φ)`` by ε, at φ (K, 3)."""
    angle = np.linalg.norm(turned, axis=1)
    half = np.maximum(angle, 1e-4) / 2
    share = np.where(angle < 1e-4, 1 / 12, (1 - half / np.tan(half)) / (4 * half**2))
    across = se3.hat(turned)
    return np.asarray(np.eye(3) - across / 2 + share[:, None, None] * across @ across)
