"""The answer of two LiDARs, stated as that of a site: however they are ordered and called."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.adjustment.answer import SiteCalibration
from retropole.base import se3
from retropole.base.errors import Reason
from retropole.pipeline import Options, calibrate, calibrate_site
from retropole.simulation import simulate_pair
from retropole.simulation.sites import SimulatedSite
from retropole.verdict.statement import named
from tests.adjustment.adjusting import between, made, reordered, with_lidar

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def of_two(pair_site: SimulatedSite) -> SiteCalibration:
    return calibrate_site(pair_site.as_site())


def test_the_frame_may_be_that_of_either(pair_site: SimulatedSite, of_two: SiteCalibration) -> None:
    other = calibrate_site(replace(pair_site.as_site(), reference=1))
    assert other.status == of_two.status == "ok"
    np.testing.assert_array_equal(other.lidars[1].T_site_lidar, np.eye(4))
    assert [each.lidar for each in other.lidars] == [0, 1]
    assert of_two.lidars[0].budget == ()
    assert other.lidars[1].budget == ()
    step = se3.local(of_two.lidars[1].T_site_lidar, se3.inverse(other.lidars[0].T_site_lidar))
    sigma = np.sqrt(np.diag(of_two.lidars[1].covariance))
    assert np.abs(step / sigma).max() < 0.5
    one_way, back = (between(site, 0, 1).covariance for site in (of_two, other))
    # In parts of the variances: the products of small correlations have no scale of their own.
    sizes = np.sqrt(np.outer(np.diag(one_way), np.diag(one_way)))
    np.testing.assert_allclose(back / sizes, one_way / sizes, atol=0.2)
    for one in other.tests:
        assert one.lidar is None or pair_site.as_site().lidars[one.lidar].name in one.name


def test_a_pair_is_tested_as_a_site_of_two(
    pair_site: SimulatedSite, of_two: SiteCalibration
) -> None:
    """Only what is tested is called otherwise: poles by their numbers in both clouds."""
    site = pair_site.as_site()
    first, second = site.lidars
    (target,), (source,) = first.clouds, second.clouds
    assert target is not None
    assert source is not None
    sensors = first.sensor, second.sensor
    pair = calibrate(target, source, options=Options(site.radius, site.radius_sigma, sensors))
    assert [each.w for each in pair.tests] == pytest.approx([each.w for each in of_two.tests])
    assert [each.pole for each in pair.tests] == [each.pole for each in of_two.tests]
    poles = {f"T{i}–S{j}" for i, j in pair.hypotheses[0].match.pairs}
    assert {each.name for each in pair.tests if each.kind == "pole"} == poles


def test_two_in_another_order_are_the_same(
    pair_site: SimulatedSite, of_two: SiteCalibration
) -> None:
    """The frame stays that of the same LiDAR, so that everything is equal."""
    other = calibrate_site(reordered(pair_site.as_site(), (1, 0), (0,)))
    for i in (0, 1):
        one, twin = of_two.lidars[i], other.lidars[1 - i]
        np.testing.assert_array_equal(one.T_site_lidar, twin.T_site_lidar)
        np.testing.assert_array_equal(one.covariance, twin.covariance)
    assert len(of_two.poles) == len(other.poles) == 3


def test_a_placement_that_one_alone_recorded_changes_nothing(
    pair_site: SimulatedSite, of_two: SiteCalibration
) -> None:
    site = pair_site.as_site()
    first, second = site.lidars
    more = replace(
        site,
        placements=("before", *site.placements),
        lidars=(
            replace(first, clouds=(first.clouds[0], *first.clouds)),
            replace(second, clouds=(None, *second.clouds)),
        ),
    )
    other = calibrate_site(more)
    np.testing.assert_array_equal(other.lidars[1].T_site_lidar, of_two.lidars[1].T_site_lidar)
    assert {pole.placement for pole in other.poles} == {1}
    assert {test.placement for test in other.tests} <= {1, None}


def test_a_placement_without_tape_is_left_aside() -> None:
    site = made(seed=1, lidars=2, placements=2).as_site()
    first, second = site.lidars[1].clouds
    assert second is not None
    assert second.intensity is not None
    dim = replace(second, intensity=np.minimum(second.intensity, 20.0))
    found = calibrate_site(with_lidar(site, 1, clouds=(first, dim)))
    alone = calibrate_site(reordered(site, (0, 1), (0,)))
    assert found.status in ("ok", "warn")
    step = se3.local(alone.lidars[1].T_site_lidar, found.lidars[1].T_site_lidar)
    assert np.abs(step / np.sqrt(np.diag(alone.lidars[1].covariance))).max() < 2.0


def test_a_lidar_that_moved_between_placements_is_named() -> None:
    site = made(seed=1, lidars=2, placements=2).as_site()
    first, second = site.lidars[1].clouds
    assert second is not None
    A = se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, np.radians(3.0)])), np.array([0.2, 0.0, 0.0]))
    found = calibrate_site(with_lidar(site, 1, clouds=(first, second.transformed(A))))
    assert found.status == "refused"
    assert found.reasons[0].code == "lidar_moved"
    assert found.reasons[0].values["lidar"] == site.lidars[1].name


def test_poles_stand_where_the_clouds_have_them(of_two: SiteCalibration) -> None:
    scan = of_two.scans[0][0]
    assert scan is not None
    for pole in of_two.poles:
        away = [
            np.linalg.norm(np.cross(own.point - pole.point, pole.direction)) for own in scan.poles
        ]
        assert min(away) < 0.05


def test_a_pole_that_moved_a_little_fails_its_test_in_a_pair_too() -> None:
    pair = simulate_pair("street", np.random.default_rng(0))
    first = len(pair.surfaces) - len(pair.poles)
    for moved, codes in ((0.0, set()), (0.03, {"misfit"})):
        xyz = pair.source.xyz.copy()
        xyz[pair.labels[1] == first, 0] += moved
        known = Options(sensors=pair.sensors)
        answer = calibrate(pair.target, replace(pair.source, xyz=xyz), options=known)
        assert {each.code for each in answer.reasons} & {"misfit"} == codes


@pytest.mark.parametrize(
    ("said", "named_so"),
    [
        ("the target LiDAR turned", "mast-a turned"),
        ("2 of the target's poles and 1 of the source's", "2 of mast-a's poles and 1 of mast-b's"),
        ("at (1, 2, 3) of the target, holds", "at (1, 2, 3) of mast-a, holds"),
        ("read it with --unit-source ft", "read it with --unit-source ft"),
        ("targets and resources", "targets and resources"),
    ],
)
def test_lidars_have_their_names(said: str, named_so: str) -> None:
    found = named(
        Reason("few_points", said, {"lidar": "source", "points": 3}), ("mast-a", "mast-b")
    )
    assert found.message == named_so
    assert found.values == {"lidar": "mast-b", "points": 3}
