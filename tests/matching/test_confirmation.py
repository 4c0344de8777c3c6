"""Doubtful poles count where both LiDARs and the scene confirm them, and nowhere else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, Calibration, Hypothesis, Placement, PointCloud, Scan
from retropole.base.errors import Refusal
from retropole.base.sensors import find_sensor
from retropole.matching import scene_support
from retropole.matching.budget import Share, Tried
from retropole.matching.confirmation import (
    Chosen,
    choose_with_doubtful,
    doubtful_in,
    doubtful_reasons,
    is_confirmed,
)
from retropole.matching.placements import PairedPlacement, PlacementHypotheses
from retropole.pipeline import calibrate
from retropole.simulation import Box, Rectangle, Surface, scan
from tests.extraction.scenes import GROUND, PAINT, TAPE, X, Y, Z, pole

SENSOR = find_sensor("XT32")
T_TARGET = np.eye(4)
T_SOURCE = se3.from_rt(se3.exp_so3(np.array([0.02, -0.03, 0.9])), np.array([0.8, -1.4, 0.2]))
PLACE: list[Surface] = [
    GROUND,
    Rectangle(5.2 * X, Y, Z, (4, 2), PAINT),
    Rectangle(np.array([0.0, 5.0, 0.5]), X, Z, (5.2, 2.5), PAINT),
    Box(np.array([-3.0, -3.5, 0]), np.eye(3), np.array([0.6, 1.0, 1.2]), PAINT),
    Box(np.array([1.5, 4.0, -0.6]), np.eye(3), np.array([0.4, 0.7, 0.6]), PAINT),
]
FREE = pole((3.6, 1.4), 0.35 * Y)
AT_THE_WALL = pole((5.0, -0.8), length=0.7)
"""A short pole 0.2 m from the wall."""


def vest(at: tuple[float, float]) -> list[Surface]:
    bands = [
        Box(np.array([*at, z]), np.eye(3), np.array([0.14, 0.24, 0.025]), TAPE)
        for z in (-0.15, 0.1)
    ]
    return [Box(np.array([*at, -0.35]), np.eye(3), np.array([0.12, 0.22, 0.85]), PAINT), *bands]


def recorded(things: list[Surface], seed: int = 0) -> tuple[PointCloud, PointCloud]:
    rng = np.random.default_rng(seed)
    target, source = (scan([*PLACE, *things], SENSOR, T, rng).cloud for T in (T_TARGET, T_SOURCE))
    return target, source


def answer_of(clouds: tuple[PointCloud, PointCloud], radius: float = 0.02) -> Calibration:
    return calibrate(*clouds, sensors=(SENSOR, SENSOR), radius=radius)


def assert_right(T: Array | None) -> None:
    assert T is not None
    apart = se3.difference(se3.inverse(T_TARGET) @ T_SOURCE, T)
    assert apart.rotation < np.radians(1.0)
    assert apart.translation < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_a_pole_near_a_wall_counts_where_both_lidars_confirm_it(seed: int) -> None:
    answer = answer_of(recorded([FREE, AT_THE_WALL], seed))
    assert_right(answer.T_target_source)
    assert answer.status == "warn"
    (reason,) = [reason for reason in answer.reasons if reason.code == "doubtful_poles"]
    assert reason.values["target"] == reason.values["source"] == 1
    for scan_ in (answer.placements[0].target, answer.placements[0].source):
        assert scan_.detection is not None
        assert len(scan_.detection.doubtful) == 1
        assert scan_.detection.doubtful[0] is scan_.poles[-1]


@pytest.mark.parametrize("seed", range(3))
def test_sure_poles_need_no_doubtful_ones(seed: int) -> None:
    answer = answer_of(recorded([FREE, pole((3.2, -1.2), -0.2 * X), AT_THE_WALL], seed))
    assert_right(answer.T_target_source)
    assert "doubtful_poles" not in {reason.code for reason in answer.reasons}
    assert answer.placements[0].target.detection is not None
    assert len(answer.placements[0].target.poles) == 2


@pytest.mark.parametrize("seed", range(3))
def test_the_bands_of_a_vest_are_no_second_pole(seed: int) -> None:
    answer = answer_of(recorded([FREE, *vest((4.0, -1.0))], seed))
    assert answer.status == "refused"
    assert [reason.code for reason in answer.reasons] == ["too_few_poles"]
    assert len(answer.placements[0].target.poles) == 1, "what was sure, and no more"


@pytest.mark.parametrize("seed", range(2))
def test_a_doubtful_pole_of_one_lidar_alone_does_not_count(seed: int) -> None:
    target, source = recorded([FREE, AT_THE_WALL], seed)
    elsewhere = replace(AT_THE_WALL, centre=AT_THE_WALL.centre + np.array([0, 0.9, 0]))
    for other in (recorded([FREE], seed)[1], recorded([FREE, elsewhere], seed)[1]):
        assert answer_of((target, other)).status == "refused"
    assert answer_of((target, source)).status == "warn"


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
def confirmed() -> tuple[Calibration, tuple[PairedPlacement, ...]]:
    answer = answer_of(recorded([FREE, AT_THE_WALL]))
    return answer, (PairedPlacement(answer.placements[0], answer.hypotheses[0]),)


Confirmed = tuple[Calibration, tuple[PairedPlacement, ...]]


def test_every_witness_is_needed(confirmed: Confirmed) -> None:
    answer, paired = confirmed
    best, *others = answer.hypotheses
    assert is_confirmed(paired, answer.hypotheses, 0.02)
    rival = replace(others[0], score=best.score - 0.99 * scene_support.MIN_CONFIRMED_LEAD)
    assert not is_confirmed(paired, (best, rival), 0.02)
    least, of_all = scene_support.MIN_CONFIRMED_COVISIBLE, scene_support.LEAST_OVERLAP
    small = replace(best, overlap=1.01 * of_all, covisible_overlap=1.01 * least)
    assert is_confirmed(paired, (small, *others), 0.02)
    for worse in (
        replace(
            best,
            overlap=0.99 * scene_support.MIN_CONFIRMED_OVERLAP,
            covisible_overlap=0.99 * least,
        ),
        replace(small, overlap=0.99 * of_all),
        replace(small, covisible_overlap=0.99 * least),
        replace(best, free_space_violation=1.01 * scene_support.MAX_CONFIRMED_VIOLATION),
        replace(best, icp_rotation=1.01 * scene_support.MAX_ICP_ROTATION),
        replace(best, icp_translation=1.01 * scene_support.MAX_ICP_TRANSLATION),
        replace(best, icp_rotation=None, icp_translation=None),
    ):
        assert not is_confirmed(paired, (worse, *others), 0.02)
    for rms, holds in ((0.0345, True), (0.0360, False)):
        match = replace(best.match, pole_rms=rms)
        again = (PairedPlacement(paired[0].placement, replace(best, match=match)),)
        assert is_confirmed(again, answer.hypotheses, 0.02) is holds


def untimed(step: str) -> AbstractContextManager[None]:
    return nullcontext()


def settled(hypothesis: Hypothesis, **changes: Any) -> Hypothesis:
    return replace(hypothesis, match=replace(hypothesis.match, settled=True, **changes))


def test_a_settled_hypothesis_needs_no_icp_that_stays(confirmed: Confirmed) -> None:
    answer, paired = confirmed
    best, *others = answer.hypotheses
    slid = replace(best, icp_translation=1.01 * scene_support.MAX_ICP_TRANSLATION)
    assert not is_confirmed(paired, (slid, *others), 0.02)
    assert is_confirmed(paired, (settled(slid), *others), 0.02)
    seen_through = replace(slid, free_space_violation=1.01 * scene_support.MAX_CONFIRMED_VIOLATION)
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


def test_hypotheses_settle_only_where_nothing_else_is_confirmed(confirmed: Confirmed) -> None:
    answer, paired = confirmed
    refusal = Refusal("too_few_poles", "", {})
    nothing = Chosen((), (), refusal)
    right = Chosen(answer.hypotheses, paired)
    for answers, asked in (
        ([right], "match"),
        ([nothing, right], "match match"),
        ([nothing, nothing, right], "match match settle"),
        ([nothing, nothing, nothing], "match match settle"),
    ):
        told: list[str] = []
        left = iter(answers)

        def ask(
            of: object, what: str, told: list[str] = told, left: Iterator[Chosen] = left
        ) -> Chosen:
            told.append(what)
            return next(left)

        chosen = choose_with_doubtful(
            partial(ask, what="match"),
            partial(ask, what="settle"),
            answer.placements,
            0.02,
            untimed,
        )
        assert chosen.refusal is answers[-1].refusal
        assert chosen.paired == answers[-1].paired
        assert " ".join(told) == asked


def nothing_bright(of: Scan) -> Scan:
    """Take what passes the threshold out of a recording; lower ones are not tried."""
    assert of.detection is not None
    assert of.cloud.intensity is not None
    cloud = of.cloud.select(of.cloud.intensity < of.detection.threshold)
    detection = replace(of.detection, poles=(), doubtful=(), threshold_source="given")
    return replace(of, cloud=cloud, detection=detection)


def test_without_doubtful_poles_what_was_matched_settles(confirmed: Confirmed) -> None:
    """Nothing is matched twice."""
    answer, _ = confirmed
    (placement,) = answer.placements
    target, source = (nothing_bright(scan_) for scan_ in (placement.target, placement.source))
    nothing = Chosen((), (), Refusal("too_few_poles", "", {}))
    settled: list[Chosen] = []

    def settle(chosen: Chosen) -> Chosen:
        settled.append(chosen)
        return chosen

    answers = iter([nothing])
    choose_with_doubtful(
        lambda placements: next(answers), settle, [Placement(target, source)], 0.02, untimed
    )
    assert settled == [nothing]


def test_a_refusal_says_what_was_not_tried(confirmed: Confirmed) -> None:
    answer, _ = confirmed
    tried = Tried(ways=Share(16, 310))
    scored = PlacementHypotheses(answer.placements[0], answer.hypotheses, tried)
    refusal = Refusal("ambiguous", "two are alike", {"rivals": 1})
    chosen = choose_with_doubtful(
        lambda placements: Chosen((), (), refusal, scored=(scored,)),
        lambda chosen: chosen,
        answer.placements,
        0.02,
        untimed,
    )
    assert chosen.refusal is not None
    assert chosen.refusal.code == "ambiguous"
    assert "16 of 310" in chosen.refusal.message
    assert chosen.refusal.values == {"rivals": 1, "ways": 310, "ways_tried": 16}


@pytest.mark.parametrize("is_third", [True, False])
def test_a_doubtful_third_pair_that_does_not_fit_is_left_out(
    confirmed: Confirmed, is_third: bool
) -> None:
    answer, paired = confirmed
    best = answer.hypotheses[0]
    nothing = Chosen((), (), Refusal("too_few_poles", "", {}))
    right = Chosen(answer.hypotheses, paired)
    pairs = (*best.match.pairs, best.match.pairs[-1]) if is_third else best.match.pairs
    loose = replace(best, match=replace(best.match, pairs=pairs, pole_rms=0.1))
    asked: list[int] = []

    def choose(placements: Sequence[Placement]) -> Chosen:
        detection = placements[0].target.detection
        assert detection is not None
        asked.append(len(detection.doubtful))
        if len(asked) == 1:
            return nothing
        if detection.doubtful:
            return Chosen((loose,), (PairedPlacement(placements[0], loose),))
        return right

    chosen = choose_with_doubtful(choose, lambda chosen: chosen, answer.placements, 0.02, untimed)
    assert (chosen is right) == is_third
    assert asked == ([1, 1, 0] if is_third else [1, 1])


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
    target, source = doubtful_in(each)
    assert len(target) == len(source) == 1
    assert len(doubtful_reasons((each,), answer.hypotheses)) == 1
    assert each.placement.target.detection is not None
    sides = [
        replace(s, detection=replace(s.detection, doubtful=()))
        for s in (each.placement.target, each.placement.source)
        if s.detection is not None
    ]
    sure = replace(each.placement, target=sides[0], source=sides[1])
    assert doubtful_reasons((replace(each, placement=sure),), answer.hypotheses) == []


def test_icp_and_a_contradicted_rival_count_less_where_the_scene_is_certain(
    confirmed: Confirmed,
) -> None:
    answer, paired = confirmed
    best, *others = answer.hypotheses
    behind = best.score - 1.01 * scene_support.CERTAIN_LEAD
    contradicted = scene_support.MIN_CONTRADICTED
    for covisible, violation, is_certain in (
        (1.01, 0.99, True),
        (0.99, 0.99, False),
        (1.01, 1.01, False),
    ):
        seen = replace(
            best,
            covisible_overlap=covisible * scene_support.MIN_CERTAIN_COVISIBLE,
            free_space_violation=violation * scene_support.MAX_CERTAIN_VIOLATION,
        )
        moved = replace(seen, icp_translation=2 * scene_support.MAX_ICP_TRANSLATION)
        assert is_confirmed(paired, (moved, *others), 0.02) is is_certain
        rival = replace(
            others[0], score=behind, overlap=0.5, free_space_violation=1.01 * contradicted
        )
        assert is_confirmed(paired, (seen, rival), 0.02) is is_certain
        rival = replace(rival, free_space_violation=0.99 * contradicted)
        assert not is_confirmed(paired, (seen, rival), 0.02)
        rival = replace(
            rival,
            score=best.score - 0.99 * scene_support.CERTAIN_LEAD,
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
    most, least = scene_support.MIN_OVERLAP, scene_support.MIN_COVISIBLE
    of_all = scene_support.LEAST_OVERLAP
    clear = replace(first, free_space_violation=0.99 * scene_support.MAX_CERTAIN_VIOLATION)
    by_all = replace(clear, overlap=1.01 * most, covisible_overlap=0.99 * least)
    by_covisible = replace(clear, overlap=1.01 * of_all, covisible_overlap=1.01 * least)
    for enough in (by_all, by_covisible):
        assert is_confirmed(paired, (enough, *others), 0.02) is is_settled
    for less in (
        replace(by_all, overlap=0.99 * most),
        replace(by_covisible, overlap=0.99 * of_all),
        replace(by_covisible, covisible_overlap=0.99 * least),
        replace(by_all, free_space_violation=1.01 * scene_support.MAX_CERTAIN_VIOLATION),
    ):
        assert not is_confirmed(paired, (less, *others), 0.02)


@pytest.mark.parametrize("is_settled", [True, False])
def test_a_denied_rival_counts_less_where_nothing_denies_a_settled_hypothesis(
    confirmed: Confirmed, is_settled: bool
) -> None:
    answer, paired = confirmed
    first, *others = answer.hypotheses
    first = settled(first) if is_settled else first
    clear = replace(first, free_space_violation=0.99 * scene_support.MAX_CERTAIN_VIOLATION)
    clear = replace(clear, covisible_overlap=0.99 * scene_support.MIN_CERTAIN_COVISIBLE)
    rival = replace(
        others[0],
        score=clear.score - 1.01 * scene_support.CERTAIN_LEAD,
        overlap=0.5,
        covisible_overlap=0.5,
        free_space_violation=0.0,
    )
    assert not is_confirmed(paired, (clear, rival), 0.02)
    little = replace(rival, overlap=0.99 * scene_support.MIN_OVERLAP)
    unshared = replace(little, covisible_overlap=0.99 * scene_support.MIN_COVISIBLE)
    contradicted = replace(rival, free_space_violation=1.01 * scene_support.MIN_CONTRADICTED)
    for denied in (unshared, contradicted):
        assert is_confirmed(paired, (clear, denied), 0.02) is is_settled
        near = replace(denied, score=clear.score - 0.99 * scene_support.CERTAIN_LEAD)
        assert not is_confirmed(paired, (clear, near), 0.02)
    assert not is_confirmed(paired, (clear, little), 0.02)


def dimmed(cloud: PointCloud) -> PointCloud:
    """The same cloud by a sensor that sees half of the light."""
    assert cloud.intensity is not None
    return replace(cloud, intensity=0.5 * cloud.intensity)


@pytest.mark.parametrize("seed", range(2))
def test_dim_tape_is_found_below_the_threshold_of_the_sensor_but_not_of_the_user(
    seed: int,
) -> None:
    target, source = map(dimmed, recorded([FREE, pole((3.2, -1.2), -0.2 * X)], seed))
    answer = calibrate(target, source, sensors=(SENSOR, SENSOR))
    assert_right(answer.T_target_source)
    assert answer.status == "warn"
    assert "doubtful_poles" in {reason.code for reason in answer.reasons}
    thresholds = (SENSOR.threshold, SENSOR.threshold)
    given = calibrate(target, source, sensors=(SENSOR, SENSOR), thresholds=thresholds)
    assert [reason.code for reason in given.reasons] == ["too_few_poles"]


@pytest.mark.parametrize("seed", range(2))
def test_dim_clouds_with_one_pole_are_refused(seed: int) -> None:
    target, source = map(dimmed, recorded([FREE, *vest((4.0, -1.0))], seed))
    assert calibrate(target, source, sensors=(SENSOR, SENSOR)).status == "refused"
