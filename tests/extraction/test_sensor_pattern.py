"""A sensor's name is held against the rings; a cloud of fewer of them never contradicts it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import retropole as rp
from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import Refusal
from retropole.base.sensors import SENSORS, Sensor, find_sensor
from retropole.base.systematic import Sizes, sizes_of, spinning
from retropole.extraction.sensor_pattern import (
    Beams,
    beam_scatter,
    beams_by,
    check_sensor,
    error_sizes,
    sensor_doubt,
)

WRONG = [
    ("VLP-16", "HDL-32E"),  # rings higher than it sees
    ("HDL-32E", "VLP-16"),  # more rings
    ("HDL-32E", "XT32"),  # as many, but lower
    ("Pandar64", "OS1"),
    ("PandarQT", "Pandar64"),
    ("OS1", "C32"),
    ("VLP-16", "Mid-360"),
    ("XT32", "AT128"),
]


@cache
def cloud_of(name: str) -> PointCloud:
    return rp.simulate("street", 3, sensor_target=name, sensor_source="VLP-16").target


@pytest.mark.full
@pytest.mark.parametrize("name", SENSORS)
def test_its_own_name_is_never_doubted(name: str) -> None:
    cloud = cloud_of(name)
    for seen in (cloud, replace(cloud, ring=None)):
        check_sensor(seen, SENSORS[name])
        assert sensor_doubt(seen, SENSORS[name]) == ""
        assert sensor_doubt(seen, None) == ""
        # As good as a model of the table is a description of one's own.
        assert sensor_doubt(seen, replace(SENSORS[name], name="front.toml")) == ""


@pytest.mark.full
@pytest.mark.parametrize(("own", "named"), WRONG)
def test_rings_that_the_named_sensor_has_not_are_refused(own: str, named: str) -> None:
    with pytest.raises(Refusal) as why:
        check_sensor(cloud_of(own), SENSORS[named])
    assert why.value.code == "wrong_sensor"
    assert named in why.value.message
    assert own in why.value.message.split("name the sensor")[1]


@pytest.mark.full
@pytest.mark.parametrize("kept", [slice(0, 32), slice(16, 48, 2), slice(60, 64), slice(5, 6)])
def test_fewer_rings_are_no_contradiction(kept: slice) -> None:
    cloud = cloud_of("Pandar64")
    assert cloud.ring is not None
    part = cloud.select(np.isin(cloud.ring, np.arange(64)[kept]))
    check_sensor(part, SENSORS["Pandar64"])
    assert sensor_doubt(part, SENSORS["Pandar64"]) == ""


@pytest.mark.full
def test_a_lidar_may_hang_upside_down_or_stand_elsewhere() -> None:
    cloud = cloud_of("Pandar64")
    T = se3.from_rt(se3.exp_so3(np.array([np.pi, 0, 0])), np.array([3.0, 1.0, 2.0]))
    hanging = replace(cloud, xyz=se3.apply(T, cloud.xyz), origin=T[:3, 3])
    check_sensor(hanging, SENSORS["Pandar64"])
    assert sensor_doubt(hanging, SENSORS["Pandar64"]) == ""


@pytest.mark.full
def test_a_few_wrong_numbers_are_no_rings() -> None:
    cloud = cloud_of("VLP-16")
    assert cloud.ring is not None
    ring = cloud.ring.copy()
    ring[:30] = np.arange(30) + 20
    check_sensor(replace(cloud, ring=ring), SENSORS["VLP-16"])


def a_narrow(name: str) -> Sensor:
    return replace(SENSORS[name], azimuth_span=(-0.8, 0.8))


def test_azimuths_beyond_the_field_of_view_contradict_a_name() -> None:
    cloud, narrow = cloud_of("VLP-16"), a_narrow("VLP-16")
    with pytest.raises(Refusal, match=r"azimuths over .*, the VLP-16 sees 92°") as caught:
        check_sensor(cloud, narrow)
    assert caught.value.code == "wrong_sensor"
    assert sensor_doubt(cloud, narrow) == ""
    bare = replace(cloud, ring=None)
    check_sensor(bare, narrow)
    assert "has azimuths over" in sensor_doubt(bare, narrow)


def test_where_the_field_of_view_begins_does_not_count() -> None:
    narrow = a_narrow("VLP-16")
    cloud = cloud_of("VLP-16")
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    # A driver may have y ahead; a few returns are of the LiDAR's own housing.
    behind = np.abs(np.abs(azimuth) - np.pi) < 0.78
    part = cloud.select(behind | (np.arange(len(cloud)) % 90 == 0))
    for seen in (part, replace(part, ring=None)):
        check_sensor(seen, narrow)
        assert sensor_doubt(seen, narrow) == ""


@pytest.mark.full
def test_rings_of_another_sensor_are_doubted() -> None:
    doubt = sensor_doubt(cloud_of("VLP-16"), SENSORS["Pandar64"])
    assert "are those of VLP-16" in doubt
    assert "not those of Pandar64" in doubt


@pytest.mark.full
def test_without_rings_what_the_sensor_does_not_see_is_doubted() -> None:
    cloud = replace(cloud_of("PandarQT"), ring=None)
    check_sensor(cloud, SENSORS["VLP-16"])
    doubt = sensor_doubt(cloud, SENSORS["VLP-16"])
    assert "outside the field of view of the VLP-16 (-15.0° to 15.0°)" in doubt


@pytest.mark.full
@pytest.mark.parametrize("name", SENSORS)
def test_rings_that_are_cones_say_that_a_lidar_spins(name: str) -> None:
    cloud, sensor = cloud_of(name), SENSORS[name]
    assert error_sizes(cloud, None) == (spinning(Sizes()) if sensor.rings else Sizes())
    # In any frame, if where its beams start is known, and in no other.
    T = se3.random(np.random.default_rng(4))
    moved = replace(cloud, xyz=se3.apply(T, cloud.xyz))
    seen = replace(moved, origin=T[:3, 3], axis=T[:3, :3] @ cloud.axis)
    assert error_sizes(seen, None) == error_sizes(cloud, None)
    assert error_sizes(moved, None) == Sizes()
    assert error_sizes(replace(cloud, ring=None), None) == Sizes()


@pytest.mark.full
@pytest.mark.parametrize("name", SENSORS)
def test_what_is_stated_of_a_named_sensor_counts_whatever_its_rings_are(name: str) -> None:
    for cloud in (cloud_of(name), cloud_of("Mid-360")):
        assert error_sizes(cloud, SENSORS[name]) == sizes_of(SENSORS[name])


@pytest.mark.full
def test_bent_lines_are_no_cones() -> None:
    cloud = cloud_of("XT32")
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    up = np.zeros_like(cloud.xyz)
    up[:, 2] = np.linalg.norm(cloud.xyz, axis=1) * np.radians(1.0) * np.cos(2 * azimuth)
    assert error_sizes(replace(cloud, xyz=cloud.xyz + up), None) == Sizes()


@pytest.mark.parametrize("name", [None, "VLP-16", "Pandar64"])
def test_ordinary_beams_widen_nothing_near_and_unknown_ones_nothing(name: str | None) -> None:
    beams = beams_by(None if name is None else find_sensor(name))
    assert beam_scatter(8.0, 0.02, beams) == 0.0
    assert (beam_scatter(16.0, 0.02, beams) > 0.0) == (name is not None)


@pytest.mark.parametrize(
    ("name", "half", "away"), [("PandarQT", 0.004, 7.0), ("PandarQT", 0.004, 12.0),
    ("VLP-16", 0.0015, 16.0)]
)  # fmt: skip
def test_beams_add_the_scatter_of_a_pole_seen_wider(name: str, half: float, away: float) -> None:
    beams = beams_by(find_sensor(name))
    near, far = (beam_scatter(d, 0.02, beams) for d in (away / 2, away))
    assert near < far
    seen, ordinary = 0.02 + away * half, 0.02 + min(away, 8.0) * 0.0015
    across = np.random.default_rng(0).uniform(-1, 1, 200_000)
    added = np.sqrt(np.var(seen * across) - np.var(ordinary * across))
    assert far == pytest.approx(added, rel=0.1)


def test_noisy_ranges_add_what_ordinary_ones_have_not() -> None:
    assert beam_scatter(6.0, 0.02, Beams(0.003, 0.015)) == 0.0
    assert beam_scatter(6.0, 0.02, Beams(0.003, 0.02)) == pytest.approx(0.0173, abs=1e-4)
