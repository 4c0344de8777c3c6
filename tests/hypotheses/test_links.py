"""A LiDAR that shares one pole with others: the place links it, or nothing does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment import blunders
from retropole.adjustment.answer import SiteCalibration
from retropole.adjustment.blunders import check_poles_of_dependent
from retropole.adjustment.datum import (
    Dependent,
    check_dependent,
    check_poles_left,
    find_datum,
    find_dependent,
    orient_links,
    prior_poses,
    without_poles,
)
from retropole.alignment.adjustment import SURROUNDINGS_SIGMA
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.errors import Refusal
from retropole.hypotheses import links as one_pole
from retropole.hypotheses.by_place import DETERMINED
from retropole.hypotheses.joint_choice import choose_poses
from retropole.hypotheses.links import link_by_place
from retropole.hypotheses.pairs import Pair
from retropole.pipeline import calibrate, calibrate_site
from retropole.simulation.sites import SimulatedSite, Survey, simulate_site
from tests.adjustment.adjusting import Steps, between, made, off, reordered
from tests.hypotheses.conftest import hypothesis_at

THOUSANDTH = 22.5
"""χ² with 6 degrees of freedom is above it once in a thousand times."""

GROUND = 0
"""The first of the surroundings of a site."""


def keeping(
    simulated: SimulatedSite, lidars: tuple[int, ...], pole: int = 0, *, bare: bool = False
) -> SimulatedSite:
    """Hide all poles but one from some LiDARs, and all surroundings but the ground from all."""
    first = len(simulated.surroundings)
    clouds = [list(row) for row in simulated.clouds]
    every = [list(row) for row in simulated.labels]
    for i, row in enumerate(clouds):
        for p, cloud in enumerate(row):
            assert cloud is not None
            labels = every[i][p]
            assert labels is not None
            kept = (labels < first) | (i not in lidars) | (labels == first + pole)
            if bare:
                kept &= (labels == GROUND) | (labels >= first)
            row[p], every[i][p] = cloud.select(np.flatnonzero(kept)), labels[kept]
    return replace(simulated, clouds=tuple(map(tuple, clouds)), labels=tuple(map(tuple, every)))


def with_pole_moved(simulated: SimulatedSite, lidar: int, step: Array) -> SimulatedSite:
    """Push the poles that one LiDAR sees, in the world frame, after all others recorded them."""
    (cloud,), (labels,) = simulated.clouds[lidar], simulated.labels[lidar]
    assert cloud is not None
    assert labels is not None
    xyz = cloud.xyz.copy()
    own = labels >= len(simulated.surroundings)
    xyz[own] += simulated.T_world_lidar[lidar][:3, :3].T @ step
    clouds = list(simulated.clouds)
    clouds[lidar] = (replace(cloud, xyz=xyz),)
    return replace(simulated, clouds=tuple(clouds))


def true_between(simulated: SimulatedSite, i: int, j: int) -> Array:
    return se3.inverse(simulated.T_world_lidar[i]) @ simulated.T_world_lidar[j]


@pytest.fixture(scope="module")
def hidden() -> SimulatedSite:
    """Three LiDARs in one placement, of which the last sees one pole."""
    return keeping(made(seed=101, placements=1), (2,))


@pytest.fixture(scope="module")
def answer(hidden: SimulatedSite) -> SiteCalibration:
    return calibrate_site(hidden.as_site())


@pytest.mark.full
def test_the_place_links_a_lidar_that_shares_one_pole(
    hidden: SimulatedSite, answer: SiteCalibration
) -> None:
    assert answer.status == "ok", answer.reasons
    for i, j in ((0, 1), (0, 2), (1, 2)):
        relative = between(answer, i, j)
        assert off(relative, true_between(hidden, i, j)) < THOUSANDTH
    assert answer.groups == ((0, 1, 2),)
    (note,) = [note for note in answer.notes if note.code == "by_place"]
    assert note.values == {"lidars": hidden.names[2], "poles": 1}
    assert [pair.standing for pair in answer.pairs] == [1, 1, 1]
    assert all("the place" not in test.name for test in answer.tests)


@pytest.mark.full
def test_without_surroundings_it_is_linked_to_nothing() -> None:
    bare = keeping(made(seed=101, placements=1), (2,), bare=True)
    refused = calibrate_site(bare.as_site())
    assert refused.status == "refused"
    assert refused.reasons[0].code == "disconnected"
    assert not refused.lidars


@pytest.mark.full
def test_the_order_of_the_lidars_changes_nothing(
    hidden: SimulatedSite, answer: SiteCalibration
) -> None:
    order = (2, 0, 1)
    again = calibrate_site(reordered(hidden.as_site(), order, (0,)))
    assert again.status == "ok", again.reasons
    assert {note.code for note in again.notes} == {note.code for note in answer.notes}
    for i, j in ((0, 1), (0, 2), (1, 2)):
        other = between(again, order.index(i), order.index(j))
        assert off(between(answer, i, j), other.T_i_j) < 2.0


@pytest.mark.full
def test_the_frame_of_the_lidar_that_hangs_may_be_that_of_the_site(
    hidden: SimulatedSite, answer: SiteCalibration
) -> None:
    site = replace(hidden.as_site(), reference=2)
    again = calibrate_site(site)
    assert again.status == "ok", again.reasons
    assert off(between(answer, 0, 2), between(again, 0, 2).T_i_j) < 0.5
    (note,) = [note for note in again.notes if note.code == "by_place"]
    assert note.values["lidars"] == f"{hidden.names[0]}, {hidden.names[1]}"


@pytest.mark.full
def test_a_pole_that_moved_links_nothing(hidden: SimulatedSite) -> None:
    moved = with_pole_moved(hidden, 2, np.array([0.3, 0.2, 0.0]))
    assert calibrate_site(moved.as_site()).status == "refused"


@pytest.mark.full
def test_a_pole_that_was_pushed_a_little_is_told(hidden: SimulatedSite) -> None:
    """Where it alone holds a part of the pose that is `not_checked`, where not it is refused."""
    pushed = with_pole_moved(hidden, 2, np.array([0.04, 0.03, 0.0]))
    assert calibrate_site(pushed.as_site()).status != "ok"


@pytest.mark.full
def test_what_the_surroundings_alone_do_not_hold_is_not_checked(
    steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    dependent = (Dependent(0, 2, steps.adjusted.end.T[2], frozenset({2})),)
    adjusted = replace(steps.adjusted, datum=replace(steps.datum, dependent=dependent))
    assert list(check_poles_of_dependent(steps.recorded, adjusted)) == []
    monkeypatch.setattr(blunders, "is_constrained", lambda covariance: False)
    (reason,) = check_poles_of_dependent(steps.recorded, adjusted)
    assert reason.code == "not_checked"
    assert reason.values["lidar"] == steps.site.lidars[2].name


def test_a_parted_pole_is_seen_by_one_side_each(steps: Steps) -> None:
    dependent = Dependent(0, 2, np.eye(4), frozenset({2}))
    poles = steps.datum.poles
    across = dependent.across(poles)
    parted = dependent.split_across(poles)
    assert len(parted) == len(poles) + len(across)
    assert not dependent.across(parted)
    for k, other in zip(across, parted[len(poles) :], strict=True):
        assert {**parted[k].seen, **other.seen} == poles[k].seen


@pytest.mark.full
def test_another_place_links_nothing(hidden: SimulatedSite) -> None:
    site = hidden.as_site()
    other = keeping(made(seed=104, placements=1), (2,)).as_site()
    mixed = replace(site, lidars=(*site.lidars[:2], other.lidars[2]))
    assert calibrate_site(mixed).status == "refused"


@pytest.mark.full
def test_what_was_surveyed_holds_the_frame_and_the_place_what_hangs() -> None:
    surveyed = simulate_site(
        "posts",
        np.random.default_rng(101),
        lidars=3,
        placements=1,
        sensors=("VLP-16",),
        survey=Survey((0,), 0),
    )
    one = keeping(surveyed, (2,))
    answer = calibrate_site(one.as_site())
    assert answer.status != "refused", answer.reasons
    assert "by_place" in {note.code for note in answer.notes}
    for pose in answer.lidars:
        step = se3.local(pose.T_site_lidar, one.T_world_lidar[pose.lidar])
        assert step @ np.linalg.solve(pose.covariance, step) < THOUSANDTH


@pytest.mark.full
def test_two_lidars_of_one_pole_are_a_pair(hidden: SimulatedSite) -> None:
    site = hidden.as_site()
    two = replace(site, lidars=(site.lidars[0], site.lidars[2]))
    answer = calibrate_site(two)
    target, source = (lidar.clouds[0] for lidar in two.lidars)
    assert isinstance(target, PointCloud)
    assert isinstance(source, PointCloud)
    pair = calibrate(target, source)
    assert answer.status == pair.status == "ok", answer.reasons
    assert pair.T_target_source is not None
    assert off(between(answer, 0, 1), pair.T_target_source) < 0.5


def test_where_poles_link_all_the_place_is_not_asked(
    steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*args: object) -> None:
        pytest.fail("asked")

    monkeypatch.setattr(one_pole, "choose_about_one_pole", never)
    scans, pairs = link_by_place(steps.scans, steps.pairs, 0.02)
    assert scans is steps.scans
    assert pairs == steps.pairs
    dependent = find_dependent(pairs, steps.choices.best.poses)
    assert dependent == ()
    datum = find_datum(
        steps.site, steps.scans.origins, steps.choices.best.poses, steps.poles, dependent
    )
    assert datum.surveyed.poses == ()


@pytest.mark.full
def test_a_pose_that_the_scene_does_not_confirm_links_nothing(
    hidden: SimulatedSite, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(one_pole, "_is_confirmed", lambda chosen: False)
    refused = calibrate_site(hidden.as_site())
    assert refused.reasons[0].code == "disconnected"


def at(x: float, turn: float = 0.0) -> Array:
    return se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, turn])), np.array([x, 0.0, 0.0]))


def linked(i: int, j: int, T: Array, *, by_place: bool, score: float = 0.5) -> Pair:
    own = hypothesis_at(T, {0: 1 if by_place else 3}, score)
    return Pair((i, j), (own,), True, by_place=by_place)


def test_two_links_that_tell_different_poses_do_not_go_together() -> None:
    pairs = (
        linked(0, 1, at(5.0), by_place=False),
        linked(0, 2, at(9.0), by_place=True),
        linked(1, 2, at(4.0, 1.0), by_place=True),
    )
    poles = [np.zeros((1, 3))] * 3
    assert choose_poses([0, 1, 2], pairs, poles, 0).rivals
    agreeing = (*pairs[:2], linked(1, 2, at(4.0), by_place=True))
    assert not choose_poses([0, 1, 2], agreeing, poles, 0).rivals


def test_a_chain_hangs_link_by_link() -> None:
    poses = {i: at(2.0 * i) for i in range(5)}
    pairs = (
        linked(0, 1, at(2.0), by_place=False),
        linked(1, 2, at(2.0), by_place=True, score=0.4),
        linked(0, 2, at(4.0), by_place=True, score=0.3),
        linked(2, 3, at(2.0), by_place=False),
        linked(3, 4, at(2.0), by_place=True),
    )
    dependent = find_dependent(pairs, poses)
    assert [(one.near, one.far) for one in dependent] == [(1, 2), (3, 4)]
    assert [one.lidars for one in dependent] == [{2, 3, 4}, {4}]
    turned = list(orient_links(dependent, 2, frozenset(poses)))
    assert [(one.near, one.far) for one in turned] == [(2, 1), (3, 4)]
    assert turned[0].lidars == {0, 1}
    for each in (*prior_poses(dependent, poses), *prior_poses(turned, poses)):
        np.testing.assert_allclose(each.T, poses[each.lidar], atol=1e-12)


def test_without_the_pole_of_its_link_a_lidar_is_refused(steps: Steps) -> None:
    site, poles = steps.site, steps.datum.poles
    dependent = (Dependent(0, 2, np.eye(4), frozenset({2})),)
    check_poles_left(site, dependent, poles)
    gone = set(dependent[0].across(poles))
    left = without_poles(steps.datum, gone)
    with pytest.raises(Refusal) as refusal:
        steps.again(replace(left, dependent=dependent))
    assert refusal.value.code == "degenerate_poles"


def test_a_pose_that_the_scene_holds_little_better_than_the_place_is_refused(steps: Steps) -> None:
    dependent = (Dependent(0, 1, np.eye(4), frozenset({1})),)
    T = np.stack([np.eye(4)] * 3)
    for share, is_constrained in ((0.9 * DETERMINED, True), (1.1 * DETERMINED, False)):
        covariance = np.zeros((18, 18))
        covariance[6:12, 6:12] = np.diag((share * SURROUNDINGS_SIGMA) ** 2)
        if is_constrained:
            check_dependent(steps.site, dependent, T, covariance)
            continue
        with pytest.raises(Refusal) as refusal:
            check_dependent(steps.site, dependent, T, covariance)
        assert refusal.value.code == "degenerate_poles"
        assert steps.site.lidars[1].name in refusal.value.message
