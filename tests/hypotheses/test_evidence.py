"""An answer that the scene confirms leads all other poses; what nothing could conflict with does
not.
"""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from msgspec import structs

from retropole.base import se3
from retropole.base.datatypes import (
    Calibration,
    Hypothesis,
    Match,
    Placement,
    PointCloud,
    Scan,
)
from retropole.base.sensors import find_sensor
from retropole.base.uncertainty.confirmation import Confirmation
from retropole.hypotheses.correspondence import extended
from retropole.hypotheses.evidence import (
    MAX_WRONG,
    _margin_in_map,
    confirm,
    count,
    is_in_conflict,
    scenes_of,
)
from retropole.hypotheses.placements import PairedPlacement
from retropole.pipeline import Options, calibrate
from retropole.simulation import (
    Cylinder,
    Rectangle,
    SimulatedPair,
    Surface,
    scan,
    simulate_pair,
)
from retropole.simulation.scenes import METAL, TAPE, UP
from retropole.surfaces.consistency import objects_in
from retropole.surfaces.scans import find_poles
from tests.tiers import first_of

SCENES = ("corridor", "street", "harbor")


def answered(pair: SimulatedPair) -> Calibration:
    answer = calibrate(pair.target, pair.source)
    assert answer.T_target_source is not None
    return answer


def held(answer: Calibration, T: np.ndarray) -> Confirmation:
    """Hold a pose against the scene of an answer."""
    paired = [PairedPlacement(answer.placements[0], answer.hypotheses[0])]
    return confirm(paired, T, answer.hypotheses[1:], np.random.default_rng(0))


@pytest.mark.parametrize("scene", first_of(SCENES))
@pytest.mark.full
def test_the_right_pose_is_confirmed_and_leads(scene: str) -> None:
    for seed in range(2):
        answer = answered(simulate_pair(scene, np.random.default_rng(seed)))
        found = answer.confirmation
        assert found is not None
        assert found.z_margin is not None
        assert found.z_margin > 1
        assert found.better_at is None
        assert found.probability_wrong is not None
        assert found.probability_wrong < MAX_WRONG
        assert not is_in_conflict(found)


@pytest.mark.parametrize("scene", first_of(SCENES))
@pytest.mark.full
def test_a_pose_along_the_place_does_not_lead_and_the_better_one_is_found(scene: str) -> None:
    """Walls that slide along themselves do not hide a shift."""
    for seed in range(2):
        pair = simulate_pair(scene, np.random.default_rng(seed))
        along = pair.T_world_target[:3, :3].T @ np.array([2.0, 0.0, 0.0])
        T = se3.retract(pair.T_target_source, np.r_[0, 0, 0, along])
        found = held(answered(pair), T)
        assert found.z_margin is not None
        assert found.z_margin < 0
        assert found.better_at is not None
        assert 1.7 < found.better_at < 2.3
        assert found.probability_wrong is not None
        assert found.probability_wrong > MAX_WRONG


@pytest.mark.parametrize("scene", first_of(SCENES))
@pytest.mark.full
def test_a_pose_that_lifts_the_grounds_off_each_other_is_found(scene: str) -> None:
    """Walls agree with it however high it is."""
    pair = simulate_pair(scene, np.random.default_rng(1))
    answer = answered(pair)
    for lift in (-2.0, 1.0):
        up = pair.T_world_target[:3, :3].T @ np.array([0.0, 0.0, lift])
        found = held(answer, se3.retract(pair.T_target_source, np.r_[0, 0, 0, up]))
        assert found.z_margin is not None
        assert found.z_margin < 0
        assert found.better_at == pytest.approx(abs(lift), abs=0.7)


@pytest.mark.full
def test_a_half_turn_is_beaten_by_the_other_hypothesis() -> None:
    pair = simulate_pair("street", np.random.default_rng(4))
    answer = answered(pair)
    right, *others = answer.hypotheses
    paired = [PairedPlacement(answer.placements[0], right)]
    wrong = others[0].match.T_target_source
    found = confirm(paired, wrong, [right, *others[1:]], np.random.default_rng(0))
    assert found.z_margin is not None
    assert found.z_margin < 0
    assert found.better_at is not None
    assert found.better_at > 1


@pytest.mark.full
def test_on_bare_ground_nothing_confirms_and_nothing_denies() -> None:
    for seed in range(3):
        pair = simulate_pair("bare", np.random.default_rng(seed))
        answer = calibrate(pair.target, pair.source)
        if answer.confirmation is None:
            continue
        assert answer.status == "warn"
        assert "not_confirmed" in [reason.code for reason in answer.reasons]
        assert answer.confirmation.probability_wrong is not None
        assert 0.1 < answer.confirmation.probability_wrong < 0.9
        trusted = calibrate(pair.target, pair.source, options=Options(trust_poles=True))
        assert "not_confirmed" not in [reason.code for reason in trusted.reasons]
        assert trusted.confirmation == structs.replace(answer.confirmation, trusted=True)


@pytest.mark.full
def test_a_cloud_in_which_nothing_stands_gives_finite_figures() -> None:
    pair = simulate_pair("street", np.random.default_rng(4))
    answer = answered(pair)
    (placement,) = answer.placements
    poles = np.concatenate([pole.index for pole in placement.source.poles])
    bare = replace(placement.source, cloud=placement.source.cloud.select(np.sort(poles)))
    paired = [PairedPlacement(replace(placement, source=bare), answer.hypotheses[0])]
    T, rng = pair.T_target_source, np.random.default_rng(0)
    found = confirm(paired, T, answer.hypotheses[1:], rng)
    assert found.z_margin is not None
    assert np.isfinite(found.z_margin)
    assert found.better_at is None or np.isfinite(found.better_at)
    assert found.total < 60


def test_swapping_the_clouds_changes_nothing_but_rounding() -> None:
    pair = simulate_pair("harbor", np.random.default_rng(2))
    scans = Scan(pair.target, None, None), Scan(pair.source, None, None)
    there, back = (
        count(scenes_of([Placement(*two)], np.random.default_rng(0)), T)
        for two, T in (
            (scans, pair.T_target_source),
            (scans[::-1], se3.inverse(pair.T_target_source)),
        )
    )
    assert there.agreeing == pytest.approx(back.agreeing, rel=0.02)
    assert abs(there.conflicting - back.conflicting) <= 5


@pytest.mark.full
def test_placements_check_each_other_only_where_their_poles_stand_otherwise() -> None:
    pair, other = (simulate_pair("bare", np.random.default_rng(seed)) for seed in (0, 3))
    one, two = (answered(each) for each in (pair, other))
    first = PairedPlacement(one.placements[0], one.hypotheses[0])
    second = PairedPlacement(two.placements[0], two.hypotheses[0])
    T, rng = one.hypotheses[0].match.T_target_source, np.random.default_rng(0)
    assert not confirm([first], T, (), rng).redundant
    assert not confirm([first, first], T, (), rng).redundant
    assert confirm([first, second], T, (), rng).redundant
    # A single pole has no shape that could tell two placements apart.
    match = replace(first.hypothesis.match, pairs=first.hypothesis.match.pairs[:1])
    alone = replace(first, hypothesis=replace(first.hypothesis, match=match))
    assert not confirm([alone, alone], T, (), rng).redundant
    assert not confirm([alone, second], T, (), rng).redundant


@pytest.mark.parametrize("is_regular", [True, False])
def test_posts_that_a_shift_lays_on_their_neighbours_do_not_check_a_pole(is_regular: bool) -> None:
    rng = np.random.default_rng(3)
    shifts = np.zeros(11) if is_regular else rng.uniform(-1.2, 1.2, 11)
    scene: list[Surface] = [Rectangle(np.zeros(3), np.eye(3)[0], np.eye(3)[1], (30.0, 30.0), METAL)]
    for k, y in product(range(11), (-5.0, 6.0)):
        foot = np.array([3.0 * (k - 5) + shifts[k], y, 0.75])
        scene.append(Cylinder(foot, UP, 0.05, 1.5, METAL))
    leaning = np.array([0.3, 0.2, 0.93]) / np.linalg.norm([0.3, 0.2, 0.93])
    scene.append(Cylinder(np.array([-1.5, 3.0, 1.0]), leaning, 0.05, 2.0, TAPE))
    poses = [se3.from_rt(np.eye(3), np.array([x, 0.0, 1.8])) for x in (-2.0, 1.5)]
    sensor, T = find_sensor("OS1"), se3.inverse(poses[0]) @ poses[1]
    clouds = [scan(scene, sensor, pose, rng).cloud for pose in poses]
    target, source = (
        find_poles(cloud, sensor=sensor, threshold=None, radius=0.05) for cloud in clouds
    )
    found = Placement(target, source)
    pairs = extended(found.target.poles, found.source.poles, T, 0.1)
    assert len(pairs) >= 3
    match = Match(pairs, T, 0.0, True, True, np.eye(6))
    paired = [PairedPlacement(found, Hypothesis(match, None, None, 0.5, 0.0, 0.5))]
    assert confirm(paired, T, (), rng).redundant is not is_regular


@pytest.mark.full
def test_what_agrees_with_either_pose_in_a_map_changes_nothing() -> None:
    """Walls along a street lie on themselves when shifted along it; posts do not."""
    rng = np.random.default_rng(4)
    ground = np.c_[rng.uniform(-20, 20, (20_000, 2)), np.full(20_000, -2.0)]
    posts = [
        np.c_[rng.normal([x, y], 0.05, (200, 2)), rng.uniform(-2, 2, 200)]
        for x, y in rng.uniform([-18, -4], [18, 4], (8, 2))
    ]
    shift = se3.from_rt(np.eye(3), np.array([1.5, 0.0, 0.0]))
    margins = []
    for far in (6.0, 20.0):
        walls = [
            np.c_[rng.uniform(-far, far, 9000), np.full(9000, y), rng.uniform(-2, 3, 9000)]
            for y in (-6.0, 6.0)
        ]
        both = [
            objects_in(PointCloud(np.concatenate([ground, *posts, *walls]), is_map=each), rng)
            for each in (True, False)
        ]
        margins.append(_margin_in_map((both[0], both[1]), np.eye(4))(shift))
        assert _margin_in_map((both[0], both[1]), shift)(np.eye(4)) < -1.5
    assert 1.5 < margins[0] < 1.2 * margins[1] < 1.5 * margins[0]
