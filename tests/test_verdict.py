from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from retropole.alignment.adjustment import BeamAlignment
from retropole.datatypes import (
    Detection,
    Hypothesis,
    Match,
    Placement,
    PointCloud,
    Pole,
    PoseEstimate,
    Scan,
)
from retropole.errors import Refusal
from retropole.matching.placements import PairedPlacement
from retropole.sensors import SENSORS
from retropole.uncertainty import WeakDirection
from retropole.verdict import (
    LEAST_OVERLAP,
    MIN_COVISIBLE_OVERLAP,
    MIN_OVERLAP,
    check_choice,
    margin_of,
    weaknesses,
)
from tests.conftest import PoleMaker


def hypothesis(
    score: float, overlap: float = 0.9, violation: float = 0.0, exact: bool = True
) -> Hypothesis:
    match = Match(((0, 0), (1, 1)), np.eye(4), 0.01, exact, True, np.eye(6))
    return Hypothesis(match, 0.1, 0.1, overlap, violation, score)


def test_margin_is_over_the_best_of_the_others() -> None:
    assert margin_of([hypothesis(0.9), hypothesis(0.2), hypothesis(0.5)]) == pytest.approx(0.4)
    assert margin_of([hypothesis(0.9)]) is None
    assert margin_of([]) is None


def test_a_scene_that_does_not_decide_is_refused() -> None:
    poor, contradicted = hypothesis(0.3, 0.3), hypothesis(0.6, 0.8, violation=0.2)
    check_choice([hypothesis(0.9), poor, contradicted])
    with pytest.raises(Refusal) as refusal:
        check_choice([hypothesis(0.9), hypothesis(0.75, 0.75), poor, contradicted])
    assert refusal.value.code == "ambiguous"
    assert "2 hypotheses" in str(refusal.value)


def test_a_match_that_does_not_fit_is_no_rival() -> None:
    check_choice([hypothesis(0.9), hypothesis(0.9, exact=False)])


def test_scenes_that_do_not_overlap_are_refused() -> None:
    with pytest.raises(Refusal) as refusal:
        check_choice([hypothesis(0.1, MIN_OVERLAP / 2), hypothesis(-0.5)])
    assert refusal.value.code == "no_overlap"


@pytest.mark.parametrize(("of_all", "of_both", "is_refused"), [
    (1.01 * MIN_OVERLAP, 0.0, False),
    (1.01 * LEAST_OVERLAP, 1.01 * MIN_COVISIBLE_OVERLAP, False),
    (1.01 * LEAST_OVERLAP, 0.99 * MIN_COVISIBLE_OVERLAP, True),
    (0.99 * LEAST_OVERLAP, 1.0, True),
])  # fmt: skip
def test_overlap_may_be_small_where_that_of_what_both_see_is_not(
    of_all: float, of_both: float, is_refused: bool
) -> None:
    best = replace(hypothesis(of_all, of_all), covisible_overlap=of_both)
    with pytest.raises(Refusal) if is_refused else nullcontext():
        check_choice([best, hypothesis(-0.5, 0.0)])


def an_alignment(noise: float = 0.01, sigma: float = 0.01, if_known: float = 0.01) -> BeamAlignment:
    points, axes = np.array([[4.0, -1, 0], [4.0, 1, 0]]), np.array([[0, 0, 1.0], [0.5, 0, 0.8]])
    return BeamAlignment(
        PoseEstimate(np.eye(4), sigma**2 * np.eye(6), noise),
        if_known**2 * np.eye(6),
        points,
        axes,
        0.02,
        0.0,
        (noise, 0.01),
        (0.005, 0.005),
    )


def paired_placement(target: list[Pole], source: list[Pole]) -> PairedPlacement:
    """A VLP-16 and a sensor that is not known, whose poles are paired by their order."""
    cloud = PointCloud(np.ones((1, 3)))
    scans = [
        Scan(cloud, sensor, Detection(tuple(poles), (), 200.0, "given", 0))
        for poles, sensor in ((target, SENSORS["VLP-16"]), (source, None))
    ]
    return PairedPlacement(Placement(scans[0], scans[1]), hypothesis(0.9))


def codes_of(
    target: list[Pole],
    source: list[Pole],
    aligned: BeamAlignment | None = None,
    hypotheses: tuple[Hypothesis, ...] = (hypothesis(0.9), hypothesis(0.3)),
    weak: float = 0.01,
) -> list[str]:
    weakest = WeakDirection(np.array([0, 0, 1.0]), weak, "height along the poles: 1 cm", 9.0)
    paired = paired_placement(target, source)
    found = weaknesses([paired], hypotheses, aligned or an_alignment(), weakest, None)
    return [reason.code for reason in found]


def test_weak_poles_are_named(make_pole: PoleMaker) -> None:
    up, lean = np.array([0.0, 0, 1]), np.array([np.sin(0.5), 0, np.cos(0.5)])
    good = [make_pole([4.0, -1, 0], up), make_pole([4.0, 1, 0], lean)]
    assert codes_of(good, good) == []
    few = [make_pole([4.0, -1, 0], up, count=7), good[1]]
    assert codes_of(good, few) == ["few_points"]
    assert codes_of([replace(good[0], rings=3), good[1]], good) == ["few_rings"]
    slight = make_pole([4.0, 1, 0], [np.sin(0.15), 0, np.cos(0.15)])
    assert codes_of([good[0], slight], good) == ["nearly_parallel_poles"]
    close = (hypothesis(0.9), hypothesis(0.85))
    assert codes_of(good, good, hypotheses=close) == ["small_margin"]


def test_weak_poses_are_named(make_pole: PoleMaker) -> None:
    up, lean = np.array([0.0, 0, 1]), np.array([np.sin(0.5), 0, np.cos(0.5)])
    good = [make_pole([4.0, -1, 0], up), make_pole([4.0, 1, 0], lean)]
    assert codes_of(good, good, an_alignment(noise=0.04)) == ["noisy_poles"]
    assert codes_of(good, good, weak=0.08) == ["weak_direction"]
    uncertain = an_alignment(sigma=0.08, if_known=0.01)
    assert codes_of(good, good, uncertain, weak=0.08) == ["weak_direction", "offset_not_separable"]
