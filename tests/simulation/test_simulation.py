"""Ray casting against surfaces it does not know the inside of, and scans against their truth."""

import json
from pathlib import Path

import numpy as np
import pytest
from pypcd4 import PointCloud as OtherReader

from retropole import se3
from retropole.datatypes import Array
from retropole.errors import UsageError
from retropole.io import read_cloud
from retropole.sensors import SENSORS, find_sensor
from retropole.simulation import (
    EXACT,
    SCENES,
    TYPICAL,
    Box,
    Cylinder,
    Material,
    NoiseModel,
    Rectangle,
    SimulationError,
    scan,
    simulate_pair,
    write_pair,
)
from retropole.simulation.paper import draw_poles, lidar_poses
from retropole.simulation.raycast import Surface, cast
from retropole.simulation.scenes import SURROUNDINGS

DIFFUSE = Material()


def turned(rng: np.random.Generator) -> Array:
    return se3.random(rng)[:3, :3]


def distance_from(surface: Surface, points: Array) -> Array:
    """Distance of points (N, 3) from a surface, by another road than the ray caster's."""
    if isinstance(surface, Cylinder):
        rel = points - surface.centre
        along = rel @ surface.axis
        radial = np.linalg.norm(np.cross(rel, surface.axis), axis=1) - surface.radius
        beyond = np.maximum(np.abs(along) - surface.length / 2, 0)
        return np.asarray(np.hypot(radial, beyond))
    if isinstance(surface, Rectangle):
        rel = points - surface.centre
        inside = np.stack(
            [
                np.clip(rel @ surface.u, -surface.half[0], surface.half[0]),
                np.clip(rel @ surface.v, -surface.half[1], surface.half[1]),
            ],
            axis=1,
        )
        return np.asarray(
            np.linalg.norm(rel - inside[:, :1] * surface.u - inside[:, 1:] * surface.v, axis=1)
        )
    rel = (points - surface.centre) @ surface.axes
    outside = np.abs(rel) - surface.half
    return np.asarray(
        np.abs(np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0))
    )


def a_surface(kind: str, rng: np.random.Generator) -> Surface:
    R, centre = turned(rng), rng.uniform(-1, 1, 3) + np.array([6.0, 0.0, 0.0])
    if kind == "cylinder":
        return Cylinder(centre, R[:, 0], 0.4, 2.0, DIFFUSE)
    if kind == "rectangle":
        return Rectangle(centre, R[:, 0], R[:, 1], (1.5, 0.8), DIFFUSE)
    return Box(centre, R, np.array([0.7, 1.1, 0.4]), DIFFUSE)


@pytest.mark.parametrize("kind", ["cylinder", "rectangle", "box"])
@pytest.mark.parametrize("seed", range(5))
def test_rays_end_on_the_surface_and_nowhere_before(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    surface = a_surface(kind, rng)
    rays = np.array([1.0, 0.0, 0.0]) + rng.uniform(-0.4, 0.4, (4000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origin = rng.uniform(-0.5, 0.5, 3)
    hits = cast(origin, rays, [surface])
    hit = np.isfinite(hits.ranges)
    assert 50 < hit.sum() < 3950
    points = origin + hits.ranges[hit, None] * rays[hit]
    assert distance_from(surface, points).max() < 1e-9
    # March along the rays: none that is said to miss comes near, none hits before its range.
    steps = np.linspace(0.05, 12.0, 1500)
    for row in rng.permutation(len(rays))[:60]:
        path = origin + steps[:, None] * rays[row]
        near = distance_from(surface, path)
        before = steps < hits.ranges[row] - 0.02
        if kind == "cylinder":
            # Open at its ends: the march sees the far wall through them, the caster does not.
            inside = np.linalg.norm(np.cross(path - surface.centre, surface.axis), axis=1)
            before &= inside > surface.radius
        assert near[before].min(initial=1.0) > 1e-6


@pytest.mark.parametrize("kind", ["cylinder", "rectangle", "box"])
def test_casting_does_not_depend_on_the_frame(kind: str) -> None:
    rng = np.random.default_rng(7)
    surface, T = a_surface(kind, rng), se3.random(rng)
    rays = np.array([1.0, 0.0, 0.0]) + rng.uniform(-0.6, 0.6, (2000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    R, centre = T[:3, :3], se3.apply(T, surface.centre[None])[0]
    if isinstance(surface, Cylinder):
        moved: Surface = Cylinder(centre, R @ surface.axis, surface.radius, 2.0, DIFFUSE)
    elif isinstance(surface, Rectangle):
        moved = Rectangle(centre, R @ surface.u, R @ surface.v, surface.half, DIFFUSE)
    else:
        moved = Box(centre, R @ surface.axes, surface.half, DIFFUSE)
    here = cast(np.zeros(3), rays, [surface])
    there = cast(T[:3, 3], rays @ R.T, [moved])
    np.testing.assert_allclose(there.ranges, here.ranges, atol=1e-9)
    np.testing.assert_allclose(there.cosine, here.cosine, atol=1e-9)


def test_the_nearest_surface_wins() -> None:
    walls: list[Surface] = [
        Rectangle(np.array([x, 0.0, 0.0]), np.eye(3)[1], np.eye(3)[2], (9.0, 9.0), DIFFUSE)
        for x in (5.0, 3.0, 4.0)
    ]
    hits = cast(np.zeros(3), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), walls)
    assert hits.surface.tolist() == [1, -1]
    assert hits.ranges.tolist() == [3.0, np.inf]


@pytest.mark.parametrize("scene", SCENES)
def test_exact_scans_lie_on_their_surfaces(scene: str) -> None:
    pair = simulate_pair(scene, np.random.default_rng(2), nuisances=EXACT)
    for cloud, labels, T in (
        (pair.target, pair.labels[0], pair.T_world_target),
        (pair.source, pair.labels[1], pair.T_world_source),
    ):
        world = se3.apply(T, cloud.xyz)
        for k, surface in enumerate(pair.surfaces):
            on_it = world[labels == k]
            assert distance_from(surface, on_it).max(initial=0.0) < 1e-8
    np.testing.assert_allclose(
        pair.T_world_target @ pair.T_target_source, pair.T_world_source, atol=1e-12
    )


@pytest.mark.parametrize("scene", sorted(SURROUNDINGS))
def test_scenes_are_what_was_asked_for(scene: str) -> None:
    for seed in range(5):
        pair = simulate_pair(scene, np.random.default_rng(seed), poles=3)
        axes = np.array([pole.axis for pole in pair.poles])
        i, j = np.triu_indices(3, 1)
        angles = np.arccos(np.abs(np.sum(axes[i] * axes[j], axis=1)))
        assert angles.min() >= np.radians(15)
        assert min(min(counts) for counts in pair.returns_on_poles) >= 6


def test_equal_generators_give_equal_pairs() -> None:
    one, two = (simulate_pair("street", np.random.default_rng(4)) for _ in range(2))
    np.testing.assert_array_equal(one.target.xyz, two.target.xyz)
    np.testing.assert_array_equal(one.T_target_source, two.T_target_source)
    other = simulate_pair("street", np.random.default_rng(5))
    assert not np.array_equal(one.T_target_source, other.T_target_source)


def wall_scan(nuisances: NoiseModel, *, retro: bool = False, frames: int = 1) -> Array:
    """Range errors of a scan of four walls around, in metres."""
    rng = np.random.default_rng(3)
    sensor, x_y_z, paint = find_sensor("VLP-16"), np.eye(3), Material(0.5, retro)
    walls: list[Surface] = [
        Rectangle(8.0 * sign * x_y_z[axis], x_y_z[1 - axis], x_y_z[2], (8.0, 8.0), paint)
        for sign in (-1, 1)
        for axis in (0, 1)
    ]
    cloud = scan(walls, sensor, np.eye(4), rng, nuisances, frames).cloud
    ranges = np.linalg.norm(cloud.xyz, axis=1)
    across = np.abs(cloud.xyz[:, :2]).max(axis=1)
    return np.asarray((across - 8.0) * ranges / across)


def test_noise_is_what_it_says() -> None:
    noise = find_sensor("VLP-16").range_noise
    quiet = NoiseModel(0.0, 0.0, 0.0, False, 0.0, 0.0, 0.0)
    assert np.abs(wall_scan(quiet)).max() < 1e-9
    along = wall_scan(NoiseModel(1.0, 0.0, 0.0, False, 0.0, 0.0, 0.0))
    assert along.std() == pytest.approx(noise, rel=0.03)
    assert abs(along.mean()) < 4 * noise / np.sqrt(len(along))
    dropped = wall_scan(NoiseModel(0.0, 0.0, 0.3, False, 0.0, 0.0, 0.0))
    assert len(dropped) == pytest.approx(0.7 * len(wall_scan(quiet)), rel=0.02)
    biased = wall_scan(NoiseModel(0.0, 0.0, 0.0, False, 0.0, 0.02, 0.0), retro=True)
    assert biased.std() < 1e-9
    assert 0 < abs(biased.mean()) < 0.1
    assert np.abs(wall_scan(NoiseModel(0, 0, 0, False, 0, 0.02, 0))).max() < 1e-9


def test_frames_add_up() -> None:
    assert len(wall_scan(EXACT, frames=3)) == 3 * len(wall_scan(EXACT))
    pair = simulate_pair("street", np.random.default_rng(1), frames=3)
    assert pair.target.frame is not None
    assert np.unique(pair.target.frame).tolist() == [0, 1, 2]


def test_wide_beams_return_from_near_misses() -> None:
    counts = [
        simulate_pair(
            "paper", np.random.default_rng(6), nuisances=NoiseModel(0, 0, 0, wide, 0, 0, 0)
        ).returns_on_poles
        for wide in (False, True)
    ]
    assert np.all(np.array(counts[1]) > np.array(counts[0]))


def test_a_rosette_fills_its_field_of_view_and_goes_on() -> None:
    pair = simulate_pair("bare", np.random.default_rng(1), sensor_source="Mid-360", frames=20)
    elevation = np.arcsin(pair.source.xyz[:, 2] / np.linalg.norm(pair.source.xyz, axis=1))
    low, high = SENSORS["Mid-360"].elevation_span
    assert elevation.min() >= low - 0.01
    assert elevation.max() <= high + 0.01
    assert pair.source.ring is None


def test_the_papers_set_up() -> None:
    (a, b), rng = lidar_poses(), np.random.default_rng(0)
    np.testing.assert_allclose(a[:3, 3], [1, -1, 0])
    np.testing.assert_allclose(b[:3, 3], [1, 1, 0])
    for _ in range(50):
        first, second = draw_poles(rng)
        for pole in (first, second):
            assert pole.axis[2] > 0.9
            assert pole.centre[2] == 0
            assert 2 <= np.linalg.norm(pole.centre) <= 3
        assert 1.5 <= np.linalg.norm(first.centre - second.centre) <= 4
    pair = simulate_pair("paper", rng)
    np.testing.assert_allclose(pair.T_target_source, se3.inverse(a) @ b, atol=1e-12)


def test_what_is_written_reads_back_here_and_elsewhere(tmp_path: Path) -> None:
    pair = simulate_pair("corridor", np.random.default_rng(1))
    write_pair(pair, tmp_path)
    truth = json.loads((tmp_path / "truth.json").read_text())
    np.testing.assert_array_equal(truth["T_target_source"], pair.T_target_source)
    for name, cloud in (("lidar0.pcd", pair.target), ("lidar1.pcd", pair.source)):
        ours = read_cloud(tmp_path / name)
        theirs = OtherReader.from_path(tmp_path / name)
        np.testing.assert_allclose(ours.xyz, cloud.xyz, atol=1e-5)
        np.testing.assert_array_equal(ours.xyz, theirs.numpy(("x", "y", "z")).astype(float))
        np.testing.assert_array_equal(ours.intensity, theirs.numpy(("intensity",))[:, 0])


def test_impossible_demands_are_named() -> None:
    with pytest.raises(UsageError, match="street"):
        simulate_pair("moon", np.random.default_rng(0))
    with pytest.raises(UsageError, match="no sensor"):
        simulate_pair("street", np.random.default_rng(0), sensor_target="eye")
    with pytest.raises(SimulationError, match="2 poles"):
        simulate_pair("street", np.random.default_rng(0), min_pole_angle=float(np.radians(80)))


def test_typical_is_not_exact() -> None:
    assert TYPICAL != EXACT
    assert TYPICAL.retro_bias > 0
