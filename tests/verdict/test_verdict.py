"""Ok, warn or refused: each rule on made-up answers, on both of its sides."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from scipy.special import chdtrc

from retropole.adjustment.agreement import (
    MAX_AXES_CHI2,
    MAX_MAHALANOBIS_SQ,
    WARN_MAHALANOBIS_SQ,
    agreement_tests,
    check_axes,
    check_contradiction,
)
from retropole.adjustment.descent import End
from retropole.adjustment.refinement import Refinement
from retropole.alignment.adjustment import AxesTest, BeamAlignment
from retropole.alignment.certainty import MAX_NORMAL, SIGNIFICANCE
from retropole.alignment.network import gaussian_factor
from retropole.base.datatypes import (
    Array,
    Detection,
    Hypothesis,
    Match,
    Placement,
    PointCloud,
    Pole,
    PoseEstimate,
    Scan,
)
from retropole.base.errors import Reason, Refusal, warnings_and_notes
from retropole.base.se3 import PoseDifference
from retropole.base.sensors import SENSORS
from retropole.base.uncertainty import RadiusEstimate, Uncertainty, WeakDirection
from retropole.base.uncertainty.confirmation import DECEIVING, Confirmation
from retropole.hypotheses.evidence import (
    MAX_CONFLICTING,
    MAX_WRONG,
    MIN_TOTAL,
    check_confirmation,
    check_unconfirmed,
)
from retropole.hypotheses.placements import PairedPlacement
from retropole.hypotheses.similarity import LEAST_CHANGE
from retropole.surfaces.patches import surface_patches
from retropole.verdict import check_returns, check_sensor, weaknesses
from tests.conftest import PoleMaker


@pytest.fixture
def good(make_pole: PoleMaker) -> list[Pole]:
    """Two poles, one of which leans."""
    lean = np.array([np.sin(0.5), 0, np.cos(0.5)])
    return [make_pole([4.0, -1, 0], [0, 0, 1.0]), make_pole([4.0, 1, 0], lean)]


def hypothesis(
    score: float, overlap: float = 0.9, violation: float = 0.0, exact: bool = True
) -> Hypothesis:
    match = Match(((0, 0), (1, 1)), np.eye(4), 0.01, exact, True, np.eye(6))
    return Hypothesis(match, 0.1, 0.1, overlap, violation, score)


AXES = np.array([[4.0, -1, 0], [4.0, 1, 0]]), np.array([[0, 0, 1.0], [0.5, 0, 0.8]])


NO_PATCHES = surface_patches(PointCloud(np.ones((1, 3))))
TWO, NOTHING = np.stack([np.eye(4)] * 2), np.zeros(0)
NOWHERE = End(TWO, TWO, NOTHING, NOTHING, NOTHING, np.eye(12), np.eye(12), ())


def an_alignment(noise: float = 0.01, sigma: float = 0.01, if_known: float = 0.01) -> BeamAlignment:
    pose = PoseEstimate(np.eye(4), sigma**2 * np.eye(6), noise)
    return BeamAlignment(
        pose=pose,
        uncertainty=Uncertainty(sigma**2 * np.eye(6), np.zeros((6, 6))),
        factor=gaussian_factor(pose),
        covariance_if_known=if_known**2 * np.eye(6),
        axis_points=AXES[0],
        axis_directions=AXES[1],
        radius=RadiusEstimate(0.02, 0.0004, 0.02, 0.0004),
        radius_conflict=0.0,
        axes_test=AxesTest(1.5, 2, np.array([1.0, 0.5])),
        noise=(noise, 0.01),
        lateral_noise=(0.005, 0.005),
    )


def a_refinement(
    mahalanobis_sq: float = 5.0, minima: Sequence[Array] = (), converged: bool = True
) -> Refinement:
    return Refinement(
        pose=PoseEstimate(np.eye(4), 1e-6 * np.eye(6), 0.01),
        uncertainty=Uncertainty(1e-6 * np.eye(6), np.zeros((6, 6))),
        patches=500,
        mahalanobis_sq=mahalanobis_sq,
        from_poles=PoseDifference(float(np.radians(0.4)), 0.052),
        other_minima=tuple(minima),
        converged=converged,
        iterations=40,
        surfaces=(NO_PATCHES, NO_PATCHES),
        corrected=(NO_PATCHES, NO_PATCHES),
        end=NOWHERE,
        parts=(),
        held=1e-6 * np.eye(6),
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
    refined: Refinement | None = None,
) -> list[str]:
    found = reasons_of(target, source, aligned, hypotheses, weak, refined)
    return [reason.code for reason in found]


def reasons_of(
    target: list[Pole],
    source: list[Pole],
    aligned: BeamAlignment | None = None,
    hypotheses: tuple[Hypothesis, ...] = (hypothesis(0.9), hypothesis(0.3)),
    weak: float = 0.01,
    refined: Refinement | None = None,
) -> list[Reason]:
    weakest = WeakDirection(np.array([0, 0, 1.0]), weak, "height along the poles: 1 cm", 9.0)
    paired = paired_placement(target, source)
    aligned = aligned or an_alignment()
    return weaknesses([paired], hypotheses, aligned, weakest, refined, places(500, 2, z_margin=6.0))


def test_weak_poles_are_named(make_pole: PoleMaker, good: list[Pole]) -> None:
    assert codes_of(good, good) == []
    few = [make_pole([4.0, -1, 0], [0, 0, 1.0], count=7), good[1]]
    assert codes_of(good, few) == ["few_points"]
    assert codes_of([replace(good[0], rings=3), good[1]], good) == ["few_rings"]
    # Two good ones hold a pose, whatever a third adds.
    assert [reason.code for reason in check_returns("target", few)] == ["few_points"]
    assert not list(check_returns("target", [*few, good[0]]))
    slight = make_pole([4.0, 1, 0], [np.sin(0.15), 0, np.cos(0.15)])
    assert codes_of([good[0], slight], good) == ["nearly_parallel_poles"]
    close = (hypothesis(0.9), hypothesis(0.85))
    assert codes_of(good, good, hypotheses=close) == ["small_margin"]


def test_weak_poses_are_named(good: list[Pole]) -> None:
    assert codes_of(good, good, an_alignment(noise=0.04)) == ["noisy_poles"]
    assert codes_of(good, good, weak=0.08) == ["weak_direction"]
    uncertain = an_alignment(sigma=0.08, if_known=0.01)
    assert codes_of(good, good, uncertain, weak=0.08) == ["weak_direction", "offset_not_separable"]


def test_several_minima_are_told_with_the_furthest(good: list[Pole]) -> None:
    near, far = np.array([0, 0, 0.001, 0.02, 0, 0]), np.array([0, 0, 0.01, 0, 0.3, 0.4])
    assert codes_of(good, good, refined=a_refinement()) == []
    (reason,) = reasons_of(good, good, refined=a_refinement(minima=[near, far]))
    assert reason.code == "several_minima"
    assert reason.values == pytest.approx({"apart_m": 0.5, "apart_rad": 0.01, "starts": 3})
    assert "0.50 m" in reason.message
    assert "0.57°" in reason.message


def test_a_radius_that_the_returns_deny_is_told(good: list[Pole]) -> None:
    radius = RadiusEstimate(0.04, 0.0008, 0.0203, 0.0011)
    (reason,) = reasons_of(
        good, good, replace(an_alignment(), radius=radius, radius_conflict=MAX_NORMAL + 4)
    )
    assert reason.code == "radius_differs"
    assert reason.values == {"given_m": 0.04, "estimated_m": 0.0203, "sigma_m": 0.0011}
    assert "40.0 mm" in reason.message
    assert "20.3 ± 1.1 mm" in reason.message
    hardly = replace(an_alignment(), radius=radius, radius_conflict=MAX_NORMAL - 0.1)
    assert codes_of(good, good, hardly) == []


def test_poles_and_scene_that_disagree_are_told_and_beyond_a_limit_refused(
    good: list[Pole],
) -> None:
    agree, disagree, contradict = (
        a_refinement(square)
        for square in (
            0.9 * WARN_MAHALANOBIS_SQ,
            1.1 * WARN_MAHALANOBIS_SQ,
            1.1 * MAX_MAHALANOBIS_SQ,
        )
    )
    for refined in (None, agree, disagree):
        check_contradiction(refined)
    assert codes_of(good, good, refined=agree) == []
    (reason,) = reasons_of(good, good, refined=disagree)
    assert reason.code == "poles_and_scene_disagree"
    assert "52 mm" in reason.message
    assert "0.40°" in reason.message
    with pytest.raises(Refusal) as refusal:
        check_contradiction(contradict)
    assert refusal.value.code == "poles_scene_contradict"
    assert "52 mm" in str(refusal.value)
    assert refusal.value.values["mahalanobis_sq"] == contradict.mahalanobis_sq


@pytest.mark.parametrize("beyond", [0.9, 1.1])
def test_what_the_table_of_tests_allows_is_what_is_not_warned_of(
    good: list[Pole], beyond: float
) -> None:
    refined = replace(
        a_refinement(beyond * WARN_MAHALANOBIS_SQ),
        scale=(1.0 + beyond * LEAST_CHANGE, 0.5 * LEAST_CHANGE / MAX_NORMAL),
    )
    aligned = replace(an_alignment(), radius_conflict=beyond * MAX_NORMAL)
    tests = {test.kind: test for test in agreement_tests(aligned, refined)}
    assert set(tests) == {"surfaces", "radius", "scale"}
    for test in tests.values():
        assert (test.w > test.allowed) is (beyond > 1.0)
        assert (float(chdtrc(test.freedom, test.chi2)) < SIGNIFICANCE) is (beyond > 1.0)
    assert len(codes_of(good, good, aligned, refined=refined)) == (2 if beyond > 1.0 else 0)
    # Of six unknowns of the poles' pose, with 10 mm, the surfaces, with 1 mm, check nearly all.
    assert tests["surfaces"].redundancy == pytest.approx(0.99, abs=0.001)
    assert [test.kind for test in agreement_tests(aligned, None)] == ["radius"]


def places(
    agreeing: int, contradicting: int, missing: int = 0, z_margin: float | None = None
) -> Confirmation:
    return Confirmation(
        agreeing=agreeing, contradicting=contradicting, missing=missing, z_margin=z_margin
    )


def chance(found: Confirmation) -> float:
    assert found.probability_wrong is not None
    return found.probability_wrong


def test_what_stands_in_the_scene_denies_confirms_or_says_nothing() -> None:
    def codes(found: Confirmation) -> list[str]:
        check_confirmation(found)
        return [reason.code for reason in check_unconfirmed(found)]

    good = places(500, 2, z_margin=6.0)
    assert chance(good) < MAX_WRONG / 2
    assert codes(good) == []
    # That much agrees says little where another pose agrees with as much.
    assert codes(structs.replace(good, agreeing=60, z_margin=0.0)) == ["not_confirmed"]
    nothing = places(0, 0, z_margin=0.0)
    assert 0.2 < chance(nothing) < 0.8
    assert codes(nothing) == ["not_confirmed"]
    # More poles or placements confirm each other where the scene has too little to say …
    assert codes(structs.replace(nothing, redundant=True)) == []
    assert codes(structs.replace(nothing, trusted=True)) == []
    assert codes(places(0, MIN_TOTAL - 1, z_margin=0.0)) == ["not_confirmed"]
    # … but not against it.
    contradicted = places(
        1000, round(1000 * 1.1 * MAX_CONFLICTING / (1 - 1.1 * MAX_CONFLICTING)), z_margin=6.0
    )
    redundant, trusted = (
        structs.replace(contradicted, **{k: True}) for k in ("redundant", "trusted")
    )
    for found in (contradicted, redundant, trusted):
        with pytest.raises(Refusal) as refusal:
            codes(found)
        assert refusal.value.code == "scene_contradicts"
        assert refusal.value.values["agreeing"] == 1000
    with pytest.raises(Refusal, match="should agree"):
        codes(places(2, 20, MIN_TOTAL))
    with pytest.raises(Refusal, match=r"fits better 1\.6 m away"):
        codes(structs.replace(good, better_at=1.6))


def test_an_answer_is_likelier_wrong_the_more_denies_it_and_the_less_it_leads() -> None:
    found = [places(500, count, z_margin=3.0) for count in (0, 5, 50, 200)]
    chances = [chance(each) for each in found]
    assert chances == sorted(chances)
    chances = [chance(places(500, 5, z_margin=margin)) for margin in (-3, -1, 1, 3)]
    assert chances == sorted(chances, reverse=True)
    assert places(500, 5).probability_wrong is None, "it was held against nothing"
    missing = places(500, 0, 50, z_margin=3.0)
    assert chance(missing) == chance(found[2])
    assert all(0 < each < 1 for each in chances)


def test_the_chance_that_an_answer_is_wrong_is_stated_for_a_share_that_deceives() -> None:
    """Bayes: odds go with the odds of the share; what is seen of the scene is another factor."""
    found = [places(500, 20, z_margin=margin) for margin in (0.5, 3.0)]
    for share in (0.01, 0.2, 0.9):
        stated = [structs.replace(each, deceiving=share) for each in found]
        ratios = [
            (chance(one) / (1 - chance(one))) / (chance(other) / (1 - chance(other)))
            for one, other in zip(stated, found, strict=True)
        ]
        odds = share / (1 - share) / (DECEIVING / (1 - DECEIVING))
        assert ratios == pytest.approx([odds, odds])


def test_a_message_counts_what_the_document_counts() -> None:
    """What contradicts and what should agree and does not are two counts everywhere."""
    found = places(500, 150, 50, z_margin=0.5)
    with pytest.raises(Refusal) as refused:
        check_confirmation(found)
    (doubted,) = check_unconfirmed(found)
    for said in (refused.value.message, doubted.message, found.text):
        assert "500 patches agree, 150 contradict, 50 should agree and do not" in said
    for values in (refused.value.values, doubted.values):
        assert (values["contradicting"], values["missing"]) == (150, 50)


def test_notes_are_no_reason_to_doubt() -> None:
    few = Reason("few_points", "a pole has 8 returns", {})
    moved = Reason("pole_moved", "pole 2 moved", {})
    assert warnings_and_notes([few, moved, few]) == ((moved,), (few, few))
    assert warnings_and_notes([]) == ((), ())


@pytest.mark.parametrize("freedom", [2, 6])
def test_poles_that_do_not_stand_alike_are_refused(freedom: int) -> None:
    """Of three poles the one that explains most is named; of two neither can be told."""
    limit = MAX_AXES_CHI2 * freedom
    by_pole = np.array([3.0, 9.0] if freedom == 2 else [3.0, 9.0, 4.0])
    check_axes(replace(an_alignment(), axes_test=AxesTest(0.99 * limit, freedom, by_pole)))
    with pytest.raises(Refusal) as refusal:
        check_axes(replace(an_alignment(), axes_test=AxesTest(1.01 * limit, freedom, by_pole)))
    assert refusal.value.code == "poles_inconsistent"
    assert refusal.value.values["pole"] == (-1 if freedom == 2 else 1)
    assert refusal.value.values["dof"] == freedom
    assert ("freeing pole 1" in str(refusal.value)) == (freedom == 6)


def test_what_still_moves_is_told_stage_by_stage(good: list[Pole]) -> None:
    stages = [
        reason.values["stage"]
        for reason in reasons_of(
            good,
            good,
            replace(an_alignment(), converged=False),
            refined=a_refinement(converged=False),
        )
    ]
    assert stages == ["poles", "refined"]


def test_angles_that_are_not_those_of_the_unit_are_a_warning() -> None:
    cloud = PointCloud(np.ones((3, 3)))
    assert not list(check_sensor("the target", Scan(cloud, None)))
    nominal = Scan(replace(cloud, nominal_angles="Hesai XT32"), None)
    (reason,) = check_sensor("the target", nominal)
    assert reason.code == "nominal_angles"
    assert reason in warnings_and_notes([reason])[0]
    assert "Hesai XT32" in reason.message
    assert "0.2 m at 30 m" in reason.message
    assert "--angles FILE" in reason.message
