"""Sites in the world: nothing is lost there and back, and lengths are those on the ground."""

from __future__ import annotations

import builtins
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from retropole.base import projection, se3, world
from retropole.base.datatypes import Array
from retropole.base.description import ControlPoint, Frame, Geodetic, Sighting, Site, SurveyedPole
from retropole.base.errors import MissingExtraError, UsageError
from retropole.base.projection import grid_at, projected

UTM = 25832
POLES = np.array(
    [
        [691_607.123456, 5_334_765.654321, 512.250001],
        [691_637.5, 5_334_790.25, 513.0],
        [691_590.0, 5_334_700.75, 511.5],
        [691_650.25, 5_334_720.5, 518.125],
    ]
)
ENU = Frame("ENU", surveyed=True, geodetic=Geodetic(0.84, 0.2, 560.0))


def with_pyproj() -> Any:
    return pytest.importorskip("pyproj", reason="needs pip install 'retropole[world]'")


def pose(seed: int) -> Array:
    return se3.random(np.random.default_rng(seed), 30.0)


def test_a_frame_without_a_place_keeps_its_offset_exactly() -> None:
    frame = Frame("site plan", surveyed=True, offset=np.array([4e5, 5.7e6, 100.0]))
    full = np.array([[4e5 + 1 / 1024, 5.7e6 + 1 / 2048, 100.5]])
    np.testing.assert_array_equal(world.to_site(frame, full), [[1 / 1024, 1 / 2048, 0.5]])
    np.testing.assert_array_equal(world.to_frame(frame, world.to_site(frame, full)), full)
    T = pose(1)
    np.testing.assert_array_equal(world.pose_in_frame(frame, T)[:3, :3], T[:3, :3])
    assert world.heading(frame, T) is None
    with pytest.raises(UsageError, match="has no known position on the earth"):
        world.geodetic(frame, full)


def test_a_local_frame_needs_no_projection(monkeypatch: pytest.MonkeyPatch) -> None:
    without_pyproj(monkeypatch)
    places = np.array([[0.0, 0.0, 0.0], [30.0, -20.0, 5.0]])
    found = world.on_wgs84(ENU, places)
    assert ENU.geodetic is not None
    np.testing.assert_allclose(found.geodetic[0], ENU.geodetic.array, rtol=0, atol=1e-15)
    assert found.datum == ""
    back = projection.local_of(found.geodetic, ENU.geodetic.array)
    np.testing.assert_allclose(back, places, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(world.to_frame(ENU, places), places)


def test_headings_count_from_north_by_east() -> None:
    def facing(yaw: float, pitch: float = 0.0) -> Array:
        return se3.from_rt(se3.rotation_from_rpy(np.array([0.0, pitch, yaw])), np.zeros(3))

    # Yaw counts from east to north.
    assert world.heading(ENU, facing(0.0)) == pytest.approx(np.pi / 2)
    assert world.heading(ENU, facing(np.pi / 2)) == pytest.approx(0.0, abs=1e-12)
    assert world.heading(ENU, facing(np.pi)) == pytest.approx(3 * np.pi / 2)
    assert world.heading(ENU, facing(0.0, pitch=-np.pi / 2)) is None


@pytest.mark.parametrize("latitude", [2.0, -1.6, float("nan")])
def test_an_origin_that_is_no_place_is_refused(latitude: float) -> None:
    frame = replace(ENU, geodetic=Geodetic(latitude, 0.0, 0.0))
    with pytest.raises(UsageError, match="outside the valid range"):
        world.geodetic(frame, np.zeros((1, 3)))


def without_pyproj(monkeypatch: pytest.MonkeyPatch) -> None:
    imported = builtins.__import__

    def absent(name: str, *rest: Any, **more: Any) -> Any:
        if name.partition(".")[0] == "pyproj":
            raise ImportError(name)
        return imported(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", absent)
    projected.cache_clear()


def test_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    without_pyproj(monkeypatch)
    with pytest.raises(MissingExtraError, match=r"retropole\[world\]"):
        world.tangent_frame(UTM, POLES)
    in_grid = Frame("EPSG:25832", surveyed=True, epsg=UTM)
    with pytest.raises(MissingExtraError, match=r"retropole\[world\]"):
        world.on_wgs84(in_grid, POLES)


def transverse_mercator(latitude: float, longitude: float) -> Array:
    """UTM zone 32 by Krüger's series to the fourth order in n, which is good to a micrometre."""
    a, f = 6_378_137.0, 1 / 298.257222101
    n = f / (2 - f)
    A = a / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    alpha = [
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16 + 41 * n**4 / 180,
        13 * n**2 / 48 - 3 * n**3 / 5 + 557 * n**4 / 1440,
        61 * n**3 / 240 - 103 * n**4 / 140,
        49561 * n**4 / 161280,
    ]
    e = np.sqrt(f * (2 - f))
    s = np.sin(latitude)
    t = np.sinh(np.arctanh(s) - e * np.arctanh(e * s))
    away = longitude - np.radians(9.0)
    xi, eta = np.arctan2(t, np.cos(away)), np.arcsinh(np.sin(away) / np.hypot(t, np.cos(away)))
    k = 2 * np.arange(1, 5)
    north = xi + alpha @ (np.sin(k * xi) * np.cosh(k * eta))
    east = eta + alpha @ (np.cos(k * xi) * np.sinh(k * eta))
    return np.array([500_000.0, 0.0]) + 0.9996 * A * np.array([east, north])


def test_a_survey_comes_back_to_a_micrometre() -> None:
    with_pyproj()
    frame = world.tangent_frame(UTM, POLES)
    local = world.to_site(frame, POLES)
    assert np.abs(local).max() < 100
    np.testing.assert_allclose(world.to_frame(frame, local), POLES, rtol=0, atol=1e-6)


def test_projected_coordinates_are_those_of_the_series() -> None:
    with_pyproj()
    frame = world.tangent_frame(UTM, POLES)
    places = world.geodetic(frame, world.to_site(frame, POLES))
    for (latitude, longitude, height), full in zip(places, POLES, strict=True):
        by_hand = transverse_mercator(latitude, longitude)
        np.testing.assert_allclose(by_hand, full[:2], rtol=0, atol=5e-6)
        assert height == pytest.approx(full[2], abs=1e-8)


def test_lengths_of_the_site_are_those_on_the_ground() -> None:
    with_pyproj()
    frame = world.tangent_frame(UTM, POLES)
    local = world.to_site(frame, POLES)
    places = world.geodetic(frame, local)
    grid = grid_at(UTM, places.mean(axis=0))
    # GRS 80, the ellipsoid of ETRS 89.
    grs80 = projection.Ellipsoid(6_378_137.0, 1 / 298.257222101)
    ground = np.linalg.norm(np.diff(projection.geocentric_of(places, grs80), axis=0), axis=1)
    lengths = np.linalg.norm(np.diff(local, axis=0), axis=1)
    np.testing.assert_allclose(lengths, ground, rtol=0, atol=1e-7)
    in_grid = np.linalg.norm(np.diff(POLES[:, :2], axis=0), axis=1)
    level = np.linalg.norm(np.diff(local[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(in_grid / level, grid.combined, rtol=0, atol=2e-6)
    assert np.abs(in_grid - level).max() > 1e-3


def test_poses_in_the_grid_are_exact_and_turn_to_grid_north() -> None:
    with_pyproj()
    frame = world.tangent_frame(UTM, POLES)
    for seed in range(5):
        T = pose(seed)
        full = world.pose_in_frame(frame, T)
        np.testing.assert_allclose(full[:3, 3], world.to_frame(frame, T[None, :3, 3])[0])
        np.testing.assert_allclose(full[:3, :3].T @ full[:3, :3], np.eye(3), rtol=0, atol=1e-12)
        # A point 1 m along the x axis lies in the grid where the turned axis points to.
        ahead = world.to_frame(frame, se3.apply(T, np.array([[1.0, 0, 0]])))[0] - full[:3, 3]
        np.testing.assert_allclose(ahead, full[:3, 0], rtol=0, atol=5e-4)
        true, of_grid = (world.heading(frame, T, of_grid=is_grid) for is_grid in (False, True))
        (at,) = world.geodetic(frame, T[None, :3, 3])
        assert true is not None
        assert of_grid is not None
        turn = (true - of_grid + np.pi) % (2 * np.pi) - np.pi
        assert turn == pytest.approx(grid_at(UTM, at).convergence, abs=1e-12)
    rigid = world.site_in_frame(frame)
    np.testing.assert_allclose(rigid[:3, 3], np.round(POLES.mean(axis=0)), rtol=0, atol=1e-6)


def test_another_datum_is_moved_to_wgs84_and_reported() -> None:
    with_pyproj()
    # Potsdam datum and WGS 84 are some 150 m apart in Bavaria.
    origin = Geodetic(*np.radians([48.14, 11.57, 0.0]))
    frame = Frame("f", surveyed=True, epsg=31468, geodetic=origin)
    found = world.on_wgs84(frame, np.zeros((1, 3)))
    away = projection.local_of(found.geodetic, world.geodetic(frame, np.zeros((1, 3)))[0])
    assert 100 < np.linalg.norm(away[0, :2]) < 200
    assert "DHDN to WGS 84" in found.datum
    assert found.accuracy is not None


def surveyed_site(frame: Frame) -> Site:
    """Give a site of two poles and a control point, less the frame's offset."""
    local = POLES - frame.offset
    return Site(
        "yard",
        lidars=(),
        placements=("one",),
        frame=frame,
        poles=(
            SurveyedPole("A", 0, local[0], local[1], 0.005),
            SurveyedPole("B", 0, local[2], None, 0.005),
        ),
        points=(ControlPoint("P", local[3], 0.004, (Sighting(0, np.ones(3), 0.01),)),),
    )


def test_a_survey_in_a_grid_is_taken_to_metres_on_the_ground() -> None:
    with_pyproj()
    offset = np.array([691_000.0, 5_334_000.0, 500.0])
    given = surveyed_site(Frame("EPSG:25832", surveyed=True, offset=offset, epsg=UTM))
    site = world.in_metres(given)
    first, second = site.poles
    places = [first.foot, first.top, second.foot, site.points[0].at]
    local = np.array([place for place in places if place is not None])
    assert len(local) == len(POLES)
    assert second.top is None
    np.testing.assert_allclose(world.to_frame(site.frame, local), POLES, rtol=0, atol=1e-6)
    np.testing.assert_allclose(local, world.to_site(world.tangent_frame(UTM, POLES), POLES))
    assert site.points[0].seen == given.points[0].seen
    # Once is enough.
    assert world.in_metres(site) is site


def test_a_metric_site_stays_as_it_is() -> None:
    for frame in (ENU, Frame("plan", surveyed=True, offset=np.array([4e5, 5.7e6, 0.0]))):
        site = surveyed_site(frame)
        assert world.in_metres(site) is site
