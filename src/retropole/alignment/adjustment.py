"""Pose from both LiDARs' returns on shared cylinders.

A line fitted to the returns on a pole runs in front of its axis, for each LiDAR on another side.
Here the axes of the poles and the pose are estimated together, with a range offset that all
retro-reflective returns of one LiDAR share, and the radius where it is not known for sure. Every
return is held against the place where its own beam can have met the pole, and every beam that
passed close by against the space beside it (`beams`). The noise of the returns, in depth and
sideways, is estimated with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..datatypes import Array, PoseEstimate
from ..errors import Refusal
from .observations import Beams
from .posterior import SHARED, Fit, Priors, State, evaluate, look

RETRO_BIAS = 0.003
"""1 σ of a range error that all retro-reflective returns of one LiDAR share, metres."""

RING_BIAS, RING_BIAS_WEIGHT = 0.0025, 8.0
"""1 σ of a range error that all returns of one beam share, metres: what is assumed, and the number
of beams that it counts for beside those of the poles themselves."""

MIN_NOISE = 2e-5
"""Least noise of a return, metres."""

MIN_SIDEWAYS = 1 / 5
"""Least noise sideways, of that in depth. With less, the edges of the pole are walls: the posterior
is no parabola, its curvature promises too much, and the climb takes long."""

START_NOISE = (0.005, 0.5)
"""Bounds of the noise that the search starts from, metres."""

MAX_NOISE = 0.05
"""Most noise of a return that still says anything of a pole, metres."""

MAX_ROTATION_SIGMA, MAX_TRANSLATION_SIGMA = 0.1, 0.5
"""1 σ, rad and m, from which the poles are said to leave the pose free."""

MIN_RETURNS_PER_POLE = 3
MAX_ITERATIONS = 60
STEP_TOLERANCE = 0.02
"""Step from which the noise is kept and only the geometry is polished, in units of each
parameter's own 1 σ."""


def maximise(state: State, log_noise: Array, beams: Sequence[Beams], priors: Priors) -> Fit:
    """Climb to the nearest maximum of the posterior, noise and all (Levenberg–Marquardt)."""
    floor = np.log(MIN_NOISE)
    now = evaluate(state, np.maximum(log_noise, floor), beams, priors)
    damping, polish = 1e-4, 0
    for _ in range(MAX_ITERATIONS):
        scale = np.sqrt(np.diag(now.safe_information)) + 1e-12
        curve = now.safe_information / np.outer(scale, scale) + damping * np.eye(len(scale))
        step = np.linalg.solve(curve, now.gradient / scale)
        noise = now.log_noise
        if not polish:
            noise = np.maximum(noise + now.noise_step / (1.0 + damping), floor)
            # Returns sharp in depth and blurred sideways would fall between the nodes.
            noise[:, 0] = np.maximum(noise[:, 0], noise[:, 1] - np.log(2.0))
            noise[:, 1] = np.maximum(noise[:, 1], noise[:, 0] + np.log(MIN_SIDEWAYS))
        new = evaluate(now.state.moved(step / scale), noise, beams, priors)
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


@dataclass(frozen=True, eq=False)
class BeamAlignment:
    """Pose from shared cylinders.

    Attributes
    ----------
    stage
        Pose, its covariance with all else marginalised, and root mean square of the noise of both
        LiDARs along the beam.
    covariance_sure
        (6, 6) the covariance were the radius and the range offsets known: what the returns alone
        leave open.
    axis_points, axis_directions
        (K, 3) a point on each pole's axis and its unit direction, target frame.
    radius, radius_sigma
        Metres.
    noise
        1 σ of a return along the beam, for the target and the source, metres.
    sideways
        The same across the beam.
    """

    stage: PoseEstimate
    covariance_sure: Array
    axis_points: Array
    axis_directions: Array
    radius: float
    radius_sigma: float
    noise: tuple[float, float]
    sideways: tuple[float, float]


def align_beams(
    target: Beams,
    source: Beams,
    T_start: Array,
    *,
    radius: float,
    radius_sigma: float = 0.0,
    bias: float = RETRO_BIAS,
) -> BeamAlignment:
    """Align matched poles by what both LiDARs' beams can have met.

    Parameters
    ----------
    target, source
        Beams of the two LiDARs; the poles are numbered alike.
    T_start
        (4, 4) the chosen hypothesis, target from source.
    radius, radius_sigma
        Of the poles, and its 1 σ, metres: with 0 it is known.
    bias
        1 σ of the range error that all returns of one LiDAR share, metres.

    Raises
    ------
    Refusal
        ``too_few_points`` with less than two poles or `MIN_RETURNS_PER_POLE` returns on one;
        ``degenerate_poles`` where the poles leave the pose all but free in some direction;
        ``poor_fit`` where most returns lie on no common pole.
    """
    counts = np.concatenate([np.bincount(one.pole) for one in (target, source)])
    poles = int(target.pole.max()) + 1
    if poles < 2 or counts.min() < MIN_RETURNS_PER_POLE:
        raise Refusal(
            "too_few_points",
            f"{poles} poles with {counts.min()} returns on the poorest: two poles with "
            f"{MIN_RETURNS_PER_POLE} each are the least; bring the poles nearer or add frames",
            {"poles": poles, "returns": int(counts.min())},
        )
    priors = Priors(bias, radius, radius_sigma)
    state, noise = _start(target, source, T_start, radius)
    fit = maximise(state, noise, (target, source), priors)
    sigma = np.exp(fit.log_noise)
    total = int(counts.sum())
    if not np.isfinite(fit.log) or sigma[:, 0].max() > MAX_NOISE or fit.inliers < 0.5 * total:
        raise Refusal(
            "poor_fit",
            f"the returns do not lie on shared poles: noise {100 * sigma[:, 0].max():.1f} cm, "
            f"{fit.inliers:.0f} of {total} returns fit; check the radius and what was taken for a "
            "pole",
            {"noise_m": float(sigma[:, 0].max()), "inliers": fit.inliers, "points": total},
        )
    covariance = _covariance(fit)
    sure = _covariance(fit, known=slice(6, SHARED))
    turn, shift = (
        float(np.sqrt(np.linalg.eigvalsh(covariance[i, i])[-1])) for i in (slice(3), slice(3, 6))
    )
    if not (turn < MAX_ROTATION_SIGMA and shift < MAX_TRANSLATION_SIGMA):
        raise Refusal(
            "degenerate_poles",
            f"the poles leave the pose free by {np.degrees(turn):.1f}° and {shift:.2f} m (1 σ); "
            "lean one pole by 15° or more against the other",
            {"rotation_sigma_rad": turn, "translation_sigma_m": shift},
        )
    return BeamAlignment(
        PoseEstimate(fit.state.T, covariance[:6, :6], float(np.sqrt(np.mean(sigma[:, 0] ** 2)))),
        sure[:6, :6],
        fit.state.points,
        fit.state.directions,
        fit.state.radius,
        float(np.sqrt(covariance[8, 8])),
        (float(sigma[0, 0]), float(sigma[1, 0])),
        (float(sigma[0, 1]), float(sigma[1, 1])),
    )


def _start(target: Beams, source: Beams, T_start: Array, radius: float) -> tuple[State, Array]:
    """Start from lines fitted to the target's returns, moved back from its facing side."""
    centres, directions = [], []
    returns = target.origin + target.ranges[:, None] * target.directions
    for k in range(int(target.pole.max()) + 1):
        xyz = returns[target.pole == k]
        centre = xyz.mean(axis=0)
        n = np.linalg.svd(xyz - centre, full_matrices=False)[2][0]
        away = centre - target.origin
        away = away - (away @ n) * n
        centres.append(centre + np.pi / 4 * radius * away / max(np.linalg.norm(away), 1e-9))
        directions.append(n)
    state = State(np.asarray(T_start), np.zeros(2), radius, np.array(centres), np.array(directions))
    noise = np.zeros((2, 2))
    for i, one in enumerate((target, source)):
        sight = look(state, i, one.origin, one.directions, one.ranges, one.pole)
        spread = np.sqrt(np.mean((sight.depth - radius) ** 2 + sight.miss**2))
        noise[i] = np.log(np.clip(spread, *START_NOISE))
    return state, noise


def _covariance(fit: Fit, known: slice | None = None) -> Array:
    """Covariance of all parameters, (P, P), with the range errors of single beams counted in.

    ``I⁻¹ (I + τ² Σ_b c_b c_bᵀ) I⁻¹``: c_b is what a range offset of beam b does to the slope. τ² is
    estimated from the mean residuals of the beams, with `RING_BIAS` for a start.
    """
    information, safe = fit.information, fit.safe_information
    keep = np.ones(len(information), dtype=bool)
    if known is not None:
        keep[known] = False
    scale = np.sqrt(np.diag(safe)) + 1e-12
    chosen = np.ix_(keep, keep)
    eigenvalue, vector = np.linalg.eigh((information / np.outer(scale, scale))[chosen])
    if eigenvalue[0] < 1e-9:
        eigenvalue, vector = np.linalg.eigh((safe / np.outer(scale, scale))[chosen])
    inverse = np.zeros_like(information)
    inverse[chosen] = (vector / np.maximum(eigenvalue, 1e-15)) @ vector.T
    inverse /= np.outer(scale, scale)
    sums = np.concatenate([part[0] for part in fit.rings])
    slope = np.concatenate([part[1] for part in fit.rings])
    weight = np.concatenate([part[2] for part in fit.rings])
    seen = weight > 0
    # The mean residual of beam b has variance 1/weight_b + τ².
    excess = float(np.sum((slope[seen] / weight[seen]) ** 2 - 1.0 / weight[seen]))
    assumed = RING_BIAS_WEIGHT * RING_BIAS**2
    tau = max((assumed + excess) / (RING_BIAS_WEIGHT + int(np.count_nonzero(seen))), 0.0)
    spread = inverse @ sums.T
    return np.asarray(inverse + tau * spread @ spread.T)
