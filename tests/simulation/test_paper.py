"""The set-up of Xue et al. 2019, Sec. IV-A."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.simulation import EXACT, simulate_pair
from retropole.simulation.paper import PAPER_RADIUS, draw_poles, lidar_poses


def test_lidars_and_poles_stand_as_in_the_paper() -> None:
    target, source = lidar_poses()
    np.testing.assert_allclose(target[:3, 3], [1, -1, 0])
    np.testing.assert_allclose(source[:3, 3], [1, 1, 0])
    rng = np.random.default_rng(0)
    for _ in range(50):
        first, second = draw_poles(rng)
        for pole in (first, second):
            assert pole.axis[2] > 0.9
            assert pole.centre[2] == 0
            assert 2 <= np.linalg.norm(pole.centre) <= 3
            assert pole.radius == PAPER_RADIUS
        assert 1.5 <= np.linalg.norm(first.centre - second.centre) <= 4


def test_the_truth_is_that_of_the_two_poses() -> None:
    target, source = lidar_poses()
    pair = simulate_pair("paper", np.random.default_rng(0))
    np.testing.assert_allclose(pair.T_target_source, se3.inverse(target) @ source, atol=1e-12)
    assert pair.surroundings == ()
    assert [sensor.name for sensor in pair.sensors] == ["VLP-16", "VLP-16"]


def test_the_noise_is_6_mm_in_each_coordinate() -> None:
    errors = []
    for seed in range(5):
        noisy, exact = (
            simulate_pair("paper", np.random.default_rng(seed), noise=noise)
            for noise in (None, EXACT)
        )
        errors.append(noisy.target.xyz - exact.target.xyz)
    each = np.concatenate(errors)
    assert each.std(axis=0) == pytest.approx(np.full(3, 0.006), rel=0.1)
    assert np.abs(each.mean(axis=0)).max() < 4 * 0.006 / np.sqrt(len(each))
