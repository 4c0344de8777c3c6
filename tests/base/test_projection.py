"""Projected systems: their scale and convergence, and those that are no frame for a site."""

import numpy as np
import pytest

from retropole.base import projection, world
from retropole.base.description import Frame, Geodetic
from retropole.base.errors import UsageError
from retropole.base.projection import (
    WGS84,
    Ellipsoid,
    enu_axes,
    geocentric_of,
    geodetic_of,
    geodetic_of_local,
    local_of,
    mean_radius,
)

pytest.importorskip("pyproj", reason="needs pip install 'retropole[world]'")
UTM = 25832
POLES = np.array([[691_607.25, 5_334_765.5, 512.0], [691_637.5, 5_334_790.25, 513.0]])


@pytest.mark.parametrize("epsg", [25832, 31468, 5514, 2056, 27700, 28355, 2154])
def test_scale_and_convergence_are_the_slopes_of_the_projection(epsg: int) -> None:
    west, south, east, north = np.radians(projection.projected(epsg).crs.area_of_use.bounds)
    at = np.array([0.6 * south + 0.4 * north, 0.3 * west + 0.7 * east, 300.0])
    frame = Frame("f", surveyed=True, epsg=epsg, geodetic=Geodetic(*at))
    steps = world.to_frame(frame, np.array([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]]))
    to_east, to_north = steps[1, :2] - steps[0, :2], steps[2, :2] - steps[0, :2]
    grid = projection.grid_at(epsg, at)
    assert np.linalg.norm(to_east) == pytest.approx(grid.combined, abs=2e-7)
    assert np.linalg.norm(to_north) == pytest.approx(grid.combined, abs=2e-7)
    assert np.arctan2(-to_north[0], to_north[1]) == pytest.approx(grid.convergence, abs=1e-6)
    assert grid.distortion < 1e-6


def test_the_words_say_what_30_m_become() -> None:
    words = projection.grid_at(UTM, np.radians([50.0, 9.0, 0.0])).text
    assert "EPSG:25832, ETRS89 / UTM zone 32N: 30 m on the ground are 29.9880 m" in words
    assert "-12.0 mm, scale 0.9996000" in words


@pytest.mark.parametrize(
    ("epsg", "reason"),
    [
        (4326, "not a projected system"),
        (4978, "not a projected system"),
        (2263, "US survey foot"),
        (2048, "west and south"),
        (3031, "north and north"),
        (27572, "Paris"),
        (999_999, "in no database"),
        (2**53, "in no database"),
    ],
)
def test_systems_that_are_no_frame_for_a_site_are_refused(epsg: int, reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        world.tangent_frame(epsg, POLES)


def test_exchanged_coordinates_are_refused() -> None:
    with pytest.raises(UsageError, match="are east and north swapped"):
        world.tangent_frame(UTM, POLES[:, [1, 0, 2]])
    with pytest.raises(UsageError, match="far outside"):
        world.tangent_frame(UTM, POLES + np.array([1e9, 0, 0]))


def test_a_compound_system_gives_its_horizontal_part() -> None:
    assert projection.projected(7415).name == "EPSG:7415, Amersfoort / RD New"


def test_a_system_that_bends_angles_reports_it_and_by_how_much() -> None:
    at = np.radians([50.0, 20.0, 0.0])
    grid = projection.grid_at(3035, at)
    assert "it is not conformal" in grid.text
    assert "conformal" not in projection.grid_at(25834, at).text
    ways = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0, np.pi, 181)])
    frame = Frame("f", surveyed=True, epsg=3035, geodetic=Geodetic(*at))
    full = world.to_frame(frame, np.vstack([np.zeros(3), ways]))
    lengths = np.linalg.norm(full[1:, :2] - full[0, :2], axis=1)
    assert (lengths.max() - lengths.min()) / 2 == pytest.approx(grid.distortion / 2, rel=0.01)


def test_a_place_that_a_system_is_not_meant_for_is_reported() -> None:
    # Norway uses zone 33 as far as Bergen.
    assert "not intended for" in projection.grid_at(25833, np.radians([60.4, 5.3, 0.0])).text
    assert "not intended for" not in projection.grid_at(25832, np.radians([60.4, 6.3, 0.0])).text
    frame = world.tangent_frame(28992, np.array([[470_000.0, 690_000.0, 0.0]]))
    assert frame.geodetic is not None
    assert "are the coordinates right" in projection.grid_at(28992, frame.geodetic.array).text


def test_coordinates_that_only_swapped_lie_where_a_system_is_used_are_refused() -> None:
    # East and north of the Netherlands, swapped, lie in Germany.
    with pytest.raises(UsageError, match="are east and north swapped"):
        world.tangent_frame(28992, np.array([[470_000.0, 190_000.0, 0.0]]))


def test_an_area_may_lie_across_180_degrees() -> None:
    west, _, east, _ = projection.projected(3832).crs.area_of_use.bounds
    assert west > east
    for longitude, is_inside in ((179.0, True), (-179.0, True), (0.0, False)):
        grid = projection.grid_at(3832, np.radians([0.1, longitude, 0.0]))
        assert grid.in_area == is_inside


def test_gauss_krueger_with_north_first_is_reported() -> None:
    """As the register orders it: taken for east, it lies within 20° of where the system is used."""
    system = projection.projected(31467)
    right = np.array([[3_500_000.0, 5_600_000.0, 100.0], [3_520_000.0, 5_610_000.0, 100.0]])
    assert projection.unproject(system, right).shape == (2, 3)
    for east in (3_480_000.0, 3_500_000.0, 3_560_000.0):
        for north in (5_250_000.0, 5_600_000.0, 6_000_000.0):
            with pytest.raises(UsageError, match="are east and north swapped"):
                projection.unproject(system, np.array([[north, east, 100.0]]))
    # A neighbour's system is not told: north of 60° people use it far outside of its zone.
    norway = projection.projected(25833)
    assert projection.unproject(norway, np.array([[100_000.0, 7_000_000.0, 0.0]])).shape == (1, 3)


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
