"""A network adjusted by GTSAM: its own residuals, steps and marginals; nothing of ours but the
data.

GTSAM's residual is the logarithm of ``T_measured⁻¹ T`` in the axes of the second frame, ours a
rotation and a translation in those of the first. Covariances are turned from one to the other to
first order, so that means differ by the second order of what edges miss.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from retropole.base.datatypes import Array
from retropole.fleet.network.graph import Graph


@dataclass(frozen=True, eq=False)
class Found:
    """Poses (N, 4, 4), and their covariances (N, 6, 6) in our axes."""

    T: Array
    covariance: Array


def _blocks(R: Array) -> Array:
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    return out


def _noise(T: Array, covariance: Array) -> gtsam.noiseModel.Base:
    to_body = _blocks(T[:3, :3].T)
    return gtsam.noiseModel.Gaussian.Covariance(to_body @ covariance @ to_body.T)


def adjust(graph: Graph, start: Array, marginals: np.ndarray) -> Found:
    """Adjust all edges and control points; covariances of some nodes."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    edges, points = graph.edges, graph.points
    for i, j, T, C in zip(edges.i, edges.j, edges.T_i_j, edges.covariance, strict=True):
        factors.add(gtsam.BetweenFactorPose3(int(i), int(j), gtsam.Pose3(T), _noise(T, C)))
    for node, world, C in zip(points.node, points.world, points.covariance, strict=True):
        noise = gtsam.noiseModel.Gaussian.Covariance(C)
        factors.add(gtsam.PoseTranslationPrior3D(int(node), world, noise))
    for k, T in enumerate(start):
        values.insert(k, gtsam.Pose3(T))
    options = gtsam.LevenbergMarquardtParams()
    options.setRelativeErrorTol(1e-14)
    options.setAbsoluteErrorTol(1e-12)
    found = gtsam.LevenbergMarquardtOptimizer(factors, values, options).optimize()
    T = np.array([found.atPose3(k).matrix() for k in range(graph.nodes)])
    covariances = gtsam.Marginals(factors, found)
    own = []
    for k in marginals:
        turned = _blocks(T[k, :3, :3])
        own.append(turned @ covariances.marginalCovariance(int(k)) @ turned.T)
    return Found(T, np.array(own))
