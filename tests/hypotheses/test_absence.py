"""A pole that a LiDAR would see, and does not, speaks against a hypothesis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, Detection, Hypothesis, Match, Placement, Scan
from retropole.base.sensors import find_sensor
from retropole.extraction.poles import extract_poles
from retropole.hypotheses.absence import absent, without_absent
from retropole.hypotheses.correspondence import match_poles
from retropole.simulation import Box, Surface, scan
from tests.extraction.scenes import GROUND, PAINT, pole

SENSOR = find_sensor("XT32")
T_SOURCE = se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, 0.9])), np.array([1.5, -4.0, 0.0]))
LEANING = [
    pole((4.5, 1.2), np.array([0.35, 0.0, 0.0])),
    pole((5.5, -1.5), np.array([-0.35, 0.0, 0.0])),
    pole((6.5, 0.3), np.array([0.0, 0.35, 0.0])),
]
"""They lean alike: the bisector of the first two is upright."""


def placement_of(*things: Surface) -> Placement:
    rng = np.random.default_rng(0)
    scans = []
    for T in (np.eye(4), T_SOURCE):
        cloud = scan([GROUND, *LEANING, *things], SENSOR, T, rng).cloud
        scans.append(Scan(cloud, SENSOR, extract_poles(cloud, sensor=SENSOR)))
    return Placement(scans[0], scans[1])


@pytest.fixture(scope="module")
def placement() -> Placement:
    return placement_of()


def is_right(T: Array) -> bool:
    return bool(se3.difference(T, T_SOURCE).rotation < np.radians(5.0))


def right_and_half_turn(placement: Placement) -> tuple[Match, Match]:
    """The right match, and the one that lays ground on ground by two poles."""
    matches = match_poles(placement.target.poles, placement.source.poles)
    right = next(match for match in matches if is_right(match.T_target_source))
    # The vertical stays up.
    turned = next(
        match
        for match in matches
        if match.exact and match is not right and match.T_target_source[2, 2] > 0.95
    )
    assert (len(right.pairs), len(turned.pairs)) == (3, 2)
    return right, turned


def test_the_third_pole_is_absent_for_both_under_a_half_turn(placement: Placement) -> None:
    right, turned = right_and_half_turn(placement)
    assert absent(placement, right) == 0
    assert absent(placement, turned) == 2
    back = Placement(placement.source, placement.target)
    pairs = tuple((j, i) for i, j in turned.pairs)
    inverse = replace(turned, pairs=pairs, T_target_source=se3.inverse(turned.T_target_source))
    assert absent(back, inverse) == 2


def test_a_place_that_something_hides_says_nothing(placement: Placement) -> None:
    _, turned = right_and_half_turn(placement)
    (left,) = {0, 1, 2} - {j for _, j in turned.pairs}
    at = se3.apply(turned.T_target_source, placement.source.poles[left].point[None])[0]
    half = np.array([0.1, 1.5, 1.5])
    hidden = placement_of(Box(0.6 * at, np.eye(3), half, PAINT))
    target = replace(placement.target, cloud=hidden.target.cloud)
    assert absent(Placement(target, placement.source), turned) == 1


def test_a_candidate_pole_need_not_be_there(placement: Placement) -> None:
    _, turned = right_and_half_turn(placement)

    def doubted(scan: Scan) -> Scan:
        assert isinstance(scan.detection, Detection)
        return replace(scan, detection=replace(scan.detection, candidates=scan.poles))

    doubtful = Placement(doubted(placement.target), doubted(placement.source))
    assert absent(doubtful, turned) == 0


def test_only_what_the_scene_does_not_prefer_is_left_out(placement: Placement) -> None:
    right, turned = right_and_half_turn(placement)
    alike = (
        Hypothesis(turned, None, None, 0.3, 0.0, 0.3),
        Hypothesis(right, None, None, 0.3, 0, 0.3),
    )
    assert without_absent(placement, alike) == alike[1:]
    better = replace(alike[0], overlap=0.9, score=0.9)
    assert without_absent(placement, (better, alike[1])) == (better, alike[1])
    assert without_absent(placement, alike[:1]) == alike[:1]
