"""Up to the maximum of the posterior of shared cylinders, from lines fitted to the returns.

The posterior may be of two LiDARs or more. Each LiDAR's beams constrain the poles as `posterior`
states; survey and inertial sensors add information about axes and poses. Of a pair the target's
pose is fixed: its frame is that of the poles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray
from ..base.errors import Refusal
from ..base.systematic import MIN_ERROR_SIGMA
from .expansion import MAX_LATERAL_NOISE, MIN_LATERAL_NOISE, MIN_NOISE
from .observations import Beams
from .posterior import (
    NOISE_STEP,
    SHARED,
    JointState,
    Posterior,
    S,
    State,
    beam_geometry,
    evaluate_lidar,
)
from .solver import DAMPING, ROUNDING, Solution, levenberg_marquardt
from .survey import Surveyed, survey_terms
from .unknowns import POSE

START_NOISE = (0.005, 0.5)
"""Bounds of the noise that the search starts from, metres: with less, a pose that is off by 0.4 m
is kept, since most returns are outliers there (tests/adjustment/test_blunders.py)."""

MAX_NOISE = 0.05
"""Most noise of a return that still says anything of a pole, metres: more than its thickness."""

MIN_INLIER_SHARE = 0.5
"""Share of the returns that must lie on the common poles."""

POLE_STEP = POLE_GAIN = 0.01
"""Step, in units of the 1 σ of each parameter were all others known, at which the geometry has
converged: the next is a twentieth as large, and the expansion about the end takes it too. And gain
of the logarithm of the posterior below which the noise is kept, and the geometry alone goes on."""

NOISE_DAMPING = DAMPING
"""Least damping with the noise: at the bounds of the noise, steps of the noise make the cost rise,
and from less it takes many to damp them."""


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
        f"{total} returns fit; check the radius, and which objects were detected as poles",
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


START_ROTATION, START_TRANSLATION = 0.3, 1.0
"""1 σ about the poses that the search starts from, rad and m: wide enough to add no information in
directions that the poles determine, and to keep the problem solvable in those that they do not."""


@dataclass(frozen=True, eq=False)
class JointPriors:
    """What is known before: the start with its width, 1 σ of offsets (L,), the radius, the datum.

    `free` (6 L,) says which parameters of the poses are estimated; the others are the datum.
    """

    start: Array
    offsets: Array
    radius: float
    radius_sigma: float
    free: BoolArray


@dataclass(frozen=True, eq=False)
class Sight:
    """The beams of one LiDAR at the poles of all placements, and which axis each of them is."""

    lidar: int
    beams: Beams
    own: IntArray


def evaluate_joint(
    state: JointState,
    log_noise: Array,
    sights: Sequence[Sight],
    surveyed: Surveyed,
    priors: JointPriors,
) -> Posterior[JointState]:
    """Evaluate the posterior, and where the noise (L, 2) of the LiDARs should go."""
    count, size = len(state.T), state.size
    x, prior = np.zeros(size), np.zeros(size)
    steps = [se3.local(start, T) for start, T in zip(priors.start, state.T, strict=True)]
    x[: POSE * count] = np.concatenate(steps)
    prior[: POSE * count] = np.tile(
        np.repeat([START_ROTATION**-2.0, START_TRANSLATION**-2.0], 3), count
    )
    offsets = slice(POSE * count, (POSE + 1) * count)
    x[offsets] = state.offsets
    prior[offsets] = np.maximum(priors.offsets, MIN_ERROR_SIGMA) ** -2.0
    radius = state.first_axis - 1
    x[radius] = state.radius - priors.radius
    prior[radius] = max(priors.radius_sigma, MIN_ERROR_SIGMA) ** -2.0
    log, score = -0.5 * float(prior @ x**2), -prior * x
    information, damped = np.diag(prior), np.diag(prior)
    noise_step, inliers = np.zeros((count, 2)), 0.0
    for sight in sights:
        place = place_of(state, sight)
        terms, on_poles = evaluate_lidar(
            state.of(sight.lidar, sight.own), 1, sight.beams, np.exp(log_noise[sight.lidar])
        )
        noise_step[sight.lidar] = on_poles.noise_step
        inliers += on_poles.inliers
        log += terms.log
        # The target's offset has no part in it.
        kept = np.r_[0:POSE, 7:SHARED, SHARED : len(terms.score)]
        score[place] += terms.score[kept]
        information[np.ix_(place, place)] += terms.information[np.ix_(kept, kept)]
        damped[np.ix_(place, place)] += terms.damped[np.ix_(kept, kept)]
    for term in survey_terms(state, surveyed):
        J = np.zeros((len(term.residual), size))
        J[:, term.place] = term.jacobian
        weighted = J.T * term.sigma**-2.0
        log -= 0.5 * float(np.sum((term.residual / term.sigma) ** 2))
        score -= weighted @ term.residual
        information += weighted @ J
        damped += weighted @ J
    constrained = np.flatnonzero(~np.r_[priors.free, np.ones(size - POSE * count, dtype=bool)])
    score[constrained] = 0.0
    for matrix in (information, damped):
        matrix[constrained], matrix[:, constrained] = 0.0, 0.0
        matrix[constrained, constrained] = 1.0
    return Posterior(
        state,
        log_noise,
        -log,
        -score,
        information,
        damped,
        np.clip(noise_step, *NOISE_STEP),
        inliers,
    )


def place_of(state: JointState, sight: Sight) -> IntArray:
    """Where pose, offset, radius and axes of a LiDAR's terms are in a step of the site."""
    count = len(state.T)
    parts = np.r_[
        POSE * sight.lidar + np.arange(POSE),
        POSE * count + sight.lidar,
        state.first_axis - 1,
        state.axes(sight.own),
    ]
    return np.asarray(parts, dtype=np.int64)


def noise_of_start(state: JointState, sights: Sequence[Sight]) -> Array:
    """(L, 2) logarithm of how far the returns lie from where the search starts."""
    noise = np.zeros((len(state.T), 2))
    for sight in sights:
        noise[sight.lidar] = start_noise(state.of(sight.lidar, sight.own), 1, sight.beams)
    return noise


def maximise_joint(
    state: JointState,
    log_noise: Array,
    sights: Sequence[Sight],
    surveyed: Surveyed,
    priors: JointPriors,
    most_noise: Array | float = np.inf,
) -> Solution[Posterior[JointState]]:
    """Climb to the nearest maximum of the posterior.

    Parameters
    ----------
    state, log_noise
        Where to start.
    sights, surveyed, priors
        What was seen, and what is known.
    most_noise
        (L, 2) bound of each LiDAR's noise at the answer, metres. A pole that moved between the
        recordings would else pass for noise.

    Raises
    ------
    Refusal
        ``poor_fit`` where most returns lie on no common pole.
    """

    def evaluate(state: JointState, log_noise: Array) -> Posterior[JointState]:
        return evaluate_joint(state, log_noise, sights, surveyed, priors)

    found = maximise(state, log_noise, evaluate)
    if np.any(np.exp(found.point.log_noise) > most_noise):
        found = maximise(found.point.state, found.point.log_noise, evaluate, most_noise)
    check_fit(
        found.point, sum(len(sight.beams.pole) for sight in sights), "the returns of all LiDARs"
    )
    return found
