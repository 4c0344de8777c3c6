"""What is refused, and what is warned of: by what was found, not by who asks."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.answer import LidarPose, LoopClosure
from retropole.base import se3
from retropole.base.errors import Reason, Refusal
from retropole.base.uncertainty.purpose import Need
from retropole.hypotheses.joint_choice import Choice, Choices, check_linked
from retropole.hypotheses.pairs import Pair
from retropole.verdict.site import (
    CHECKED,
    LOOP_SIGNIFICANCE,
    check_decided,
    confirm_links,
    fitness_of,
    weaknesses,
)
from tests.adjustment.adjusting import Steps

pytestmark = pytest.mark.full


def codes(reasons: object) -> list[str]:
    return [reason.code for reason in reasons]  # type: ignore[attr-defined]


def test_a_site_in_groups_is_refused_with_their_names(steps: Steps) -> None:
    check_linked(steps.site, steps.scans, [[0, 1, 2]], steps.pairs)
    with pytest.raises(Refusal) as refused:
        check_linked(steps.site, steps.scans, [[0, 2], [1]], steps.pairs)
    assert refused.value.code == "disconnected"
    assert "posts-1, posts-3; posts-2" in refused.value.message
    why = Reason("no_match", "nothing fits", {})
    alone = [Pair((0, 1), (), False, why), Pair((0, 2), (), False), Pair((1, 2), (), False)]
    with pytest.raises(Refusal) as refused:
        check_linked(steps.site, steps.scans, [[0], [1], [2]], alone)
    assert refused.value.code == "too_few_lidars"
    assert "nothing fits" in refused.value.message


def test_choices_that_go_together_as_well_are_refused_with_the_loop(steps: Steps) -> None:
    best = steps.choices.best
    check_decided(steps.site, Choices(best, (), True), steps.pairs, steps.at)
    turned = best.poses[1] @ np.diag([-1.0, -1.0, 1.0, 1.0])
    rival = Choice({**best.poses, 1: turned}, best.count)
    with pytest.raises(Refusal) as refused:
        check_decided(steps.site, Choices(best, (rival,), True), steps.pairs, steps.at)
    assert refused.value.code == "ambiguous_loop"
    assert refused.value.values["lidars"] == "posts-2"
    assert "posts-1 – posts-2 – posts-3" in refused.value.message
    with pytest.raises(Refusal) as refused:
        check_decided(steps.site, Choices(best, (), False), steps.pairs, steps.at)
    assert refused.value.code == "ambiguous_loop"


def lidar_poses(steps: Steps, scale: float = 1.0) -> list[LidarPose]:
    found = []
    for i in range(3):
        own = scale * steps.adjusted.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        T = steps.adjusted.end.T[i]
        found.append(LidarPose(i, T, own, (), (), fitness_of(steps.site, own)))
    return found


LOOP = LoopClosure((0, 1, 2), 1e-4, 1e-3, 6.0, 6, 0.4)


def test_a_sound_site_has_no_weakness(steps: Steps) -> None:
    assert not list(weaknesses(steps.site, steps.scans, steps.adjusted, [LOOP], lidar_poses(steps)))
    assert not list(confirm_links(steps.site, steps.scans, steps.adjusted, steps.pairs))


def test_a_loop_that_does_not_close_is_told(steps: Steps) -> None:
    open_loop = replace(LOOP, chi2=90.0, probability=LOOP_SIGNIFICANCE / 2)
    found = list(
        weaknesses(steps.site, steps.scans, steps.adjusted, [LOOP, open_loop], lidar_poses(steps))
    )
    assert codes(found) == ["loop_open"]
    assert "1 of 2 loops" in found[0].message
    assert "posts-1 – posts-2 – posts-3" in found[0].message


def test_a_lidar_that_nothing_checks_is_told(steps: Steps) -> None:
    tests = tuple(
        replace(test, redundancy=CHECKED / 2)
        if test.kind == "placement" and test.lidar == 1
        else test
        for test in steps.adjusted.tests
    )
    unchecked = replace(steps.adjusted, tests=tests)
    found = list(weaknesses(steps.site, steps.scans, unchecked, [LOOP], lidar_poses(steps)))
    assert codes(found) == ["not_checked"]
    assert found[0].values["lidar"] == "posts-2"


def test_poses_that_still_move_are_told(steps: Steps) -> None:
    moving = replace(steps.adjusted, converged=False)
    found = list(weaknesses(steps.site, steps.scans, moving, [LOOP], lidar_poses(steps)))
    assert codes(found) == ["not_converged"]


def test_a_need_is_asked_of_every_lidar(steps: Steps) -> None:
    need = replace(steps, site=replace(steps.site, need=Need(1e-4, 30.0)))
    found = list(weaknesses(need.site, need.scans, need.adjusted, [LOOP], lidar_poses(need)))
    assert codes(found) == ["not_fit_for_purpose"]
    assert "posts-2, posts-3" in found[0].message
    loose = replace(steps, site=replace(steps.site, need=Need(1.0, 30.0)))
    assert not list(weaknesses(loose.site, loose.scans, loose.adjusted, [LOOP], lidar_poses(loose)))
    # Without a need, being usable is asked alone.
    assert codes(
        weaknesses(steps.site, steps.scans, steps.adjusted, [], lidar_poses(steps, 1e6))
    ) == ["not_fit_for_purpose"]


def test_a_scene_that_denies_an_answer_refuses_it(steps: Steps) -> None:
    by = se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, 0.4])), np.array([1.5, -1.0, 0.0]))
    T = steps.adjusted.end.T.copy()
    T[1:] = by @ T[1:]
    wrong = replace(steps.adjusted, end=replace(steps.adjusted.end, T=T))
    with pytest.raises(Refusal) as refused:
        list(confirm_links(steps.site, steps.scans, wrong, steps.pairs))
    assert refused.value.code == "scene_contradicts"
    assert "posts-" in refused.value.message
