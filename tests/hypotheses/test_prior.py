"""A rotation known beforehand chooses, and is never needed."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Detection, Match, Placement, PointCloud, Scan
from retropole.base.errors import Refusal, UsageError
from retropole.hypotheses.correspondence import MAX_HYPOTHESES, every_match
from retropole.hypotheses.prior import PosePrior, agreeing_with_prior, pose_prior
from retropole.hypotheses.search import match_poles
from retropole.pipeline import Options, calibrate
from retropole.simulation import simulate_pair
from tests.conftest import PoleMaker


def match(phi: list[float]) -> Match:
    T = np.eye(4)
    T[:3, :3] = se3.exp_so3(np.array(phi))
    return Match(((0, 0), (1, 1)), T, 0.01, True, True, np.eye(6))


def test_upright_looks_at_the_tilt_only() -> None:
    prior = pose_prior(True, None, 10.0)
    assert prior is not None
    assert prior.misfit(match([0, 0, 2.0]).T_target_source) == pytest.approx(0, abs=1e-6)
    assert prior.misfit(match([np.radians(20), 0, 0]).T_target_source) == pytest.approx(2.0)


def test_angles_are_about_fixed_axes_x_first() -> None:
    prior = pose_prior(False, (10.0, 20.0, 30.0), 5.0)
    assert prior is not None
    assert prior.rotation is not None
    x, y, z = (se3.exp_so3(np.radians(a) * e) for a, e in zip((10, 20, 30), np.eye(3), strict=True))
    np.testing.assert_allclose(prior.rotation, z @ y @ x, atol=1e-12)


def test_hypotheses_that_contradict_it_are_left_out() -> None:
    near, far = match([0, 0, 0.1]), match([0, 0, 3.0])
    prior = PosePrior(np.eye(3), np.radians(10))
    assert agreeing_with_prior([near, far], prior) == [near]
    assert agreeing_with_prior([near, far], None) == [near, far]
    with pytest.raises(Refusal) as refusal:
        agreeing_with_prior([far], prior)
    assert refusal.value.code == "prior_contradicted"
    with pytest.raises(UsageError, match="exclude"):
        pose_prior(True, (0.0, 0.0, 0.0), 1.0)


def test_only_hypotheses_that_fit_the_poles_count_as_agreeing() -> None:
    prior = PosePrior(np.eye(3), np.radians(10))
    far, near = match([0, 0, 3.0]), replace(match([0, 0, 0.1]), exact=False)
    with pytest.raises(Refusal, match="of 1 hypothesis that") as refusal:
        agreeing_with_prior([far, near], prior)
    assert float(refusal.value.values["sigmas"]) > float(refusal.value.values["allowed"])


def test_it_speaks_before_the_best_of_many_are_taken(make_pole: PoleMaker) -> None:
    """What the prior allows is tried, however many better matches it conflicts with."""
    turns = [np.array([0, 0, k * np.pi / 6]) for k in range(12)]
    ring = [
        make_pole((4.0, 0.0, 0.0), (0.2, 0.5, 1.0), T=se3.from_rt(se3.exp_so3(t), np.zeros(3)))
        for t in turns
    ]
    few = [*ring[:2], make_pole((0.5, 0.2, 0.0), (0.4, 0.0, 1.0))]
    cloud = PointCloud(np.zeros((1, 3)))
    target, source = (
        Scan(cloud, None, Detection(tuple(poles), (), 0.0, "given", 0)) for poles in (ring, few)
    )
    every = every_match(ring, few).matches
    last = [match for match in every if match.exact][-1]
    assert len(every) > MAX_HYPOTHESES
    prior = PosePrior(last.T_target_source[:3, :3], np.radians(0.1))
    kept = match_poles(Placement(target, source), None, prior)
    assert any(match.pairs == last.pairs for match in kept.matches)
    assert kept.tried.ways.tried == kept.tried.ways.found < len(every)


@pytest.mark.full
def test_it_decides_where_the_scene_does_not() -> None:
    pair = simulate_pair("bare", np.random.default_rng(5), symmetric=True)
    assert calibrate(pair.target, pair.source).status == "refused"
    prior = PosePrior(pair.T_target_source[:3, :3], np.radians(10))
    answer = calibrate(pair.target, pair.source, options=Options(prior=prior))
    assert answer.T_target_source is not None
    off = se3.local(answer.T_target_source, pair.T_target_source)
    assert np.linalg.norm(off[:3]) < np.radians(1.5)


@pytest.mark.full
def test_a_wrong_one_is_refused() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    wrong = se3.exp_so3(np.array([0, 0, np.radians(70)])) @ pair.T_target_source[:3, :3]
    answer = calibrate(
        pair.target, pair.source, options=Options(prior=PosePrior(wrong, np.radians(3)))
    )
    assert answer.status == "refused"
    assert answer.reasons[0].code in ("prior_contradicted", "no_overlap")


def test_a_place_is_a_prior_as_a_rotation_is() -> None:
    """What is farther than three sigma of it is left out, whatever the rotation."""
    prior = pose_prior(False, None, 10.0, 2.0)
    assert prior is not None
    near, far = (se3.from_rt(np.eye(3), np.array([x, 0.0, 0.0])) for x in (5.9, 6.1))
    assert prior.allows(near)
    assert not prior.allows(far)
    both = pose_prior(True, None, 5.0, 2.0)
    assert both is not None
    tilted = se3.from_rt(se3.exp_so3(np.array([0.3, 0.0, 0.0])), near[:3, 3])
    assert both.allows(near)
    assert not both.allows(tilted)
    assert prior.allows(tilted)
    assert pose_prior(False, None, 10.0) is None
