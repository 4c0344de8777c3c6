"""The posterior of shared cylinders: that of all beams of both LiDARs, and its gradient.

The state is the pose, a range offset that all retro-reflective returns of one LiDAR share,
the radius, and the axes of the poles in the target frame. Derivatives are analytic, over a step of
`State.moved`. The cost is the negative logarithm of the posterior.

`JointState` is that of a site: all its poses, and control points.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np

from ..base import se3
from ..base.datatypes import Array, IntArray
from .likelihood import arc_likelihood, closest_approach, passed_beam_likelihood
from .observations import Beams
from .unknowns import POSE


@dataclass(frozen=True, eq=False)
class JointState:
    """What is estimated from the poles.

    Attributes
    ----------
    T
        (L, 4, 4) site from LiDAR, about its beam origin.
    offsets
        (L,) range offset of all retro-reflective returns of each, metres.
    radius
        Of the poles, metres.
    points, directions
        (K, 3) the axes in the frame of the site.
    control
        (Q, 3) control points there.
    """

    T: Array
    offsets: Array
    radius: float
    points: Array
    directions: Array
    control: Array

    @property
    def size(self) -> int:
        """How many parameters a step has."""
        return self.first_axis + 4 * len(self.points) + 3 * len(self.control)

    @property
    def first_axis(self) -> int:
        """Where the parameters of the axes start: after poses, offsets and the radius."""
        return (POSE + 1) * len(self.T) + 1

    def axes(self, own: IntArray) -> IntArray:
        """(4 N,) indices of the parameters of some axes."""
        return np.asarray((self.first_axis + 4 * own[:, None] + np.arange(4)).reshape(-1))

    def control_points(self) -> slice:
        """Indices of the parameters of the control points."""
        return slice(self.first_axis + 4 * len(self.points), self.size)

    def of(self, lidar: int, own: IntArray) -> State:
        """What one LiDAR sees of some axes, as the source of a pair whose target is the site."""
        return State(
            self.T[lidar],
            np.array([0.0, self.offsets[lidar]]),
            self.radius,
            self.points[own],
            self.directions[own],
        )

    def moved(self, step: Array) -> JointState:
        """Move by a step: poses (6 each), offsets, radius, axes (4 each), control points (3)."""
        count = len(self.T)
        steps = step[: POSE * count].reshape(-1, POSE)
        whole = State(np.eye(4), np.zeros(2), self.radius, self.points, self.directions)
        axes = step[self.first_axis : self.first_axis + 4 * len(self.points)]
        moved = whole.moved(np.r_[np.zeros(8), step[self.first_axis - 1], axes])
        return JointState(
            np.stack([se3.retract(T, one) for T, one in zip(self.T, steps, strict=True)]),
            self.offsets + step[POSE * count : (POSE + 1) * count],
            moved.radius,
            moved.points,
            moved.directions,
            self.control + step[self.control_points()].reshape(-1, 3),
        )


SHARED = 9
"""Parameters before those of the axes: pose 6, offsets 2, radius 1."""

RETURN_CURVATURE = 0.02
"""Least curvature of the cost of a return that a step is taken with, in units of its information
``1/σ²``: beyond the inflection of the likelihood the true one is negative. It steers the steps
only, the covariance takes the true curvature. The same for the logarithm of the noise, per return
that lies on a pole."""

NOISE_STEP = (-1.0, 0.5)
"""Bounds of a step of the logarithm of the noise: at most e times less, 1.6 times more."""


@dataclass(frozen=True, eq=False)
class State:
    """What is estimated: pose, a range offset per LiDAR, radius, and axes in the target frame."""

    T: Array
    offsets: Array
    radius: float
    points: Array
    directions: Array

    @cached_property
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
class BeamGeometry:
    """How beams lie to their axes.

    Attributes
    ----------
    depth, lateral_offset, sine
        (N,) each: how far the return lies in front of the axis and to its side, metres, and the
        sine of the angle between beam and axis.
    jacobian
        (N, 2, P) derivative of depth and lateral offset by a step of `State.moved`.
    """

    depth: Array
    lateral_offset: Array
    sine: Array
    jacobian: Array

    def part(self, some: slice) -> BeamGeometry:
        """Give a part of the beams."""
        fields = self.depth, self.lateral_offset, self.sine, self.jacobian
        return BeamGeometry(*(field[some] for field in fields))


def beam_geometry(
    state: State, lidar: int, origin: Array, directions: Array, ranges: Array, own: IntArray
) -> BeamGeometry:
    """Depth and lateral offset of beams at their axis, and the Jacobian over a step of `State`.

    The radius is not included in either; `ranges` may be anything where only the lateral offset
    matters.

    Parameters
    ----------
    state
        Pose and axes.
    lidar
        0 for the target, 1 for the source: whether the pose comes in, and which range offset.
    origin, directions, ranges
        (3,), (N, 3) and (N,): the beams in the frame of the LiDAR, metres.
    own
        (N,) the pole of each beam.
    """
    q, n = state.points, state.directions
    T = state.T if lidar else np.eye(4)
    R, t = T[:3, :3], T[:3, 3]
    by = closest_approach(origin, directions, ((q - t) @ R)[own], (n @ R)[own])
    ahead = by.ranges - ranges + state.offsets[lidar]
    grad = np.stack(
        [
            by.sine[:, None] * by.ranges_by_axis + ahead[:, None] * by.sine_by_axis,
            by.lateral_offset_by_axis,
        ],
        axis=1,
    )
    grad_q, grad_n = grad[:, :, :3] @ R.T, grad[:, :, 3:] @ R.T
    J = np.zeros((len(own), 2, SHARED + 4 * len(q)))
    if lidar:
        J[:, :, :3] = grad_q @ se3.hat(q - t)[own] + grad_n @ se3.hat(n)[own]
        J[:, :, 3:6] = -grad_q
    J[:, 0, 6 + lidar] = by.sine
    B = state.tangents[own]
    block = np.concatenate([grad_q @ B, grad_n @ B], axis=2)
    index = np.arange(len(own))
    for k in range(4):
        J[index, :, SHARED + 4 * own + k] = block[:, :, k]
    return BeamGeometry(ahead * by.sine, by.lateral_offset, by.sine, J)


def lidar_geometry(state: State, lidar: int, beams: Beams) -> tuple[BeamGeometry, BeamGeometry]:
    """Geometry of a LiDAR's beams that hit poles, and of those that passed next to them."""
    # All at once: the arrays are small, and calls cost as much as what they compute.
    any_range = np.zeros(len(beams.passed_pole))
    both = beam_geometry(
        state,
        lidar,
        beams.origin,
        np.concatenate([beams.directions, beams.passed_directions]),
        np.concatenate([beams.ranges, any_range]),
        np.concatenate([beams.pole, beams.passed_pole]),
    )
    on_pole, passed_by = slice(0, len(beams.pole)), slice(len(beams.pole), None)
    return both.part(on_pole), both.part(passed_by)


@dataclass(frozen=True, eq=False)
class Terms:
    """What beams add to the logarithm of the posterior, its slope (P,), and its curvature (P, P):
    the true one, and one without negative eigenvalues.
    """

    log: float
    score: Array
    information: Array
    damped: Array


class Movable(Protocol):
    """A state that a step moves."""

    def moved(self: S, step: Array) -> S:
        """Move by a step (P,)."""


S = TypeVar("S", bound=Movable)


@dataclass(frozen=True, eq=False)
class Posterior(Generic[S]):
    """The posterior at a state.

    Attributes
    ----------
    state, log_noise
        Where, and the logarithm of the noise in depth and sideways of each LiDAR, (L, 2).
    cost
        Negative logarithm of the posterior.
    gradient, information, curvature
        Of the cost: its derivative (P,), its second derivative (P, P), and one that is positive
        definite everywhere.
    noise_step
        (L, 2) where the logarithm of the noise should go.
    inliers
        How many returns lie on the poles.
    """

    state: S
    log_noise: Array
    cost: float
    gradient: Array
    information: Array
    curvature: Array
    noise_step: Array
    inliers: float


@dataclass(frozen=True, eq=False)
class OnPoles:
    """What the returns on the poles show: of the state, and of the log-noise (2,)."""

    terms: Terms
    noise_step: Array
    inliers: float


def evaluate_lidar(state: State, lidar: int, beams: Beams, noise: Array) -> tuple[Terms, OnPoles]:
    """Evaluate the likelihood of the beams of one LiDAR, under a noise (2,) in depth and sideways,
    metres.

    Returns
    -------
    Terms, OnPoles
        Of all its beams; and what its returns on the poles show of the noise.
    """
    seen, passed_by = lidar_geometry(state, lidar, beams)
    on_poles = _on_poles(state, seen, beams, noise)
    on, by = on_poles.terms, _passed(state, passed_by, beams, noise)
    joint = Terms(
        on.log + by.log,
        on.score + by.score,
        on.information + by.information,
        on.damped + by.damped,
    )
    return joint, on_poles


def _on_poles(state: State, seen: BeamGeometry, beams: Beams, noise: Array) -> OnPoles:
    """Evaluate the returns on the poles."""
    size = SHARED + 4 * len(state.points)
    sigma_depth = np.hypot(noise[0] * seen.sine, noise[1] * np.sqrt(1.0 - seen.sine**2))
    sigma_lateral = np.full_like(sigma_depth, noise[1])
    arc = arc_likelihood(
        seen.depth,
        seen.lateral_offset,
        sigma_depth,
        sigma_lateral,
        state.radius,
        beams.half_width,
        beams.passed_share,
    )
    J = np.concatenate([seen.jacobian, np.zeros((len(beams.pole), 1, size))], axis=1)
    J[:, 2, 8] = 1.0
    least = RETURN_CURVATURE * arc.inlier / sigma_depth**2
    terms = _terms(arc.log, arc.score, arc.information, J, least)
    # Newton in the logarithm of the noise; expectation-maximisation where that is not concave.
    gradient = arc.inlier @ (arc.noise - 1.0)
    curvature = arc.inlier @ (2.0 * arc.noise - arc.noise_variance)
    inliers = max(float(arc.inlier.sum()), 1e-300)
    return OnPoles(terms, gradient / np.maximum(curvature, RETURN_CURVATURE * inliers), inliers)


def _passed(state: State, seen: BeamGeometry, beams: Beams, noise: Array) -> Terms:
    """What the beams that passed next to the poles show."""
    size = SHARED + 4 * len(state.points)
    if not len(beams.passed_pole):
        nothing = np.zeros((size, size))
        return Terms(0.0, np.zeros(size), nothing, nothing)
    zero = np.zeros(len(beams.passed_pole))
    free = passed_beam_likelihood(
        seen.lateral_offset,
        np.full_like(zero, noise[1]),
        state.radius,
        beams.passed_half_width,
    )
    J = np.zeros_like(seen.jacobian)
    J[:, 0] = seen.jacobian[:, 1]
    J[:, 1, 8] = 1.0
    return _terms(free.log, free.score, free.information, J, zero)


def _terms(log: Array, score: Array, information: Array, J: Array, least: Array) -> Terms:
    """Sum terms of beams; no eigenvalue of their damped information is below the least (N,)."""
    size = J.shape[2]
    flat = J.reshape(-1, size)
    total = flat.T @ (information @ J).reshape(-1, size)
    damping = damping_of(information, least)
    raised = np.flatnonzero(damping)
    rows = (np.sqrt(damping[raised])[:, None, None] * J[raised]).reshape(-1, size)
    return Terms(float(log.sum()), score.reshape(-1) @ flat, total, total + rows.T @ rows)


def damping_of(information: Array, least: Array) -> Array:
    """By how much (N,) to raise all eigenvalues of each (N, C, C), so that none is below the least
    (N,).
    """
    if information.shape[1] == 2:
        a, b, c = information[:, 0, 0], information[:, 0, 1], information[:, 1, 1]
        lowest = np.asarray(0.5 * (a + c) - np.hypot(0.5 * (a - c), b))
    else:
        lowest = np.asarray(np.linalg.eigvalsh(information)[:, 0])
    return np.asarray(np.maximum(least - lowest, 0.0))
