"""Pose from both LiDARs' returns on shared cylinders.

A line fitted to the returns on a pole runs in front of its axis, for each LiDAR on another side.
Here the axes of the poles and the pose are estimated together, with a range offset that all
retro-reflective returns of one LiDAR share, and the radius where it is not known exactly. Every
return is compared with where its own beam can have met the pole, and every beam that passed close
by with the space beside it (`likelihood`). The noise of the returns, in depth and sideways, is
estimated with them. See docs/method.md, Beam model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..base import se3
from ..base.datatypes import Array, PoseEstimate
from ..base.errors import Refusal
from ..base.quantities import counted
from ..base.systematic import MIN_ERROR_SIGMA, ErrorModel, Sizes
from ..base.uncertainty import RadiusEstimate, Uncertainty
from .certainty import (
    considered,
    floors,
    group_scales,
    parts_of_errors,
    prior_precision,
    scatter_of_poles,
    solve_factor,
    uncertainty_of_pair,
    working_sigma,
)
from .climb import climb, start_of
from .expansion import AxesTest, Expansion, compare_axes, pole_factor
from .factor import PoleFactor
from .observations import Beams
from .posterior import Posterior, State
from .solver import Solution

RADIUS_TOLERANCE = 0.02
"""Least 1 σ of the radius, as a part of it: tubes differ by so much, and tape adds to them."""

MAX_ROTATION_SIGMA, MAX_TRANSLATION_SIGMA = 0.1, 0.5
"""1 σ, rad and m, from which the poles are said to leave the pose free."""

MIN_RETURNS_PER_POLE = 3
"""A line through two returns says nothing of their noise."""

RADIUS_DENIED = 3.0
"""So many σ between the given radius and the returns, and it is the returns that are believed."""

RADIUS_MODEL, RADIUS_EDGE = 0.0015, 0.12
"""1 σ of the radius that the beam model itself leaves open, metres, and as a part of the one given:
which returns from the edge of a pole are bright enough is not known. Where intensity falls with
range and incidence (seeds 0 to 99 of that family in benchmarks/coverage.py) the returns alone gave
18.4 mm of 20 mm in the middle and 8.9 mm at the least, 3.0 σ with 0.12 and 3.6 σ with 0.06; with
0.12 all of 24 diameters that were given for the radius are denied."""

RADIUS_ROUNDS, MAX_RADIUS_CHANGE = 6, 0.5
"""So often a radius is put in the place of the one given, until the returns agree with it, and by
no larger a part of the one before: far off, the returns overshoot."""

MIN_RADIUS_PRECISION = 1e-2
"""Of a prior of the radius that says nothing, 1/m²."""

SCALE_ROUNDS = 3
"""So often the sizes of the errors are estimated; they settle in two."""


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
    given_sigma = max(radius_sigma, RADIUS_TOLERANCE * radius, MIN_ERROR_SIGMA)
    model = ErrorModel(sizes, given_sigma)
    state, log_noise = start_of(target, source, T_start, radius)
    found, expansion = climb(state, log_noise, beams, model, radius)
    by_returns = _radius_of_returns(expansion, model, radius)
    denied = by_returns.sigmas_below(radius, given_sigma)
    if denied > RADIUS_DENIED:
        # What was given has no say any more; the returns' own radius takes its place.
        assumed = radius
        for _ in range(RADIUS_ROUNDS):
            change = np.clip(
                by_returns.value / assumed - 1.0, -MAX_RADIUS_CHANGE, MAX_RADIUS_CHANGE
            )
            assumed = float(assumed * (1.0 + change))
            model = replace(model, radius_sigma=by_returns.sigma)
            start = replace(found.point.state, radius=assumed)
            found, expansion = climb(start, found.point.log_noise, beams, model, assumed)
            by_returns = _radius_of_returns(expansion, model, assumed)
            if abs(by_returns.value - assumed) < by_returns.sigma:
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
            f"{counted(poles, 'pole')} with {counted(int(counts.min()), 'return')} on the "
            f"poorest: two poles with "
            f"{MIN_RETURNS_PER_POLE} each are the least; bring the poles nearer or add frames",
            {"poles": poles, "returns": int(counts.min())},
        )


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
    factor = pole_factor(expansion)
    groups, own = factor.unknowns.groups(), factor.unknowns.radius
    poses = factor.unknowns.poses
    known = model.sigmas(groups)
    precision = prior_precision(groups, known)
    precision[own - poses] = MIN_RADIUS_PRECISION
    estimate = solve_factor(factor, precision)
    row = estimate.inverse[own]
    passed = row[poses:] * precision * considered(groups, known)
    variance = float(row[own] + passed @ passed)
    return _ReturnsRadius(
        radius + float(estimate.errors[own - poses]),
        float(np.sqrt(variance + RADIUS_MODEL**2 + (RADIUS_EDGE * radius) ** 2)),
    )


def _answer(
    found: Solution[Posterior[State]],
    expansion: Expansion,
    model: ErrorModel,
    radius: RadiusEstimate,
    radius_denied: float,
) -> BeamAlignment:
    """Estimate pose and errors together from the expansion, and state how sure the pose is."""
    end = found.point
    noise = np.exp(end.log_noise)
    factor = pole_factor(expansion)
    unknowns, groups = factor.unknowns, factor.unknowns.groups()
    known = model.sigmas(groups)
    sigma = known
    for _ in range(SCALE_ROUNDS):
        precision = prior_precision(groups, working_sigma(groups, sigma, poles_alone=True))
        estimate = solve_factor(factor, precision)
        variance = np.diag(estimate.inverse)[unknowns.poses :]
        sigma = group_scales(groups, known, precision, estimate.errors, variance)
    uncertainty = uncertainty_of_pair(
        [
            *parts_of_errors(groups, sigma, precision, estimate.inverse, estimate.errors),
            scatter_of_poles("scatter of the poles' returns", factor, estimate.inverse),
            *floors(factor.T, factor.free),
        ]
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
    order = unknowns.of_layout(expansion.layout, (0, 1)) - unknowns.poses
    return BeamAlignment(
        PoseEstimate(
            se3.retract(end.state.T, estimate.steps[unknowns.pose(1)]),
            covariance,
            float(np.sqrt(np.mean(noise[:, 0] ** 2))),
        ),
        uncertainty,
        factor,
        np.asarray(np.linalg.inv(factor.information[np.ix_(unknowns.pose(1), unknowns.pose(1))])),
        end.state.points,
        end.state.directions,
        radius,
        radius_denied,
        compare_axes(
            expansion, prior_precision(groups, sigma)[order], considered(groups, sigma)[order]
        ),
        (float(noise[0, 0]), float(noise[1, 0])),
        (float(noise[0, 1]), float(noise[1, 1])),
        found.converged,
        found.iterations,
    )
