"""Which returns are of the ground."""

import numpy as np
import pytest

from retropole.base.errors import Refusal
from retropole.ground.surface import cells_of, find_ground
from tests.ground.grounds import pose, rings, viewer

RNG = np.random.default_rng(4)


def test_a_road_is_parted_from_its_pavement() -> None:
    at = rings(60, near=1.0)
    on_road = np.abs(at[:, 1]) < 3
    z = np.where(on_road, 0.0, 0.12) + RNG.normal(0, 0.003, len(at))
    ground = find_ground([viewer(at, z, pose(2.0, 3.0))], 10.0)
    taken = on_road[ground.points[0]]
    assert taken.mean() > 0.995
    assert ground.others[0].height == pytest.approx(0.12, abs=0.03)
    assert len(taken) > 0.6 * np.count_nonzero(on_road & (np.hypot(*at.T) < 20))


def test_a_camber_is_one_ground() -> None:
    at = rings(60)
    ground = find_ground([viewer(at, -0.04 * np.abs(at[:, 1]), pose(2.0))], 10.0)
    assert len(ground.points[0]) > 0.9 * np.count_nonzero(np.hypot(*at.T) < 20)


def test_roofs_and_walls_are_none() -> None:
    at = rings(60)
    car = (np.abs(at[:, 0] - 5) < 2) & (np.abs(at[:, 1]) < 1)
    high = np.where(car, 1.4, 0.0)
    wall = np.abs(at[:, 1] - 8) < 0.1
    high[wall] = RNG.uniform(0, 3, np.count_nonzero(wall))
    ground = find_ground([viewer(at, high, pose(2.5))], 10.0)
    assert not high[ground.points[0]].max() > 0.06


def test_walls_alone_are_refused() -> None:
    y, z = RNG.uniform(-10, 10, 20000), RNG.uniform(-2, 2, 20000)
    side = np.where(RNG.uniform(size=20000) < 0.5, -2.0, 2.0)
    with pytest.raises(Refusal) as refusal:
        find_ground([viewer(np.c_[y, side], z + 2.0, pose(2.0))], 10.0)
    assert refusal.value.code == "too_little_ground"


@pytest.mark.parametrize("foot", [0.0, 6.0])
def test_below_a_wide_blind_cone_is_what_is_seen_along_the_kerb(foot: float) -> None:
    at = rings(60, near=7.0)
    on_road = np.abs(at[:, 1] + foot) < 4
    ground = find_ground([viewer(at, np.where(on_road, 0.0, 0.12), pose(2.0))], 10.0)
    assert (on_road[ground.points[0]] == (foot < 4)).all()
    assert ground.others[0].height == pytest.approx(0.12 if foot < 4 else -0.12, abs=0.01)


@pytest.mark.parametrize("foot", [0.0, 1.0])
def test_a_corner_of_kerbs_below_a_wide_blind_cone_is_refused(foot: float) -> None:
    at = rings(60, near=7.0)
    z = np.where((at > foot).all(axis=1), 0.0, 0.12)
    with pytest.raises(Refusal) as refusal:
        find_ground([viewer(at, z, pose(2.0))], 10.0)
    assert refusal.value.code == "two_grounds"


def test_a_ceiling_is_not_the_floor_and_a_hanging_lidar_has_its_ground_above() -> None:
    at = rings(60)
    both = np.concatenate([at, at])
    z = np.repeat([0.0, 3.0], len(at))
    ground = find_ground([viewer(both, z, pose(1.4))], 10.0)
    assert z[ground.points[0]].max() == 0
    assert ground.ceiling is not None
    hanging = find_ground([viewer(at, 0 * at[:, 0], pose(1.4, roll=180.0))], 10.0)
    assert len(hanging.points[0]) > 1000


def test_cells_have_quantiles_of_their_heights() -> None:
    points = np.array([[0.1, 0.1, 1.0], [0.2, 0.2, 2.0], [0.6, 0.1, 5.0]])
    low, high, count, corner = cells_of(points, 0.5)
    assert (low[0, 0], high[0, 0], low[1, 0], count[0, 0]) == (1.0, 2.0, 5.0, 2)
    assert np.allclose(corner, 0)
