"""Where LiDARs are on a vehicle, from where they are over the ground."""

from pathlib import Path

import numpy as np
import pytest

from retropole.api.leveling import BaseLink, _on_vehicle, level_result
from retropole.base import se3
from retropole.base.errors import RetropoleError
from retropole.ground.level import LidarLevel
from tests.ground.grounds import pose


def lidar(name: str, T: np.ndarray) -> LidarLevel:
    roll, pitch, _ = se3.rpy_from_rotation(T[:3, :3])
    return LidarLevel(name, T, np.zeros((6, 6)), roll, pitch, T[2, 3], np.zeros((3, 3)))


def test_the_vehicle_moves_along_the_ground_alone() -> None:
    first, second = lidar("a", pose(2.0, 3.0, 4.0, 20.0)), lidar("b", pose(1.5, -2.0, 1.0, 70.0))
    second.T_ground_lidar[:2, 3] = 0.4, 1.0
    base = BaseLink(1.2, -0.3, np.radians(90.0))
    found = _on_vehicle([first, second], first, base)
    T = found["a"][0]
    assert np.allclose(T[:3, 3], [1.2, -0.3, 2.0])
    assert np.allclose(np.degrees(se3.rpy_from_rotation(T[:3, :3])), [3.0, 4.0, 90.0])
    between = se3.inverse(found["a"][0]) @ found["b"][0]
    assert np.allclose(
        between, se3.inverse(first.T_ground_lidar) @ second.T_ground_lidar, atol=1e-12
    )


@pytest.mark.full
def test_its_covariance_is_that_of_drawn_measurements() -> None:
    first, second = lidar("a", pose(2.0)), lidar("b", pose(1.5, yaw=70.0))
    second.T_ground_lidar[:2, 3] = 3.0, 1.0
    rng, sigma, turn = np.random.default_rng(1), 0.02, 0.01
    T, covariance = _on_vehicle([first, second], first, BaseLink(1.0, 0.0, 0.5, sigma, turn))["b"]
    steps = []
    for x, y, yaw in rng.normal(size=(2000, 3)) * [sigma, sigma, turn]:
        drawn = BaseLink(1.0 + x, y, 0.5 + yaw)
        steps.append(se3.local(T, _on_vehicle([first, second], first, drawn)["b"][0]))
    assert np.allclose(np.cov(np.array(steps).T), covariance, atol=8e-5)


def test_what_is_no_result_is_reported(tmp_path: Path) -> None:
    with pytest.raises(RetropoleError):
        level_result(tmp_path)
