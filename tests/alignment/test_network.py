"""Observations as quadratic forms: where they stand, what is eliminated, what is drawn."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.alignment.certainty import few_freedom, prior_precision, solve_factor
from retropole.alignment.maximum import JointPriors, Sight, evaluate_joint
from retropole.alignment.network import (
    DEPTH_SIGMA,
    OF_SOURCE,
    Network,
    about,
    bands_of,
    factor_of,
    gaussian_factor,
    observe,
    poses_of_pair,
)
from retropole.alignment.posterior import JointState
from retropole.alignment.survey import NOTHING_SURVEYED
from retropole.alignment.unknowns import POSE, Unknowns
from retropole.base import se3
from retropole.base.datatypes import Array, PoseEstimate
from retropole.base.systematic import TAPE, ErrorModel, band_of
from tests.adjustment import geodetic
from tests.adjustment.adjusting import Steps
from tests.alignment.beams import beams_with_surroundings, state_near
from tests.tiers import first_of

pytestmark = pytest.mark.full


def test_each_lidars_returns_in_each_placement_are_one_observation(surveyed: Steps) -> None:
    network, poles = surveyed.adjusted.network, surveyed.datum.poles
    found = {}
    for one in network.observations:
        if one.poles is None:
            continue
        assert one.lidar is not None
        found[one.lidar, one.placement] = set(one.poles.tolist())
        # The axes are the last of its unknowns, in their order.
        np.testing.assert_array_equal(
            one.place[-4 * len(one.poles) :], network.unknowns.axis(one.poles)
        )
        np.testing.assert_array_equal(one.place[:6], network.unknowns.pose(one.lidar))
        assert np.linalg.eigvalsh(one.information)[0] > -1e-6 * np.trace(one.information)
        assert one.returns > 10
    expected = {
        (i, p): {k for k, pole in enumerate(poles) if pole.placement == p and i in pole.seen}
        for i in range(3)
        for p in range(2)
    }
    assert found == {key: own for key, own in expected.items() if own}


def test_no_lidar_knows_the_depth_of_a_pole_better_than_its_beams_are_known(steps: Steps) -> None:
    """However many returns it has; sideways they average."""
    network = steps.adjusted.network
    most_aside = 0.0
    for one in network.observations:
        if one.poles is None or one.lidar is None:
            continue
        state = network.state.of(one.lidar, one.poles)
        for k, (point, tangents) in enumerate(zip(state.points, state.tangents, strict=True)):
            first = len(one.place) - 4 * (len(one.poles) - k)
            ray = point - state.T[:3, 3]
            depth = tangents.T @ (ray / np.linalg.norm(ray))
            aside = np.array([-depth[1], depth[0]]) / np.linalg.norm(depth)
            own = one.information[first : first + 2, first : first + 2]
            # A beam across the axis knows all of that depth, one at a slant a part.
            assert 0.1 < depth @ own @ depth * DEPTH_SIGMA**2 < 1.0
            most_aside = max(most_aside, float(aside @ own @ aside) * DEPTH_SIGMA**2)
    assert most_aside > 1.5


def test_the_scatter_and_the_depth_make_all_that_the_poles_err(steps: Steps) -> None:
    """Both parts are no more than the information allows, and neither is nothing."""
    factor = factor_of(steps.adjusted.network)
    by_depth = factor.depth @ factor.depth.T
    scatter = factor.information - by_depth
    most = np.linalg.eigvalsh(factor.information)[-1]
    assert np.linalg.eigvalsh(scatter)[0] > -1e-9 * most
    free = factor.unknowns.pose(1)
    shares = np.diag(by_depth)[free] / np.diag(factor.information)[free]
    assert np.all((shares > 0.01) & (shares < 0.99))


def test_what_was_surveyed_is_reported_of_its_own_axis_or_point(surveyed: Steps) -> None:
    network = surveyed.adjusted.network
    unknowns, known = network.unknowns, surveyed.datum.surveyed
    by_name = {one.name: one for one in network.observations if one.poles is None}
    assert len(by_name) == len(known.ends) + len(known.known) + len(known.seen)
    for end in known.ends:
        place = by_name[end.name].place
        np.testing.assert_array_equal(place, unknowns.axis(np.array([end.axis])))
    for q, point in enumerate(known.known):
        np.testing.assert_array_equal(by_name[point.name].place, unknowns.control_point(q))
    for seen in known.seen:
        one = by_name[seen.name]
        assert one.lidar == seen.lidar
        both = np.r_[unknowns.pose(seen.lidar), unknowns.control_point(seen.point)]
        np.testing.assert_array_equal(one.place, both)


def test_eliminating_axes_changes_no_answer(surveyed: Steps) -> None:
    """Poses and errors as the whole system has them, and as certain."""
    network = surveyed.adjusted.network
    kept = network.unknowns.kept
    prior = np.zeros(network.unknowns.size)
    prior[network.unknowns.poses : kept] = surveyed.adjusted.end.precision
    whole, gradient = network.total()
    inverse = np.linalg.inv(whole + np.diag(prior))
    factor = factor_of(network)
    reduced, vector = factor.information, factor.vector
    np.testing.assert_allclose(
        np.linalg.inv(reduced + np.diag(prior[:kept])), inverse[:kept, :kept], rtol=1e-4, atol=1e-14
    )
    # The prior holds the errors at zero, not where the expansion starts.
    step = inverse @ (gradient + whole @ network.start)
    alone = np.linalg.solve(reduced + np.diag(prior[:kept]), vector)
    np.testing.assert_allclose(alone, step[:kept], rtol=1e-4, atol=1e-9)


def test_leaving_out_is_adding_nothing(steps: Steps) -> None:
    network = steps.adjusted.network
    whole, gradient = network.total()
    left = network.without({1})
    one = network.observations[1]
    less, by = left.total()
    less[np.ix_(one.place, one.place)] += one.information
    by[one.place] += one.gradient
    np.testing.assert_allclose(less, whole, atol=1e-6 * np.abs(whole).max())
    np.testing.assert_allclose(by, gradient, atol=1e-6 * np.abs(gradient).max())


def test_axes_of_which_nothing_is_reported_need_a_ridge(steps: Steps) -> None:
    network = steps.adjusted.network
    left = network.without({k for k, one in enumerate(network.observations) if one.placement == 0})
    factor = factor_of(left, ridge=1.0)
    assert np.isfinite(factor.information).all()
    assert np.isfinite(factor.vector).all()


def test_the_expansion_starts_where_its_slopes_are_small(steps: Steps) -> None:
    """The maximum of the poles' posterior: what is left is what few returns leave open."""
    network = steps.adjusted.network
    whole, gradient = network.total()
    axes = slice(network.unknowns.kept, None)
    off = np.linalg.solve(whole[axes, axes], gradient[axes])
    assert np.abs(off.reshape(-1, 4)[:, :2]).max() < 0.005
    assert network.start[: network.unknowns.poses].any() == 0


def test_bands_are_those_of_poles_and_surfaces(steps: Steps) -> None:
    own = [np.array([60], dtype=np.int64) for _ in range(3)]
    for sight, bands in zip(steps.sights, bands_of(steps.sights, own), strict=True):
        on_poles = band_of(sight.beams.directions, sight.beams.axis)
        np.testing.assert_array_equal(bands, np.unique([*on_poles, 60]))
    assert isinstance(steps.adjusted.network.unknowns, Unknowns)


@pytest.mark.parametrize("first_held", first_of([False, True]))
def test_the_covariance_is_that_of_drawn_observations(first_held: bool) -> None:
    network = geodetic.network(first_held=first_held)
    rng = np.random.default_rng(0)
    steps = []
    for _ in range(300):
        errors = geodetic.drawn_errors(network, rng)
        end, _ = geodetic.adjusted(geodetic.with_errors(network, errors))
        pairs = zip(network.state.T, end.T, strict=True)
        steps.append(np.concatenate([se3.local(a, b) for a, b in pairs]))
    poses = network.unknowns.poses
    stated = end.inverse[:poses, :poses]
    free = np.flatnonzero(network.free)
    assert not stated[~network.free].any()
    assert not np.array(steps)[:, ~network.free].any()
    L = np.linalg.cholesky(np.linalg.inv(stated[np.ix_(free, free)]))
    white = np.array(steps)[:, free] @ L
    found = white.T @ white / len(white)
    # 300 draws know a variance to 8 %.
    np.testing.assert_allclose(found, np.eye(len(free)), atol=0.3)
    np.testing.assert_allclose(np.diag(found).mean(), 1.0, atol=0.06)


def test_observations_about_other_poses_say_the_same() -> None:
    """At small steps from there."""
    rng = np.random.default_rng(3)
    network = geodetic.network()
    network = geodetic.with_errors(network, geodetic.drawn_errors(network, rng))
    steps = 0.1 * rng.normal(size=network.unknowns.poses)
    T = moved(network.state.T, steps)
    there = about(network, T)
    np.testing.assert_array_equal(there.state.T, T)
    step = 1e-6 * rng.normal(size=network.unknowns.size)
    poses = network.unknowns.poses
    onward = zip(network.state.T, moved(T, step[:poses]), strict=True)
    here = np.concatenate([se3.local(a, b) for a, b in onward])
    unknowns = np.r_[here, step[poses:]]
    for one, other in zip(network.observations, there.observations, strict=True):
        # Of what is no pose the slope is the same.
        rest = one.place >= poses
        expected = one.gradient - one.information @ unknowns[one.place]
        found = other.gradient - other.information @ step[other.place]
        np.testing.assert_allclose(found[rest], expected[rest], atol=1e-7 * np.abs(expected).max())
        assert one.by_value is not None
        assert other.by_value is not None
        np.testing.assert_allclose(
            other.by_value[1] + other.by_value[0] @ step[other.place],
            one.by_value[1] + one.by_value[0] @ unknowns[one.place],
            atol=1e-8,
        )
        np.testing.assert_allclose(other.gradient, -other.by_value[0].T @ other.by_value[1])
        np.testing.assert_allclose(other.information, other.by_value[0].T @ other.by_value[0])


def moved(T: Array, step: Array) -> Array:
    steps = step.reshape(-1, 6)
    return np.stack([se3.retract(one, by) for one, by in zip(T, steps, strict=True)])


@pytest.fixture(scope="module")
def network() -> Network:
    """Of the poles of a street, a little off the truth."""
    pair, beams = beams_with_surroundings()
    near = state_near(pair)
    own, nobody = np.arange(len(pair.poles)), np.zeros(0, dtype=np.int64)
    state = JointState(
        poses_of_pair(near.T),
        near.offsets,
        near.radius,
        near.points,
        near.directions,
        np.zeros((0, 3)),
    )
    sights = [Sight(lidar, one, own) for lidar, one in enumerate(beams)]
    priors = JointPriors(state.T, np.full(2, 0.004), near.radius, 0.0004, OF_SOURCE)
    at = evaluate_joint(state, np.log(np.full((2, 2), 0.008)), sights, NOTHING_SURVEYED, priors)
    bands = bands_of(sights, [nobody, nobody])
    placement, radius = np.zeros(len(own), dtype=np.int64), pair.poles[0].radius
    return observe(at, sights, placement, NOTHING_SURVEYED, radius, bands, OF_SOURCE)


def weighed(unknowns: Unknowns) -> Array:
    groups = unknowns.groups()
    return prior_precision(groups, ErrorModel().sigmas(groups))


def test_with_more_bands_nothing_changes(network: Network) -> None:
    factor = factor_of(network)
    wider = factor.with_bands([np.array([-40, -2, 30]), np.array([-3, 50])])
    assert wider.unknowns.kept > factor.unknowns.kept
    alone = solve_factor(factor, weighed(factor.unknowns))
    among = solve_factor(wider, weighed(wider.unknowns))
    place = factor.unknowns.places_in(wider.unknowns)
    errors, poses = place[factor.unknowns.poses :] - wider.unknowns.poses, wider.unknowns.poses
    assert wider.redundancy == factor.redundancy
    np.testing.assert_allclose(among.steps, alone.steps, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(among.errors[errors], alone.errors, rtol=1e-6)
    np.testing.assert_allclose(among.inverse[np.ix_(place, place)], alone.inverse, rtol=1e-6)
    # The bands that the poles have no returns in keep their prior.
    new = np.setdiff1d(np.arange(wider.unknowns.errors), errors)
    assert len(new) > 0
    np.testing.assert_allclose(among.errors[new], 0.0, atol=1e-15)
    np.testing.assert_allclose(
        np.diag(among.inverse)[poses + new], 1 / weighed(wider.unknowns)[new]
    )


def test_about_other_poses_the_answer_is_the_same(network: Network) -> None:
    """To first order: their steps are counted from there."""
    factor = factor_of(network)
    precision = weighed(factor.unknowns)
    found = solve_factor(factor, precision)
    step = 1e-4 * np.arange(1.0, 7.0)
    other = factor.T.copy()
    other[1] = se3.retract(factor.T[1], step)
    again = solve_factor(factor.about(other), precision)
    pose, pose_again = (
        se3.retract(T[1], each.steps[POSE:]) for T, each in ((factor.T, found), (other, again))
    )
    sigma = np.sqrt(np.diag(found.inverse)[POSE : 2 * POSE])
    assert np.abs(se3.local(pose, pose_again) / sigma).max() < 1e-3
    np.testing.assert_allclose(again.errors, found.errors, rtol=1e-3, atol=1e-9)


def test_a_given_covariance_says_nothing_of_the_errors() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(6, 6)) * 0.01
    covariance = half @ half.T + 1e-6 * np.eye(6)
    pose = PoseEstimate(se3.random(rng), covariance, 0.0)
    factor = gaussian_factor(pose)
    assert few_freedom(factor.redundancy) == 1.0
    precision, poses = weighed(factor.unknowns), factor.unknowns.poses
    found = solve_factor(factor, precision)
    np.testing.assert_allclose(found.steps, 0.0)
    np.testing.assert_allclose(found.errors, 0.0)
    np.testing.assert_allclose(found.inverse[POSE:poses, POSE:poses], covariance, rtol=1e-6)
    np.testing.assert_allclose(found.inverse[poses:, :poses], 0.0, atol=1e-15)
    np.testing.assert_allclose(np.diag(found.inverse)[poses:], 1 / precision)


def test_offsets_and_radius_count_from_what_was_given(network: Network) -> None:
    """Errors are told from there, wherever the expansion was made."""
    unknowns, state = network.unknowns, network.state
    tape = [unknowns.device(lidar)[TAPE] for lidar in (0, 1)]
    np.testing.assert_allclose(network.start[tape], state.offsets)
    assert network.start[unknowns.radius] == pytest.approx(0.001)
    assert np.count_nonzero(network.start) == 3
    # Errors that are known to be what the state has them move nothing else.
    factor = factor_of(network)
    known = factor.information @ network.start[: unknowns.kept]
    other = factor_of(replace(network, start=np.zeros_like(network.start)))
    np.testing.assert_allclose(factor.vector - known, other.vector, rtol=1e-6, atol=1e-3)
