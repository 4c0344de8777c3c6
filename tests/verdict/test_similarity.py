"""Mirrored and scaled clouds and other units are named, honest ones are not accused."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import retropole as rp
from benchmarks.again import record_again
from retropole.adjustment.refinement import Refinement
from retropole.base import se3
from retropole.base.datatypes import DEFAULT_RADIUS, Calibration, Placement, PointCloud, Scan
from retropole.base.errors import Refusal
from retropole.io.fields import METRES, NAMES, Unit
from retropole.pipeline import Options, calibrate
from retropole.simulation import SimulatedPair, simulate_pair
from retropole.surfaces.scans import find_poles
from retropole.verdict.similarity import (
    beyond_sensors,
    check_similarity,
    check_unit,
    explain,
    unit_of_one,
)
from tests.tiers import first_of

FIND = partial(find_poles, sensor=None, threshold=None, radius=DEFAULT_RADIUS)
REFUSED = Refusal("no_match", "none fit")
UNIT_OF: dict[float, Unit] = {0.3048: "ft", 1000.0: "mm"}


def times(cloud: PointCloud, *by: float) -> PointCloud:
    factor = np.array(by)
    return replace(cloud, xyz=cloud.xyz * factor, origin=cloud.origin * factor)


def reason(target: PointCloud, source: PointCloud) -> Refusal:
    """Ask of a refusal, whatever it was."""
    return explain(REFUSED, [Placement(FIND(target), FIND(source))], (), radius=DEFAULT_RADIUS)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Threads of BLAS wait by spinning, as in `calibrate`."""
    with threadpool_limits(1, user_api="blas"):
        yield


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    return simulate_pair("harbor", np.random.default_rng(2))


@pytest.mark.parametrize("factor", [1.05, 0.3048, 1000.0])
@pytest.mark.full
def test_the_factor_is_named_and_swapping_the_clouds_inverts_it(
    pair: SimulatedPair, factor: float
) -> None:
    scaled = times(pair.source, factor, factor, factor)
    there, back = reason(pair.target, scaled), reason(scaled, pair.target)
    assert [there.code, back.code] == ["wrong_scale"] * 2
    assert float(there.values["factor"]) == pytest.approx(1 / factor, rel=0.005)
    assert float(back.values["factor"]) == pytest.approx(factor, rel=0.005)
    unit = UNIT_OF.get(factor)
    assert there.values.get("unit") == back.values.get("unit") == (unit and NAMES[unit])
    if unit is not None:
        # Numbers that are too large are in a small unit.
        small = "source" if factor > 1 else "target"
        assert f"{METRES[unit]:g}: is the {small} in {NAMES[unit]}?" in there.message
        units = f"m --unit {unit}" if factor > 1 else f"{unit} --unit m"
        assert f"--unit {units})" in there.message


@pytest.mark.parametrize(
    ("flip", "axis"),
    [
        ((-1.0, 1.0, 1.0), "horizontal"),
        ((1.0, -1.0, 1.0), "horizontal"),
        ((1.0, 1.0, -1.0), "vertical"),
    ],
)
@pytest.mark.full
def test_a_mirrored_cloud_is_named_whichever_it_is(
    pair: SimulatedPair, flip: tuple[float, float, float], axis: str
) -> None:
    for target, source in (
        (pair.target, times(pair.source, *flip)),
        (times(pair.target, *flip), pair.source),
    ):
        found = reason(target, source)
        assert found.code == "mirrored"
        assert found.values["axis"] == axis
        assert int(found.values["agreeing"]) > int(found.values["rigid_agreeing"])


@pytest.mark.full
def test_moving_a_cloud_changes_nothing(pair: SimulatedPair) -> None:
    T = se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, 0.7])), np.array([2.0, -1.0, 0.5]))
    for change in ((1.05, 1.05, 1.05), (1.0, -1.0, 1.0)):
        changed = times(pair.source, *change)
        still, moved = reason(pair.target, changed), reason(pair.target, changed.transformed(T))
        assert moved.code == still.code != REFUSED.code
        assert moved.values.get("axis") == still.values.get("axis")
        factors = [float(each.values.get("factor", 1.0)) for each in (moved, still)]
        assert factors[0] == pytest.approx(factors[1], rel=0.002)


@pytest.mark.parametrize("scene", ["street", "corridor", "harbor", "bare"])
@pytest.mark.parametrize("seed", first_of(range(2)))
@pytest.mark.full
def test_honest_recordings_are_not_accused(scene: str, seed: int) -> None:
    pair = simulate_pair(scene, np.random.default_rng(seed))
    assert reason(pair.target, pair.source) is REFUSED


@pytest.mark.full
def test_both_mirrored_or_both_scaled_lie_on_each_other_as_before(pair: SimulatedPair) -> None:
    for of_target, of_source in (((-1, 1, 1), (1, -1, 1)), ((1.05, 1.05, 1.05),) * 2):
        both = times(pair.target, *of_target), times(pair.source, *of_source)
        assert reason(*both) is REFUSED


def test_other_refusals_stay_what_they_are(pair: SimulatedPair) -> None:
    mirrored = Placement(FIND(pair.target), FIND(times(pair.source, -1, 1, 1)))
    for code in ("no_intensity", "moving_pole"):
        refusal = Refusal(code, "as it was")
        assert explain(refusal, [mirrored], (), radius=DEFAULT_RADIUS) is refusal
    none = Scan(pair.target)
    assert explain(REFUSED, [Placement(none, none)], (), radius=DEFAULT_RADIUS) is REFUSED
    assert explain(REFUSED, [], (), radius=DEFAULT_RADIUS) is REFUSED


def scaled_answer(pair: SimulatedPair, factor: float) -> Calibration:
    return calibrate(pair.target, times(pair.source, factor, factor, factor))


@pytest.mark.full
def test_an_answer_is_refused_beyond_one_per_cent_of_scale(pair: SimulatedPair) -> None:
    assert scaled_answer(pair, 1.005).status != "refused"
    (found,) = scaled_answer(pair, 1.02).reasons
    assert found.code == "wrong_scale"
    assert float(found.values["factor"]) == pytest.approx(1 / 1.02, abs=0.003)


@pytest.mark.full
def test_a_mirrored_cloud_gets_no_answer() -> None:
    pair = simulate_pair("corridor", np.random.default_rng(1))
    answer = calibrate(pair.target, times(pair.source, 1, -1, 1))
    assert [each.code for each in answer.reasons] == ["mirrored"]
    assert answer.T_target_source is None


def test_an_answer_is_held_against_its_mirror_image(pair: SimulatedPair) -> None:
    source = times(pair.source, 1, -1, 1)
    placement = Placement(FIND(pair.target), FIND(source))
    wrong = pair.T_target_source @ np.diag([-1.0, -1.0, 1.0, 1.0])
    with pytest.raises(Refusal, match="reversed") as refusal:
        check_similarity(None, [placement], wrong)
    assert refusal.value.code == "mirrored"
    honest = Placement(placement.target, FIND(pair.source))
    check_similarity(None, [honest], pair.T_target_source)


@pytest.mark.parametrize(
    ("factor", "sigma", "refused"),
    [(1.014, 0.004, True), (0.986, 0.004, True), (1.013, 0.005, False), (1.009, 0.0001, False)],
)
def test_a_scale_is_denied_beyond_its_significance_and_one_per_cent(
    pair: SimulatedPair, factor: float, sigma: float, refused: bool
) -> None:
    placement = Placement(FIND(pair.target), FIND(pair.source))
    wanted = cast("Refinement", SimpleNamespace(scale=(factor, sigma)))
    if not refused:
        return check_similarity(wanted, [placement], pair.T_target_source)
    with pytest.raises(Refusal) as refusal:
        check_similarity(wanted, [placement], pair.T_target_source)
    assert refusal.value.code == "wrong_scale"
    return None


RADIUS = 0.02


@cache
def corridor(radius: float = RADIUS, poles: bool = True) -> tuple[PointCloud, PointCloud]:
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


def unit_told(placement: Placement) -> Refusal:
    few = Refusal("too_few_poles", "none are seen")
    return explain(few, [placement], (), radius=RADIUS)


@pytest.mark.parametrize("unit", ["ft", "in", "cm", "mm"])
@pytest.mark.full
def test_the_unit_of_both_is_found(unit: Unit) -> None:
    target, source = corridor()
    placement = placed(counted(target, unit), counted(source, unit))
    found = unit_told(placement)
    assert found.values["unit"] == unit
    assert f"the target shows 2 poles of radius {RADIUS:g} m and the source 2" in found.message
    for scan in placement.scans:
        alone = unit_of_one(scan.cloud, RADIUS)
        # A corridor in feet is no longer than a place in metres.
        assert (alone and alone[0]) == (None if unit == "ft" else unit)


@pytest.mark.parametrize("clouds", [corridor(), corridor(poles=False)])
@pytest.mark.full
def test_metres_are_no_other_unit(clouds: tuple[PointCloud, PointCloud]) -> None:
    placement = placed(*clouds)
    assert "unit" not in unit_told(placement).values
    assert [unit_of_one(cloud, RADIUS) for cloud in clouds] == [None, None]


@pytest.mark.full
def test_one_cloud_in_feet_is_told_where_it_reaches_farther_than_its_sensor() -> None:
    made = simulate_pair("harbor", np.random.default_rng(1))
    assert unit_of_one(made.target, RADIUS) is None
    assert beyond_sensors(made.target) is None
    shown = unit_of_one(counted(made.target, "ft"), RADIUS)
    assert shown is not None
    assert shown[0] == "ft"


@pytest.mark.full
def test_two_units_are_none_of_both() -> None:
    target, source = corridor()
    placement = placed(counted(target, "ft"), counted(source, "in"))
    assert "unit" not in unit_told(placement).values


@pytest.mark.full
def test_no_cloud_and_one_beyond_all_ranges_are_no_unit() -> None:
    target, source = corridor()
    none = target.select(np.zeros(len(target), bool))
    for other in (none, counted(source, "m"), replace(source, xyz=source.xyz * 1e9)):
        assert "unit" not in unit_told(placed(none, other)).values


@pytest.mark.full
def test_feet_are_told_beside_thicker_poles_and_not_applied() -> None:
    """Both would look the same: the hint names both, and each of them is an answer."""
    clouds = [counted(cloud, "ft") for cloud in corridor()]
    answer = calibrate(*clouds, options=Options(radius=RADIUS))
    assert answer.T_target_source is None
    (reason,) = answer.reasons
    assert (reason.code, reason.values["unit"]) == ("too_few_poles", "ft")
    assert "either the coordinates are in feet (--unit ft), or the poles are" in reason.message
    target, source = clouds
    assert rp.calibrate(target, source, unit="ft").status != "refused"
    thick = [counted(cloud, "m") for cloud in corridor(RADIUS / METRES["ft"])]
    (reason,) = calibrate(*thick, options=Options(radius=RADIUS)).reasons
    if "unit" in reason.values:
        assert "times as thick as given (--radius 0.0" in reason.message


@pytest.mark.full
def test_no_answer_is_given_where_another_unit_alone_shows_the_poles() -> None:
    """Surroundings and doubtful candidates fit in any unit that both clouds share."""
    check = partial(check_unit, radius=RADIUS, thresholds=(None, None))
    check(placed(*corridor()))
    check(placed(*corridor(poles=False)))
    with pytest.raises(
        Refusal, match=r"two poles that both LiDARs see; read as feet, the target shows 2"
    ):
        check(placed(*(counted(cloud, "ft") for cloud in corridor())))


@pytest.mark.parametrize("unit", ["in", "cm", "mm"])
@pytest.mark.full
def test_ranges_that_are_no_metres_are_told_by_poles(unit: Unit) -> None:
    answer = calibrate(
        *(counted(cloud, unit) for cloud in corridor()), options=Options(radius=RADIUS)
    )
    (reason,) = answer.reasons
    assert (reason.code, reason.values["unit"]) == ("wrong_unit", unit)
    assert f"read them with --unit {unit}" in reason.message
