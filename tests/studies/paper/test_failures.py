"""Each trouble does what it says, and an answer is judged on both sides of the limit."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.errors import Refusal
from retropole.base.sensors import SENSORS
from retropole.simulation import EXACT, SimulatedPair, simulate_pair
from studies.paper.failures import (
    TROUBLES,
    WRONG_ROTATION,
    WRONG_TRANSLATION,
    by_paper,
    judge,
    paper_poles,
    paper_threshold,
    with_fading_tape,
    with_rings,
    with_strips,
)
from tests.studies.paper.exhibits import all_exhibits, number

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    return simulate_pair("corridor", np.random.default_rng(0), noise=EXACT)


def bright(pair: SimulatedPair) -> int:
    intensity = pair.target.intensity
    assert intensity is not None
    return int(np.count_nonzero(intensity >= paper_threshold(pair.sensors[0])))


def test_the_papers_detector_finds_the_poles(pair: SimulatedPair) -> None:
    first = len(pair.surroundings)
    for cloud, labels, sensor in zip(
        (pair.target, pair.source), pair.labels, pair.sensors, strict=True
    ):
        poles = paper_poles(cloud, paper_threshold(sensor))
        assert {int(k) for pole in poles for k in labels[pole.index]} == {first, first + 1}
    with pytest.raises(Refusal, match="0 poles"):
        paper_poles(pair.target, 1e9)


def test_the_papers_method_is_right_in_a_clean_corridor(pair: SimulatedPair) -> None:
    answer = judge(by_paper, pair)
    assert answer.outcome == "success"
    assert answer.errors is not None
    assert 1e-3 < answer.errors.e_rt < 0.5, "biased, but near"


def test_answers_are_judged_on_both_sides_of_the_limits(pair: SimulatedPair) -> None:
    for k, limit in ((0, WRONG_ROTATION), (3, WRONG_TRANSLATION)):
        for factor, outcome in ((0.9, "success"), (1.1, "wrong")):
            T = se3.retract(pair.T_target_source, factor * limit * np.eye(6)[k])
            assert judge(lambda _, T=T: T, pair).outcome == outcome  # type: ignore[misc]

    def refuses(_: SimulatedPair) -> Array:
        raise Refusal("too_few_poles", "none", {})

    assert judge(refuses, pair).outcome == "refused"


def test_the_threshold_is_the_papers() -> None:
    assert paper_threshold(SENSORS["VLP-16"]) == 230
    assert paper_threshold(SENSORS["XT32"]) == 200


def test_posts_are_seen_and_bright(pair: SimulatedPair) -> None:
    more = with_strips(3)(pair, np.random.default_rng(0))
    assert len(more.surfaces) == len(pair.surfaces) + 6
    assert more.poles == pair.poles
    assert bright(more) > bright(pair)


def test_every_fourth_ring_errs(pair: SimulatedPair) -> None:
    worse = with_rings(0.1, 0.01, 4)(pair, np.random.default_rng(0))
    for device in worse.devices:
        bad = device.ring_range != 0
        assert bad.sum() == len(bad) / 4
        np.testing.assert_array_equal(bad, device.ring_elevation != 0)
        assert 0.02 < np.sqrt(np.mean(device.ring_range[bad] ** 2)) < 0.3


def test_tape_fades_with_its_distance(pair: SimulatedPair) -> None:
    counts = []
    for reach in (100.0, 5.0, 0.5):
        fading = replace(pair, noise=replace(EXACT, intensity_falloff=True))
        counts.append(bright(with_fading_tape(reach)(fading, np.random.default_rng(0))))
    near, middle, none = counts
    assert near > middle > none == 0


@pytest.mark.nightly
def test_every_trouble_is_counted_for_both_methods() -> None:
    rows = all_exhibits()["weaknesses"].rows
    assert len(rows) == 2 * len(TROUBLES)
    for _, _, _, success, wrong, refused, error in rows:
        assert number(success) + number(wrong) + number(refused) == 1
        assert (error is None) == (success == 0)
