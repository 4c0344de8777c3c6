"""Pose from both LiDARs' returns on shared cylinders.

A line fitted to the returns on a pole runs in front of its axis, for each LiDAR on another side.
Here the axes of the poles and the pose are estimated together, with a range offset that all
retro-reflective returns of one LiDAR share, and the radius where it is not known exactly. Every
return is compared with where its own beam can have met the pole, and every beam that passed close
by with the space beside it (`likelihood`). The noise of the returns, in depth and sideways, is
estimated with them. See docs/method.md, Beam model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..datatypes import Array, PoseEstimate
from ..errors import Refusal
from .observations import Beams
from .posterior import SHARED, Posterior, Priors, State, beam_geometry, evaluate
from .solver import Solution, Step, levenberg_marquardt

RETRO_BIAS = 0.003
"""1 σ of a range error that all retro-reflective returns of one LiDAR share, metres. An assumption:
no source states it."""

RING_BIAS, RING_BIAS_WEIGHT = 0.0025, 8.0
"""1 σ of a range error that all returns of one ring share, metres: what is assumed, and the number
of rings that it counts for beside those of the poles themselves. Set so that the 95 % regions of
benchmarks/accuracy.py hold the truth in 95 % of its simulated scenes."""

MIN_NOISE = 2e-5
"""Least noise of a return, metres."""

MIN_LATERAL_NOISE = 1 / 5
"""Least noise sideways, as a part of that in depth. With less, the edges of the pole are walls: the
posterior is far from a parabola, its curvature promises too much, and the climb takes long."""

MAX_LATERAL_NOISE = 2.0
"""Most noise sideways, as a multiple of that in depth: returns sharp in depth and blurred sideways
would fall between the nodes of the integral."""

START_NOISE = (0.005, 0.5)
"""Bounds of the noise that the search starts from, metres."""

MAX_NOISE = 0.05
"""Most noise of a return that still says anything of a pole, metres: more than its thickness."""

MIN_INLIER_SHARE = 0.5
"""Share of the returns that must lie on the common poles."""

MAX_ROTATION_SIGMA, MAX_TRANSLATION_SIGMA = 0.1, 0.5
"""1 σ, rad and m, from which the poles are said to leave the pose free."""

MIN_RETURNS_PER_POLE = 3
"""A line through two returns says nothing of their noise."""

MAX_POLE_ITERATIONS = 60
POLE_STEP, POLE_GAIN = 0.02, 0.01
"""Step, in units of each parameter's own 1 σ, and gain of the logarithm of the posterior, below
which the noise is kept and one more step polishes the geometry alone. Damped steps count too: in 33
of 50 simulated scenes the poles' pose was still up to 0.34 σ from the maximum, and the refined pose
that starts from it up to 0.14 σ."""

POLE_DAMPING, MIN_POLE_DAMPING = 1e-4, 1e-9
"""Of the solver, at the start and at least."""
POLE_SLACK = 1e-9
"""The cost may rise by this part of itself: it is a sum over hundreds of returns."""

MIN_EIGENVALUE = 1e-9
"""Least eigenvalue of the scaled information that is taken for positive; below it the lifted
curvature stands in."""


def maximise(
    state: State, log_noise: Array, beams: Sequence[Beams], priors: Priors
) -> Solution[Posterior]:
    """Climb to the nearest maximum of the posterior, noise and all (Levenberg–Marquardt).

    First geometry and noise together, until a step is small, then one more step of the geometry
    alone. The first part may end on a damped step, since at the bounds of the noise its own steps
    make the cost rise.
    """
    floor = np.log(MIN_NOISE)

    def with_noise(now: Posterior, step: Array, damping: float) -> Posterior:
        noise = np.maximum(now.log_noise + now.noise_step / (1.0 + damping), floor)
        noise[:, 0] = np.maximum(noise[:, 0], noise[:, 1] - np.log(MAX_LATERAL_NOISE))
        noise[:, 1] = np.maximum(noise[:, 1], noise[:, 0] + np.log(MIN_LATERAL_NOISE))
        return evaluate(now.state.moved(step), noise, beams, priors)

    def geometry_alone(now: Posterior, step: Array, damping: float) -> Posterior:
        return evaluate(now.state.moved(step), now.log_noise, beams, priors)

    def small(step: Step) -> bool:
        return bool(np.abs(step.scaled).max() < POLE_STEP and step.gain < POLE_GAIN)

    start = evaluate(state, np.maximum(log_noise, floor), beams, priors)
    found = levenberg_marquardt(
        start,
        with_noise,
        small,
        tolerance=POLE_STEP,
        damping=POLE_DAMPING,
        min_damping=MIN_POLE_DAMPING,
        slack=POLE_SLACK,
        max_iterations=MAX_POLE_ITERATIONS,
    )
    polished = levenberg_marquardt(
        found.point,
        geometry_alone,
        lambda step: True,
        tolerance=POLE_STEP,
        damping=found.damping,
        min_damping=MIN_POLE_DAMPING,
        slack=POLE_SLACK,
        max_iterations=MAX_POLE_ITERATIONS,
    )
    return Solution(
        polished.point,
        found.converged and polished.converged,
        found.iterations + polished.iterations,
        polished.damping,
    )


@dataclass(frozen=True, eq=False)
class BeamAlignment:
    """Pose from shared cylinders.

    Attributes
    ----------
    pose
        Pose, its covariance with all else marginalised, and root mean square of the noise of both
        LiDARs along the beam.
    covariance_if_known
        (6, 6) the covariance if the radius and the range offsets were known: what the returns alone
        leave open.
    axis_points, axis_directions
        (K, 3) a point on each pole's axis and its unit direction, target frame.
    radius, radius_sigma
        Metres.
    noise, lateral_noise
        1 σ of a return along the beam and across it, for the target and the source, metres.
    converged, iterations
        Whether the solver came to rest, and after how many steps.
    """

    pose: PoseEstimate
    covariance_if_known: Array
    axis_points: Array
    axis_directions: Array
    radius: float
    radius_sigma: float
    noise: tuple[float, float]
    lateral_noise: tuple[float, float]
    converged: bool = True
    iterations: int = 0


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
    state, log_noise = _start(target, source, T_start, radius)
    found = maximise(state, log_noise, (target, source), Priors(bias, radius, radius_sigma))
    end = found.point
    sigma = np.exp(end.log_noise)
    total = int(counts.sum())
    if (
        not np.isfinite(end.cost)
        or sigma[:, 0].max() > MAX_NOISE
        or end.inliers < MIN_INLIER_SHARE * total
    ):
        raise Refusal(
            "poor_fit",
            f"the returns do not lie on shared poles: noise {100 * sigma[:, 0].max():.1f} cm, "
            f"{end.inliers:.0f} of {total} returns fit; check the radius and what was taken for a "
            "pole",
            {"noise_m": float(sigma[:, 0].max()), "inliers": end.inliers, "points": total},
        )
    covariance = _covariance(end)
    rotation, translation = (
        float(np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1]))
        for part in (slice(3), slice(3, 6))
    )
    if not (rotation < MAX_ROTATION_SIGMA and translation < MAX_TRANSLATION_SIGMA):
        raise Refusal(
            "degenerate_poles",
            f"the poles leave the pose free by {np.degrees(rotation):.1f}° and {translation:.2f} m "
            "(1 σ); lean one pole by 15° or more against the other",
            {"rotation_sigma_rad": rotation, "translation_sigma_m": translation},
        )
    return BeamAlignment(
        PoseEstimate(end.state.T, covariance[:6, :6], float(np.sqrt(np.mean(sigma[:, 0] ** 2)))),
        _covariance(end, known=slice(6, SHARED))[:6, :6],
        end.state.points,
        end.state.directions,
        end.state.radius,
        float(np.sqrt(covariance[8, 8])),
        (float(sigma[0, 0]), float(sigma[1, 0])),
        (float(sigma[0, 1]), float(sigma[1, 1])),
        found.converged,
        found.iterations,
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
    for lidar, one in enumerate((target, source)):
        seen = beam_geometry(state, lidar, one.origin, one.directions, one.ranges, one.pole)
        spread = np.sqrt(np.mean((seen.depth - radius) ** 2 + seen.lateral_offset**2))
        noise[lidar] = np.log(np.clip(spread, *START_NOISE))
    return state, noise


def _covariance(end: Posterior, known: slice | None = None) -> Array:
    """Covariance of all parameters, (P, P), with the range errors of single rings counted in.

    ``I⁻¹ (I + τ² Σ_b c_b c_bᵀ) I⁻¹``: c_b is what a range offset of ring b does to the gradient. τ²
    is estimated from the mean residuals of the rings, with `RING_BIAS` for a start.
    """
    keep = np.ones(len(end.information), dtype=bool)
    if known is not None:
        keep[known] = False
    scale = np.sqrt(np.diag(end.curvature)) + 1e-12
    chosen = np.ix_(keep, keep)
    eigenvalue, vector = np.linalg.eigh((end.information / np.outer(scale, scale))[chosen])
    if eigenvalue[0] < MIN_EIGENVALUE:
        eigenvalue, vector = np.linalg.eigh((end.curvature / np.outer(scale, scale))[chosen])
    inverse = np.zeros_like(end.information)
    inverse[chosen] = (vector / np.maximum(eigenvalue, 1e-15)) @ vector.T
    inverse /= np.outer(scale, scale)
    by_ring = np.concatenate([ring.curvature for ring in end.rings])
    gradient = np.concatenate([ring.gradient for ring in end.rings])
    weight = np.concatenate([ring.weight for ring in end.rings])
    seen = weight > 0
    # The mean residual of ring b has variance 1/weight_b + τ².
    excess = float(np.sum((gradient[seen] / weight[seen]) ** 2 - 1.0 / weight[seen]))
    assumed = RING_BIAS_WEIGHT * RING_BIAS**2
    tau = max((assumed + excess) / (RING_BIAS_WEIGHT + int(np.count_nonzero(seen))), 0.0)
    spread = inverse @ by_ring.T
    return np.asarray(inverse + tau * spread @ spread.T)
