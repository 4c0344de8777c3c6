"""Candidate poles count where both LiDARs and the scene confirm them, and nowhere else."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from retropole.base.datatypes import Hypothesis, PointCloud
from retropole.hypotheses import candidate_confirmation as confirming
from retropole.hypotheses import choice
from retropole.hypotheses.candidate_confirmation import (
    candidate_reasons,
    candidates_in,
    is_confirmed,
)
from retropole.hypotheses.placements import PairedPlacement
from retropole.pipeline import Options, calibrate
from tests.extraction.scenes import X, Y, pole
from tests.hypotheses.walls import (
    AT_THE_WALL,
    FREE,
    SENSOR,
    Confirmed,
    answer_of,
    assert_right,
    confirmed_answer,
    recorded,
    vest,
)
from tests.tiers import first_of

pytestmark = pytest.mark.full


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_a_pole_near_a_wall_counts_where_both_lidars_confirm_it(seed: int) -> None:
    answer = answer_of(recorded([FREE, AT_THE_WALL], seed))
    assert_right(answer.T_target_source)
    assert answer.status == "ok"
    (reason,) = [reason for reason in answer.notes if reason.code == "doubtful_poles"]
    assert reason.values["target"] == reason.values["source"] == 1
    for scan_ in (answer.placements[0].target, answer.placements[0].source):
        assert scan_.detection is not None
        assert len(scan_.detection.candidates) == 1
        assert scan_.detection.candidates[0] is scan_.poles[-1]


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_sure_poles_need_no_doubtful_ones(seed: int) -> None:
    answer = answer_of(recorded([FREE, pole((3.2, -1.2), -0.2 * X), AT_THE_WALL], seed))
    assert_right(answer.T_target_source)
    assert "doubtful_poles" not in {reason.code for reason in answer.notes}
    assert answer.placements[0].target.detection is not None
    assert len(answer.placements[0].target.poles) == 2


@pytest.mark.parametrize("seed", range(3))
def test_the_bands_of_a_vest_are_no_second_pole(seed: int) -> None:
    answer = answer_of(recorded([FREE, *vest((4.0, -1.0))], seed), poles=2)
    assert answer.status == "refused"
    assert [reason.code for reason in answer.reasons] == ["too_few_poles"]
    assert len(answer.placements[0].target.poles) == 1, "what was sure, and no more"


@pytest.mark.parametrize("seed", first_of(range(2)))
def test_a_doubtful_pole_of_one_lidar_alone_does_not_count(seed: int) -> None:
    target, source = recorded([FREE, AT_THE_WALL], seed)
    elsewhere = replace(AT_THE_WALL, centre=AT_THE_WALL.centre + np.array([0, 0.9, 0]))
    for other in (recorded([FREE], seed)[1], recorded([FREE, elsewhere], seed)[1]):
        assert answer_of((target, other), poles=2).status == "refused"
    assert answer_of((target, source)).status == "ok"


def test_a_constant_ring_gives_the_answer_of_none() -> None:
    clouds = recorded([FREE, AT_THE_WALL])
    none, constant = (
        answer_of((replace(clouds[0], ring=r[0]), replace(clouds[1], ring=r[1])))
        for r in ((None, None), tuple(np.full(len(c), 5, dtype=np.int64) for c in clouds))
    )
    assert none.status == constant.status
    if none.T_target_source is not None:
        assert constant.T_target_source is not None
        np.testing.assert_array_equal(none.T_target_source, constant.T_target_source)


@pytest.fixture(scope="module")
def confirmed() -> Confirmed:
    return confirmed_answer()


def test_every_condition_is_needed(confirmed: Confirmed) -> None:
    answer, paired = confirmed
    best, *others = answer.hypotheses
    assert is_confirmed(paired, answer.hypotheses, 0.02)
    rival = replace(others[0], score=best.score - 0.99 * confirming.MIN_CONFIRMED_MARGIN)
    assert not is_confirmed(paired, (best, rival), 0.02)
    least, of_all = (
        confirming.MIN_CONFIRMED_COVISIBLE,
        confirming.SUPPORT_LEAST_OVERLAP,
    )
    small = replace(best, overlap=1.01 * of_all, covisible_overlap=1.01 * least)
    assert is_confirmed(paired, (small, *others), 0.02)
    for worse in (
        replace(
            best,
            overlap=0.99 * confirming.MIN_CONFIRMED_OVERLAP,
            covisible_overlap=0.99 * least,
        ),
        replace(small, overlap=0.99 * of_all),
        replace(small, covisible_overlap=0.99 * least),
        replace(best, free_space_violation=1.01 * confirming.MAX_CONFIRMED_VIOLATION),
        replace(best, icp_rotation=1.01 * confirming.MAX_ICP_ROTATION),
        replace(best, icp_translation=1.01 * confirming.MAX_ICP_TRANSLATION),
        replace(best, icp_rotation=None, icp_translation=None),
    ):
        assert not is_confirmed(paired, (worse, *others), 0.02)
    for rms, holds in ((0.0345, True), (0.0360, False)):
        match = replace(best.match, pole_rms=rms)
        again = (PairedPlacement(paired[0].placement, replace(best, match=match)),)
        assert is_confirmed(again, answer.hypotheses, 0.02) is holds


def settled(hypothesis: Hypothesis, **changes: Any) -> Hypothesis:
    return replace(hypothesis, match=replace(hypothesis.match, icp_refined=True, **changes))


def test_a_settled_hypothesis_needs_no_icp_that_stays(confirmed: Confirmed) -> None:
    answer, paired = confirmed
    best, *others = answer.hypotheses
    slid = replace(best, icp_translation=1.01 * confirming.MAX_ICP_TRANSLATION)
    assert not is_confirmed(paired, (slid, *others), 0.02)
    assert is_confirmed(paired, (settled(slid), *others), 0.02)
    seen_through = replace(slid, free_space_violation=1.01 * confirming.MAX_CONFIRMED_VIOLATION)
    assert not is_confirmed(paired, (settled(seen_through), *others), 0.02)


def test_three_settled_poles_need_not_fit_as_closely_as_two(confirmed: Confirmed) -> None:
    answer, (each,) = confirmed
    best, *others = answer.hypotheses

    def counts(hypothesis: Hypothesis) -> bool:
        paired = (PairedPlacement(each.placement, hypothesis),)
        return is_confirmed(paired, (hypothesis, *others), 0.02)

    two, three = best.match.pairs, (*best.match.pairs, best.match.pairs[0])
    assert counts(settled(best, pairs=three, pole_rms=0.045))
    assert not counts(settled(best, pairs=two, pole_rms=0.045))
    assert not counts(replace(best, match=replace(best.match, pairs=three, pole_rms=0.045)))
    assert not counts(settled(best, pairs=three, pole_rms=0.045, exact=False))


@pytest.mark.parametrize(("turn", "shift"), [(0.15, 0.0), (0.0, 1.5)])
def test_lines_that_lie_otherwise_to_each_other_are_not_confirmed(
    confirmed: Confirmed, turn: float, shift: float
) -> None:
    answer, (each,) = confirmed
    source = each.placement.source
    assert source.detection is not None
    (_, j), *_ = each.hypothesis.match.pairs
    moved = source.poles[j]
    direction = moved.direction + turn * Y
    moved = replace(
        moved, direction=direction / np.linalg.norm(direction), point=moved.point + shift * X
    )
    poles = tuple(moved if k == j else own for k, own in enumerate(source.poles))
    detection = replace(source.detection, poles=poles)
    placement = replace(each.placement, source=replace(source, detection=detection))
    assert not is_confirmed((PairedPlacement(placement, each.hypothesis),), answer.hypotheses, 0.02)


def test_only_doubtful_poles_are_warned_of(confirmed: Confirmed) -> None:
    answer, (each,) = confirmed
    target, source = candidates_in(each)
    assert len(target) == len(source) == 1
    assert len(candidate_reasons((each,), answer.hypotheses)) == 1
    assert each.placement.target.detection is not None
    sides = [
        replace(s, detection=replace(s.detection, candidates=()))
        for s in (each.placement.target, each.placement.source)
        if s.detection is not None
    ]
    sure = replace(each.placement, target=sides[0], source=sides[1])
    assert candidate_reasons((replace(each, placement=sure),), answer.hypotheses) == []


def test_icp_and_a_contradicted_rival_count_less_where_the_scene_is_certain(
    confirmed: Confirmed,
) -> None:
    answer, paired = confirmed
    best, *others = answer.hypotheses
    behind = best.score - 1.01 * confirming.CERTAIN_MARGIN
    contradicted = choice.RIVAL_FREE_SPACE_VIOLATION
    for covisible, violation, is_certain in (
        (1.01, 0.99, True),
        (0.99, 0.99, False),
        (1.01, 1.01, False),
    ):
        seen = replace(
            best,
            covisible_overlap=covisible * confirming.MIN_CERTAIN_COVISIBLE,
            free_space_violation=violation * confirming.MAX_CERTAIN_VIOLATION,
        )
        moved = replace(seen, icp_translation=2 * confirming.MAX_ICP_TRANSLATION)
        assert is_confirmed(paired, (moved, *others), 0.02) is is_certain
        rival = replace(
            others[0], score=behind, overlap=0.5, free_space_violation=1.01 * contradicted
        )
        assert is_confirmed(paired, (seen, rival), 0.02) is is_certain
        rival = replace(rival, free_space_violation=0.99 * contradicted)
        assert not is_confirmed(paired, (seen, rival), 0.02)
        rival = replace(
            rival,
            score=best.score - 0.99 * confirming.CERTAIN_MARGIN,
            free_space_violation=1.01 * contradicted,
        )
        assert not is_confirmed(paired, (seen, rival), 0.02)


@pytest.mark.parametrize("is_settled", [True, False])
def test_a_settled_hypothesis_that_nothing_denies_needs_what_sure_poles_need(
    confirmed: Confirmed, is_settled: bool
) -> None:
    answer, paired = confirmed
    first, *others = answer.hypotheses
    first = settled(first) if is_settled else first
    most, least = choice.MIN_OVERLAP, choice.MIN_COVISIBLE_OVERLAP
    of_all = confirming.SUPPORT_LEAST_OVERLAP
    clear = replace(first, free_space_violation=0.99 * confirming.MAX_CERTAIN_VIOLATION)
    by_all = replace(clear, overlap=1.01 * most, covisible_overlap=0.99 * least)
    by_covisible = replace(clear, overlap=1.01 * of_all, covisible_overlap=1.01 * least)
    for enough in (by_all, by_covisible):
        assert is_confirmed(paired, (enough, *others), 0.02) is is_settled
    for less in (
        replace(by_all, overlap=0.99 * most),
        replace(by_covisible, overlap=0.99 * of_all),
        replace(by_covisible, covisible_overlap=0.99 * least),
        replace(by_all, free_space_violation=1.01 * confirming.MAX_CERTAIN_VIOLATION),
    ):
        assert not is_confirmed(paired, (less, *others), 0.02)


@pytest.mark.parametrize("is_settled", [True, False])
def test_a_denied_rival_counts_less_where_nothing_denies_a_settled_hypothesis(
    confirmed: Confirmed, is_settled: bool
) -> None:
    answer, paired = confirmed
    first, *others = answer.hypotheses
    first = settled(first) if is_settled else first
    clear = replace(first, free_space_violation=0.99 * confirming.MAX_CERTAIN_VIOLATION)
    clear = replace(clear, covisible_overlap=0.99 * confirming.MIN_CERTAIN_COVISIBLE)
    rival = replace(
        others[0],
        score=clear.score - 1.01 * confirming.CERTAIN_MARGIN,
        overlap=0.5,
        covisible_overlap=0.5,
        free_space_violation=0.0,
    )
    assert not is_confirmed(paired, (clear, rival), 0.02)
    little = replace(rival, overlap=0.99 * choice.MIN_OVERLAP)
    unshared = replace(little, covisible_overlap=0.99 * choice.MIN_COVISIBLE_OVERLAP)
    seen_through = replace(rival, free_space_violation=1.01 * choice.RIVAL_FREE_SPACE_VIOLATION)
    for contradicted in (unshared, seen_through):
        assert is_confirmed(paired, (clear, contradicted), 0.02) is is_settled
        near = replace(contradicted, score=clear.score - 0.99 * confirming.CERTAIN_MARGIN)
        assert not is_confirmed(paired, (clear, near), 0.02)
    assert not is_confirmed(paired, (clear, little), 0.02)


def dimmed(cloud: PointCloud) -> PointCloud:
    """The same cloud by a sensor that sees half of the light."""
    assert cloud.intensity is not None
    return replace(cloud, intensity=0.5 * cloud.intensity)


@pytest.mark.parametrize("seed", first_of(range(2)))
def test_dim_tape_is_found_below_the_threshold_of_the_sensor_but_not_of_the_user(
    seed: int,
) -> None:
    target, source = map(dimmed, recorded([FREE, pole((3.2, -1.2), -0.2 * X)], seed))
    answer = calibrate(target, source, options=Options(sensors=(SENSOR, SENSOR)))
    assert_right(answer.T_target_source)
    assert answer.status == "ok"
    assert "doubtful_poles" in {reason.code for reason in answer.notes}
    thresholds = (SENSOR.threshold, SENSOR.threshold)
    given = calibrate(
        target, source, options=Options(sensors=(SENSOR, SENSOR), thresholds=thresholds)
    )
    assert [reason.code for reason in given.reasons] == ["too_few_poles"]


@pytest.mark.parametrize("seed", range(2))
def test_dim_clouds_with_one_pole_are_refused(seed: int) -> None:
    target, source = map(dimmed, recorded([FREE, *vest((4.0, -1.0))], seed))
    assert (
        calibrate(target, source, options=Options(sensors=(SENSOR, SENSOR), poles=2)).status
        == "refused"
    )
