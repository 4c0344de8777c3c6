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
from dataclasses import dataclass, replace

import numpy as np

from .. import se3
from ..datatypes import Array, PoseEstimate
from ..errors import Refusal
from ..systematic import RADIUS, ErrorModel, Sizes, groups_of
from ..uncertainty import RadiusEstimate, Uncertainty
from .certainty import (
    WORKING_SHARE,
    Scatter,
    group_scales,
    prior_precision,
    solve_factor,
    stated,
    working_sigma,
)
from .factor import POSE, AxesTest, Expansion, PoleFactor, compare_axes, expand, pole_factor
from .observations import Beams
from .posterior import Posterior, Priors, State, beam_geometry, evaluate
from .solver import Solution, Step, levenberg_marquardt

RADIUS_TOLERANCE = 0.02
"""Least 1 σ of the radius, as a part of it: tubes differ by so much, and tape adds to them."""

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
which the noise is kept and the geometry alone goes on."""

POLISHED_STEP = 1e-3
"""Step, in the same units, at which the geometry has converged."""

RADIUS_DENIED = 3.0
"""So many σ between the given radius and the returns, and it is the returns that are believed."""

RADIUS_MODEL = 0.0015
"""1 σ of the radius that the beam model itself leaves open, metres: which returns from the edge of
a pole are bright enough is not known. In 24 simulated scenes the returns alone gave 0.6 to 1.7 mm
too little, whatever the sensor."""

RADIUS_ROUNDS, MIN_RADIUS_SHARE = 4, 0.2
"""So often a radius is put in the place of the one given, until the returns agree with it, and no
less than this part of the one before."""

MIN_RADIUS_PRECISION = 1e-2
"""Of a prior of the radius that says nothing, 1/m²."""

SCALE_ROUNDS = 3
"""So often the sizes of the errors are estimated; they settle in two."""

POLE_DAMPING, MIN_POLE_DAMPING = 1e-4, 1e-9
"""Of the solver, at the start and at least."""
POLE_SLACK = 1e-9
"""The cost may rise by this part of itself: it is a sum over hundreds of returns."""


def maximise(
    state: State, log_noise: Array, beams: Sequence[Beams], priors: Priors
) -> Solution[Posterior]:
    """Climb to the nearest maximum of the posterior, noise and all (Levenberg–Marquardt).

    First geometry and noise together, until a step is small, then the geometry alone. The first
    part may end on a damped step, since at the bounds of the noise its own steps make the cost
    rise; the second starts with little damping again.
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
        lambda step: bool(np.abs(step.scaled).max() < POLISHED_STEP),
        tolerance=POLISHED_STEP,
        damping=POLE_DAMPING,
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
    uncertainty
        The covariance in its two kinds, and the budget.
    factor
        What the poles say of the pose and of the LiDARs' errors, for the scene to go on from.
    covariance_if_known
        (6, 6) the covariance if the LiDARs' errors and the radius were known: what the returns
        alone leave open.
    axis_points, axis_directions
        (K, 3) a point on each pole's axis and its unit direction, target frame.
    radius
        Given and estimated.
    radius_denied
        By how many σ the returns alone deny the radius that was given.
    axes_test
        Whether both LiDARs see the poles stand to each other alike.
    noise, lateral_noise
        1 σ of a return along the beam and across it, for the target and the source, metres.
    converged, iterations
        Whether the solver came to rest, and after how many steps.
    """

    pose: PoseEstimate
    uncertainty: Uncertainty
    factor: PoleFactor
    covariance_if_known: Array
    axis_points: Array
    axis_directions: Array
    radius: RadiusEstimate
    radius_denied: float
    axes_test: AxesTest
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
    sizes: tuple[Sizes, Sizes] = (Sizes(), Sizes()),
) -> BeamAlignment:
    """Align matched poles by what both LiDARs' beams can have met.

    Parameters
    ----------
    target, source
        Beams of the two LiDARs; the poles are numbered alike.
    T_start
        (4, 4) the chosen hypothesis, target from source.
    radius, radius_sigma
        Of the poles as given, and its 1 σ, metres: at least `RADIUS_TOLERANCE` of it. Where the
        returns deny it, they alone decide.
    sizes
        Of the systematic errors of both LiDARs.

    Raises
    ------
    Refusal
        ``too_few_points`` with less than two poles or `MIN_RETURNS_PER_POLE` returns on one;
        ``degenerate_poles`` where the poles leave the pose all but free in some direction;
        ``poor_fit`` where most returns lie on no common pole.
    """
    _check_counts(target, source)
    beams = (target, source)
    given_sigma = max(radius_sigma, RADIUS_TOLERANCE * radius)
    model = ErrorModel(*sizes, given_sigma)
    state, log_noise = _start(target, source, T_start, radius)
    found, expansion = _climb(state, log_noise, beams, model, radius)
    by_returns = _radius_of_returns(expansion, model, radius)
    denied = by_returns.sigmas_below(radius, given_sigma)
    if denied > RADIUS_DENIED:
        # What was given has no say any more; the returns' own radius takes its place.
        assumed = radius
        for _ in range(RADIUS_ROUNDS):
            assumed = max(by_returns.value, MIN_RADIUS_SHARE * assumed)
            model = replace(model, radius_sigma=by_returns.sigma)
            start = replace(found.point.state, radius=assumed)
            found, expansion = _climb(start, found.point.log_noise, beams, model, assumed)
            by_returns = _radius_of_returns(expansion, model, assumed)
            if by_returns.sigmas_below(assumed, 0.0) < 1.0:
                break
        estimate = RadiusEstimate(radius, given_sigma, assumed, model.radius_sigma)
    else:
        weights = np.array([given_sigma, by_returns.sigma]) ** -2.0
        both = float(weights @ [radius, by_returns.value] / weights.sum())
        estimate = RadiusEstimate(radius, given_sigma, both, float(weights.sum() ** -0.5))
    return _answer(found, expansion, model, estimate, denied)


def _check_counts(target: Beams, source: Beams) -> None:
    counts = np.concatenate([np.bincount(one.pole) for one in (target, source)])
    poles = int(target.pole.max()) + 1
    if poles < 2 or counts.min() < MIN_RETURNS_PER_POLE:
        raise Refusal(
            "too_few_points",
            f"{poles} poles with {counts.min()} returns on the poorest: two poles with "
            f"{MIN_RETURNS_PER_POLE} each are the least; bring the poles nearer or add frames",
            {"poles": poles, "returns": int(counts.min())},
        )


def _climb(
    state: State,
    log_noise: Array,
    beams: tuple[Beams, Beams],
    model: ErrorModel,
    radius: float,
) -> tuple[Solution[Posterior], Expansion]:
    """Climb from a state, refuse what no shared poles explain, and expand about the maximum."""
    offsets = tuple(
        WORKING_SHARE * float(np.hypot(size.zero, size.tape))
        for size in (model.target, model.source)
    )
    priors = Priors((offsets[0], offsets[1]), radius, model.radius_sigma)
    found = maximise(state, log_noise, beams, priors)
    end = found.point
    noise = float(np.exp(end.log_noise[:, 0].max()))
    total = sum(len(one.pole) for one in beams)
    if not np.isfinite(end.cost) or noise > MAX_NOISE or end.inliers < MIN_INLIER_SHARE * total:
        raise Refusal(
            "poor_fit",
            f"the returns do not lie on shared poles: noise {100 * noise:.1f} cm, "
            f"{end.inliers:.0f} of {total} returns fit; check the radius and what was taken for a "
            "pole",
            {"noise_m": noise, "inliers": end.inliers, "points": total},
        )
    return found, expand(end.state, end.log_noise, beams, radius)


@dataclass(frozen=True)
class _ReturnsRadius:
    """The radius as the returns alone have it, and its 1 σ, metres."""

    value: float
    sigma: float

    def sigmas_below(self, radius: float, sigma: float) -> float:
        """By how many σ the returns want a thinner pole than one with a 1 σ of its own.

        Thicker is no denial: tape glows, and beams beside a pole return as if they had met it.
        """
        return max(radius - self.value, 0.0) / float(np.hypot(self.sigma, sigma))


def _radius_of_returns(expansion: Expansion, model: ErrorModel, radius: float) -> _ReturnsRadius:
    """Ask the returns for the radius without what was given."""
    factor, groups = pole_factor(expansion), groups_of(expansion.layout)
    precision = prior_precision(groups, model.sigmas(groups))
    precision[RADIUS] = MIN_RADIUS_PRECISION
    estimate = solve_factor(factor, precision)
    variance = float(estimate.inverse[POSE + RADIUS, POSE + RADIUS])
    return _ReturnsRadius(
        radius + float(estimate.errors[RADIUS]), float(np.hypot(np.sqrt(variance), RADIUS_MODEL))
    )


def _answer(
    found: Solution[Posterior],
    expansion: Expansion,
    model: ErrorModel,
    radius: RadiusEstimate,
    radius_denied: float,
) -> BeamAlignment:
    """Estimate pose and errors together from the expansion, and state how sure the pose is."""
    end = found.point
    noise = np.exp(end.log_noise)
    factor, groups = pole_factor(expansion), groups_of(expansion.layout)
    known = model.sigmas(groups)
    sigma = known
    for _ in range(SCALE_ROUNDS):
        precision = prior_precision(groups, working_sigma(groups, sigma, poles_alone=True))
        estimate = solve_factor(factor, precision)
        variance = np.diag(estimate.inverse)[POSE:]
        sigma = group_scales(groups, known, precision, estimate.errors, variance)
    inverse = estimate.inverse
    returns = inverse[:POSE] @ factor.information @ inverse[:POSE].T
    uncertainty = stated(
        groups,
        sigma,
        precision,
        inverse,
        estimate.errors,
        (Scatter("scatter of the poles' returns", returns, factor.redundancy),),
    )
    covariance = uncertainty.covariance
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
        PoseEstimate(
            se3.retract(end.state.T, estimate.step),
            covariance,
            float(np.sqrt(np.mean(noise[:, 0] ** 2))),
        ),
        uncertainty,
        factor,
        np.asarray(np.linalg.inv(factor.information[:POSE, :POSE])),
        end.state.points,
        end.state.directions,
        radius,
        radius_denied,
        compare_axes(expansion, prior_precision(groups, sigma)),
        (float(noise[0, 0]), float(noise[1, 0])),
        (float(noise[0, 1]), float(noise[1, 1])),
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
