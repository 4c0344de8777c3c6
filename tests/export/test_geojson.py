"""The LiDARs of a site on the map, held against RFC 7946 and against the projection."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from retropole.base.errors import UsageError
from retropole.base.projection import local_of
from retropole.export.documents import write_geojson
from retropole.export.tree import tree_of
from retropole.result.site import SiteDoc
from tests.export import sites


def collection(document: SiteDoc) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(write_geojson(tree_of(document)))
    return found


def test_it_is_a_feature_collection_of_points() -> None:
    found = collection(sites.surveyed())
    assert found["type"] == "FeatureCollection"
    assert "crs" not in found
    assert [feature["id"] for feature in found["features"]] == ["mast-a", "mast-b", "gate"]
    for feature in found["features"]:
        assert feature["type"] == "Feature"
        assert feature["geometry"]["type"] == "Point"
        longitude, latitude, _ = feature["geometry"]["coordinates"]
        assert abs(longitude - 4.2) < 1e-3
        assert abs(latitude - 52.1) < 2e-3


def test_the_points_are_where_the_lidars_are() -> None:
    document = sites.surveyed()
    at = document.frame.geodetic
    assert at is not None
    origin = np.array([at.latitude_rad, at.longitude_rad, at.height_m])
    for feature, lidar in zip(collection(document)["features"], document.lidars, strict=True):
        longitude, latitude, height = feature["geometry"]["coordinates"]
        place = np.array([[np.radians(latitude), np.radians(longitude), height]])
        T = np.array(lidar.T_site_lidar)
        np.testing.assert_allclose(local_of(place, origin)[0], T[:3, 3], rtol=0, atol=2e-5)
        about = feature["properties"]
        azimuth = np.degrees(np.arctan2(T[0, 0], T[1, 0])) % 360
        assert about["heading_deg"] == pytest.approx(azimuth, abs=1e-5)
        C = np.array(lidar.covariance)[3:, 3:]
        assert about["sigma_vertical_m"] == pytest.approx(np.sqrt(C[2, 2]))
        assert about["sigma_horizontal_m"] ** 2 == pytest.approx(np.linalg.norm(C[:2, :2], 2))
        assert np.array(about["covariance"])[:3, :3] == pytest.approx(C)
        assert about["serial"] == lidar.serial


def test_points_of_a_projected_site_are_their_grid_coordinates() -> None:
    pyproj = sites.with_pyproj()
    there = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True)
    for feature in collection(sites.in_utm())["features"]:
        about = feature["properties"]
        east, north = there.transform(*feature["geometry"]["coordinates"][:2])
        assert (east, north) == pytest.approx((about["east_m"], about["north_m"]), abs=1e-4)
        turn = about["heading_deg"] - about["heading_grid_deg"]
        # 2.6 degrees east of the central meridian, 48.1 degrees north.
        assert turn == pytest.approx(2.576 * np.sin(np.radians(48.14)), abs=2e-3)
        assert about["datum_accuracy_m"] == 1.0


@pytest.mark.parametrize("document", [sites.free, sites.on_plan])
def test_a_frame_that_is_nowhere_on_earth_has_no_map(document: Any) -> None:
    with pytest.raises(UsageError, match="has no known position on the earth"):
        write_geojson(tree_of(document()))
