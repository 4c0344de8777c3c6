"""Pose from both LiDARs' returns on shared cylinders.

A line fitted to the returns on a pole runs in front of its axis, for each LiDAR on another side.
Here the axes of the poles and the pose are estimated together, with a range offset that all
retro-reflective returns of one LiDAR share, and the radius if it is not known exactly. Every
return is compared with the points where its beam can have hit the pole, and every beam that passed
close by with the space next to it (`likelihood`). The noise of the returns, in depth and sideways,
is estimated with them. See docs/method.md, Beam model.

Also estimates the radius from the returns alone, and tests whether both LiDARs saw the same
angles and distances between the poles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PoseEstimate
from ..base.errors import Refusal
from ..base.quantities import counted
from ..base.systematic import MIN_ERROR_SIGMA, ErrorModel, Sizes
from ..base.uncertainty import RadiusEstimate, Uncertainty
from ..extraction.lines import MIN_LINE_POINTS
from .certainty import (
    MAX_NORMAL,
    POLES,
    WORKING_SHARE,
    considered,
    floors,
    group_scales,
    parts_of_errors,
    parts_of_poles,
    prior_precision,
    solve_factor,
    sways,
    uncertainty_of_pair,
    working_sigma,
)
from .maximum import JointPriors, Sight, lines_of, maximise_joint, noise_of_start
from .network import (
    DEPTH_SIGMA,
    OF_SOURCE,
    Network,
    PoleFactor,
    bands_of,
    factor_of,
    gaussian_factor,
    observe,
    poses_of_pair,
)
from .observations import Beams
from .posterior import JointState, Posterior
from .solver import Solution
from .survey import NOTHING_SURVEYED, PriorPose, Surveyed
from .unknowns import POSE

RADIUS_EDGE = 0.12
"""1 σ of the radius that the beam model itself does not determine, as a part of the one given,
beyond `DEPTH_SIGMA`: which returns from the edge of a pole are bright enough is not known. Where
intensity falls with range and incidence (seeds 0 to 99 of that family in benchmarks/coverage.py)
the returns alone gave 18.4 mm of 20 mm in the middle and 8.9 mm at the least, 3.0 σ with 0.12 and
3.6 σ with 0.06; with 0.12 all of 24 diameters that were given for the radius are contradicted."""


@dataclass(frozen=True)
class ReturnsRadius:
    """The radius estimated from the returns alone, and its 1 σ, metres."""

    value: float
    sigma: float

    def sigmas_below(self, radius: float, sigma: float) -> float:
        """By how many σ the returns indicate a thinner pole than a given one with its 1 σ.

        A thicker one is not a contradiction: tape blooms, and beams next to a pole return as if
        they had hit it.
        """
        return max(radius - self.value, 0.0) / float(np.hypot(self.sigma, sigma))


def radius_of_returns(network: Network, model: ErrorModel, radius: float) -> ReturnsRadius:
    """Estimate the radius from the returns without the given value.

    Parameters
    ----------
    network
        About a maximum that was found with a radius, metres.
    model
        Of the errors.
    radius
        That radius.
    """
    factor = factor_of(network)
    groups, own = factor.unknowns.groups(), factor.unknowns.radius
    poses = factor.unknowns.poses
    known = model.sigmas(groups)
    precision = prior_precision(groups, known)
    precision[own - poses] = 0.0
    estimate = solve_factor(factor, precision)
    row = estimate.inverse[own]
    passed = row[poses:] * precision * considered(groups, known)
    variance = float(row[own] + passed @ passed)
    return ReturnsRadius(
        radius + float(estimate.errors[own - poses]),
        float(np.sqrt(variance + DEPTH_SIGMA**2 + (RADIUS_EDGE * radius) ** 2)),
    )


@dataclass(frozen=True, eq=False)
class AxesTest:
    """Whether both LiDARs see the same arrangement of the poles.

    Attributes
    ----------
    chi2, freedom
        Increase of twice the logarithm of the posterior by separate axes for each LiDAR,
        and the number of additional parameters: χ² if the arrangement was the same.
    by_pole
        (K,) the same if only that pole's axis is separate.
    """

    chi2: float
    freedom: int
    by_pole: Array


def compare_axes(network: Network, precision: Array, considered: Array) -> AxesTest:
    """Test whether both LiDARs recorded the same arrangement of poles (score test, Rao 1948).

    The source's axes get a separate displacement, in addition to pose, errors and common axes. Six
    of its directions are the pose's; two poles leave two to test, their angle and their distance.

    Parameters
    ----------
    network
        Of both LiDARs, about the maximum.
    precision
        (B,) of the prior of the errors.
    considered
        (B,) 1 σ of errors that are not estimated, but may be the cause; 0 of others.
    """
    unknowns, poles = network.unknowns, network.unknowns.axes
    whole, slope = network.total()
    source, pull = network.of_lidar(1).total()
    index = np.arange(unknowns.poses, unknowns.kept)
    errors = index[np.flatnonzero(considered)]
    by_errors = whole[:, errors].copy()
    whole[index, index] += precision
    slope[index] -= precision * network.start[index]
    free = np.flatnonzero(np.r_[network.free, np.ones(unknowns.size - unknowns.poses, dtype=bool)])

    def gain(own: IntArray) -> float:
        cross = source[:, own]
        known = np.zeros((unknowns.size, len(own) + 1))
        known[free] = np.linalg.solve(
            whole[np.ix_(free, free)], np.column_stack([cross, slope])[free]
        )
        score = pull[own] - cross.T @ known[:, -1]
        left = source[np.ix_(own, own)] - cross.T @ known[:, :-1]
        # Considered parameters move the score by this amount.
        by = (source[np.ix_(own, errors)] - known[:, :-1].T @ by_errors) * considered[
            errors - unknowns.poses
        ]
        left = left + by @ by.T
        return float(score @ np.linalg.pinv(left, rcond=1e-9, hermitian=True) @ score)

    by_pole = [gain(unknowns.axis(np.array([k]))) for k in range(poles)]
    return AxesTest(
        gain(unknowns.axis(np.arange(poles))), max(4 * poles - POSE, 1), np.array(by_pole)
    )


RADIUS_TOLERANCE = 0.02
"""Least 1 σ of the radius, relative to it: tubes differ by this amount, and tape adds to it."""

MAX_ROTATION_SIGMA, MAX_TRANSLATION_SIGMA = 0.1, 0.5
"""1 σ, rad and m, from which the poles are treated as not determining the pose."""

SURROUNDINGS_SIGMA = np.repeat([np.radians(2.0), 0.2], 3)
"""1 σ of the pose that the surroundings give where the poles leave some of it undetermined, rad
and m, as far as
the poles are used: wide compared with what surfaces show afterwards. Of 66 that were
refined about one pole (benchmarks/hard_scenes.py, seeds 0 to 39) the furthest was 0.24° and 2 cm
off."""


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
        Information of the poles on the pose and the LiDARs' errors, used in the refinement by the
        scene.
    covariance_if_known
        (6, 6) the covariance if the LiDARs' errors and the radius were known: the uncertainty from
        the returns alone.
    axis_points, axis_directions
        (K, 3) a point on each pole's axis and its unit direction, target frame.
    radius
        Given and estimated.
    radius_conflict
        By how many σ the returns alone conflict with the given radius.
    axes_test
        Whether both LiDARs see the same arrangement of the poles.
    noise, lateral_noise
        1 σ of a return along the beam and across it, for the target and the source, metres.
    converged, iterations
        Whether the solver converged, and after how many steps.
    joint
        The joint estimate that it is from; None without poles.
    """

    pose: PoseEstimate
    uncertainty: Uncertainty
    factor: PoleFactor
    covariance_if_known: Array
    axis_points: Array
    axis_directions: Array
    radius: RadiusEstimate
    radius_conflict: float
    axes_test: AxesTest
    noise: tuple[float, float]
    lateral_noise: tuple[float, float]
    converged: bool = True
    iterations: int = 0
    joint: Aligned | None = None


@dataclass(frozen=True, eq=False)
class Aligned:
    """Poses from shared cylinders, of two LiDARs or more.

    Attributes
    ----------
    maximum
        The maximum of the posterior.
    network
        The observations about it.
    radius, radius_conflict
        As in `BeamAlignment`.
    radius_sigma
        1 σ of the radius that was finally used, metres.
    sights
        The observations of each LiDAR.
    """

    maximum: Solution[Posterior[JointState]]
    network: Network
    radius: RadiusEstimate
    radius_conflict: float
    radius_sigma: float
    sights: Sequence[Sight]


def align_beams(
    target: Beams,
    source: Beams,
    T_start: Array,
    *,
    radius: float,
    radius_sigma: float = 0.0,
    sizes: tuple[Sizes, Sizes] = (Sizes(), Sizes()),
    placement: IntArray | None = None,
    by_place: bool = False,
    left: tuple[Array, ...] = (),
) -> BeamAlignment:
    """Align matched poles by the points that both LiDARs' beams can have hit.

    Parameters
    ----------
    target, source
        Beams of the two LiDARs; the poles have the same numbers.
    T_start
        (4, 4) the chosen hypothesis, target from source.
    radius, radius_sigma
        Of the poles as given, and its 1 σ, metres: at least the fraction `RADIUS_TOLERANCE`. If the
        returns conflict with it, they alone are used.
    sizes, left
        Of the systematic errors of both LiDARs, and of their sway; see `ErrorModel`.
    placement
        (K,) index of that of each pole; None if there is one.
    by_place
        Whether the part of `T_start` that the poles do not determine is from the surroundings.

    Raises
    ------
    Refusal
        ``too_few_points`` with less than two poles, or one `by_place`, or `MIN_LINE_POINTS`
        returns on one;
        ``degenerate_poles`` if the poles hardly constrain the pose in some direction; ``poor_fit``
        if most returns lie on no common pole.
    """
    _check_counts(target, source, needed=1 if by_place else 2)
    given_sigma = max(radius_sigma, RADIUS_TOLERANCE * radius, MIN_ERROR_SIGMA)
    own = np.arange(int(target.pole.max()) + 1)
    sights = Sight(0, target, own), Sight(1, source, own)
    points, directions = lines_of(target, radius)
    state = JointState(
        poses_of_pair(T_start), np.zeros(2), radius, points, directions, np.zeros((0, 3))
    )
    placement_of = np.zeros(len(own), dtype=np.int64) if placement is None else placement
    known = (PriorPose("the place", 1, T_start, SURROUNDINGS_SIGMA),) if by_place else ()
    model = ErrorModel(sizes, given_sigma)
    found = align_all(state, sights, model, placement_of, OF_SOURCE, surveyed=Surveyed(poses=known))
    return pose_of_pair(found, ErrorModel(sizes, found.radius_sigma, left))


def without_poles(T: Array, radius: float, sigma: Array = SURROUNDINGS_SIGMA) -> BeamAlignment:
    """Express a pose (4, 4) from the surroundings alone as if from poles without information.

    With its 1 σ (6,), rad and m.
    """
    covariance = np.diag(sigma**2)
    pose = PoseEstimate(T, covariance, 0.0)
    nothing = np.zeros((0, 3))
    return BeamAlignment(
        pose,
        Uncertainty(covariance, np.zeros_like(covariance), ()),
        gaussian_factor(pose),
        covariance,
        nothing,
        nothing,
        RadiusEstimate(radius, 0.0, radius, 0.0),
        0.0,
        AxesTest(0.0, 1, np.zeros(0)),
        (0.0, 0.0),
        (0.0, 0.0),
    )


def align_all(
    state: JointState,
    sights: Sequence[Sight],
    model: ErrorModel,
    placement: IntArray,
    free: BoolArray,
    *,
    surveyed: Surveyed = NOTHING_SURVEYED,
    scene_bands: Sequence[IntArray] = (),
    most_noise: Array | float = np.inf,
) -> Aligned:
    """Maximise from a state, refuse returns that no common poles explain, and expand about the
    maximum.

    Parameters
    ----------
    state
        The start, with the given radius.
    sights, surveyed
        Observations of the poles, and surveyed ones.
    model
        Of the errors.
    placement
        (K,) index of that of each pole.
    free
        (6 L,) which parameters of the poses are estimated.
    scene_bands
        For each LiDAR, bands of elevation that it has returns in other than those on poles.
    most_noise
        As in `maximum.maximise_joint`.

    Raises
    ------
    Refusal
        ``poor_fit`` if most returns lie on no common pole.
    """
    radius, given_sigma = state.radius, model.radius_sigma
    none = np.zeros(0, dtype=np.int64)
    bands = bands_of(sights, scene_bands or [none] * len(state.T))
    offsets = np.array([WORKING_SHARE * np.hypot(size.zero, size.tape) for size in model.sizes])

    def maximum(
        start: JointState, log_noise: Array, sigma: float
    ) -> tuple[Solution[Posterior[JointState]], Network]:
        priors = JointPriors(state.T, offsets, start.radius, sigma, free)
        found = maximise_joint(start, log_noise, sights, surveyed, priors, most_noise)
        assumed = start.radius
        return found, observe(found.point, sights, placement, surveyed, assumed, bands, free)

    found, network = maximum(state, noise_of_start(state, sights), given_sigma)
    by_returns = radius_of_returns(network, model, radius)
    contradicted = by_returns.sigmas_below(radius, given_sigma)
    if contradicted <= MAX_NORMAL:
        weights = np.array([given_sigma, by_returns.sigma]) ** -2.0
        both = float(weights @ [radius, by_returns.value] / weights.sum())
        estimate = RadiusEstimate(radius, given_sigma, both, float(weights.sum() ** -0.5))
        return Aligned(found, network, estimate, contradicted, given_sigma, sights)
    # The given value is no longer used: the radius is estimated again, practically unconstrained,
    # and replaces it.
    assumed = found.point.state.radius
    found, network = maximum(found.point.state, found.point.log_noise, radius)
    by_returns = radius_of_returns(network, model, assumed)
    # Poles that give no information about it may yield a negative one.
    own = max(by_returns.value, 0.0)
    start = replace(found.point.state, radius=own)
    found, network = maximum(start, found.point.log_noise, by_returns.sigma)
    estimate = RadiusEstimate(radius, given_sigma, own, by_returns.sigma)
    return Aligned(found, network, estimate, contradicted, by_returns.sigma, sights)


def _check_counts(target: Beams, source: Beams, needed: int) -> None:
    counts = np.concatenate([np.bincount(one.pole) for one in (target, source)])
    poles = int(target.pole.max()) + 1
    if poles < needed or counts.min() < MIN_LINE_POINTS:
        raise Refusal(
            "too_few_points",
            f"{counted(poles, 'pole')} with {counted(int(counts.min()), 'return')} on the "
            f"poorest: {counted(needed, 'pole')} with "
            f"{MIN_LINE_POINTS} each are needed; bring the poles nearer or add frames",
            {"poles": poles, "returns": int(counts.min())},
        )


def widest(covariance: Array) -> tuple[float, float]:
    """Largest 1 σ of rotation and translation, rad and m, of a covariance (6, 6) of a pose."""
    parts = (covariance[part, part] for part in (slice(3), slice(3, 6)))
    rotation, translation = (float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in parts)
    return rotation, translation


def is_nearly_determined(covariance: Array) -> bool:
    """Whether a covariance (6, 6) of a pose is within the limits for poles."""
    rotation, translation = widest(covariance)
    return rotation < MAX_ROTATION_SIGMA and translation < MAX_TRANSLATION_SIGMA


def pose_of_pair(found: Aligned, model: ErrorModel) -> BeamAlignment:
    """Estimate the pose of a pair and all errors together, and state the uncertainty of the pose.

    Parameters
    ----------
    found
        Of two LiDARs, the target's pose fixed.
    model
        Of the errors, with the 1 σ of the radius that was used.

    Raises
    ------
    Refusal
        ``degenerate_poles`` if the poles hardly constrain the pose in some direction.
    """
    end = found.maximum.point
    noise = np.exp(end.log_noise)
    factor = factor_of(found.network, left=model.left)
    unknowns, groups = factor.unknowns, factor.unknowns.groups()
    known = model.sigmas(groups)
    precision = prior_precision(groups, working_sigma(groups, known, poles_alone=True))
    estimate = solve_factor(factor, precision)
    variance = np.diag(estimate.inverse)[unknowns.poses :]
    # Poles alone determine the size of hardly any error: another evaluation gives the same.
    sigma = group_scales(groups, known, precision, estimate.errors, variance)
    uncertainty = uncertainty_of_pair(
        [
            *parts_of_errors(groups, sigma, precision, estimate.inverse, estimate.errors),
            *parts_of_poles(POLES, factor, estimate.inverse),
            *floors(factor.T, factor.free),
            *sways(factor.T, factor.free, factor.left),
        ]
    )
    covariance = uncertainty.covariance
    if not is_nearly_determined(covariance):
        rotation, translation = widest(covariance)
        raise Refusal(
            "degenerate_poles",
            f"the poles determine the pose only to {np.degrees(rotation):.1f}° and "
            f"{translation:.2f} m (1 σ); lean one pole by 15° or more against the other",
            {"rotation_sigma_rad": rotation, "translation_sigma_m": translation},
        )
    return BeamAlignment(
        PoseEstimate(
            se3.retract(end.state.T[1], estimate.steps[unknowns.pose(1)]),
            covariance,
            float(np.sqrt(np.mean(noise[:, 0] ** 2))),
        ),
        uncertainty,
        factor,
        np.asarray(np.linalg.inv(factor.information[np.ix_(unknowns.pose(1), unknowns.pose(1))])),
        end.state.points,
        end.state.directions,
        found.radius,
        found.radius_conflict,
        compare_axes(found.network, prior_precision(groups, sigma), considered(groups, sigma)),
        (float(noise[0, 0]), float(noise[1, 0])),
        (float(noise[0, 1]), float(noise[1, 1])),
        found.maximum.converged,
        found.maximum.iterations,
        found,
    )
