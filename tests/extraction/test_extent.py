"""Clouds far from where their beams are said to start: told by the rings, or refused."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.base.errors import Refusal
from retropole.extraction.extent import FARTHEST_ORIGIN, check_coordinates, located
from retropole.simulation import simulate_pair

RADIUS = 0.02


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    rng = np.random.default_rng(3)
    return simulate_pair("corridor", rng, sensor_target="VLP-16", sensor_source="VLP-16").target


def moved(cloud: PointCloud, by: tuple[float, float, float]) -> PointCloud:
    """As another program would leave it: it says nothing of where the LiDAR was."""
    return replace(cloud, xyz=cloud.xyz + by)


def test_in_the_lidars_own_frame_nothing_changes(cloud: PointCloud) -> None:
    assert located(cloud, RADIUS) is cloud
    bare = replace(cloud, ring=None)
    assert located(bare, RADIUS) is bare


@pytest.mark.parametrize("by", [(40, -20, 3), (300, 200, 0), (3000, -9000, 20)])
def test_rings_tell_where_the_lidar_was(cloud: PointCloud, by: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(located(moved(cloud, by), RADIUS).origin, by, atol=2e-3)


@pytest.mark.parametrize("by", [(300, 200, 0), (3000, -9000, 20), (5e5, 5.4e6, 100)])
def test_without_rings_it_is_not_known(cloud: PointCloud, by: tuple[float, float, float]) -> None:
    with pytest.raises(Refusal, match=r"0 of \d+ points are within 100 m") as refused:
        located(replace(moved(cloud, by), ring=None), RADIUS)
    assert refused.value.code == "far_from_lidar"
    assert len(refused.value.message) <= 300


def test_thick_poles_are_seen_from_farther(cloud: PointCloud) -> None:
    bare = replace(moved(cloud, (300, 0, 0)), ring=None)
    with pytest.raises(Refusal):
        located(bare, 0.02)
    assert located(bare, 0.2) is bare


@pytest.mark.parametrize(("by", "is_far"), [(0.5, False), (2.0, True)])
def test_no_pose_is_given_about_an_origin_too_far_away(
    cloud: PointCloud, by: float, is_far: bool
) -> None:
    shift = np.array([by * FARTHEST_ORIGIN, 0.0, 0.0])
    known = replace(cloud, xyz=cloud.xyz + shift, origin=shift)
    if not is_far:
        assert located(known, RADIUS) is known
        return
    with pytest.raises(Refusal, match=r"subtract an offset such as \(20000, 0, 0\)") as refused:
        located(known, RADIUS)
    assert refused.value.code == "far_from_lidar"
    assert len(refused.value.message) <= 300


@pytest.mark.parametrize("size", [1e9, 1e30, 1.7e308])
@pytest.mark.parametrize("count", [1, 5000, None])
def test_coordinates_that_no_frame_has(cloud: PointCloud, size: float, count: int | None) -> None:
    xyz = cloud.xyz.copy()
    xyz[:count] = size
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(Refusal, match="beyond 1e") as refused:
            check_coordinates(replace(cloud, xyz=xyz))
    assert refused.value.values["far"] == (count or len(cloud))
    assert ("remove them" in refused.value.message) == (count is not None)
