"""Laws of the ellipsoid, and the few values that anybody can compute."""

import numpy as np
import pytest

from retropole.world.geodesy import (
    WGS84,
    Ellipsoid,
    enu_axes,
    geocentric_of,
    geodetic_of,
    geodetic_of_local,
    local_of,
    mean_radius,
)

RNG = np.random.default_rng(1)
PLACES = np.column_stack(
    [
        np.r_[RNG.uniform(-np.pi / 2, np.pi / 2, 200), 0.0, np.pi / 2, -np.pi / 2, 1e-12],
        np.r_[RNG.uniform(-np.pi, np.pi, 200), 0.0, 0.0, 1.0, np.pi],
        np.r_[RNG.uniform(-500.0, 9000.0, 200), 0.0, 100.0, -5.0, 30.0],
    ]
)


def test_axes_of_the_ellipsoid() -> None:
    minor = WGS84.semi_major * (1 - WGS84.flattening)
    found = geocentric_of(np.array([[0.0, 0.0, 10.0], [0.0, np.pi / 2, 0.0], [np.pi / 2, 0, 5.0]]))
    expected = [[WGS84.semi_major + 10, 0, 0], [0, WGS84.semi_major, 0], [0, 0, minor + 5]]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


def test_there_and_back_is_the_same_place() -> None:
    back = geodetic_of(geocentric_of(PLACES))
    np.testing.assert_allclose(back[:, 2], PLACES[:, 2], rtol=0, atol=1e-8)
    away = geocentric_of(back) - geocentric_of(PLACES)
    assert np.abs(away).max() < 1e-8


def test_a_point_on_the_normal_keeps_its_latitude() -> None:
    for latitude, longitude, height in PLACES[:20]:
        up = enu_axes(latitude, longitude)[:, 2]
        (foot,) = geocentric_of(np.array([[latitude, longitude, 0.0]]))
        (found,) = geodetic_of((foot + height * up)[None])
        np.testing.assert_allclose(found[:2], [latitude, longitude], rtol=0, atol=1e-14)
        assert found[2] == pytest.approx(height, abs=1e-8)


def test_east_north_up_are_orthonormal_and_point_where_they_say() -> None:
    step = 1e-6
    for place in PLACES[:20]:
        axes = enu_axes(place[0], place[1])
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), rtol=0, atol=1e-15)
        assert np.linalg.det(axes) == pytest.approx(1.0, abs=1e-12)
        ways = local_of(place + np.diag([step, step, 1.0]), place)
        unit = ways / np.linalg.norm(ways, axis=1)[:, None]
        np.testing.assert_allclose(unit, np.eye(3)[[1, 0, 2]], rtol=0, atol=5e-6)


@pytest.mark.parametrize("ellipsoid", [WGS84, Ellipsoid(6_377_563.396, 1 / 299.3249646)])
def test_local_frames_keep_distances_and_come_back(ellipsoid: Ellipsoid) -> None:
    origin = np.array([0.9, -0.1, 120.0])
    local = RNG.uniform(-500.0, 500.0, (50, 3))
    places = geodetic_of_local(local, origin, ellipsoid)
    np.testing.assert_allclose(local_of(places, origin, ellipsoid), local, rtol=0, atol=1e-7)
    straight = np.diff(geocentric_of(places, ellipsoid), axis=0)
    np.testing.assert_allclose(
        np.linalg.norm(straight, axis=1),
        np.linalg.norm(np.diff(local, axis=0), axis=1),
        rtol=0,
        atol=1e-7,
    )


def test_the_ground_falls_away_from_a_level_plane() -> None:
    origin, far = np.array([0.9, 0.2, 0.0]), 10_000.0
    fall = geodetic_of_local(np.array([[far, 0.0, 0.0], [0.0, far, 0.0]]), origin)[:, 2]
    np.testing.assert_allclose(fall, far**2 / (2 * mean_radius(0.9)), rtol=0.01)
