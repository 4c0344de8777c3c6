"""Falloff: light fades with range and incidence, and the threshold is not right by construction."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Array
from retropole.base.sensors import SENSORS, find_sensor
from retropole.simulation import EXACT, FIELD, TYPICAL, NoiseModel
from retropole.simulation.intensity import CALIBRATED_FALLOFF, RAW_FALLOFF, intensities
from tests.simulation.rooms import scan_room

FADING = replace(TYPICAL, intensity_falloff=True)


def recorded(
    sensor: str,
    noise: NoiseModel,
    *,
    retro: bool,
    ranges: float,
    incidence_deg: float = 20.0,
    count: int = 2000,
) -> Array:
    """Intensities of a white surface or of tape, in units of the sensor's threshold."""
    ones = np.ones(count)
    model = find_sensor(sensor)
    found = intensities(
        model,
        np.full(count, retro),
        0.7 * ones,
        np.cos(np.radians(incidence_deg)) * ones,
        ranges * ones,
        ones,
        np.random.default_rng(0),
        noise,
    )
    assert found.max() <= model.intensity_max
    assert found.min() >= 0
    return found / model.threshold


@pytest.mark.parametrize("sensor", list(SENSORS))
@pytest.mark.parametrize("ranges", [3.0, 8.0])
def test_tape_where_poles_stand_is_above_the_threshold(sensor: str, ranges: float) -> None:
    for incidence_deg in (0.0, 40.0):
        found = recorded(sensor, FADING, retro=True, ranges=ranges, incidence_deg=incidence_deg)
        assert np.mean(found > 1) > 0.95


@pytest.mark.parametrize("sensor", list(SENSORS))
def test_far_and_grazing_tape_falls_below_it(sensor: str) -> None:
    assert recorded(sensor, FADING, retro=True, ranges=40.0).max() < 1
    grazing = recorded(sensor, FADING, retro=True, ranges=8.0, incidence_deg=85.0)
    assert grazing.max() < 1
    assert recorded(sensor, TYPICAL, retro=True, ranges=40.0).min() > 1, "not without falloff"


@pytest.mark.parametrize(("sensor", "power"), [("OS1", RAW_FALLOFF), ("XT32", CALIBRATED_FALLOFF)])
def test_diffuse_light_fades_with_a_power_of_the_range(sensor: str, power: float) -> None:
    noise = replace(EXACT, intensity_falloff=True)
    near, far = (recorded(sensor, noise, retro=False, ranges=r).mean() for r in (6.0, 18.0))
    assert far / near == pytest.approx(3.0**-power, rel=0.05)
    same = [recorded(sensor, TYPICAL, retro=False, ranges=r).mean() for r in (6.0, 18.0)]
    assert same[0] == pytest.approx(same[1])


@pytest.mark.parametrize("sensor", list(SENSORS))
def test_walls_hardly_ever_pass_for_tape(sensor: str) -> None:
    for ranges in (1.0, 5.0, 30.0):
        found = recorded(sensor, FADING, retro=False, ranges=ranges, incidence_deg=0.0)
        assert np.mean(found > 1) < 0.01


def test_noise_grows_with_range_and_darkness() -> None:
    noise = replace(EXACT, range_noise=1.0, noise_growth=FIELD.noise_growth)
    exact, noisy = scan_room(EXACT).cloud.xyz, scan_room(noise).cloud.xyz
    ranges = np.linalg.norm(exact, axis=1)
    off = np.linalg.norm(noisy, axis=1) - ranges
    sigma = find_sensor("VLP-16").range_noise
    brightness = 0.5 * 8.0 / ranges
    grown = sigma * np.sqrt(1 + (noise.noise_growth * ranges / 10) ** 2 / brightness)
    assert grown.max() > 1.1 * sigma
    for part in (ranges < np.median(ranges), ranges > np.median(ranges)):
        assert np.std(off[part] / grown[part]) == pytest.approx(1.0, rel=0.03)
