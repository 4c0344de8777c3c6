"""Scans of walls at known distances: noise is what the model states, intensities stay apart."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base.datatypes import Array
from retropole.base.sensors import SENSORS, find_sensor
from retropole.simulation import (
    EXACT,
    FIELD,
    TYPICAL,
    Material,
    NoiseModel,
    Rectangle,
    Surface,
    scan,
)
from retropole.simulation.scanning import LabelledScan, beams

pytestmark = pytest.mark.full


def scan_walls(
    noise: NoiseModel, *, sensor: str = "VLP-16", retro: bool = False, frames: int = 1
) -> LabelledScan:
    """Scan four walls around the sensor, 8 m away."""
    rng, axes, material = np.random.default_rng(3), np.eye(3), Material(0.5, retro)
    walls: list[Surface] = [
        Rectangle(8.0 * sign * axes[axis], axes[1 - axis], axes[2], (8.0, 8.0), material)
        for sign in (-1, 1)
        for axis in (0, 1)
    ]
    return scan(walls, find_sensor(sensor), np.eye(4), rng, noise, frames)


def range_errors(noise: NoiseModel, *, retro: bool = False, frames: int = 1) -> Array:
    """Range errors (N,) of a scan of the walls, metres."""
    xyz = scan_walls(noise, retro=retro, frames=frames).cloud.xyz
    ranges = np.linalg.norm(xyz, axis=1)
    across = np.abs(xyz[:, :2]).max(axis=1)
    return np.asarray((across - 8.0) * ranges / across)


def test_without_noise_every_return_lies_on_its_surface() -> None:
    assert np.abs(range_errors(EXACT)).max() < 1e-9


def test_noise_along_the_beam_is_the_sensors() -> None:
    sigma = find_sensor("VLP-16").range_noise
    along = range_errors(replace(EXACT, range_noise=1.0))
    assert along.std() == pytest.approx(sigma, rel=0.03)
    assert abs(along.mean()) < 4 * sigma / np.sqrt(len(along))


def test_dropout_is_the_share_of_lost_returns() -> None:
    dropped = range_errors(replace(EXACT, dropout=0.3))
    assert len(dropped) == pytest.approx(0.7 * len(range_errors(EXACT)), rel=0.02)


def test_a_retro_bias_is_common_to_all_tape_and_to_nothing_else() -> None:
    biased = replace(EXACT, retro_bias=0.02)
    tape = range_errors(biased, retro=True)
    assert tape.std() < 1e-9
    assert 0 < abs(tape.mean()) < 0.1
    assert np.abs(range_errors(biased)).max() < 1e-9


def test_a_ring_bias_is_common_to_all_returns_of_a_ring() -> None:
    cloud = scan_walls(replace(EXACT, ring_bias=0.02)).cloud
    assert cloud.ring is not None
    errors = range_errors(replace(EXACT, ring_bias=0.02))
    means = []
    for ring in np.unique(cloud.ring):
        own = errors[cloud.ring == ring]
        assert np.ptp(own) < 1e-9
        means.append(own.mean())
    assert np.std(means) > 0.005


def test_frames_add_up() -> None:
    assert len(range_errors(EXACT, frames=3)) == 3 * len(range_errors(EXACT))
    cloud = scan_walls(EXACT, frames=3).cloud
    assert cloud.frame is not None
    assert np.unique(cloud.frame).tolist() == [0, 1, 2]
    assert scan_walls(EXACT).cloud.frame is None


@pytest.mark.parametrize("sensor", list(SENSORS))
def test_the_threshold_separates_tape_from_diffuse_returns(sensor: str) -> None:
    threshold = find_sensor(sensor).threshold
    diffuse = scan_walls(TYPICAL, sensor=sensor).cloud.intensity
    tape = scan_walls(TYPICAL, sensor=sensor, retro=True).cloud.intensity
    assert diffuse is not None
    assert tape is not None
    assert diffuse.max() < threshold < tape.min()
    assert tape.max() <= find_sensor(sensor).intensity_max


@pytest.mark.parametrize("sensor", list(SENSORS))
def test_beams_are_unit_vectors_within_the_field_of_view(sensor: str) -> None:
    model = find_sensor(sensor)
    rays, rings, times = beams(model, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0)
    elevation = np.arcsin(rays[:, 2])
    low, high = model.elevation_span
    assert elevation.min() >= low - 1e-9
    assert elevation.max() <= high + 1e-9
    assert len(rays) == len(rings) == len(times) == model.points
    if model.pattern == "spinning":
        np.testing.assert_allclose(elevation, model.elevations[rings], atol=1e-9)


def test_a_rosette_fills_its_field_of_view_and_never_repeats() -> None:
    model, rng = find_sensor("Mid-360"), np.random.default_rng(1)
    first, second = beams(model, rng)[0], beams(model, rng)[0]
    # Equal solid angles hold equal numbers: the sine of the elevation is uniform.
    counts = np.histogram(first[:, 2], 10, tuple(np.sin(model.elevation_span)))[0]
    assert counts.min() > 0.95 * counts.max()
    assert not np.any(np.all(np.isclose(first, second), axis=1))


def test_the_field_leaves_nothing_out_and_exact_leaves_all() -> None:
    off = (0, False, "centre")
    switched_off = {name for name in vars(FIELD) if getattr(FIELD, name) in off}
    # Noise is along the beam, a mast stands still, and rings' azimuth is a family of its own.
    assert switched_off == {"isotropic_noise", "sway", "ring_azimuth", "bend"}
    assert all(size in off for size in vars(EXACT).values())
    for name, size in vars(TYPICAL).items():
        assert size in (*off, getattr(FIELD, name)) or 0 < size < getattr(FIELD, name)
