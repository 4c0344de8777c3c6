"""Scans of walls at known distances: noise is what the model states, intensities stay apart."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.again import record_again
from retropole.base import se3
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
    scan,
    simulate_pair,
)
from retropole.simulation.scanning import (
    KEPT_FREE,
    WALK,
    LabelledScan,
    Mover,
    Sway,
    draw_movers,
    sweeps,
    wet_loss,
)
from tests.simulation.rooms import HALF, X, Y, ranges_and_rays, scan_room, walls
from tests.simulation.surfaces import distance_from


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


@pytest.mark.full
def test_without_noise_every_return_lies_on_its_surface() -> None:
    assert np.abs(range_errors(EXACT)).max() < 1e-9


@pytest.mark.full
def test_noise_along_the_beam_is_the_sensors() -> None:
    sigma = find_sensor("VLP-16").range_noise
    along = range_errors(replace(EXACT, range_noise=1.0))
    assert along.std() == pytest.approx(sigma, rel=0.03)
    assert abs(along.mean()) < 4 * sigma / np.sqrt(len(along))


@pytest.mark.full
def test_dropout_is_the_share_of_lost_returns() -> None:
    dropped = range_errors(replace(EXACT, dropout=0.3))
    assert len(dropped) == pytest.approx(0.7 * len(range_errors(EXACT)), rel=0.02)


@pytest.mark.full
def test_a_retro_bias_is_common_to_all_tape_and_to_nothing_else() -> None:
    biased = replace(EXACT, retro_bias=0.02)
    tape = range_errors(biased, retro=True)
    assert tape.std() < 1e-9
    assert 0 < abs(tape.mean()) < 0.1
    assert np.abs(range_errors(biased)).max() < 1e-9


@pytest.mark.full
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


@pytest.mark.full
def test_frames_add_up() -> None:
    assert len(range_errors(EXACT, frames=3)) == 3 * len(range_errors(EXACT))
    cloud = scan_walls(EXACT, frames=3).cloud
    assert cloud.frame is not None
    assert np.unique(cloud.frame).tolist() == [0, 1, 2]
    assert scan_walls(EXACT).cloud.frame is None


@pytest.mark.full
@pytest.mark.parametrize("sensor", list(SENSORS))
def test_the_threshold_separates_tape_from_diffuse_returns(sensor: str) -> None:
    threshold = find_sensor(sensor).threshold
    diffuse = scan_walls(TYPICAL, sensor=sensor).cloud.intensity
    tape = scan_walls(TYPICAL, sensor=sensor, retro=True).cloud.intensity
    assert diffuse is not None
    assert tape is not None
    assert diffuse.max() < threshold < tape.min()
    assert tape.max() <= find_sensor(sensor).intensity_max


@pytest.mark.full
@pytest.mark.parametrize("sensor", list(SENSORS))
def test_beams_are_unit_vectors_within_the_field_of_view(sensor: str) -> None:
    model = find_sensor(sensor)
    (sent,) = sweeps(model, np.random.default_rng(0), 1)
    rays, rings, times = sent
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0)
    elevation = np.arcsin(rays[:, 2])
    low, high = model.elevation_span
    assert elevation.min() >= low - 1e-9
    assert elevation.max() <= high + 1e-9
    assert len(rays) == len(rings) == len(times) == model.points
    if model.pattern == "spinning":
        azimuth = np.arctan2(rays[:, 1], rays[:, 0])
        line = model.elevations[rings] + model.risen(azimuth)
        np.testing.assert_allclose(elevation, line, atol=1e-9)
    assert np.mean(model.has_in_view(rays, -1e-6)) > 0.998


@pytest.mark.full
def test_a_rosette_fills_its_field_of_view_and_never_repeats() -> None:
    model = find_sensor("Mid-360")
    first, second = (each.rays for each in sweeps(model, np.random.default_rng(1), 2))
    # Equal solid angles hold equal numbers: the sine of the elevation is uniform.
    counts = np.histogram(first[:, 2], 10, tuple(np.sin(model.elevation_span)))[0]
    assert counts.min() > 0.95 * counts.max()
    assert not np.any(np.all(np.isclose(first, second), axis=1))
    # It continues: two sweeps cover the field as one sequence of twice the length does.
    longer = replace(model, points=2 * model.points)
    (both,) = sweeps(longer, np.random.default_rng(1), 1)
    np.testing.assert_allclose(np.concatenate([first, second]), both.rays)


@pytest.mark.parametrize("name", ["Avia", "HAP"])
def test_a_rosette_with_a_limited_view_covers_it_evenly(name: str) -> None:
    model = find_sensor(name)
    (sent,) = sweeps(model, np.random.default_rng(1), 1)
    azimuth = np.arctan2(sent.rays[:, 1], sent.rays[:, 0]) / (model.turn / 2)
    elevation = np.arcsin(sent.rays[:, 2]) / model.elevation_span[1]
    assert np.abs([azimuth.min(), azimuth.max()]) == pytest.approx(1.0, abs=0.01)
    assert (np.hypot(azimuth, elevation).max() < 1.001) == model.is_round
    quarters = np.histogram2d(azimuth, elevation, (2, 2))[0]
    assert quarters.min() > 0.97 * quarters.max()


def test_lines_start_and_end_with_the_field_and_rise() -> None:
    model = replace(find_sensor("XT32"), azimuth_span=(-1.0, 0.5), rise=np.array([0.1, 0.0, 0.05]))
    (sent,) = sweeps(model, np.random.default_rng(1), 1)
    azimuth = np.arctan2(sent.rays[:, 1], sent.rays[:, 0])
    assert azimuth.min() >= -1.0
    assert azimuth.max() <= 0.5 + model.azimuth_step
    lowest = np.arcsin(sent.rays[sent.rings == 0, 2]) - model.elevations[0]
    assert (lowest[0], lowest.min(), lowest[-1]) == pytest.approx((0.1, 0.0, 0.05), abs=2e-3)
    assert sent.times.max() < 0.1


@pytest.mark.full
def test_the_field_leaves_nothing_out_and_exact_leaves_all() -> None:
    off = (0, False, "centre")
    switched_off = {name for name in vars(FIELD) if getattr(FIELD, name) in off}
    # Noise is along the beam, a mast stands still, and rings' azimuth is a family of its own.
    of_all = {"bend", "elevation", "elevation_scale"}
    assert switched_off == {"isotropic_noise", "sway", "ring_azimuth"} | of_all
    assert all(size in off for size in vars(EXACT).values())
    for name, size in vars(TYPICAL).items():
        assert size in (*off, getattr(FIELD, name)) or 0 < size < getattr(FIELD, name)


GROUND = Rectangle(np.array([0, 0, -1.2]), X, Y, (60, 60), Material(0.2))


def test_a_mover_stands_elsewhere_in_each_sweep() -> None:
    velocity = np.array([0.0, 1.5, 0.0])
    walker = Mover(Box(np.array([5.0, -2, 0]), np.eye(3), np.full(3, 0.4), Material()), velocity)
    rng, sensor = np.random.default_rng(0), find_sensor("XT32")
    scanned = scan(walls(), sensor, np.eye(4), rng, EXACT, 5, movers=[walker], start=1.0)
    assert scanned.cloud.frame is not None
    assert set(scanned.labels) == {-1, 0, 1, 2, 3}
    on_it = scanned.labels == -1
    for k in range(5):
        own = scanned.cloud.xyz[on_it & (scanned.cloud.frame == k)]
        assert len(own) > 50
        assert distance_from(walker.at(1.0 + 0.1 * k), own).max() < 1e-9
    assert np.abs(np.abs(scanned.cloud.xyz[~on_it, :2]).max(axis=1) - HALF).max() < 1e-9


def test_people_walk_and_keep_off_the_lidars() -> None:
    rng = np.random.default_rng(1)
    lidars = [np.array([1.0, 0, 1]), np.array([-1.0, 1, 1])]
    movers = draw_movers(300, (6.0, 5.0), lidars, 5.0, rng)
    assert len(movers) > 290
    speeds = np.array([np.linalg.norm(mover.velocity) for mover in movers])
    assert speeds.max() < WALK[1]
    assert np.mean(speeds > WALK[0]) == pytest.approx(0.5, abs=0.1)
    for mover in movers:
        path = np.array([mover.at(t).centre for t in np.arange(0, 5, 0.2)])
        for at in lidars:
            assert np.linalg.norm((path - at)[:, :2], axis=1).min() > KEPT_FREE


@pytest.mark.full
def test_movers_differ_between_recordings_and_nothing_else_does() -> None:
    noise = replace(EXACT, movers=6)
    rng = np.random.default_rng(2)
    pair = simulate_pair("harbor", rng, noise=noise)
    again = record_again(pair, rng)
    passers = []
    for each in (pair, again):
        for cloud, labels, T in (
            (each.target, each.labels[0], each.T_world_target),
            (each.source, each.labels[1], each.T_world_source),
        ):
            world = se3.apply(T, cloud.xyz)
            for k, surface in enumerate(each.surfaces):
                assert distance_from(surface, world[labels == k]).max(initial=0.0) < 1e-8
            passers.append(world[labels == -1])
    counts = [len(points) for points in passers]
    assert min(counts) > 20
    assert max(counts) < 0.3 * len(pair.target)
    for other in passers[1:]:
        gaps = np.linalg.norm(passers[0][:, None, :2] - other[None, :, :2], axis=2).min(axis=1)
        assert gaps.max() > 0.5


def test_wet_ground_swallows_its_share_and_nothing_else_loses_any() -> None:
    surfaces = [GROUND, *walls()]
    dry, wet = (scan_room(replace(EXACT, wet=share), surfaces) for share in (0.0, 0.5))
    on_ground = dry.labels == 0
    assert np.count_nonzero(wet.labels > 0) == np.count_nonzero(dry.labels > 0)
    ranges = np.linalg.norm(dry.cloud.xyz[on_ground], axis=1)
    cosine = -dry.cloud.xyz[on_ground][:, 2] / ranges
    expected = wet_loss(0.5, np.full(len(cosine), 0.2), cosine)
    assert expected.max() < 0.5
    lost = np.count_nonzero(on_ground) - np.count_nonzero(wet.labels == 0)
    sigma = np.sqrt(np.sum(expected * (1 - expected)))
    assert lost == pytest.approx(expected.sum(), abs=4 * sigma)


def test_wet_loses_most_where_it_is_dark() -> None:
    chance = wet_loss(0.4, np.array([0.2, 0.2, 0.2, 0.7]), np.array([1.0, 0.5, 0.0, 0.5]))
    np.testing.assert_allclose(chance, [0.0, 0.2, 0.4, 0.0])


def test_a_mast_sways_about_its_pose() -> None:
    rng = np.random.default_rng(3)
    rays = ranges_and_rays(rng.normal(size=(20, 3)))[1]
    sway = Sway(np.array([0.6, 0.8, 0.0]), 1e-3, 0.7)
    times = np.linspace(0, 1, 1000, endpoint=False)
    turned = np.stack([sway.turn(rays, np.full(len(rays), time)) for time in times])
    np.testing.assert_allclose(np.linalg.norm(turned, axis=2), 1.0)
    np.testing.assert_allclose(turned.mean(axis=0), rays, atol=1e-6)
    across = np.linalg.norm(np.cross(sway.axis, rays), axis=1)
    off = np.linalg.norm(turned - rays, axis=2)
    np.testing.assert_allclose(off.max(axis=0), 1e-3 * across, rtol=1e-3)


@pytest.mark.full
def test_sway_has_no_mean_over_recordings_and_its_amplitude_in_each() -> None:
    amplitude = 1e-3
    noise = replace(EXACT, sway=amplitude)
    ground: list[Surface] = [GROUND]
    tilts = []
    for seed in range(150):
        xyz = scan_room(noise, ground, seed=seed).cloud.xyz
        # The tilt of the plane that the ground seems to be.
        flat = np.column_stack([xyz[:, :2], np.ones(len(xyz))])
        tilts.append(np.linalg.lstsq(flat, xyz[:, 2], rcond=None)[0][:2])
    tilt = np.array(tilts)
    # A level axis of any heading and any phase: a sine of either in each of two directions.
    assert tilt.std() == pytest.approx(amplitude / 2, rel=0.2)
    assert np.abs(tilt.mean(axis=0)).max() < 4 * tilt.std() / np.sqrt(len(tilt))


def test_a_mast_turns_about_its_foot() -> None:
    foot, rest = np.array([1.0, 2.0, 0.0]), np.array([1.0, 2.0, 5.0])
    sway = Sway(np.array([1.0, 0.0, 0.0]), 1e-3, 0.0, 0.5, foot)
    assert sway.origin(rest, 0.0) == pytest.approx(rest)
    # A quarter of a period later it leans by the amplitude.
    assert sway.origin(rest, 0.5) == pytest.approx([1.0, 1.995, 5.0], abs=1e-5)
    assert Sway(sway.axis, 1e-3, 0.0).origin(rest, 0.3) is rest
