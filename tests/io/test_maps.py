"""The part of a map about a place: nothing of it is said to have been looked through."""

from pathlib import Path

import numpy as np
import pytest

from retropole.base.datatypes import PointCloud
from retropole.base.errors import ReadError
from retropole.io.fields import MapPlace, Wanted
from retropole.io.maps import REACH, as_map, is_near

PLACE = MapPlace((412_000.0, 5_654_000.0, 90.0))


def cloud(count: int = 20_000, half: float = 150.0) -> PointCloud:
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-half, -half, 0], [half, half, 10], (count, 3))
    return PointCloud(xyz + np.array(PLACE.at), intensity=np.ones(count), ring=np.zeros(count, int))


def test_what_is_far_goes_and_what_only_a_lidar_has() -> None:
    whole = cloud()
    part = as_map(whole, PLACE)
    away = np.abs(whole.xyz - np.array(PLACE.at))[:, :2].max(axis=1)
    np.testing.assert_array_equal(part.xyz, whole.xyz[away <= REACH])
    np.testing.assert_array_equal(part.origin, PLACE.at)
    assert part.is_map
    assert part.ring is None
    assert part.intensity is None


def test_a_small_map_needs_no_place_and_a_large_one_does() -> None:
    small = cloud(half=50.0)
    part = as_map(small, MapPlace())
    assert len(part) == len(small)
    np.testing.assert_allclose(part.origin[:2], np.array(PLACE.at)[:2], atol=2.0)
    with pytest.raises(ReadError, match="--prior-xyz"):
        as_map(cloud(), MapPlace())


def test_a_place_next_to_the_map_is_refused_with_where_the_map_is() -> None:
    with pytest.raises(ReadError, match=r"0 points .* x 411,85\d"):
        as_map(cloud(), MapPlace((0.0, 0.0, 0.0)))


def test_a_las_file_is_cropped_as_it_is_read(tmp_path: Path) -> None:
    """By blocks: what is kept is what the whole file has there."""
    laspy = pytest.importorskip("laspy")
    from retropole.io.las import read_las

    whole = cloud()
    file = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    file.header.offsets, file.header.scales = np.floor(whole.xyz.min(axis=0)), [0.001] * 3
    file.x, file.y, file.z = whole.xyz.T
    file.write(str(tmp_path / "map.las"))
    part = read_las(tmp_path / "map.las", Wanted(place=PLACE))
    near = whole.xyz[is_near(whole.xyz[:, 0], whole.xyz[:, 1], PLACE)]
    assert abs(len(part) - len(near)) <= 2  # rounded to millimetres at the edge
    np.testing.assert_allclose(part.xyz.mean(axis=0), near.mean(axis=0), atol=0.05)
    with pytest.raises(ReadError, match="0 points of the map"):
        read_las(tmp_path / "map.las", Wanted(place=MapPlace((0.0, 0.0, 0.0))))
