"""Edges: what a wide beam reports of two surfaces; the glow around tape."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Array
from retropole.base.sensors import SENSORS, find_sensor
from retropole.simulation import (
    EXACT,
    FIELD,
    TYPICAL,
    Box,
    Material,
    NoiseModel,
    Rectangle,
    Surface,
)
from retropole.simulation.devices import Footprint
from retropole.simulation.returns import (
    BLOOM_NOISE,
    CALIBRATED_FALLOFF,
    RAW_FALLOFF,
    bloom,
    intensities,
    sideways,
    turned,
)
from tests.simulation.rooms import X, Y, Z, ranges_and_rays, scan_room

TAPE = Material(0.9, retro=True)
SENSOR = "VLP-16"


def before_a_wall(gap: float, near: Material, far: Material) -> list[Surface]:
    """Give a plate 6 m ahead, and a wall by a gap behind it."""
    return [
        Rectangle(6 * X, Y, Z, (0.5, 0.7), near),
        Rectangle((6 + gap) * X, Y, Z, (4, 4), far),
    ]


def depths(noise: NoiseModel, surfaces: list[Surface]) -> np.ndarray:
    return scan_room(noise, surfaces, sensor=SENSOR).cloud.xyz[:, 0]


@pytest.mark.parametrize("footprint", ["first", "strongest"])
def test_far_apart_surfaces_do_not_mix_and_near_ones_do(footprint: Footprint) -> None:
    noise = replace(EXACT, footprint=footprint)
    grey = Material(0.5)
    beside = find_sensor(SENSOR).divergence * 10  # the parts of a beam on one flat surface
    distance = depths(noise, before_a_wall(2.0, grey, grey))
    assert np.minimum(np.abs(distance - 6), np.abs(distance - 8)).max() < beside
    mixed = depths(noise, before_a_wall(0.3, grey, grey))
    between = (mixed > 6 + 0.05) & (mixed < 6.3 - 0.05)
    assert 5 < np.count_nonzero(between) < 0.1 * len(mixed)
    assert mixed.min() > 6 - beside
    assert mixed.max() < 6.3 + beside


def test_away_from_edges_a_footprint_changes_nothing() -> None:
    surfaces = before_a_wall(2.0, Material(0.5), Material(0.5))
    exact, wide = (
        scan_room(noise, surfaces, sensor=SENSOR).cloud.xyz
        for noise in (EXACT, replace(EXACT, footprint="first"))
    )
    inside = (np.abs(exact[:, 1]) < 0.4) & (np.abs(exact[:, 0] - 6) < 1e-6)
    inside &= np.abs(exact[:, 2]) < 0.5
    assert np.count_nonzero(inside) > 50
    gaps = np.linalg.norm(exact[inside][:, None] - wide[None], axis=2).min(axis=1)
    assert gaps.max() < 1e-9


def test_the_first_return_favours_what_is_near_and_the_strongest_what_is_bright() -> None:
    def on_plate(footprint: Footprint, near: float, far: float) -> int:
        surfaces = before_a_wall(2.0, Material(near), Material(far))
        labels = scan_room(replace(EXACT, footprint=footprint), surfaces, sensor=SENSOR).labels
        return int(np.count_nonzero(labels == 0))

    centre = on_plate("centre", 0.1, 0.9)
    assert on_plate("first", 0.1, 0.9) > centre
    assert on_plate("strongest", 0.1, 0.9) < on_plate("first", 0.1, 0.9)
    assert on_plate("strongest", 0.9, 0.1) > on_plate("strongest", 0.1, 0.9)
    assert on_plate("first", 0.1, 0.9) < 1.5 * centre


def test_turned_beams_are_off_by_the_angle_stated() -> None:
    rng = np.random.default_rng(0)
    rays = ranges_and_rays(rng.normal(size=(20000, 3)))[1]
    first, second = sideways(rays)
    for a, b in ((first, first), (second, second), (rays, rays)):
        np.testing.assert_allclose(np.sum(a * b, axis=1), 1.0)
    for a, b in ((first, second), (first, rays), (second, rays)):
        np.testing.assert_allclose(np.sum(a * b, axis=1), 0.0, atol=1e-12)
    off = turned(rays, *(1e-3 * rng.normal(size=(2, len(rays)))))
    squared = np.sum(np.cross(rays, off) ** 2, axis=1)
    assert squared.mean() == pytest.approx(2e-6, rel=0.05)


def test_pointing_noise_moves_points_along_their_nominal_beams() -> None:
    noise = replace(EXACT, pointing_noise=1e-3)
    true, rays = ranges_and_rays(scan_room(EXACT).cloud.xyz)
    stated, same = ranges_and_rays(scan_room(noise).cloud.xyz)
    np.testing.assert_allclose(same, rays, atol=1e-12)
    sigma = 1e-3 * true * np.sqrt((true / 8.0) ** 2 - 1)
    slanted = sigma > 1e-3
    assert np.std((stated - true)[slanted] / sigma[slanted]) == pytest.approx(1.0, rel=0.1)


def test_the_glow_falls_linearly_and_ends() -> None:
    rng = np.random.default_rng(1)
    azimuth = np.r_[0.0, rng.uniform(-0.02, 0.02, 20000)]
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    on_tape = azimuth == 0
    false, beside = bloom(rays, on_tape, 0.01, rng)
    assert np.all(beside == 0)
    assert np.abs(azimuth[false]).max() < 0.01
    for low, high in ((0.0, 0.002), (0.004, 0.006), (0.008, 0.01)):
        within = (np.abs(azimuth) > low) & (np.abs(azimuth) < high)
        falsely = within & np.isin(np.arange(len(azimuth)), false)
        share = np.count_nonzero(falsely) / np.count_nonzero(within)
        assert share == pytest.approx(1 - (low + high) / 0.02, abs=0.05)
    none = bloom(rays, np.zeros(len(rays), dtype=bool), 0.01, rng)
    assert len(none[0]) == len(none[1]) == 0


def test_false_returns_are_bright_near_tape_and_on_no_surface() -> None:
    half_width = float(np.radians(0.5))
    noise = replace(EXACT, blooming=half_width)
    surfaces = before_a_wall(2.0, TAPE, Material(0.5))
    plain, glowing = (scan_room(each, surfaces, sensor="XT32") for each in (EXACT, noise))
    false = glowing.labels == -1
    assert 10 < np.count_nonzero(false) < 0.5 * np.count_nonzero(plain.labels == 0)
    assert len(glowing.cloud) == len(plain.cloud), "they take the place of what their beams met"
    bright = glowing.cloud.intensity
    assert bright is not None
    assert bright[false].min() >= find_sensor("XT32").threshold
    own = glowing.cloud.xyz[glowing.labels == 0]
    np.testing.assert_array_equal(own, plain.cloud.xyz[plain.labels == 0])
    ranges, rays = ranges_and_rays(glowing.cloud.xyz[false])
    on_tape, directions = ranges_and_rays(own)
    nearest = np.argmax(rays @ directions.T, axis=1)
    chord = np.linalg.norm(rays - directions[nearest], axis=1)
    assert chord.max() <= half_width + 1e-9
    off = ranges - on_tape[nearest]
    assert off.std() == pytest.approx(BLOOM_NOISE, rel=0.5)
    assert np.abs(off).max() < 5 * BLOOM_NOISE


def test_a_rosette_has_edges_too() -> None:
    box: list[Surface] = [
        Box(np.array([4.0, 0, 0.5]), np.eye(3), np.full(3, 0.5), Material(0.5)),
        Rectangle(4.2 * X, Y, Z, (4, 4), Material(0.5)),
    ]
    exact = scan_room(EXACT, box, sensor="Mid-360").cloud.xyz
    wide = scan_room(replace(EXACT, footprint="first"), box, sensor="Mid-360").cloud.xyz
    moved = 1 - np.isin(wide[:, 0], exact[:, 0]).mean()
    assert 0 < moved < 0.5


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
