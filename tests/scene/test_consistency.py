"""What stands in a scene: at the right pose it agrees, elsewhere it denies the pose."""

import numpy as np
import pytest

from retropole import se3
from retropole.scene.consistency import (
    DENIED,
    MAX_CONTRADICTED,
    MIN_AGREEING,
    Standing,
    consistency,
    standing_in,
)
from retropole.simulation import SimulatedPair, simulate_pair
from retropole.uncertainty import Confirmation


def standing(pair: SimulatedPair) -> tuple[Standing, Standing]:
    rng = np.random.default_rng(0)
    return standing_in(pair.target, rng), standing_in(pair.source, rng)


def elsewhere(T: np.ndarray, angle: float, distance: float) -> np.ndarray:
    """Turn a pose about the height of a level target, and move it along the ground."""
    return se3.retract(T, np.array([0.0, 0.0, angle, distance, -distance, 0.0]))


@pytest.mark.parametrize("scene", ["corridor", "street", "harbor"])
def test_the_right_pose_is_confirmed_and_others_are_denied(scene: str) -> None:
    for seed in range(3):
        pair = simulate_pair(scene, np.random.default_rng(seed))
        target, source = standing(pair)
        right = consistency(target, source, pair.T_target_source)
        assert right.agreeing > MIN_AGREEING
        assert right.contradicted < MAX_CONTRADICTED
        wrong = consistency(target, source, elsewhere(pair.T_target_source, 1.0, 2.0))
        assert wrong.contradicted > DENIED or wrong.agreeing < MIN_AGREEING
        assert wrong.agreeing < right.agreeing / 2


def test_bare_ground_confirms_nothing() -> None:
    pair = simulate_pair("bare", np.random.default_rng(0))
    target, source = standing(pair)
    assert consistency(target, source, pair.T_target_source).agreeing < MIN_AGREEING


def test_both_directions_count_alike() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    target, source = standing(pair)
    T = elsewhere(pair.T_target_source, 0.1, 0.5)
    there = consistency(target, source, T)
    back = consistency(source, target, se3.inverse(T))
    # Up to rounding at the limits.
    assert abs(back.agreeing - there.agreeing) <= 2
    assert abs(back.contradicting - there.contradicting) <= 2
    assert there.total > 100


def test_nothing_denies_nothing() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    far = elsewhere(pair.T_target_source, 0.0, 1000.0)
    found = consistency(*standing(pair), far)
    assert found == Confirmation(0, 0)
    assert found.contradicted == 0
