"""One pole that both LiDARs see: the place gives the rest of the pose, or there is no answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.refinement import refine
from retropole.alignment.adjustment import SURROUNDINGS_SIGMA
from retropole.base import se3
from retropole.base.datatypes import (
    Calibration,
    Detection,
    Hypothesis,
    Match,
    Placement,
    PointCloud,
    PoseEstimate,
    Scan,
)
from retropole.base.errors import Refusal
from retropole.base.uncertainty.confirmation import Confirmation
from retropole.hypotheses import by_place
from retropole.hypotheses.by_place import (
    DETERMINED,
    align_by_place_if_open,
    check_confirmed_by_surroundings,
    check_constrained,
    choose_by_place,
    confirmed_by_place,
    has_rival,
)
from retropole.hypotheses.placements import (
    Chosen,
    PairedPlacement,
    PlacementHypotheses,
    find_recurring,
    is_by_place,
)
from retropole.pipeline import Options, calibrate
from retropole.simulation import Cylinder, SimulatedPair, simulate_pair
from retropole.simulation.pairs import Arrangement, Recorders, record
from retropole.simulation.scenes import TAPE, rotated_by_180
from retropole.surfaces.visibility import score_hypotheses
from tests.hypotheses.conftest import simulated_with_one_pole
from tests.hypotheses.test_one_pole import MOVED, assert_near, found_in, poses_in
from tests.tiers import first_of

pytestmark = pytest.mark.full

SCENES = {"corridor": 3, "street": 1, "harbor": 2}


@pytest.fixture(scope="module", params=first_of(sorted(SCENES)))
def pair(request: pytest.FixtureRequest) -> SimulatedPair:
    return simulated_with_one_pole(request.param, SCENES[request.param])


@pytest.fixture(scope="module")
def answer(pair: SimulatedPair) -> Calibration:
    return calibrate(pair.target, pair.source)


def test_one_pole_gives_the_truth_where_the_place_tells(
    pair: SimulatedPair, answer: Calibration
) -> None:
    assert answer.status == "ok", answer.reasons
    assert_near(answer.T_target_source, pair.T_target_source)
    assert answer.T_target_source is not None
    assert answer.covariance is not None
    off = se3.local(answer.T_target_source, pair.T_target_source)
    assert off @ np.linalg.solve(answer.covariance, off) < 22.5
    assert [len(h.match.pairs) for h in answer.hypotheses[:1]] == [1]
    (note,) = [note for note in answer.notes if note.code == "by_place"]
    assert note.values["poles"] == 1
    assert "nearly_parallel_poles" not in {each.code for each in answer.notes}


def test_swapping_the_clouds_inverts_the_answer(pair: SimulatedPair, answer: Calibration) -> None:
    back = calibrate(pair.source, pair.target)
    assert answer.T_target_source is not None
    assert_near(back.T_target_source, se3.inverse(answer.T_target_source), 0.05, 0.02)


def test_moving_both_clouds_moves_the_answer(one_pole: SimulatedPair) -> None:
    both = one_pole.target.transformed(MOVED), one_pole.source.transformed(MOVED)
    moved = calibrate(*both)
    assert_near(moved.T_target_source, MOVED @ one_pole.T_target_source @ se3.inverse(MOVED))


def test_bare_ground_gives_no_answer() -> None:
    bare = simulated_with_one_pole("bare", 0)
    answer = calibrate(bare.target, bare.source)
    assert answer.status == "refused"
    assert answer.T_target_source is None


def half_turned_quay() -> SimulatedPair:
    """A quay that a half turn about its one pole maps onto itself."""
    quay = simulated_with_one_pole("harbor", 2)
    surroundings = [*quay.surroundings, *rotated_by_180(list(quay.surroundings))]
    upright = Cylinder(np.array([0.0, 0.0, 1.02]), np.array([0.0, 0.0, 1.0]), 0.02, 2.0, TAPE)
    poses = quay.T_world_target, quay.T_world_source
    at = Arrangement(surroundings, [upright], poses, quay.clear)
    recorders = Recorders(quay.sensors, quay.devices, quay.noise, 1)
    pair = record(at, recorders, np.random.default_rng(0))
    assert pair.sees_every_pole
    return pair


def test_a_place_that_a_half_turn_about_the_pole_changes_nothing_of_gives_no_answer() -> None:
    pair = half_turned_quay()
    assert calibrate(pair.target, pair.source).status == "refused"


def test_files_of_two_places_give_no_answer(one_pole: SimulatedPair) -> None:
    other = simulated_with_one_pole("harbor", 2)
    assert calibrate(one_pole.target, other.source).status == "refused"


def test_the_number_of_poles_that_was_asked_for_counts(one_pole: SimulatedPair) -> None:
    assert calibrate(one_pole.target, one_pole.source, options=Options(poles=1)).status == "ok"
    refused = calibrate(one_pole.target, one_pole.source, options=Options(poles=2))
    assert refused.status == "refused"
    assert refused.reasons[0].code == "too_few_poles"


def test_without_the_scene_two_poles_are_needed(one_pole: SimulatedPair) -> None:
    refused = calibrate(one_pole.target, one_pole.source, options=Options(scene=False))
    assert refused.reasons[0].code == "too_few_poles"


def test_a_pose_that_the_scene_holds_no_better_than_was_assumed_is_refused(
    one_pole: SimulatedPair,
) -> None:
    placement = found_in(one_pole)
    scans = placement.target.cloud, placement.source.cloud
    (hypothesis, *_) = score_hypotheses(*scans, poses_in(placement))
    paired = [PairedPlacement(placement, hypothesis)]
    with pytest.raises(Refusal, match="too few surfaces") as refused:
        check_constrained(paired, None)
    assert refused.value.code == "degenerate_poles"
    T = hypothesis.match.T_target_source
    refined = refine(*scans, PoseEstimate(T, np.diag(SURROUNDINGS_SIGMA**2), 0.01))
    assert refined is not None
    check_constrained(paired, refined.pose)
    assert refined.pose.covariance is not None
    for k in range(6):
        variance = np.diag(refined.pose.covariance).copy()
        variance[k] = (1.1 * DETERMINED * SURROUNDINGS_SIGMA[k]) ** 2
        loose = PoseEstimate(T, np.diag(variance), 0.01)
        with pytest.raises(Refusal, match="determine the pose only to"):
            check_constrained(paired, loose)
    doubted = np.diag((2 * DETERMINED * SURROUNDINGS_SIGMA) ** 2)
    check_constrained(paired, PoseEstimate(T, doubted, 0.01), refined.held)
    with pytest.raises(Refusal, match="determine the pose only to"):
        check_constrained(paired, PoseEstimate(T, 400 * doubted, 0.01), refined.held)
    two = replace(hypothesis, match=replace(hypothesis.match, by_place=False))
    check_constrained([PairedPlacement(placement, two)], None)


def test_what_nothing_about_the_poles_gives_is_laid_from_above(
    one_pole: SimulatedPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(by_place, "matches_about", lambda *_: [])
    chosen = choose_by_place([found_in(one_pole)], 0.02)
    assert chosen is not None
    assert chosen.refusal is None
    best = chosen.hypotheses[0].match
    assert_near(best.T_target_source, one_pole.T_target_source, 1.0, 0.1)
    assert best.pairs == ((0, 0),)
    # Another pole is on none there.
    other = simulated_with_one_pole("street", 5)
    foreign = replace(found_in(one_pole).source, detection=found_in(other).source.detection)
    placement = replace(found_in(one_pole), source=foreign)
    assert choose_by_place([placement], 0.02) is None


def test_the_like_of_a_pose_about_a_pole_is_a_rival(one_pole: SimulatedPair) -> None:
    """A half turn maps a quay onto itself, and nothing of the street."""
    for pair, expected in ((half_turned_quay(), True), (one_pole, False)):
        found = found_in(pair)
        match = Match(((0, 0),), pair.T_target_source, 0.0, True, True, np.eye(6))
        hypotheses = score_hypotheses(found.target.cloud, found.source.cloud, [match])
        paired = PairedPlacement(found, hypotheses[0])
        assert has_rival([paired], 0.02) is expected


def test_what_stands_off_the_ground_tells_two_poles_apart_where_the_overlap_does_not() -> None:
    refusal = Refusal("no_overlap", "", {})

    def told_in(scene: str, seed: int) -> tuple[SimulatedPair, Chosen | None]:
        pair = simulate_pair(scene, np.random.default_rng(seed))
        answer = calibrate(pair.target, pair.source)
        (placement,) = answer.placements
        scored = PlacementHypotheses(placement, answer.hypotheses)
        choices = find_recurring([scored])
        # The best last: its place in the list does not count.
        return pair, confirmed_by_place(
            Chosen(answer.hypotheses, (), refusal, tuple(choices[::-1]), scored=(scored,))
        )

    pair, told = told_in("street", 0)
    assert told is not None
    assert told.refusal is None
    assert_near(told.hypotheses[0].match.T_target_source, pair.T_target_source, 3.0, 0.3)
    assert told.paired == told.choices[0].paired
    assert told_in("bare", 0)[1] is None
    assert confirmed_by_place(Chosen((), (), refusal)) is None


def test_two_poles_that_leave_the_pose_open_are_aligned_where_the_place_is() -> None:
    """Of two poles both LiDARs see a hand's breadth: they fit, and tell hardly any angle."""
    pair = simulate_pair("street", np.random.default_rng(4))
    found = found_in(pair)
    target, source = (replace(scan, detection=shortened(scan)) for scan in found.scans)
    short = Placement(target, source)
    match = Match(((0, 0), (1, 1)), pair.T_target_source, 0.0, True, True, np.eye(6))
    hypotheses = score_hypotheses(short.target.cloud, short.source.cloud, [match])
    chosen = Chosen(hypotheses, (PairedPlacement(short, hypotheses[0]),))
    with pytest.raises(Refusal, match="determine the pose only to"):
        align_by_place_if_open(chosen, radius=0.02, radius_sigma=0.0, by_place=False)
    again, aligned = align_by_place_if_open(chosen, radius=0.02, radius_sigma=0.0, by_place=True)
    assert is_by_place(again.paired)
    assert_near(aligned.pose.T_target_source, pair.T_target_source, 1.0, 0.1)


@pytest.mark.parametrize("none", [True, False])
def test_why_the_place_does_not_tell_is_said_in_one_line(
    none: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(by_place, "has_no_poles", lambda paired: none)
    nothing = Scan(PointCloud(np.zeros((0, 3))), None)
    match = Match((), np.eye(4), 0.0, True, True, np.eye(6), by_place=True)
    paired = PairedPlacement(Placement(nothing, nothing), Hypothesis(match, None, None, 0, 0, 0))
    found = Confirmation(agreeing=1234, contradicting=123, missing=123, z_margin=0.1)
    with pytest.raises(Refusal, match="chance of a wrong pose") as refusal:
        check_confirmed_by_surroundings([paired], found)
    assert len(str(refusal.value)) <= 300


def shortened(scan: Scan) -> Detection:
    """Keep of each pole what is near its middle."""
    assert scan.detection is not None
    poles = []
    for pole in scan.poles:
        near = np.abs((pole.xyz - pole.point) @ pole.direction) < 0.15
        poles.append(replace(pole, xyz=pole.xyz[near], index=pole.index[near], length=0.3))
    return replace(scan.detection, poles=tuple(poles))
