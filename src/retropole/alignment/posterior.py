"""The posterior of shared cylinders: what all beams of both LiDARs say together, and its slopes.

The state holds the pose, a range offset that all retro-reflective returns of one LiDAR share, the
radius, and the axes of the poles in the target frame. Derivatives are analytic, over a step of
`State.moved`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import se3
from ..datatypes import Array, IntArray
from .likelihood import arc_likelihood, closest_approach, passed_beam_likelihood
from .observations import Beams

SHARED = 9
"""Parameters before those of the axes: pose 6, offsets 2, radius 1."""


@dataclass(frozen=True, eq=False)
class State:
    """What is estimated: pose, a range offset per LiDAR, radius, and axes in the target frame."""

    T: Array
    offsets: Array
    radius: float
    points: Array
    directions: Array

    @property
    def tangents(self) -> Array:
        """(K, 3, 2) two directions across each axis."""
        return np.linalg.svd(self.directions[:, None, :])[2][:, 1:, :].transpose(0, 2, 1)

    def moved(self, step: Array) -> State:
        """Move by a step: pose (6), offsets (2), radius, then (point 2, direction 2) per axis."""
        axes = step[SHARED:].reshape(-1, 4)
        B = self.tangents
        n = self.directions + np.einsum("kij,kj->ki", B, axes[:, 2:])
        return State(
            se3.retract(self.T, step[:6]),
            self.offsets + step[6:8],
            max(self.radius + float(step[8]), 0.0),
            self.points + np.einsum("kij,kj->ki", B, axes[:, :2]),
            n / np.linalg.norm(n, axis=1, keepdims=True),
        )


@dataclass(frozen=True, eq=False)
class Sight:
    """How beams lie to the axes: depth, miss, sine (N,); Jacobian (N, 2, P) over a step."""

    depth: Array
    miss: Array
    sine: Array
    jacobian: Array


def look(
    state: State, lidar: int, origin: Array, directions: Array, ranges: Array, own: IntArray
) -> Sight:
    """Depth g and miss m of beams at their own axis, and the Jacobian over a step of `State`.

    The radius is no part of either; `ranges` may be anything where only the miss is wanted.
    """
    q, n = state.points, state.directions
    T = state.T if lidar else np.eye(4)
    R, t = T[:3, :3], T[:3, 3]
    by = closest_approach(origin, directions, ((q - t) @ R)[own], (n @ R)[own])
    ahead = by.nearest - ranges + state.offsets[lidar]
    grad = np.stack(
        [by.sine[:, None] * by.nearest_axis + ahead[:, None] * by.sine_axis, by.miss_axis], axis=1
    )
    grad_q, grad_n = grad[:, :, :3] @ R.T, grad[:, :, 3:] @ R.T
    J = np.zeros((len(own), 2, SHARED + 4 * len(q)))
    if lidar:
        J[:, :, :3] = grad_q @ se3.hat(q - t)[own] + grad_n @ se3.hat(n)[own]
        J[:, :, 3:6] = -grad_q
    J[:, 0, 6 + lidar] = by.sine
    B = state.tangents[own]
    block = np.concatenate([grad_q @ B, grad_n @ B], axis=2)
    rows = np.arange(len(own))
    for k in range(4):
        J[rows, :, SHARED + 4 * own + k] = block[:, :, k]
    return Sight(ahead * by.sine, by.miss, by.sine, J)


@dataclass(frozen=True, eq=False)
class Fit:
    """Where a maximisation stands.

    Attributes
    ----------
    state, log_noise
        And the logarithm of the noise in depth and sideways of each LiDAR, (2, 2).
    log
        Of the posterior.
    gradient, information, safe_information
        Its slope (P,), negative curvature (P, P), and one that is positive everywhere.
    noise_step
        (2, 2) where the noise should go.
    inliers
        How many returns lie on the poles.
    rings
        Per LiDAR, sums over the returns of each beam: of the curvature times derivative of a range
        offset (R, P), of the residuals in depth over their variance (R,), and of the weights (R,).
    """

    state: State
    log_noise: Array
    log: float
    gradient: Array
    information: Array
    safe_information: Array
    noise_step: Array
    inliers: float
    rings: tuple[tuple[Array, Array, Array], ...]


@dataclass(frozen=True)
class Priors:
    """1 σ of the range offsets and of the radius, metres, and the radius itself."""

    bias: float
    radius: float
    radius_sigma: float


def evaluate(state: State, log_noise: Array, beams: Sequence[Beams], priors: Priors) -> Fit:
    """Posterior of the state under given noise, its slopes, and where the noise should go."""
    size = SHARED + 4 * len(state.points)
    x, prior = np.zeros(size), np.zeros(size)
    x[6:8], x[8] = state.offsets, state.radius - priors.radius
    prior[6:8], prior[8] = (1.0 / max(s, 1e-9) ** 2 for s in (priors.bias, priors.radius_sigma))
    log, gradient = -0.5 * float(prior @ x**2), -prior * x
    information, safe = np.diag(prior), np.diag(prior)
    noise_step, inliers, rings = np.zeros((2, 2)), 0.0, []
    for i, one in enumerate(beams):
        sigma = np.exp(log_noise[i])
        sight = look(state, i, one.origin, one.directions, one.ranges, one.pole)
        sigma_depth = np.hypot(sigma[0] * sight.sine, sigma[1] * np.sqrt(1.0 - sight.sine**2))
        sigma_miss = np.full_like(sigma_depth, sigma[1])
        arc = arc_likelihood(
            sight.depth, sight.miss, sigma_depth, sigma_miss, state.radius, one.half_width
        )
        J = np.concatenate([sight.jacobian, np.zeros((len(one.pole), 1, size))], axis=1)
        J[:, 2, 8] = 1.0
        flat = J.reshape(-1, size)
        log += float(arc.log.sum())
        gradient = gradient + arc.score.reshape(-1) @ flat
        pull = arc.information @ J
        information = information + flat.T @ pull.reshape(-1, size)
        # Far from the top the posterior is no hill everywhere; there, climb by a rounder one.
        least_curve = np.linalg.eigvalsh(arc.information)[:, 0]
        lift = np.maximum(0.02 * arc.inlier / sigma_depth**2 - least_curve, 0.0)
        safe = safe + flat.T @ (pull + lift[:, None, None] * J).reshape(-1, size)
        if len(one.passed):
            far = np.zeros(len(one.passed))
            by = look(state, i, one.origin, one.passing, far, one.passed)
            gone = passed_beam_likelihood(
                by.miss, np.full_like(far, sigma[1]), state.radius, one.passing_half_width
            )
            K = by.jacobian.copy()
            K[:, 0] = K[:, 1]
            K[:, 1] = 0.0
            K[:, 1, 8] = 1.0
            log += float(gone.log.sum())
            gradient = gradient + gone.score.reshape(-1) @ K.reshape(-1, size)
            curve = K.reshape(-1, size).T @ (gone.information @ K).reshape(-1, size)
            information = information + curve
            lift = np.maximum(-np.linalg.eigvalsh(gone.information)[:, 0], 0.0)
            rounder = (gone.information + lift[:, None, None] * np.eye(2)) @ K
            safe = safe + K.reshape(-1, size).T @ rounder.reshape(-1, size)
        # Newton in the logarithm of the noise; expectation-maximisation where that is no hill.
        slope = arc.inlier @ (arc.noise - 1.0)
        bend = arc.inlier @ (2.0 * arc.noise - arc.noise_variance)
        noise_step[i] = slope / np.maximum(bend, 0.05 * arc.inlier.sum())
        inliers += float(arc.inlier.sum())
        count = int(one.ring.max()) + 1
        sums = np.zeros((count, size))
        np.add.at(sums, one.ring, pull[:, 0] * sight.sine[:, None])
        weight = arc.inlier / sigma_depth**2
        rings.append(
            (
                sums,
                np.bincount(one.ring, arc.score[:, 0], count).astype(np.float64),
                np.bincount(one.ring, weight, count).astype(np.float64),
            )
        )
    return Fit(
        state,
        log_noise,
        log,
        gradient,
        information,
        safe,
        np.clip(noise_step, -1.0, 0.5),
        inliers,
        tuple(rings),
    )
