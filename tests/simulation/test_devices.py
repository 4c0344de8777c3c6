"""A LiDAR's own errors: each family disturbs what it should, and all recordings share them."""

from dataclasses import fields, replace

import numpy as np
import pytest

from benchmarks.again import record_again
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.sensors import find_sensor
from retropole.simulation import (
    EXACT,
    FIELD,
    Device,
    NoiseModel,
    SimulatedPair,
    draw_device,
    place_again,
    simulate_pair,
)
from retropole.simulation.devices import MAX_SLANT
from tests.simulation.rooms import HALF, ranges_and_rays, scan_room
from tests.simulation.surfaces import distance_from

pytestmark = pytest.mark.full

OF_FAMILY = {
    "ring_bias": "ring_range",
    "retro_bias": "tape_offset",
    "zero_offset": "zero_offset",
    "scale": "scale",
    "slant": "slant",
    "ring_elevation": "ring_elevation",
    "ring_azimuth": "ring_azimuth",
    "encoder": "encoder",
    "wobble": "wobble",
    "bend": "bend",
    "elevation": "elevation",
    "elevation_scale": "elevation_scale",
}
"""What each family of `NoiseModel` disturbs in a `Device`."""


def only(**sizes: float) -> NoiseModel:
    """Switch on single families."""
    return replace(EXACT, **sizes)  # type: ignore[arg-type]


SYSTEMATIC = only(**{name: getattr(FIELD, name) for name in OF_FAMILY})


def device_of(noise: NoiseModel, seed: int = 1, sensor: str = "VLP-16") -> Device:
    return draw_device(find_sensor(sensor), noise, np.random.default_rng(seed))


def angles(rays: Array) -> tuple[Array, Array]:
    """Azimuth and elevation (N,) of rays (N, 3), rad."""
    return np.arctan2(rays[:, 1], rays[:, 0]), np.arcsin(rays[:, 2])


@pytest.mark.parametrize(("family", "own"), OF_FAMILY.items())
def test_the_errors_of_a_family_are_of_its_size_and_of_no_other(family: str, own: str) -> None:
    # The field has no errors of the azimuth of rings, nor bent scan lines.
    size = getattr(FIELD, family) or 3e-4
    noise = only(**{family: size})
    drawn = [device_of(noise, seed) for seed in range(400)]
    values = np.concatenate([np.atleast_1d(getattr(device, own)) for device in drawn])
    assert values.std() == pytest.approx(size, rel=0.15)
    assert abs(values.mean()) < 4 * values.std() / np.sqrt(len(values))
    for other in fields(Device):
        assert other.name == own or not np.any(getattr(drawn[0], other.name))


def test_switching_a_family_off_changes_no_other() -> None:
    whole, part = device_of(FIELD), device_of(replace(FIELD, encoder=0.0, ring_bias=0.0))
    for field in fields(Device):
        if field.name not in ("encoder", "ring_range"):
            np.testing.assert_array_equal(getattr(whole, field.name), getattr(part, field.name))


def test_a_device_without_errors_states_what_is() -> None:
    device = device_of(EXACT)
    rng = np.random.default_rng(0)
    rays = ranges_and_rays(rng.normal(size=(50, 3)))[1]
    rings = rng.integers(0, 16, 50)
    np.testing.assert_array_equal(device.directions(rays, rings), rays)
    true = rng.uniform(1, 50, 50)
    stated = device.ranges(true, rings, rng.uniform(0, 1, 50), rng.uniform(size=50) < 0.5)
    np.testing.assert_array_equal(stated, true)


def test_an_eccentric_encoder_turns_beams_about_the_vertical() -> None:
    device = device_of(replace(EXACT, encoder=2e-3))
    rays = ranges_and_rays(np.random.default_rng(0).normal(size=(500, 3)))[1]
    (azimuth, elevation), (turned, same) = (
        angles(each) for each in (rays, device.directions(rays, np.zeros(500, dtype=np.int64)))
    )
    expected = device.encoder[0] * np.cos(azimuth) + device.encoder[1] * np.sin(azimuth)
    off = (turned - azimuth + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(off, expected, atol=1e-12)
    np.testing.assert_allclose(same, elevation, atol=1e-12)


def test_wobble_and_rings_raise_beams() -> None:
    device = device_of(replace(EXACT, wobble=2e-3, ring_elevation=3e-3))
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-3, 3, 500), rng.uniform(-0.5, 0.5, 500)
    rings = rng.integers(0, 16, 500)
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    same, raised = angles(device.directions(rays, rings))
    expected = device.wobble[0] * np.cos(azimuth) + device.wobble[1] * np.sin(azimuth)
    np.testing.assert_allclose(raised - elevation, expected + device.ring_elevation[rings])
    np.testing.assert_allclose(same, azimuth, atol=1e-12)


def test_all_beams_are_raised_alike() -> None:
    device = device_of(replace(EXACT, elevation=2e-3))
    azimuth = np.linspace(-np.pi, np.pi, 361)[:-1]
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    same, raised = angles(device.directions(rays, np.zeros(360, dtype=np.int64)))
    np.testing.assert_allclose(raised, device.elevation, atol=1e-12)
    np.testing.assert_allclose(same, azimuth, atol=1e-12)


def test_bent_scan_lines_have_periods_of_180_and_120_degrees() -> None:
    device = device_of(replace(EXACT, bend=2e-3))
    azimuth = np.linspace(-np.pi, np.pi, 361)[:-1]
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    _, raised = angles(device.directions(rays, np.zeros(360, dtype=np.int64)))
    waves = [f(k * azimuth) for k in (2, 3) for f in (np.cos, np.sin)]
    np.testing.assert_allclose(raised, device.bend @ waves, atol=1e-12)


@pytest.mark.parametrize("family", ["ring_elevation", "ring_azimuth", "encoder", "wobble", "bend"])
def test_beams_go_astray_and_points_lie_where_the_lidar_believes(family: str) -> None:
    noise = only(**{family: 5e-3})
    device, cloud = device_of(noise), scan_room(EXACT).cloud
    astray = scan_room(noise, device=device).cloud
    assert astray.ring is not None
    ranges, rays = ranges_and_rays(astray.xyz)
    nominal = ranges_and_rays(cloud.xyz)[1]
    np.testing.assert_allclose(rays, nominal, atol=1e-12)
    true = ranges[:, None] * device.directions(rays, astray.ring)
    np.testing.assert_allclose(np.abs(true[:, :2]).max(axis=1), HALF, atol=1e-9)
    assert np.abs(np.abs(astray.xyz[:, :2]).max(axis=1) - HALF).max() > 1e-3


@pytest.mark.parametrize("family", ["zero_offset", "scale", "slant"])
def test_a_range_error_follows_its_law(family: str) -> None:
    noise = only(**{family: 1e-2})
    device = device_of(noise)
    true, rays = ranges_and_rays(scan_room(EXACT).cloud.xyz)
    stated, same = ranges_and_rays(scan_room(noise, device=device).cloud.xyz)
    np.testing.assert_allclose(same, rays, atol=1e-12)
    tangent = np.sqrt((true / HALF) ** 2 - 1)
    law = {"zero_offset": np.ones_like(true), "scale": true, "slant": true * tangent}[family]
    np.testing.assert_allclose(stated - true, getattr(device, family) * law, atol=1e-9)


def test_the_slant_error_is_bounded() -> None:
    device = device_of(replace(EXACT, slant=1e-2))
    grazing = device.ranges(np.array([10.0]), np.array([0]), np.array([0.0]), np.array([False]))
    assert grazing[0] - 10 == pytest.approx(device.slant * 10 * MAX_SLANT)


def undone(device: Device, cloud: PointCloud, retro: Array) -> Array:
    """Points (N, 3) of a recording without noise and slant, freed of a LiDAR's errors."""
    ring = cloud.ring
    assert ring is not None
    ranges, rays = ranges_and_rays(cloud.xyz)
    true = ranges - device.ring_range[ring] - device.zero_offset - device.tape_offset * retro
    return np.asarray((true / (1 + device.scale))[:, None] * device.directions(rays, ring))


def worst(pair: SimulatedPair, devices: tuple[Device, Device]) -> float:
    """Greatest distance of undone points from their surfaces, metres."""
    found = 0.0
    retro = np.array([surface.material.retro for surface in pair.surfaces])
    for cloud, labels, T, device in (
        (pair.target, pair.labels[0], pair.T_world_target, devices[0]),
        (pair.source, pair.labels[1], pair.T_world_source, devices[1]),
    ):
        world = se3.apply(T, undone(device, cloud, retro[labels]))
        for k, surface in enumerate(pair.surfaces):
            found = max(found, float(distance_from(surface, world[labels == k]).max(initial=0.0)))
    return found


def test_a_lidar_keeps_its_errors_in_all_its_recordings() -> None:
    rng, lidars = np.random.default_rng(4), ("HDL-32E", "VLP-16")
    pair = simulate_pair(
        "street",
        rng,
        sensor_target=lidars[0],
        sensor_source=lidars[1],
        noise=replace(SYSTEMATIC, slant=0.0),
    )
    step = np.array([0.01, 0.0, 0.02, 0.1, 0.0, -0.05])
    again, moved = record_again(pair, rng), record_again(pair, rng, moved=step, poles=False)
    for other in (again, moved, place_again(pair, rng), record_again(again, rng, noise=EXACT)):
        assert other.devices == pair.devices
        assert worst(other, pair.devices) < 1e-8
    assert not np.array_equal(again.target.xyz[:100], pair.target.xyz[:100])
    target, source = (device_of(SYSTEMATIC, 5, name) for name in lidars)
    assert worst(pair, (target, source)) > 1e-3
