"""Poles, radius and scene that contradict each other: said, refused, or within what is stated."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.pipeline import calibrate
from retropole.simulation import SimulatedPair, record_again, simulate_pair
from tests.numeric import CHI2_6_95, mahalanobis_sq

SCENES = ("street", "corridor", "harbor")

BEYOND_3_SIGMA = 20.06
"""χ² with 6 degrees of freedom exceeds this as seldom as a normal variable its 3 σ."""


def small(scene: str, seed: int) -> SimulatedPair:
    return simulate_pair(
        scene, np.random.default_rng(seed), sensor_target="VLP-16", sensor_source="VLP-16"
    )


@pytest.mark.parametrize("scene", SCENES)
def test_a_diameter_given_for_the_radius_is_told_and_does_no_harm(scene: str) -> None:
    pair = small(scene, 0)
    wrong = calibrate(pair.target, pair.source, sensors=pair.sensors, radius=0.04)
    assert "radius_differs" in [reason.code for reason in wrong.reasons]
    assert wrong.radius is not None
    assert wrong.radius.given == 0.04
    assert abs(wrong.radius.estimated - 0.02) < 3 * wrong.radius.sigma
    right = calibrate(pair.target, pair.source, sensors=pair.sensors)
    assert "radius_differs" not in [reason.code for reason in right.reasons]
    for answer in (wrong, right):
        for pose in (answer.poles, answer.refined):
            assert pose is not None
            assert mahalanobis_sq(pose, pair.T_target_source) < CHI2_6_95


def with_a_moved_pole(scene: str, seed: int) -> tuple[SimulatedPair, SimulatedPair]:
    """Recordings between which one pole was moved by 15 cm over the ground, whichever way."""
    pair, rng = small(scene, seed), np.random.default_rng(seed)
    way = rng.uniform(0.0, 2 * np.pi)
    step = 0.15 * np.array([np.cos(way), np.sin(way), 0.0])
    first, *rest = pair.poles
    poles = (replace(first, centre=first.centre + step), *rest)
    between = replace(pair, surfaces=(*pair.surroundings, *poles), poles=poles)
    return pair, record_again(between, rng)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("seed", range(50, 55))
def test_a_pole_moved_between_the_recordings_gives_no_false_certainty(
    scene: str, seed: int
) -> None:
    pair, later = with_a_moved_pole(scene, seed)
    answer = calibrate(pair.target, later.source, sensors=pair.sensors)
    if answer.status != "refused":
        assert answer.refined is not None
        assert mahalanobis_sq(answer.refined, pair.T_target_source) < BEYOND_3_SIGMA
