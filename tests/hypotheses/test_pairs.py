"""What each pair says by itself: the true pose is among it, and placements are put together."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.hypotheses.pairs import Pair, find_pairs, is_same_pose, poles_of
from retropole.hypotheses.scans import find_scans, views_of
from retropole.simulation import FIELD
from retropole.simulation.sites import SimulatedSite, simulate_site
from tests.adjustment.adjusting import Steps, made
from tests.hypotheses.conftest import hypothesis_at

pytestmark = pytest.mark.full


def test_every_pair_has_its_true_pose_from_both_placements(
    simulated: SimulatedSite, steps: Steps
) -> None:
    assert [pair.lidars for pair in steps.pairs] == [(0, 1), (0, 2), (1, 2)]
    for pair in steps.pairs:
        i, j = pair.lidars
        T = se3.inverse(simulated.T_world_lidar[i]) @ simulated.T_world_lidar[j]
        met = pair.at(T, poles_of(steps.scans, j))
        assert met is not None
        assert met is pair.hypotheses[0]
        assert set(met.poles) == {0, 1}
        assert sum(met.poles.values()) >= 4
        scores = [each.score for each in pair.hypotheses]
        assert scores == sorted(scores, reverse=True)


def test_hypotheses_of_a_pair_are_different_poses(steps: Steps) -> None:
    for pair in steps.pairs:
        at = poles_of(steps.scans, pair.lidars[1])
        for k, one in enumerate(pair.hypotheses):
            assert not any(is_same_pose(one.T, each.T, at) for each in pair.hypotheses[:k])


def test_a_placement_that_only_one_recorded_says_nothing(steps: Steps) -> None:
    scans = steps.scans.without({(0, 0), (1, 1)})
    pairs = find_pairs(scans, views_of(scans))
    first = pairs[0]
    assert first.lidars == (0, 1)
    assert not first.hypotheses
    assert first.refusal is not None
    assert first.refusal.code == "too_few_poles"
    assert all(set(each.poles) == {1} for each in pairs[1].hypotheses)
    assert all(set(each.poles) == {0} for each in pairs[2].hypotheses)


def test_a_ring_closes_with_what_the_scene_speaks_against_a_little() -> None:
    """20 returns leave a pose 2.5° off, under which the scenes of bare ground hardly agree."""
    rng = np.random.default_rng(29)
    simulated = simulate_site("ring", rng, lidars=int(rng.integers(3, 7)), noise=FIELD)
    scans = find_scans(simulated.as_site())
    found = []
    for pair in find_pairs(scans, views_of(scans)):
        if pair.hypotheses:
            i, j = pair.lidars
            T = se3.inverse(simulated.T_world_lidar[i]) @ simulated.T_world_lidar[j]
            met = pair.at(T, poles_of(scans, j))
            assert met is not None, pair.lidars
            found.append(met.stands)
    assert len(found) == 6
    assert not all(found)


def test_symmetric_poles_leave_several_hypotheses_standing() -> None:
    simulated = made(kind="ring", placements=None)
    scans = find_scans(simulated.as_site())
    for pair in find_pairs(scans, views_of(scans)):
        i, j = pair.lidars
        T = se3.inverse(simulated.T_world_lidar[i]) @ simulated.T_world_lidar[j]
        at = poles_of(scans, j)
        assert at.shape == (4, 3)
        assert any(is_same_pose(each.T, T, at) for each in pair.hypotheses)
        one, other = (each.T for each in pair.standing[:2])
        turn = one @ se3.inverse(other)
        assert se3.rotation_angle(turn[:3, :3]) > np.radians(170.0)


def test_of_what_stands_at_a_pose_that_of_more_placements_is_met() -> None:
    T = se3.random(np.random.default_rng(0))
    at = np.zeros((1, 3))
    few = hypothesis_at(T, {0: 2}, 0.9)
    many = hypothesis_at(T, {0: 2, 1: 2}, 0.5)
    fallen = hypothesis_at(T, {0: 2, 1: 2, 2: 2}, 0.4, stands=False)
    pair = Pair((0, 1), (few, many, fallen), True)
    assert pair.at(T, at) is many
    assert pair.at(se3.retract(T, np.r_[0, 0, 0, 5.0, 0, 0]), at) is None
    assert pair.standing == (few, many)
