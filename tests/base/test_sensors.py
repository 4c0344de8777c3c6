"""The sensor table and the threshold that a cloud gives by itself."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from retropole.base.errors import UsageError
from retropole.base.sensors import (
    SENSORS,
    auto_threshold,
    find_sensor,
    lower_thresholds,
    threshold_for,
)
from retropole.simulation import simulate_pair

NAMES = (
    *("VLP-16", "VLP-32C", "HDL-32E", "VLS-128", "Pandar64", "PandarQT", "XT32", "RS-LiDAR-16"),
    *("RS-LiDAR-32", "C16", "C32", "OS0", "OS1", "Mid-360"),
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
def test_auto_threshold_scales_with_the_intensity(scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    intensity = np.concatenate([rng.uniform(0, 60, 5000), rng.uniform(150, 255, 60)])
    plain = auto_threshold(intensity).value
    assert auto_threshold(scale * intensity).value == pytest.approx(scale * plain)


@pytest.mark.parametrize("name", [n for n in NAMES if n != "Mid-360"])
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
    sensor = SENSORS["VLP-16"]
    assert threshold_for(intensity, sensor, 12.0).value == 12.0
    assert threshold_for(intensity, sensor, None).value == 230.0
    assert threshold_for(intensity / 255, sensor, None).value == pytest.approx(230 / 255)
    assert threshold_for(intensity, None, None) == auto_threshold(intensity)


@pytest.mark.parametrize("glints", [0, 20])
def test_lower_thresholds_descend_to_where_dim_tape_stands_out(glints: int) -> None:
    rng = np.random.default_rng(0)
    dim, diffuse = rng.uniform(100, 130, 60), rng.uniform(0, 40, 5000)
    intensity = np.concatenate([diffuse, dim, np.full(glints, 255.0)])
    chosen = threshold_for(intensity, SENSORS["VLP-16"], None)
    values = [each.value for each in lower_thresholds(intensity, chosen)]
    assert values == sorted(values, reverse=True)
    assert max(values) < chosen.value
    assert 40 < min(values) < 100, "above the diffuse returns, below the tape"
    assert lower_thresholds(intensity, threshold_for(intensity, None, 230.0)) == ()
