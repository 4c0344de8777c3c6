"""Target and source the other way round are told from a movement."""

from functools import cache

import numpy as np
import pytest

import retropole as rp
from retropole.base import se3
from retropole.base.datatypes import Array, Placement, Scan
from retropole.base.sensors import SENSORS
from retropole.hypotheses.evidence import count, scenes_of
from retropole.monitoring.swapped import NEAR_TRANSLATION, swapped_clouds, swapped_sensors
from retropole.simulation import SimulatedPair
from retropole.surfaces.consistency import Standing

SCENES = ("street", "harbor", "corridor")

Scenes = list[tuple[Standing, Standing]]


@cache
def pair_of(scene: str) -> SimulatedPair:
    return rp.simulate(scene, 1, sensor_target="VLP-16", sensor_source="XT32")


@cache
def scenes(scene: str, swapped: bool) -> Scenes:
    clouds = pair_of(scene).target, pair_of(scene).source
    first, second = clouds[::-1] if swapped else clouds
    return scenes_of([Placement(Scan(first), Scan(second))], np.random.default_rng(0))


def told(scene: str, swapped: bool, stored: Array, found: Array | None = None) -> bool:
    standing = scenes(scene, swapped)
    reason = swapped_clouds(stored, found, standing, count(standing, stored))
    assert reason is None or reason.code == "swapped"
    return reason is not None


@pytest.mark.parametrize("scene", SCENES)
def test_what_stands_there_tells(scene: str) -> None:
    T = pair_of(scene).T_target_source
    assert told(scene, swapped=True, stored=T)
    assert not told(scene, swapped=False, stored=T)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("seed", range(3))
def test_a_movement_is_no_swap(scene: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = pair_of(scene).T_target_source
    step = np.r_[rng.normal(0, 0.1, 3), rng.normal(0, 0.5, 3)]
    for found in (None, T):
        assert not told(scene, swapped=False, stored=se3.retract(T, step), found=found)


def test_the_pose_of_the_poles_tells_first() -> None:
    T = pair_of("street").T_target_source
    reverse = se3.inverse(T)
    near = se3.retract(reverse, np.r_[np.zeros(3), 0.5 * NEAR_TRANSLATION, 0, 0])
    far = se3.retract(reverse, np.r_[np.zeros(3), 2.0 * NEAR_TRANSLATION, 0, 0])
    assert told("street", swapped=True, stored=T, found=near)
    assert not told("street", swapped=True, stored=T, found=far)


def test_back_to_back_either_order_is_right() -> None:
    half_turn = se3.from_rt(se3.exp_so3(np.array([0, 0, np.pi])), np.array([-3.0, 0, 0]))
    np.testing.assert_allclose(half_turn, se3.inverse(half_turn), atol=1e-12)
    assert not told("street", swapped=True, stored=half_turn, found=half_turn)


def test_sensors_tell_where_each_cloud_is_of_the_other() -> None:
    pair = pair_of("street")
    right, wrong = (SENSORS["VLP-16"], SENSORS["XT32"]), (SENSORS["XT32"], SENSORS["VLP-16"])
    placement = Placement(Scan(pair.source), Scan(pair.target))
    reason = swapped_sensors(placement, right)
    assert reason is not None
    assert "give them the other way round" in reason.message
    assert swapped_sensors(placement, (right[0], None)) is None
    assert swapped_sensors(Placement(Scan(pair.source), Scan(pair.source)), wrong) is None
