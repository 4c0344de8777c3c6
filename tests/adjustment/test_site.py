"""One adjustment of a site: near the truth, as sure as it says; refused where poses are free."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.datum import without_poles
from retropole.adjustment.site import check_determined, find_links, without_observations
from retropole.base import se3
from retropole.base.errors import Refusal
from retropole.base.se3 import joint_of, relative
from retropole.simulation.sites import SimulatedSite
from tests.adjustment.adjusting import Steps, off
from tests.tiers import first_of

pytestmark = pytest.mark.full

THOUSANDTH = 22.5
"""χ² with 6 degrees of freedom is above this once in a thousand times."""


@pytest.mark.parametrize("which", first_of(["surveyed", "steps"]))
def test_every_two_lidars_are_as_far_from_the_truth_as_is_stated(
    which: str, simulated: SimulatedSite, request: pytest.FixtureRequest
) -> None:
    found: Steps = request.getfixturevalue(which)
    T, covariance = found.adjusted.end.T, found.adjusted.covariance
    for i, j in ((0, 1), (0, 2), (1, 2)):
        true = se3.inverse(simulated.T_world_lidar[i]) @ simulated.T_world_lidar[j]
        pose = relative(T[i], T[j], joint_of(covariance, i, j))
        assert off(pose, true) < THOUSANDTH
        apart = se3.difference(pose.T_i_j, true)
        assert apart.rotation < np.radians(0.1)
        assert apart.translation < 0.02
    assert found.adjusted.converged


def test_a_survey_gives_poses_in_its_own_frame(
    simulated_survey: SimulatedSite, surveyed: Steps
) -> None:
    for i, (T, true) in enumerate(
        zip(surveyed.adjusted.end.T, simulated_survey.T_world_lidar, strict=True)
    ):
        own = surveyed.adjusted.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        step = se3.local(T, true)
        assert step @ np.linalg.solve(own, step) < THOUSANDTH
        assert np.linalg.norm(step[3:]) < 0.05


def test_more_that_is_observed_leaves_less_open(steps: Steps) -> None:
    """Without a placement no pose is surer of the poles' and surfaces' information."""
    gone = {k for k, pole in enumerate(steps.datum.poles) if pole.placement == 1}
    less = replace(steps, scenes=[]).again(without_poles(steps.datum, gone))
    more = replace(steps, scenes=[]).again(steps.datum)
    for i in (1, 2):
        own = slice(6 * i, 6 * i + 6)
        wide, narrow = (np.sqrt(np.diag(a.covariance)[own]) for a in (less, more))
        assert np.median(wide / narrow) > 1.0


def test_leaving_out_what_one_lidar_saw_leaves_what_the_others_saw(steps: Steps) -> None:
    left = without_observations(steps.datum, 1, 0)
    for before, after in zip(steps.datum.poles, left.poles, strict=True):
        kept = before.seen.keys() - ({1} if before.placement == 0 else set())
        assert after.seen.keys() == kept
    again = steps.again(left)
    for one in again.network.observations:
        assert (one.lidar, one.placement) != (1, 0)


def test_poses_that_are_all_but_free_are_refused(steps: Steps) -> None:
    good = steps.adjusted.covariance
    check_determined(steps.site, good, is_surveyed=False)
    wide = good.copy()
    wide[15, 15] = 0.6**2
    with pytest.raises(Refusal) as refused:
        check_determined(steps.site, wide, is_surveyed=True)
    assert refused.value.code == "degenerate_poles"
    assert refused.value.values["lidar"] == "posts-3"
    with pytest.raises(Refusal) as refused:
        check_determined(steps.site, good + 0.2 * np.eye(18), is_surveyed=True)
    assert refused.value.code == "survey_too_weak"


def test_links_are_told_with_the_poles_that_both_their_sides_see(steps: Steps) -> None:
    """Two groups of LiDARs, of three poles each, and two poles more that one of each sees."""
    pole = steps.adjusted.datum.poles[0]
    own = next(iter(pole.seen.values()))
    seen = [*[(0, 1)] * 3, *[(2, 3)] * 3, (1, 2), (1, 2, 3)]
    poles = [replace(pole, seen=dict.fromkeys(each, own)) for each in seen]
    datum = replace(steps.adjusted.datum, poles=poles)
    four = replace(steps.adjusted.end, T=steps.adjusted.end.T[[0, 0, 0, 0]], scene=())
    found = {
        link.lidars: link for link in find_links(replace(steps.adjusted, datum=datum, end=four))
    }
    assert found[0, 1].poles == (0, 1, 2)
    assert found[2, 3].poles == (3, 4, 5, 7)
    # All that the one group has to do with the other are two poles, though each LiDAR sees more.
    assert found[1, 2].poles == (6, 7)
    assert found[1, 2].near == {0, 1}
    assert len(found) == 3


def test_links_of_one_pair_are_that_pair(pair_steps: Steps) -> None:
    (link,) = find_links(pair_steps.adjusted)
    assert link.lidars == (0, 1)
    assert link.near == {0}
    assert link.poles == (0, 1, 2)
