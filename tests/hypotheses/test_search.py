"""Which poles are tried, and in which order, until the scene confirms a choice."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from retropole.base.datatypes import Detection, Placement, PointCloud, Scan
from retropole.base.errors import Refusal
from retropole.base.reasons import Code
from retropole.base.sensors import LITTLE, find_sensor
from retropole.hypotheses import search
from retropole.hypotheses.placements import (
    Chosen,
    PairedPlacement,
    PlacementHypotheses,
    Share,
    Tried,
)
from retropole.hypotheses.search import choose_with_candidates
from tests.hypotheses.walls import Confirmed, confirmed_answer

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def confirmed() -> Confirmed:
    return confirmed_answer()


def untimed(step: str) -> Any:
    return nullcontext()


def test_hypotheses_settle_only_where_nothing_else_is_confirmed(
    confirmed: Confirmed, monkeypatch: pytest.MonkeyPatch
) -> None:
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

        def ask(what: str, told: list[str] = told, left: Iterator[Chosen] = left) -> Chosen:
            told.append(what)
            return next(left)

        monkeypatch.setattr(search, "choose", lambda *_, ask=ask, **__: ask("match"))
        monkeypatch.setattr(search, "choose_after_icp", lambda *_, ask=ask: ask("settle"))
        monkeypatch.setattr(search, "choose_by_place", lambda *_, **__: None)
        chosen = choose_with_candidates(answer.placements, 0.02, untimed)
        assert chosen.refusal is answers[-1].refusal
        assert chosen.paired == answers[-1].paired
        assert " ".join(told) == asked


def nothing_bright(of: Scan) -> Scan:
    """Take what passes the threshold out of a recording; lower ones are not tried."""
    assert of.detection is not None
    assert of.cloud.intensity is not None
    cloud = of.cloud.select(of.cloud.intensity < of.detection.threshold)
    detection = replace(of.detection, poles=(), candidates=(), threshold_source="given")
    return replace(of, cloud=cloud, detection=detection)


def test_without_doubtful_poles_what_was_matched_settles(
    confirmed: Confirmed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is matched twice."""
    answer, _ = confirmed
    (placement,) = answer.placements
    target, source = (nothing_bright(scan_) for scan_ in (placement.target, placement.source))
    nothing = Chosen((), (), Refusal("too_few_poles", "", {}))
    settled: list[Chosen] = []

    def settle(chosen: Chosen, step: object) -> Chosen:
        settled.append(chosen)
        return chosen

    answers = iter([nothing])
    monkeypatch.setattr(search, "choose", lambda *_, **__: next(answers))
    monkeypatch.setattr(search, "choose_after_icp", settle)
    choose_with_candidates([Placement(target, source)], 0.02, untimed)
    assert settled == [nothing]


def test_a_refusal_says_what_was_not_tried(
    confirmed: Confirmed, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer, _ = confirmed
    tried = Tried(ways=Share(16, 310))
    scored = PlacementHypotheses(answer.placements[0], answer.hypotheses, tried)
    refusal = Refusal("ambiguous", "two are alike", {"rivals": 1})
    ambiguous = Chosen((), (), refusal, scored=(scored,))
    monkeypatch.setattr(search, "choose", lambda *_, **__: ambiguous)
    monkeypatch.setattr(search, "choose_after_icp", lambda chosen, step: chosen)
    chosen = choose_with_candidates(answer.placements, 0.02, untimed)
    assert chosen.refusal is not None
    assert chosen.refusal.code == "ambiguous"
    assert chosen.refusal.message == refusal.message
    assert chosen.refusal.values == {"rivals": 1, "ways": 310, "ways_tried": 16}


@pytest.mark.parametrize("is_third", [True, False])
def test_a_doubtful_third_pair_that_does_not_fit_is_left_out(
    confirmed: Confirmed, is_third: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer, paired = confirmed
    best = answer.hypotheses[0]
    nothing = Chosen((), (), Refusal("too_few_poles", "", {}))
    right = Chosen(answer.hypotheses, paired)
    pairs = (*best.match.pairs, best.match.pairs[-1]) if is_third else best.match.pairs
    loose = replace(best, match=replace(best.match, pairs=pairs, pole_rms=0.1))
    asked: list[int] = []

    def choose(placements: Sequence[Placement], *_: object, **__: object) -> Chosen:
        detection = placements[0].target.detection
        assert detection is not None
        asked.append(len(detection.candidates))
        if len(asked) == 1:
            return nothing
        if detection.candidates:
            return Chosen((loose,), (PairedPlacement(placements[0], loose),))
        return right

    monkeypatch.setattr(search, "choose", choose)
    monkeypatch.setattr(search, "choose_after_icp", lambda chosen, step: chosen)
    chosen = choose_with_candidates(answer.placements, 0.02, untimed)
    assert (chosen is right) == is_third
    assert asked == ([1, 1, 0] if is_third else [1, 1])


def bare_scan(sensor: str | None, frames: int, threshold_source: str) -> Scan:
    rng = np.random.default_rng(0)
    frame = np.repeat(np.arange(frames), 50) if frames > 1 else None
    cloud = PointCloud(rng.normal(size=(50 * frames, 3)), frame=frame)
    detection = Detection((), (), 80.0, threshold_source, 9)
    return Scan(cloud, None if sensor is None else find_sensor(sensor), detection)


@pytest.mark.parametrize(
    ("sensor", "frames", "found", "said"),
    [
        (
            "Mid-360",
            1,
            "auto",
            "1 sweep of the Mid-360, too few to show a pole well",
        ),
        ("Mid-360", 5, "auto", "5 sweeps of the Mid-360, too few"),
        ("Mid-360", 5, "auto", "record 1.5 s or more, 15 sweeps"),
        (None, 1, "auto", "one sweep of a LiDAR without rings shows little of a pole"),
        ("Mid-360", 11, "auto", "check the tape and the threshold"),
        ("HAP", 1, "auto", "check the tape and the threshold"),
        ("VLP-16", 1, "auto", "check the tape and the threshold"),
        ("VLP-16", 1, f"auto: 78%; {LITTLE}", "nothing there is distinctly brighter than the rest"),
    ],
)
@pytest.mark.parametrize("source", [False, True])
def test_of_too_few_poles_it_is_said_what_helps(
    sensor: str | None, frames: int, found: str, said: str, source: bool
) -> None:
    few, enough = bare_scan(sensor, frames, found), bare_scan("VLP-16", 1, "given")
    placement = Placement(enough, few) if source else Placement(few, enough)
    refusal = Refusal(
        "too_few_poles",
        "the LiDAR sees 0 poles, 2 are needed; check the tape and the threshold with 'detect'",
        {"lidar": "source" if source else "target"},
    )
    message = search.explained(refusal, [placement]).message
    assert message.startswith("the LiDAR sees 0 poles, 2 are needed; ")
    assert said in message
    assert ("threshold" in message) is (said == "check the tape and the threshold")


@pytest.mark.parametrize("first", ["too_few_poles", "no_overlap"])
def test_two_poles_that_lack_nothing_are_not_refused_for_what_one_pole_lacks(
    confirmed: Confirmed, monkeypatch: pytest.MonkeyPatch, first: Code
) -> None:
    answer, _ = confirmed
    poles, place = Refusal(first, "by the poles", {}), Refusal("too_few_poles", "by one pole", {})
    monkeypatch.setattr(search, "choose", lambda *_, **__: Chosen((), (), poles))
    monkeypatch.setattr(search, "choose_after_icp", lambda *_: Chosen((), (), poles))
    monkeypatch.setattr(search, "choose_by_place", lambda *_, **__: Chosen((), (), place))
    bare = [
        replace(each, target=nothing_bright(each.target), source=nothing_bright(each.source))
        for each in answer.placements
    ]
    refusal = choose_with_candidates(bare, 0.02, untimed).refusal
    assert refusal is not None
    assert str(refusal).startswith("by one pole" if first == "too_few_poles" else "by the poles")
