"""Coordinates that cannot be metres about a LiDAR, and how they are brought to metres."""

from dataclasses import replace

import numpy as np
import pytest

import retropole as rp
from retropole.base.datatypes import PointCloud
from retropole.io import read_cloud
from retropole.io.coordinates import FARTHEST_HALF, oddity_of
from retropole.io.fields import METRES, Unit, in_metres
from tests.paths import SHARED

RECORDINGS = ("pandar_0001/top.pcd", "pandar_0001/left.pcd", "pandar_scene1/qt_202.pcd")


def scene(median: float, spread: float = 0.8) -> PointCloud:
    """Make points about a LiDAR, half of them within a median range, metres."""
    rng = np.random.default_rng(0)
    ray = rng.normal(size=(5000, 3)) * [1, 1, 0.2]
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    factors = np.clip(np.exp(rng.normal(0, spread, 5000)), 1 / 8, 8)
    return PointCloud(median * ray * factors[:, None])


def scaled(cloud: PointCloud, factor: float) -> PointCloud:
    return replace(cloud, xyz=cloud.xyz * factor, origin=cloud.origin * factor)


def units_of(cloud: PointCloud) -> tuple[Unit, ...]:
    odd = oddity_of(cloud)
    return () if odd is None or odd.is_map else odd.units


@pytest.mark.parametrize("median", [1.5, 5.0, 13.0, 30.0])
def test_the_unit_is_among_those_that_are_named(median: float) -> None:
    assert oddity_of(scene(median)) is None
    for unit in ("cm", "mm", "in"):
        if median / METRES[unit] < FARTHEST_HALF:
            # 1.5 m are 59 inches, which may be metres.
            continue
        cloud = scaled(scene(median), 1 / METRES[unit])
        assert unit in units_of(cloud)
        brought = in_metres(cloud, unit)
        np.testing.assert_allclose(brought.xyz, scene(median).xyz, rtol=1e-12)
        assert oddity_of(brought) is None
    assert units_of(scaled(scene(13.0), 1000)) == ("mm",)


def test_where_several_units_would_explain_it_all_are_named() -> None:
    odd = oddity_of(scaled(scene(13.0), 100))
    assert odd is not None
    assert odd.candidates == "centimetres (13 m) or millimetres (1.3 m) or inches (33 m)"


@pytest.mark.parametrize("name", RECORDINGS)
def test_of_real_recordings(name: str) -> None:
    if not (SHARED / name).exists():
        pytest.skip("recordings are not here")
    cloud = read_cloud(SHARED / name)
    assert oddity_of(cloud) is None
    assert "cm" in units_of(scaled(cloud, 100))
    assert "mm" in units_of(scaled(cloud, 1000))


@pytest.mark.parametrize("name", ["street", "harbor", "corridor"])
def test_simulated_scenes_are_in_metres(name: str) -> None:
    pair = rp.simulate(name, 4)
    for cloud in (pair.target, pair.source):
        assert oddity_of(cloud) is None
        assert "mm" in units_of(scaled(cloud, 1000))


@pytest.mark.parametrize("offset", [(500.0, 300, 0), (4e5, 5.2e6, 100)])
def test_a_heap_far_from_the_origin_is_in_the_frame_of_a_map(
    offset: tuple[float, float, float],
) -> None:
    cloud = replace(scene(13.0), xyz=scene(13.0).xyz + offset)
    odd = oddity_of(cloud)
    assert odd is not None
    assert odd.is_map
    assert odd.units == ()
    assert "a LAS file does not store where the LiDAR was" not in odd.text
    of_las = oddity_of(replace(cloud, source="survey.LAZ"))
    assert of_las is not None
    assert (
        "a LAS file does not store where the LiDAR was, so that the origin of the beams is unknown"
        in of_las.text
    )


def test_what_is_narrow_and_in_millimetres_is_no_map() -> None:
    wide = scene(8.0).xyz
    ahead = wide[(wide[:, 0] > 0) & (np.abs(wide[:, 1]) < 0.5 * wide[:, 0])]
    assert units_of(PointCloud(1000 * ahead)) == ("mm",)


def test_no_place_is_smaller_than_a_hand() -> None:
    odd = oddity_of(scaled(scene(13.0), 0.001))
    assert odd is not None
    assert odd.is_tiny
    assert "the given unit" in odd.text


def test_a_long_range_with_much_near_is_metres() -> None:
    cloud = scene(30.0)
    far = replace(cloud, xyz=np.concatenate([cloud.xyz, 40 * cloud.xyz[:1000]]))
    assert oddity_of(far) is None
    assert oddity_of(PointCloud(np.zeros((0, 3)))) is None
