"""Several placements of the poles before the same LiDARs."""

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.base.errors import Refusal
from retropole.checking.metrics import e_rt
from retropole.hypotheses.placements import NOTHING, Share, Tried, merge_clouds, with_attempts
from retropole.pipeline import Options, calibrate
from retropole.simulation import SimulatedPair, place_again, simulate_pair


def placements(scene: str, seed: int, count: int = 3) -> list[SimulatedPair]:
    rng = np.random.default_rng(seed)
    pairs = [simulate_pair(scene, rng)]
    while len(pairs) < count:
        pairs.append(place_again(pairs[0], rng))
    return pairs


@pytest.fixture(scope="module")
def harbor() -> list[SimulatedPair]:
    return placements("harbor", 4)


def test_placements_share_the_truth(harbor: list[SimulatedPair]) -> None:
    for pair in harbor[1:]:
        np.testing.assert_array_equal(pair.T_target_source, harbor[0].T_target_source)
        assert not np.allclose(pair.poles[0].centre, harbor[0].poles[0].centre)


@pytest.mark.full
def test_one_answer_for_all(harbor: list[SimulatedPair]) -> None:
    answer = calibrate([p.target for p in harbor], [p.source for p in harbor])
    assert answer.T_target_source is not None, answer.reasons
    assert e_rt(answer.T_target_source, harbor[0].T_target_source) < 0.05
    assert len(answer.placements) == 3
    for placement in answer.placements:
        assert placement.left_out is not None
        assert placement.left_out.rotation < np.radians(1.0)


@pytest.mark.nightly
def test_more_placements_are_more_accurate() -> None:
    one: list[float] = []
    four: list[float] = []
    for seed in range(6):
        pairs = placements("street", 20 + seed, 4)
        for some, errors in ((pairs[:1], one), (pairs, four)):
            answer = calibrate(
                [p.target for p in some], [p.source for p in some], options=Options(scene=False)
            )
            assert answer.T_target_source is not None, answer.reasons
            errors.append(e_rt(answer.T_target_source, pairs[0].T_target_source))
    assert np.median(four) < 0.6 * np.median(one)


@pytest.mark.full
def test_a_lidar_that_moved_between_is_refused(harbor: list[SimulatedPair]) -> None:
    other = simulate_pair("harbor", np.random.default_rng(9))
    answer = calibrate([harbor[0].target, other.target], [harbor[0].source, other.source])
    assert answer.status == "refused"
    assert answer.reasons[0].code == "placements_disagree"


def test_one_cloud_merged_is_itself() -> None:
    cloud = PointCloud(np.ones((3, 3)))
    assert merge_clouds([cloud]) is cloud
    assert len(merge_clouds([cloud, cloud])) == 6


def test_merged_clouds_keep_their_sweeps_apart_and_their_rings() -> None:
    rings = np.array([0, 1, 1])
    one = PointCloud(np.ones((3, 3)), ring=rings)
    two = PointCloud(np.ones((3, 3)), ring=rings, frame=np.array([0, 0, 4]))
    merged = merge_clouds([one, two, one])
    assert merged.frame is not None
    np.testing.assert_array_equal(merged.frame, [0, 0, 0, 1, 1, 5, 6, 6, 6])
    np.testing.assert_array_equal(merged.ring, np.tile(rings, 3))
    # Rings of some say nothing of the others.
    assert merge_clouds([one, PointCloud(np.ones((3, 3)))]).ring is None


REFUSAL = Refusal("no_overlap", "nothing lies on anything", {"overlap": 0.1})


def test_where_all_was_tried_nothing_is_said() -> None:
    whole = Tried(Share(200, 200), Share(9, 9), Share(4, 4))
    for tried in ([], [NOTHING], [NOTHING, whole]):
        assert with_attempts(REFUSAL, tried) is REFUSAL


def test_every_cut_is_said_and_no_whole() -> None:
    said = with_attempts(REFUSAL, [Tried(Share(200, 229), Share(16, 310), Share(3, 3))])
    assert (said.code, said.message) == (REFUSAL.code, REFUSAL.message)
    counts = {"pairs": 229, "pairs_laid": 200, "ways": 310, "ways_tried": 16}
    assert said.values == {**REFUSAL.values, **counts}


def test_of_several_attempts_the_one_with_most_ways_is_told() -> None:
    few, many = (Tried(ways=Share(16, count)) for count in (20, 400))
    for tried in ([few, many], [many, few]):
        assert with_attempts(REFUSAL, tried).values["ways"] == 400
