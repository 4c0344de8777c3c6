"""Rings are believed where they are rings, in any frame, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.io.rings import MAX_RING_SPREAD, ring_spread, rings_fault, with_trusted_rings
from retropole.simulation import Rectangle
from tests.extraction.scenes import PAINT, X, Y, Z, pole, seen

SENSORS = ["VLP-16", "XT32", "OS1", "Pandar64"]


def recorded(sensor: str) -> PointCloud:
    walls = [
        Rectangle(6.0 * axis, other, Z, (8, 3), PAINT) for axis, other in ((X, Y), (Y, X), (-X, Y))
    ]
    return seen([*walls, pole((4, 1))], sensor)[0]


@pytest.mark.parametrize("sensor", SENSORS)
def test_rings_of_a_recording_are_rings_in_any_frame(sensor: str) -> None:
    cloud = recorded(sensor)
    assert ring_spread(cloud) < 0.1 * MAX_RING_SPREAD
    assert with_trusted_rings(cloud) is cloud
    moved = cloud.transformed(se3.random(np.random.default_rng(1), 20.0))
    assert with_trusted_rings(moved) is moved
    lost = replace(moved, origin=np.zeros(3))
    assert ring_spread(lost) > MAX_RING_SPREAD
    assert with_trusted_rings(lost) is lost


@pytest.mark.parametrize("sensor", SENSORS)
def test_what_is_no_ring_is_left_out(sensor: str) -> None:
    cloud = recorded(sensor)
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    drawn = np.random.default_rng(0).integers(0, 16, len(cloud))
    for ring, words in (
        (np.full(len(cloud), 7), "have the ring 7"),
        (drawn, "neighbours are on different rings"),
        (np.round(np.degrees(azimuth + np.pi) / 0.4).astype(np.int64), "more than any LiDAR"),
    ):
        wrong = replace(cloud, ring=ring)
        assert words in rings_fault(wrong)
        assert with_trusted_rings(wrong).ring is None


def test_a_cloud_without_rings_has_no_fault() -> None:
    cloud = replace(recorded("VLP-16"), ring=None)
    assert rings_fault(cloud) == ""
    assert ring_spread(cloud) == np.inf
    assert rings_fault(PointCloud(np.zeros((0, 3)), ring=np.zeros(0, dtype=np.int64))) == ""
