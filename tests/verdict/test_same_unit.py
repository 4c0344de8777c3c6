"""Both clouds in another unit: the poles tell, and nothing is converted."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import retropole as rp
from benchmarks.again import record_again
from retropole.base.datatypes import Placement, PointCloud
from retropole.io.fields import METRES, Unit
from retropole.pipeline import calibrate
from retropole.simulation import simulate_pair
from retropole.surfaces.scans import find_poles
from retropole.verdict.same_unit import beyond_sensors, common_unit, unit_of_one

pytestmark = pytest.mark.full

RADIUS = 0.02
NO_THRESHOLDS = None, None


@cache
def pair(radius: float = RADIUS, poles: bool = True) -> tuple[PointCloud, PointCloud]:
    rng = np.random.default_rng(4)
    made = simulate_pair("corridor", rng, radius=radius)
    if not poles:
        made = record_again(made, rng, poles=False)
    return made.target, made.source


def counted(cloud: PointCloud, unit: Unit) -> PointCloud:
    size = METRES[unit]
    return replace(cloud, xyz=cloud.xyz / size, origin=cloud.origin / size)


def placed(target: PointCloud, source: PointCloud) -> Placement:
    target_scan, source_scan = (
        find_poles(cloud, sensor=None, threshold=None, radius=RADIUS) for cloud in (target, source)
    )
    return Placement(target_scan, source_scan)


@pytest.mark.parametrize("unit", ["ft", "in", "cm", "mm"])
def test_the_unit_of_both_is_found(unit: Unit) -> None:
    target, source = pair()
    placement = placed(counted(target, unit), counted(source, unit))
    found = common_unit(placement, RADIUS, NO_THRESHOLDS)
    assert found is not None
    assert found.target.unit == found.source.unit == unit
    assert len(found.target.scan.poles) == len(found.source.scan.poles) == 2
    assert found.target.radius_before == pytest.approx(RADIUS / METRES[unit], rel=0.5)
    for scan in placement.scans:
        alone = unit_of_one(scan.cloud, RADIUS)
        # A corridor in feet is no longer than a place in metres.
        assert (alone and alone.unit) == (None if unit == "ft" else unit)


@pytest.mark.parametrize("clouds", [pair(), pair(poles=False)])
def test_metres_are_no_other_unit(clouds: tuple[PointCloud, PointCloud]) -> None:
    placement = placed(*clouds)
    assert common_unit(placement, RADIUS, NO_THRESHOLDS) is None
    assert [unit_of_one(cloud, RADIUS) for cloud in clouds] == [None, None]


def test_one_cloud_in_feet_is_told_where_it_reaches_farther_than_its_sensor() -> None:
    made = simulate_pair("harbor", np.random.default_rng(1))
    assert unit_of_one(made.target, RADIUS) is None
    assert beyond_sensors(made.target) is None
    shown = unit_of_one(counted(made.target, "ft"), RADIUS)
    assert shown is not None
    assert shown.unit == "ft"


def test_two_units_are_none_of_both() -> None:
    target, source = pair()
    placement = placed(counted(target, "ft"), counted(source, "in"))
    assert common_unit(placement, RADIUS, NO_THRESHOLDS) is None


def test_no_cloud_and_one_beyond_all_ranges_are_no_unit() -> None:
    target, source = pair()
    none = target.select(np.zeros(len(target), bool))
    for other in (none, counted(source, "m"), replace(source, xyz=source.xyz * 1e9)):
        assert common_unit(placed(none, other), RADIUS, NO_THRESHOLDS) is None


def test_feet_are_told_beside_thicker_poles_and_not_applied() -> None:
    """Both would look the same: the hint names both, and each of them is an answer."""
    clouds = [counted(cloud, "ft") for cloud in pair()]
    answer = calibrate(*clouds, radius=RADIUS)
    assert answer.T_target_source is None
    (reason,) = answer.reasons
    assert (reason.code, reason.values["unit"]) == ("too_few_poles", "ft")
    assert "either the coordinates are in feet (--unit ft), or the poles are" in reason.message
    target, source = clouds
    assert rp.calibrate(target, source, unit="ft").status != "refused"
    thick = [counted(cloud, "m") for cloud in pair(RADIUS / METRES["ft"])]
    (reason,) = calibrate(*thick, radius=RADIUS).reasons
    if "unit" in reason.values:
        assert "times as thick as given (--radius 0.0" in reason.message


@pytest.mark.parametrize("unit", ["in", "cm", "mm"])
def test_ranges_that_are_no_metres_are_told_by_poles(unit: Unit) -> None:
    answer = calibrate(*(counted(cloud, unit) for cloud in pair()), radius=RADIUS)
    (reason,) = answer.reasons
    assert (reason.code, reason.values["unit"]) == ("wrong_unit", unit)
    assert f"read them with --unit {unit}" in reason.message
