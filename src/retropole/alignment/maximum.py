"""Up to the maximum of the posterior of shared cylinders, from lines fitted to the returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..base.datatypes import Array
from ..base.errors import Refusal
from .observations import Beams
from .posterior import Posterior, S, State, beam_geometry
from .solver import DAMPING, ROUNDING, Solution, levenberg_marquardt
from .views import MAX_LATERAL_NOISE, MIN_LATERAL_NOISE, MIN_NOISE

START_NOISE = (0.005, 0.5)
"""Bounds of the noise that the search starts from, metres: with less, a pose that is off by 0.4 m
is kept, since most returns are outliers there (tests/adjustment/test_contradiction.py)."""

MAX_NOISE = 0.05
"""Most noise of a return that still says anything of a pole, metres: more than its thickness."""

MIN_INLIER_SHARE = 0.5
"""Share of the returns that must lie on the common poles."""

POLE_STEP = POLE_GAIN = 0.01
"""Step, in units of each parameter's own 1 σ, at which the geometry has converged; and gain of the
logarithm of the posterior below which the noise is kept, and the geometry alone goes on."""

NOISE_DAMPING = DAMPING
"""Least damping with the noise: at the bounds of the noise its own steps make the cost rise, and
from less it takes many to damp them."""


def maximise(
    state: S,
    log_noise: Array,
    posterior: Callable[[S, Array], Posterior[S]],
    most_noise: Array | float = np.inf,
) -> Solution[Posterior[S]]:
    """Climb to the nearest maximum of a posterior, noise and all (Levenberg–Marquardt).

    First geometry and noise together, until they gain little, then the geometry alone.

    Parameters
    ----------
    state, log_noise
        Where to start; the noise (L, 2) of each LiDAR in depth and sideways, metres.
    posterior
        Gives it at a state under a noise.
    most_noise
        Bound of the noise, of each (L, 2) or of all, metres.
    """
    floor, most = np.log(MIN_NOISE), np.log(most_noise)

    def with_noise(now: Posterior[S], step: Array, damping: float) -> Posterior[S]:
        noise = np.maximum(now.log_noise + now.noise_step / (1.0 + damping), floor)
        noise[:, 0] = np.maximum(noise[:, 0], noise[:, 1] - np.log(MAX_LATERAL_NOISE))
        noise[:, 1] = np.maximum(noise[:, 1], noise[:, 0] + np.log(MIN_LATERAL_NOISE))
        noise = np.minimum(noise, most)
        return _with_true_curvature(posterior(now.state.moved(step), noise))

    def geometry_alone(now: Posterior[S], step: Array, damping: float) -> Posterior[S]:
        return _with_true_curvature(posterior(now.state.moved(step), now.log_noise))

    start = posterior(state, np.clip(log_noise, floor, most))
    found = levenberg_marquardt(
        start,
        with_noise,
        lambda step: step.gain < POLE_GAIN,
        tolerance=POLE_STEP,
        min_damping=NOISE_DAMPING,
    )
    polished = levenberg_marquardt(
        _with_true_curvature(found.point),
        geometry_alone,
        lambda step: bool(np.abs(step.scaled).max() < POLE_STEP),
        tolerance=POLE_STEP,
    )
    return Solution(
        polished.point,
        found.converged and polished.converged,
        found.iterations + polished.iterations,
        polished.damping,
    )


def _with_true_curvature(now: Posterior[S]) -> Posterior[S]:
    """Give the posterior its second derivative as curvature, where that is positive definite.

    It takes 3 to 9 steps then, where the lifted one took up to 53.
    """
    scale = np.sqrt(np.maximum(np.diag(now.curvature), 1e-300))
    lowest = np.linalg.eigvalsh(now.information / np.outer(scale, scale))[0]
    return replace(now, curvature=now.information) if lowest > ROUNDING else now


def check_fit(end: Posterior[S], total: int, returns: str) -> None:
    """Refuse a maximum at which most returns lie on no common pole.

    Parameters
    ----------
    end
        The maximum.
    total
        How many returns there are.
    returns
        What they are called.

    Raises
    ------
    Refusal
        ``poor_fit``.
    """
    noise = float(np.exp(end.log_noise[:, 0].max()))
    if np.isfinite(end.cost) and noise <= MAX_NOISE and end.inliers >= MIN_INLIER_SHARE * total:
        return
    raise Refusal(
        "poor_fit",
        f"{returns} do not lie on shared poles: noise {100 * noise:.1f} cm, {end.inliers:.0f} of "
        f"{total} returns fit; check the radius and what was taken for a pole",
        {"noise_m": noise, "inliers": end.inliers, "points": total},
    )


def lines_of(beams: Beams, radius: float) -> tuple[Array, Array]:
    """Fit lines to the returns on each pole, moved back from its facing side.

    Returns
    -------
    points, directions
        (K, 3) each, in the LiDAR's frame.
    """
    centres, directions = [], []
    returns = beams.origin + beams.ranges[:, None] * beams.directions
    for k in range(int(beams.pole.max()) + 1):
        xyz = returns[beams.pole == k]
        centre = xyz.mean(axis=0)
        n = np.linalg.svd(xyz - centre, full_matrices=False)[2][0]
        away = centre - beams.origin
        away = away - (away @ n) * n
        centres.append(centre + np.pi / 4 * radius * away / max(np.linalg.norm(away), 1e-9))
        directions.append(n)
    return np.array(centres), np.array(directions)


def start_noise(state: State, lidar: int, beams: Beams) -> float:
    """Give the logarithm of how far the returns lie from the poles of a start."""
    seen = beam_geometry(state, lidar, beams.origin, beams.directions, beams.ranges, beams.pole)
    spread = np.sqrt(np.mean((seen.depth - state.radius) ** 2 + seen.lateral_offset**2))
    return float(np.log(np.clip(spread, *START_NOISE)))
