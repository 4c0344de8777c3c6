"""The sensor table and the threshold that a cloud gives by itself."""

import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from retropole.base.errors import UsageError
from retropole.base.sensors import (
    GIVEN,
    SENSORS,
    ListedErrors,
    Threshold,
    auto_threshold,
    find_sensor,
    lower_thresholds,
    threshold_for,
)
from retropole.base.systematic import sizes_of
from retropole.simulation import simulate_pair
from tests.tiers import first_of

NAMES = (
    *("VLP-16", "VLP-32C", "HDL-32E", "VLS-128", "Pandar64", "PandarQT", "XT32", "RS-LiDAR-16"),
    *("RS-LiDAR-32", "C16", "C32", "OS0", "OS1", "Mid-360", "Avia"),
    *("HAP", "AT128", "JT128", "RS-LiDAR-M1", "RS-E1", "RS-Airy", "Falcon K"),
)


def test_the_table_has_every_model() -> None:
    assert tuple(SENSORS) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_rows_make_sense(name: str) -> None:
    sensor = SENSORS[name]
    assert np.all(np.diff(sensor.elevations) > 0)
    assert sensor.elevation_span[0] < sensor.elevation_span[1]
    assert 0 < sensor.threshold < sensor.intensity_max
    assert 0 < sensor.min_range < sensor.max_range
    assert 0 < sensor.range_noise < 0.05
    assert sensor.source
    assert sensor.threshold_source


@pytest.mark.parametrize(
    ("name", "threshold"),
    [("VLP-16", 230), ("HDL-32E", 230), ("Pandar64", 200), ("RS-LiDAR-16", 200), ("C16", 200)],
)
def test_thresholds_of_the_paper(name: str, threshold: float) -> None:
    assert SENSORS[name].threshold == threshold


@pytest.mark.parametrize("name", ["vlp16", "VLP 16", "puck", "Vlp-16"])
def test_names_are_forgiving(name: str) -> None:
    assert find_sensor(name) is SENSORS["VLP-16"]


def test_an_unknown_name_lists_those_known() -> None:
    with pytest.raises(UsageError, match=r"Mid-360.*auto"):
        find_sensor("VLP-17")


@given(st.floats(1e-3, 1e3), st.integers(0, 10))
@pytest.mark.full
def test_auto_threshold_scales_with_the_intensity(scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    intensity = np.concatenate([rng.uniform(0, 60, 5000), rng.uniform(150, 255, 60)])
    plain = auto_threshold(intensity).value
    assert auto_threshold(scale * intensity).value == pytest.approx(scale * plain)


@pytest.mark.parametrize("darkest", [-2048.0, -5000.0, -1.0])
@pytest.mark.parametrize("odd", [0, 20])
def test_auto_threshold_counts_from_the_bottom_of_the_scale(darkest: float, odd: int) -> None:
    """Leica's scale runs from -2048; there, parts of zero would be above all returns."""
    rng = np.random.default_rng(3)
    intensity = np.concatenate([np.zeros(200), rng.uniform(0, 60, 5000), rng.uniform(60, 61, 9)])
    plain = auto_threshold(intensity).value
    moved = np.concatenate([intensity + darkest, np.full(odd, -99_999.0)])
    assert auto_threshold(moved).value - darkest == pytest.approx(plain, rel=0.02)
    assert plain < intensity.max()


@pytest.mark.parametrize("name", first_of([n for n in NAMES if SENSORS[n].rings], 5))
def test_auto_threshold_parts_tape_from_the_rest(name: str) -> None:
    pair = simulate_pair(
        "street", np.random.default_rng(1), sensor_target=name, sensor_source="Pandar64"
    )
    assert pair.target.intensity is not None
    value = auto_threshold(pair.target.intensity).value
    diffuse = np.array([not s.material.retro for s in pair.surfaces])[pair.labels[0]]
    first = len(pair.surfaces) - len(pair.poles)
    assert np.mean(pair.target.intensity[diffuse] >= value) < 0.01
    assert np.mean(pair.target.intensity[pair.labels[0] >= first] >= value) > 0.8


def test_given_beats_sensor_beats_cloud() -> None:
    intensity = np.linspace(0, 255, 100)
    sensor, ranges = SENSORS["VLP-16"], np.full(100, 5.0)
    assert threshold_for(intensity, ranges, sensor, 12.0) == Threshold(12.0, GIVEN)
    assert threshold_for(intensity, ranges, sensor, None).value == 230.0
    assert threshold_for(intensity / 255, ranges, sensor, None).value == pytest.approx(230 / 255)
    assert threshold_for(intensity, ranges, None, None) == auto_threshold(intensity)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("is_divided", [False, True])
def test_a_threshold_falls_with_the_range_and_leaves_diffuse_returns_below(
    name: str, is_divided: bool
) -> None:
    sensor, rng = SENSORS[name], np.random.default_rng(1)
    factor = 1 / sensor.intensity_max if is_divided else 1.0
    diffuse = factor * sensor.threshold * rng.uniform(0, 0.4, 5000)
    ranges = rng.uniform(1, 60, 5000)
    found = threshold_for(diffuse, ranges, sensor, None)
    at = found.at(np.array([0.5, 5.0, 8.0, 15.0, 100.0]))
    assert np.all(at[:2] == found.value)
    assert np.all(np.diff(at) <= 0)
    assert np.all(diffuse < found.at(ranges))
    assert np.all(at >= factor * sensor.retro_from * (1 - 1e-9))
    falls = found.least is not None
    assert falls == (sensor.retro_from < sensor.threshold)
    if falls:
        assert "falls" in found.found
        # Where diffuse returns are as bright as tape, it does not.
        bright = np.where(rng.uniform(size=5000) < 0.2, factor * sensor.threshold, diffuse)
        assert threshold_for(bright, ranges, sensor, None).least is None


@pytest.mark.parametrize("glints", [0, 20])
def test_lower_thresholds_descend_to_where_dim_tape_stands_out(glints: int) -> None:
    rng = np.random.default_rng(0)
    dim, diffuse = rng.uniform(100, 130, 60), rng.uniform(0, 40, 5000)
    intensity = np.concatenate([diffuse, dim, np.full(glints, 255.0)])
    near = np.full(len(intensity), 5.0)
    chosen = threshold_for(intensity, near, SENSORS["VLP-16"], None)
    values = [each.value for each in lower_thresholds(intensity, chosen)]
    assert values == sorted(values, reverse=True)
    assert max(values) < chosen.value
    assert 40 < min(values) < 100, "above the diffuse returns, below the tape"
    assert lower_thresholds(intensity, threshold_for(intensity, near, None, 230.0)) == ()


LIKE = 'like = "XT32"\n'
WHOLE = """
noise_m = 0.01
divergence_mrad = 2.0
range_m = [0.5, 120.0]
threshold = 200.0
threshold_source = "measured"
source = "manual"
elevations_deg = [5.0, [-14, -10, 5]]
azimuth_step_deg = 0.2
accuracy_m = 0.03
"""


def a_file(folder: Path, text: str) -> str:
    path = folder / "front.toml"
    path.write_text(text)
    return str(path)


def test_a_file_is_like_a_model_in_all_it_does_not_say(tmp_path: Path) -> None:
    name = a_file(tmp_path, LIKE + "noise_m = 0.002\n[errors]\nzero_m = 0.001\nbend_deg = 0.001")
    given, model = find_sensor(name), SENSORS["XT32"]
    assert given.name == name
    assert given.range_noise == 0.002
    np.testing.assert_array_equal(given.elevations, model.elevations)
    same = replace(given, name="", aliases=(), range_noise=0.0, errors={}, elevations=np.zeros(0))
    of_model = replace(model, name="", aliases=(), range_noise=0.0, elevations=np.zeros(0))
    arrays = {"elevations": 0, "rise": 0}
    assert {**vars(same), **arrays} == {**vars(of_model), **arrays}
    sizes = replace(sizes_of(model), zero=0.001, bend=float(np.radians(0.001)))
    assert sizes_of(given) == sizes


def test_every_size_of_an_error_can_be_measured(tmp_path: Path) -> None:
    names = ListedErrors.__struct_fields__
    text = LIKE + "[errors]\n" + "\n".join(f"{name} = 0.001" for name in names)
    sizes = asdict(sizes_of(find_sensor(a_file(tmp_path, text))))
    assert len(sizes) == len(names)
    assert set(sizes.values()) == {0.001, float(np.radians(0.001))}


def test_a_file_may_describe_a_model_that_is_not_known(tmp_path: Path) -> None:
    sensor = find_sensor(a_file(tmp_path, WHOLE))
    np.testing.assert_allclose(np.degrees(sensor.elevations), [-14, -13, -12, -11, -10, 5])
    assert sizes_of(sensor).zero == pytest.approx(0.01)
    assert sensor.points == 6 * 1800


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "missing required field"),
        ("x = ", "front.toml"),
        ('like = "XT3"', "no sensor is named 'XT3'"),
        ('like = "front.toml"', "no sensor is named 'front'"),
        ("like = 3", "no sensor is named '3'"),
        (LIKE + "nose_m = 1.0", "nose_m"),
        (LIKE + "noise_m = nan", "above zero"),
        (LIKE + "range_m = [5.0, 1.0]", "above zero"),
        (LIKE + "elevations_deg = []", "expected elevations_deg"),
        (LIKE + "elevations_deg = [[0, 1, 0]]", "expected elevations_deg"),
        (LIKE + "elevations_deg = [[0, 1, 999999999]]", "expected elevations_deg"),
        (LIKE + "elevations_deg = [nan]", "90°"),
        (LIKE + "rosette_deg = [0, 100]\npoints = 9", "90°"),
        ('like = "Mid-360"\npoints = 0', "points"),
        (LIKE + "azimuth_deg = [60, -60]", "azimuth_deg"),
        (LIKE + "azimuth_deg = [-200, 200]", "azimuth_deg"),
        (LIKE + "azimuth_deg = [nan, 60]", "azimuth_deg"),
        (LIKE + "round = true", "round"),
        (LIKE + "rise_deg = [0, 90]", "rise_deg"),
        ('like = "HAP"\nrise_deg = [1]', "rise_deg"),
        (LIKE + "[errors]\nzero_m = -0.001", "errors.zero_m"),
        (LIKE + "[errors]\nzero_m = nan", "errors.zero_m"),
        (LIKE + "[errors]\nzero = 0.001", "zero"),
    ],
)
def test_what_describes_no_sensor_is_reported(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(UsageError, match=re.escape(told)):
        find_sensor(a_file(tmp_path, text))


def test_a_file_may_limit_the_azimuths(tmp_path: Path) -> None:
    sensor = find_sensor(a_file(tmp_path, WHOLE + "azimuth_deg = [-60, 30]\nrise_deg = [1, 0]"))
    assert not sensor.sees_all_around
    assert sensor.points == 6 * 450
    assert np.degrees(sensor.elevation_span) == pytest.approx((-14, 6))
    azimuth = np.radians([-60, -15, 30, 31, 180])
    np.testing.assert_allclose(np.degrees(sensor.risen(azimuth[:3])), [1, 0.5, 0], atol=1e-9)
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(5)], axis=1)
    assert sensor.has_in_view(5 * rays, -1e-9).tolist() == [True, True, True, False, False]
    assert sensor.has_in_view(rays, np.radians(10)).tolist() == [False, True, False, False, False]
    assert SENSORS["XT32"].has_in_view(rays, 1.0).all()


def test_a_round_field_is_narrow_above_and_below() -> None:
    avia = SENSORS["Avia"]
    azimuth, up = np.radians([[30, 0], [30, 30]])
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(up)], axis=1)
    assert avia.has_in_view(rays).tolist() == [False, True]
    assert avia.has_in_view(rays * [1, 1, 0]).all()


def test_how_long_to_record_is_known_of_patterns_that_do_not_repeat() -> None:
    asked = {name: sensor.seconds for name, sensor in SENSORS.items() if sensor.sweeps > 1}
    assert asked == {"Mid-360": 1.5, "Avia": 0.5}


def test_a_file_that_is_not_there_is_reported(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.toml"):
        find_sensor(str(tmp_path / "none.toml"))
