"""Pose from both LiDARs' returns on shared cylinders of known radius.

A line fitted to the returns on a pole runs in front of its axis, for each LiDAR on another side
(`beams.expected_line_error`). Here the axes of the poles and the pose are estimated together, and
every return is held against the place where its own beam can have met the pole.

What a return says. In the plane across the axis, seen from the LiDAR, a return lies a depth g in
front of the axis and m beside it. Without noise ``g = √(r² − m²)`` with ``|m| ≤ r``. With noise σ_g
in depth and σ_m sideways, and beams evenly spaced across the pole,

    p(g, m) = 1/2r ∫_{−r}^{r} N(g; √(r² − x²), σ_g²) N(m; x, σ_m²) dx,

the facing half of the circle, blurred. For σ_m → 0 its logarithm is the squared difference of the
measured range from the range at which the beam meets the pole, and a return whose beam would miss
the pole is paid for smoothly in σ_m. For σ_m = σ_g it weighs errors sideways as those in depth.
Both are estimated for each LiDAR, so that the returns say which of the two they are.

Where other software moved a cloud, the beams' origin is not where it seems, and the facing side is
not known. Then ``p`` is the whole circle, blurred. Both are densities of the same returns, so the
larger likelihood decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import se3
from .beams import arc_likelihood, pass_axis
from .datatypes import Array, IntArray
from .errors import Refusal

RETRO_BIAS = 0.005
"""1 σ of a range error that all retro-reflective returns of one LiDAR share, metres."""

MIN_NOISE, MIN_SIDEWAYS = 2e-4, 4e-4
"""Least noise of a return, in depth and sideways, metres."""

MAX_NOISE = 0.05
"""Most noise of a return that still says anything of a pole, metres."""

SUSPECT_SIDEWAYS = 0.002
"""Noise sideways from which the beams' origin is held in doubt, metres."""

MAX_TURN, MAX_SHIFT = 0.1, 0.5
"""1 σ, rad and m, from which the poles are said to leave the pose free."""

MIN_POINTS = 3
MAX_ITERATIONS = 60
STEP_TOLERANCE = 0.02
"""Step from which the noise is kept and only the geometry is polished, in units of each
parameter's own 1 σ."""


@dataclass(frozen=True, eq=False)
class State:
    """What is estimated: the pose, the axes in the target frame, a range offset per LiDAR."""

    T: Array
    points: Array
    directions: Array
    offsets: Array

    @property
    def tangents(self) -> Array:
        """(K, 3, 2) two directions across each axis."""
        return np.linalg.svd(self.directions[:, None, :])[2][:, 1:, :].transpose(0, 2, 1)

    def moved(self, step: Array) -> State:
        """Move by a step: pose (6), then offsets (2), then (point 2, direction 2) per axis."""
        axes = step[8:].reshape(-1, 4)
        B = self.tangents
        n = self.directions + np.einsum("kij,kj->ki", B, axes[:, 2:])
        return State(
            se3.retract(self.T, step[:6]),
            self.points + np.einsum("kij,kj->ki", B, axes[:, :2]),
            n / np.linalg.norm(n, axis=1, keepdims=True),
            self.offsets + step[6:8],
        )


@dataclass(frozen=True, eq=False)
class Returns:
    """Returns of one LiDAR, on all poles, as beams in its own frame."""

    lidar: int
    origin: Array
    directions: Array
    ranges: Array
    pole: IntArray
    order: IntArray

    @staticmethod
    def of(lidar: int, points: Sequence[Array], origin: Array) -> Returns:
        """Turn points, one array per pole, into beams from an origin."""
        ray = np.concatenate(list(points)) - origin
        ranges = np.linalg.norm(ray, axis=1)
        pole = np.repeat(np.arange(len(points)), [len(p) for p in points])
        order = np.lexsort(
            (np.arctan2(ray[:, 1], ray[:, 0]), np.round(ray[:, 2] / ranges, 3), pole)
        )
        return Returns(lidar, np.asarray(origin), ray / ranges[:, None], ranges, pole, order)


@dataclass(frozen=True, eq=False)
class Sight:
    """How a LiDAR's returns lie to the axes: depth, miss, sine (N,), and their Jacobian."""

    depth: Array
    miss: Array
    sine: Array
    jacobian: Array


def look(state: State, returns: Returns) -> Sight:
    """Depth g and miss m of returns, and their Jacobian (N, 2, P) over a step of `State`."""
    q, n = state.points, state.directions
    T = state.T if returns.lidar else np.eye(4)
    R, t = T[:3, :3], T[:3, 3]
    own = returns.pole
    by = pass_axis(returns.origin, returns.directions, ((q - t) @ R)[own], (n @ R)[own])
    ahead = by.nearest - returns.ranges + state.offsets[returns.lidar]
    grad = np.stack(
        [by.sine[:, None] * by.nearest_axis + ahead[:, None] * by.sine_axis, by.miss_axis], axis=1
    )
    grad_q, grad_n = grad[:, :, :3] @ R.T, grad[:, :, 3:] @ R.T
    rows = np.arange(len(own))
    J = np.zeros((len(own), 2, 8 + 4 * len(q)))
    if returns.lidar:
        J[:, :, :3] = grad_q @ se3.hat(q - t)[own] + grad_n @ se3.hat(n)[own]
        J[:, :, 3:6] = -grad_q
    J[:, 0, 6 + returns.lidar] = by.sine
    B = state.tangents[own]
    block = np.concatenate([grad_q @ B, grad_n @ B], axis=2)
    for k in range(4):
        J[rows, :, 8 + 4 * own + k] = block[:, :, k]
    return Sight(ahead * by.sine, by.miss, by.sine, J)


@dataclass(frozen=True, eq=False)
class BeamAlignment:
    """Pose from shared cylinders.

    Attributes
    ----------
    T_target_source
        (4, 4) pose, target from source.
    covariance
        (6, 6) over ``[φ, δ]``, rad and m, target axes; the axes and the range offsets are
        marginalised.
    axis_points, axis_directions
        (K, 3) a point on each pole's axis and its unit direction, target frame.
    rms
        Root mean square noise of the returns of both LiDARs along the beam, metres.
    sigma_target, sigma_source
        1 σ of a return along the beam, for each LiDAR, metres.
    points
        How many returns were used.
    sideways
        1 σ of a return across the beam, for the target and the source, metres.
    facing
        Whether the returns of the target, of the source were held against the side that faces the
        beams' origin; if not, that origin does not explain them.
    correlation
        Of the noise of neighbouring returns, 0 to 1; the covariance counts it.
    """

    T_target_source: Array
    covariance: Array
    axis_points: Array
    axis_directions: Array
    rms: float
    sigma_target: float
    sigma_source: float
    points: int
    sideways: tuple[float, float]
    facing: tuple[bool, bool]
    correlation: float


@dataclass(frozen=True, eq=False)
class _Fit:
    """Where a maximisation stands: state, log of (depth, sideways) noise (2, 2), and slopes."""

    state: State
    log_noise: Array
    log: float
    gradient: Array
    information: Array
    safe_information: Array
    log_noise_step: Array
    correlation: float
    inliers: float


def _evaluate(
    state: State,
    log_noise: Array,
    returns: Sequence[Returns],
    radius: float,
    facing: tuple[bool, bool],
    bias: float,
) -> _Fit:
    """Posterior of the state under given noise, its slopes, and where the noise should go."""
    size = 8 + 4 * len(state.points)
    prior, x = np.zeros(size), np.zeros(size)
    prior[6:8], x[6:8] = 1.0 / max(bias, 1e-9) ** 2, state.offsets
    log, gradient = -0.5 * float(prior @ x**2), -prior * x
    information, safe = np.diag(prior), np.diag(prior)
    noise_step, inliers = np.zeros((2, 2)), 0.0
    beside, beside_square = 0.0, 0.0
    for i, one in enumerate(returns):
        sigma = np.exp(log_noise[i])
        sight = look(state, one)
        share = (sigma[0] * sight.sine) ** 2
        sigma_depth = np.sqrt(share + sigma[1] ** 2 * (1.0 - sight.sine**2))
        sigma_miss = np.full_like(sigma_depth, sigma[1])
        arc = arc_likelihood(sight.depth, sight.miss, sigma_depth, sigma_miss, radius, facing[i])
        J = sight.jacobian
        flat = J.reshape(-1, size)
        log += float(arc.log.sum())
        gradient = gradient + arc.score.reshape(-1) @ flat
        information = information + flat.T @ (arc.information @ J).reshape(-1, size)
        # A blurred circle is no hill everywhere; where it is not, climb by a rounder one.
        a, b = arc.information[:, 0, 0], arc.information[:, 1, 1]
        least = 0.5 * (a + b) - np.hypot(0.5 * (a - b), arc.information[:, 0, 1])
        lift = np.maximum(0.02 * arc.inlier / sigma_depth**2 - least, 0.0)
        lifted = arc.information + lift[:, None, None] * np.eye(2)
        safe = safe + flat.T @ (lifted @ J).reshape(-1, size)
        # Newton in the logarithm of the noise; expectation-maximisation where that is no hill.
        slope = arc.inlier @ (arc.noise - 1.0)
        curve = arc.inlier @ (2.0 * arc.noise - arc.noise_variance)
        step = slope / np.maximum(curve, 0.05 * arc.inlier.sum())
        noise_step[i] = step if facing[i] else 0.6 * step.mean()
        inliers += float(arc.inlier.sum())
        order = one.order
        neighbour = one.pole[order][1:] == one.pole[order][:-1]
        depth = (arc.score[:, 0] * sigma_depth)[order]
        beside += float(np.sum((depth[1:] * depth[:-1])[neighbour]))
        beside_square += float(np.sum((depth[1:] ** 2)[neighbour]))
    return _Fit(
        state,
        log_noise,
        log,
        gradient,
        information,
        safe,
        np.clip(noise_step, -1.0, 0.5),
        beside / max(beside_square, 1e-12),
        inliers,
    )


def _maximise(
    state: State,
    log_noise: Array,
    returns: Sequence[Returns],
    radius: float,
    facing: tuple[bool, bool],
    bias: float,
    iterations: int = MAX_ITERATIONS,
) -> _Fit:
    """Climb to the nearest maximum of the posterior, noise and all (Levenberg–Marquardt)."""
    # A whole circle is summed at fixed nodes, which noise below a tenth of it would fall between.
    floor = np.log(
        [
            [MIN_NOISE, MIN_SIDEWAYS] if side else [max(MIN_NOISE, 0.1 * radius)] * 2
            for side in facing
        ]
    )
    now = _evaluate(state, np.maximum(log_noise, floor), returns, radius, facing, bias)
    damping, polish = 1e-4, 0
    for _ in range(iterations):
        scale = np.sqrt(np.diag(now.safe_information)) + 1e-12
        curve = now.safe_information / np.outer(scale, scale) + damping * np.eye(len(scale))
        step = np.linalg.solve(curve, now.gradient / scale)
        noise = now.log_noise
        if not polish:
            noise = np.maximum(noise + now.log_noise_step / (1.0 + damping), floor)
            # Returns sharp in depth and blurred sideways would fall between the nodes.
            noise[:, 0] = np.maximum(noise[:, 0], noise[:, 1] - np.log(2.0))
        new = _evaluate(now.state.moved(step / scale), noise, returns, radius, facing, bias)
        gain = new.log - now.log
        if gain >= -1e-9 * abs(now.log):
            now, damping = new, max(damping / 10.0, 1e-9)
            small = np.abs(step).max() < STEP_TOLERANCE and gain < 0.01
            polish = polish + 1 if small or polish else 0
        else:
            damping *= 10.0
        if polish > 1 or damping > 1e6:
            break
    return now


def align_beams(
    target_points: Sequence[Array],
    source_points: Sequence[Array],
    T_start: Array,
    *,
    radius: float,
    origin_target: Array,
    origin_source: Array,
    bias: float = RETRO_BIAS,
) -> BeamAlignment:
    """Align matched poles by what both LiDARs' beams can have met.

    Parameters
    ----------
    target_points, source_points
        (N_k, 3) returns on each pole in the frame of their LiDAR, paired by their order.
    T_start
        (4, 4) the chosen hypothesis, target from source.
    radius
        Of the poles, metres.
    origin_target, origin_source
        (3,) where the beams start, in the frame of their LiDAR.
    bias
        1 σ of the range error that all returns of one LiDAR share, metres.

    Raises
    ------
    Refusal
        ``too_few_points`` with less than two poles or `MIN_POINTS` returns on one;
        ``degenerate_poles`` where the poles leave the pose all but free in some direction;
        ``poor_fit`` where most returns lie on no common pole.
    """
    counts = [len(p) for points in (target_points, source_points) for p in points]
    if (
        len(target_points) != len(source_points)
        or len(target_points) < 2
        or min(counts) < MIN_POINTS
    ):
        raise Refusal(
            "too_few_points",
            f"{len(target_points)} and {len(source_points)} poles with {min(counts, default=0)} "
            f"returns on the poorest: two poles with {MIN_POINTS} each are the least; bring the "
            "poles nearer or add frames",
            {"poles": len(target_points), "returns": min(counts, default=0)},
        )
    returns = (
        Returns.of(0, target_points, origin_target),
        Returns.of(1, source_points, origin_source),
    )
    state = _start(target_points, T_start, radius, origin_target)
    spread = [look(state, one) for one in returns]
    start = np.log(
        [
            [np.clip(np.sqrt(np.mean((s.depth - radius) ** 2 + s.miss**2)), 0.01, 0.5)] * 2
            for s in spread
        ]
    )
    facing = (True, True)
    fit = _maximise(state, start, returns, radius, facing, bias)
    for i in (0, 1):
        if radius > 0 and np.exp(fit.log_noise[i, 1]) > SUSPECT_SIDEWAYS:
            other = (False, facing[1]) if i == 0 else (facing[0], False)
            noise = fit.log_noise.copy()
            noise[i] = noise[i].mean()
            around = _maximise(fit.state, noise, returns, radius, other, bias, 3)
            if around.log > fit.log - 40.0:
                around = _maximise(around.state, around.log_noise, returns, radius, other, bias)
            if around.log > fit.log:
                fit, facing = around, other
    return _answer(fit, facing, sum(counts), returns)


def _start(points: Sequence[Array], T_start: Array, radius: float, origin: Array) -> State:
    """Start from lines fitted to the target's returns, moved back from its facing side."""
    centres, directions = [], []
    for xyz in points:
        centre = xyz.mean(axis=0)
        n = np.linalg.svd(xyz - centre, full_matrices=False)[2][0]
        away = centre - origin
        away = away - (away @ n) * n
        centres.append(centre + np.pi / 4 * radius * away / max(np.linalg.norm(away), 1e-9))
        directions.append(n)
    return State(np.asarray(T_start), np.array(centres), np.array(directions), np.zeros(2))


def _answer(
    fit: _Fit, facing: tuple[bool, bool], count: int, returns: Sequence[Returns]
) -> BeamAlignment:
    """Check the fit, and marginalise its covariance."""
    sigma = np.exp(fit.log_noise)
    if not np.isfinite(fit.log) or sigma[:, 0].max() > MAX_NOISE or fit.inliers < 0.5 * count:
        raise Refusal(
            "poor_fit",
            f"the returns do not lie on shared poles: noise {100 * sigma[:, 0].max():.1f} cm, "
            f"{fit.inliers:.0f} of {count} returns fit; check the radius and what was taken for a "
            "pole",
            {"noise_m": float(sigma[:, 0].max()), "inliers": fit.inliers, "points": count},
        )
    scale = np.sqrt(np.diag(fit.safe_information)) + 1e-12
    eigenvalue, vector = np.linalg.eigh(fit.information / np.outer(scale, scale))
    if eigenvalue[0] < 1e-9:
        eigenvalue, vector = np.linalg.eigh(fit.safe_information / np.outer(scale, scale))
    covariance = (vector / np.maximum(eigenvalue, 1e-15)) @ vector.T / np.outer(scale, scale)
    covariance = covariance[:6, :6]
    # Neighbours that err together carry less than their number says.
    rho = fit.correlation if fit.correlation > 2.5 / np.sqrt(count) else 0.0
    rho = min(rho, 0.9)
    covariance = covariance * (1 + rho) / (1 - rho)
    turn, shift = (
        float(np.sqrt(np.linalg.eigvalsh(covariance[i, i])[-1])) for i in (slice(3), slice(3, 6))
    )
    if not (turn < MAX_TURN and shift < MAX_SHIFT):
        raise Refusal(
            "degenerate_poles",
            f"the poles leave the pose free by {np.degrees(turn):.1f}° and {shift:.2f} m (1 σ); "
            "lean one pole by 15° or more against the other",
            {"rotation_sigma_rad": turn, "translation_sigma_m": shift},
        )
    return BeamAlignment(
        fit.state.T,
        covariance,
        fit.state.points,
        fit.state.directions,
        float(np.sqrt(np.mean(sigma[:, 0] ** 2))),
        float(sigma[0, 0]),
        float(sigma[1, 0]),
        count,
        (float(sigma[0, 1]), float(sigma[1, 1])),
        facing,
        rho,
    )
