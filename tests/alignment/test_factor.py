"""The quadratic form of poses and errors: more bands, other poses, and none but a covariance."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.alignment.certainty import few_freedom, prior_precision, solve_factor
from retropole.alignment.maximum import JointPriors, Sight, evaluate_joint
from retropole.alignment.network import (
    OF_SOURCE,
    Network,
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
from retropole.base.systematic import (
    TAPE,
    ErrorModel,
)
from tests.alignment.beams import beams_with_surroundings, state_near

pytestmark = pytest.mark.full


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
