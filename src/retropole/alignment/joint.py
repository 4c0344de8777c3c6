"""The posterior of poles that two LiDARs or more see: all poses, range offsets, radius and axes.

Each LiDAR's beams say of the poles what `posterior` has; survey and inertial sensors add what they
say of axes and poses. Of a pair the target's pose is held: its frame is that of the poles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray
from ..base.systematic import MIN_ERROR_SIGMA
from .maximum import check_fit, maximise, start_noise
from .observations import Beams
from .posterior import NOISE_STEP, SHARED, Posterior, evaluate_lidar
from .solver import Solution
from .state import JointState
from .survey import Surveyed, survey_terms
from .unknowns import POSE

START_ROTATION, START_TRANSLATION = 0.3, 1.0
"""1 σ about the poses that the search starts from, rad and m: wide enough to say nothing where the
poles do, and the search has a way where the poles of a LiDAR leave it free."""


@dataclass(frozen=True, eq=False)
class JointPriors:
    """What is known before: the start with its width, 1 σ of offsets (L,), the radius, the datum.

    `free` (6 L,) tells which parameters of the poses are estimated; the others are the datum.
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
    information, lifted = np.diag(prior), np.diag(prior)
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
        lifted[np.ix_(place, place)] += terms.lifted[np.ix_(kept, kept)]
    for term in survey_terms(state, surveyed):
        J = np.zeros((len(term.residual), size))
        J[:, term.place] = term.jacobian
        weighted = J.T * term.sigma**-2.0
        log -= 0.5 * float(np.sum((term.residual / term.sigma) ** 2))
        score -= weighted @ term.residual
        information += weighted @ J
        lifted += weighted @ J
    held = np.flatnonzero(~np.r_[priors.free, np.ones(size - POSE * count, dtype=bool)])
    score[held] = 0.0
    for matrix in (information, lifted):
        matrix[held], matrix[:, held] = 0.0, 0.0
        matrix[held, held] = 1.0
    return Posterior(
        state,
        log_noise,
        -log,
        -score,
        information,
        lifted,
        np.clip(noise_step, *NOISE_STEP),
        inliers,
    )


def place_of(state: JointState, sight: Sight) -> IntArray:
    """Where pose, offset, radius and axes of a LiDAR's terms stand in a step of the site."""
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
