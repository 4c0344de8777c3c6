"""What moves stands elsewhere, wet ground swallows returns, a mast sways about its pose."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.sensors import find_sensor
from retropole.simulation import (
    EXACT,
    Box,
    Material,
    Rectangle,
    Surface,
    record_again,
    scan,
    simulate_pair,
)
from retropole.simulation.environment import KEPT_FREE, WALK, Mover, Sway, draw_movers, wet_loss
from tests.simulation.rooms import HALF, X, Y, ranges_and_rays, scan_room, walls
from tests.simulation.surfaces import distance_from

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
