"""Poles in recordings look as if they had stood there when the recordings were made."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.insertion import InsertedPair, insert_into_site, insert_poles, standing
from benchmarks.insertion.standing import CLEARANCE, MAX_LEAN, MIN_RETURNS, POLE_DISTANCES
from retropole.base import se3
from retropole.base.datatypes import Array, IntArray, PointCloud
from retropole.base.sensors import Sensor, find_sensor
from retropole.io import read_cloud
from retropole.simulation import (
    EXACT,
    Box,
    Cylinder,
    LabelledScan,
    Material,
    Rectangle,
    SimulationError,
    Surface,
    scan,
)
from retropole.simulation.pairs import MIN_RINGS
from retropole.simulation.recorded import levels, recorded_beams, sharpest_axis
from retropole.simulation.scenes import FOOT_HEIGHT, POLE_SPACING, TAPE
from tests.paths import SHARED

pytestmark = pytest.mark.full

WALL = Material(0.5)
ROOM: list[Surface] = [
    Rectangle(np.array([0, 0, z]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), (15, 15), WALL)
    for z in (-1.5, 3.0)
]
ROOM += [
    Rectangle(np.array(middle), np.array(along), np.array([0, 0, 1.0]), (15, 4), WALL)
    for middle, along in (
        ([15.0, 0, 0], [0, 1.0, 0]),
        ([-15.0, 0, 0], [0, 1.0, 0]),
        ([0, 15.0, 0], [1.0, 0, 0]),
        ([0, -15.0, 0], [1.0, 0, 0]),
    )
]
"""Floor at −1.5 m, ceiling and four walls: every beam returns."""

WINDOW: list[Surface] = [
    Rectangle(np.array([15.0, y, 0]), np.array([0, 1.0, 0]), np.array([0, 0, 1.0]), (7, 4), WALL)
    for y in (-10.0, 10.0)
]
"""The first wall with a gap of 6 m in its middle."""

LEANING = np.array([0.1, 0.3, 1.0]) / np.linalg.norm([0.1, 0.3, 1.0])
POLES = (
    Cylinder(np.array([5.0, 0.4, -0.3]), np.array([0, 0, 1.0]), 0.02, 2.2, TAPE),
    Cylinder(np.array([6.0, -1.1, -0.35]), LEANING, 0.02, 2.1, TAPE),
)
T = se3.from_rt(np.eye(3), np.array([1.0, -2.0, 0.2]))


def clean(name: str) -> Sensor:
    """Give a sensor without noise whose beams have no width."""
    return replace(find_sensor(name), range_noise=0.0, divergence=0.0)


def recorded(surfaces: list[Surface], sensor: Sensor, pose: Array, seed: int = 3) -> LabelledScan:
    return scan(surfaces, sensor, pose, np.random.default_rng(seed), EXACT)


SENSORS = clean("HDL-32E"), clean("VLP-16")
POSES = np.eye(4), T


def recordings(surfaces: list[Surface], poses: tuple[Array, Array] = POSES) -> list[PointCloud]:
    """Record a target and a source."""
    return [recorded(surfaces, s, pose).cloud for s, pose in zip(SENSORS, poses, strict=True)]


@cache
def room() -> tuple[PointCloud, PointCloud]:
    target, source = recordings(ROOM)
    return target, source


def inserted(seed: int = 0, tape_offset: float = 0.0, ring_bias: float = 0.0) -> InsertedPair:
    """Put the poles into recordings without other error."""
    return insert_poles(
        *room(),
        T,
        np.random.default_rng(seed),
        sensors=SENSORS,
        poles=POLES,
        tape_offset=tape_offset,
        ring_bias=ring_bias,
    )


def test_where_every_beam_returns_it_is_as_if_scanned_with_the_poles() -> None:
    pair = inserted()
    made = zip((pair.target, pair.source), pair.labels, SENSORS, POSES, strict=True)
    for k, (cloud, labels, sensor, pose) in enumerate(made):
        direct = recorded([*ROOM, *POLES], sensor, pose)
        np.testing.assert_allclose(cloud.xyz, direct.cloud.xyz, atol=1e-9)
        on_pole = np.where(direct.labels >= len(ROOM), direct.labels - len(ROOM), -1)
        np.testing.assert_array_equal(labels, on_pole)
        counts = [int(np.count_nonzero(on_pole == pole)) for pole in range(2)]
        assert min(counts) > 8
        assert [returns[k] for returns in pair.returns_on_poles] == counts


@pytest.mark.parametrize("has_rings", [True, False])
def test_beams_without_a_return_are_put_back(has_rings: bool) -> None:
    surfaces = [*WINDOW, *ROOM[3:], *ROOM[:2]]
    clouds = recordings(surfaces)
    if not has_rings:
        clouds = [replace(cloud, ring=None) for cloud in clouds]
    pair = insert_poles(
        clouds[0],
        clouds[1],
        T,
        np.random.default_rng(0),
        sensors=SENSORS,
        poles=POLES,
        tape_offset=0.0,
        ring_bias=0.0,
    )
    made = zip((pair.target, pair.source), clouds, pair.labels, SENSORS, POSES, strict=True)
    for cloud, before, labels, sensor, pose in made:
        assert len(cloud) > len(before)
        direct = recorded([*surfaces, *POLES], sensor, pose)
        for pole in range(2):
            ours = cloud.xyz[labels == pole]
            theirs = direct.cloud.xyz[direct.labels == len(surfaces) + pole]
            assert len(ours) == len(theirs)
            order = [np.lexsort(points.round(6).T) for points in (ours, theirs)]
            np.testing.assert_allclose(ours[order[0]], theirs[order[1]], atol=1e-6)


def test_all_but_the_poles_stays_and_nothing_is_left_behind_them() -> None:
    pair, without = inserted(), room()[0]
    cloud, labels = pair.target, pair.labels[0]
    kept = labels[: len(without)] < 0
    assert kept.mean() > 0.99
    for name in ("xyz", "intensity", "ring", "time"):
        after, before = getattr(cloud, name), getattr(without, name)
        np.testing.assert_array_equal(after[: len(before)][kept], before[kept])
    rays = cloud.xyz / np.linalg.norm(cloud.xyz, axis=1)[:, None]
    for pole in POLES:
        hit = pole.intersect(np.zeros(3), rays, 0.0).ranges
        assert np.all(np.linalg.norm(cloud.xyz, axis=1) < hit + 1e-9)


def test_beams_keep_their_directions_from_any_origin() -> None:
    origin = np.array([0.4, -0.2, 0.3])
    scanned = recorded(ROOM, SENSORS[0], se3.from_rt(np.eye(3), origin)).cloud
    cloud = replace(scanned, xyz=scanned.xyz + origin, origin=origin)
    other = room()[1]
    made = insert_poles(cloud, other, T, np.random.default_rng(0), sensors=SENSORS, poles=POLES)
    before, after = (
        (xyz - origin) / np.linalg.norm(xyz - origin, axis=1)[:, None]
        for xyz in (cloud.xyz, made.target.xyz[: len(cloud)])
    )
    np.testing.assert_allclose(after, before, atol=1e-12)
    assert np.count_nonzero(made.labels[0] >= 0) > 50


def residuals(pair: InsertedPair, exact: InsertedPair, which: int) -> tuple[Array, IntArray]:
    """Errors (N,) of the ranges on the poles, and the rings (N,)."""
    labels = pair.labels[which]
    clouds = [(p.target, p.source)[which] for p in (pair, exact)]
    ranges = [np.linalg.norm(c.xyz[labels >= 0], axis=1) for c in clouds]
    assert clouds[0].ring is not None
    return ranges[0] - ranges[1], clouds[0].ring[labels >= 0]


def test_all_tape_shares_one_offset_and_each_ring_one_bias() -> None:
    exact = inserted()
    shared = [inserted(seed, tape_offset=0.05) for seed in range(40)]
    offsets = np.array([[residuals(p, exact, k)[0].mean() for k in (0, 1)] for p in shared])
    spread = np.ptp(residuals(shared[0], exact, 0)[0])
    assert spread < 1e-9
    assert 0.038 < offsets.std() < 0.064
    assert abs(np.corrcoef(offsets.T)[0, 1]) < 0.5
    off, rings = residuals(inserted(ring_bias=0.05), exact, 0)
    means = np.array([off[rings == ring].mean() for ring in np.unique(rings)])
    assert max(np.ptp(off[rings == ring]) for ring in np.unique(rings)) < 1e-9
    assert 0.035 < means.std() < 0.065


def test_a_lidar_errs_on_tape_alike_in_all_placements_and_each_has_its_own_poles() -> None:
    target, source = room()
    made = insert_into_site(
        (target, source, target),
        (np.eye(4), T, np.eye(4)),
        np.random.default_rng(4),
        sensors=(*SENSORS, SENSORS[0]),
        poles=(POLES, POLES, POLES[:1]),
        tape_offset=0.5,
        ring_bias=0.0,
    )
    assert [len(clouds) for clouds in made.clouds] == [3, 3, 3]
    exact = inserted()
    offsets = []
    for k in range(3):
        true = (exact.target, exact.source, exact.target)[k]
        longer = []
        for cloud, labels in zip(made.clouds[k][:2], made.labels[k][:2], strict=True):
            on = labels >= 0
            ranges = (np.linalg.norm(each.xyz[on], axis=1) for each in (cloud, true))
            longer.append(float(np.median(np.subtract(*ranges))))
        assert abs(longer[0] - longer[1]) < 0.01
        offsets.append(longer[0])
        assert set(np.unique(made.labels[k][2])) == {-1, 0}
    # The same model is another device with another offset.
    assert abs(offsets[0] - offsets[2]) > 0.05


def test_noise_is_the_sensors_and_1_cm_of_unknown_ones() -> None:
    exact = inserted()
    for sensor, sigma in ((replace(SENSORS[0], range_noise=0.03), 0.03), (None, 0.01)):
        rng = np.random.default_rng(1)
        made = insert_poles(
            *room(), T, rng, sensors=(sensor, None), poles=POLES, tape_offset=0, ring_bias=0
        )
        on_both = (made.labels[0] >= 0) & (exact.labels[0] >= 0)
        # Where a beam of some width meets only the edge its range is another.
        off = np.linalg.norm(made.target.xyz, axis=1) - np.linalg.norm(exact.target.xyz, axis=1)
        assert 0.8 * sigma < off[on_both].std() < 1.25 * sigma


def tape(cloud: PointCloud, sensor: Sensor | None) -> tuple[Array, Array]:
    """Intensities on the poles, and all others, of a target."""
    source = room()[1]
    rng = np.random.default_rng(0)
    made = insert_poles(cloud, source, T, rng, sensors=(sensor, None), poles=POLES)
    assert made.target.intensity is not None
    on_pole = made.labels[0] >= 0
    return made.target.intensity[on_pole], made.target.intensity[~on_pole]


def test_tape_saturates_on_the_scale_of_the_recording() -> None:
    cloud = room()[0]
    assert cloud.intensity is not None
    bright, rest = tape(cloud, SENSORS[0])
    assert 230 <= bright.min() < bright.max() <= 255
    assert rest.max() < 230
    bright, _ = tape(replace(cloud, intensity=cloud.intensity / 255), SENSORS[0])
    assert 230 / 255 - 1e-9 <= bright.min() < bright.max() <= 1
    bright, rest = tape(replace(cloud, intensity=cloud.intensity * 100), None)
    assert 0.8 * rest.max() <= bright.min() < bright.max() <= rest.max()
    bright, rest = tape(replace(cloud, intensity=None), None)
    assert rest.max() == 0
    assert 200 <= bright.min() < bright.max() <= 255


FURNITURE: list[Surface] = [
    Box(np.array([x, y, -0.9]), np.eye(3), np.array([0.6, 0.5, 0.6]), WALL)
    for x, y in ((5.0, 2.0), (-4.0, 3.0), (3.0, -6.0), (-5.0, -5.0))
]


@pytest.mark.parametrize("tilt", [0.0, 1.0])
def test_poles_that_are_drawn_stand_free_on_the_ground_in_sight_of_both(tilt: float) -> None:
    turned = se3.exp_so3(np.array([0.3 * tilt, tilt, -0.2 * tilt]))
    target_pose, source_pose = se3.from_rt(turned, np.zeros(3)), T
    target, source = recordings([*ROOM, *FURNITURE], (target_pose, source_pose))
    reference = se3.inverse(target_pose) @ source_pose
    for seed in range(6):
        made = insert_poles(
            target,
            source,
            reference,
            np.random.default_rng(seed),
            sensors=SENSORS,
            up=turned.T[:, 2],
        )
        assert np.min(made.returns_on_poles) >= MIN_RETURNS
        for cloud, labels in zip((made.target, made.source), made.labels, strict=True):
            assert cloud.ring is not None
            assert min(len(np.unique(cloud.ring[labels == k])) for k in range(2)) >= MIN_RINGS
        axes = [turned @ pole.axis for pole in made.poles]
        assert abs(axes[0] @ axes[1]) < np.cos(np.radians(15.0))
        feet = [turned @ p.centre - p.length / 2 * a for p, a in zip(made.poles, axes, strict=True)]
        assert POLE_SPACING[0] <= np.linalg.norm((feet[0] - feet[1])[:2]) <= POLE_SPACING[1]
        for pole, axis, foot in zip(made.poles, axes, feet, strict=True):
            assert axis[2] >= np.cos(MAX_LEAN) - 1e-9
            assert abs(foot[2] - FOOT_HEIGHT - -1.5) < 0.01
            for origin in (np.zeros(3), T[:3, 3]):
                away = np.linalg.norm((foot - origin)[:2])
                assert POLE_DISTANCES[0] - 1e-9 <= away <= POLE_DISTANCES[1] + 1e-9
            for box in FURNITURE:
                along = foot + np.linspace(0, pole.length, 50)[:, None] * axis
                inside = np.abs(along - box.centre) < np.array([0.6, 0.5, 0.6]) + CLEARANCE / 2
                assert not inside.all(axis=1).any()


def test_equal_seeds_give_equal_pairs() -> None:
    made = [insert_poles(*room(), T, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(made[0].target.xyz, made[1].target.xyz)
    assert not np.array_equal(made[0].labels[0], made[2].labels[0])


def test_without_ground_there_is_no_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(standing, "MAX_DRAWS", 50)
    target, source = recordings(ROOM[2:])
    with pytest.raises(SimulationError, match="50 draws gave no 2 poles"):
        insert_poles(target, source, T, np.random.default_rng(0))


@pytest.mark.parametrize("width_deg", [20.0, 70.0])
def test_a_gap_is_filled_unless_it_is_wide(width_deg: float) -> None:
    cloud = replace(room()[0], ring=None)
    azimuth = np.degrees(np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0]))
    gap = np.abs(azimuth) < width_deg / 2
    beams = recorded_beams(cloud.select(~gap))
    missing = beams.directions[np.isinf(beams.ranges)]
    if width_deg > 45:
        assert len(missing) == 0
        return
    lost = cloud.xyz[gap] / np.linalg.norm(cloud.xyz[gap], axis=1)[:, None]
    order = [np.lexsort(np.round(d, 6).T) for d in (missing, lost)]
    np.testing.assert_allclose(missing[order[0]], lost[order[1]], atol=1e-6)
    assert np.array_equal(np.unique(beams.rings), np.arange(32))


def test_rings_are_found_about_a_tilted_axis_and_none_in_a_raster() -> None:
    turned = se3.exp_so3(np.radians([1.3, -0.7, 40.0]))
    cloud = room()[0]
    directions = cloud.xyz @ turned.T / np.linalg.norm(cloud.xyz, axis=1)[:, None]
    axis = sharpest_axis(directions)
    assert np.degrees(np.arccos(axis @ turned[:, 2])) < 0.02
    np.testing.assert_array_equal(levels(directions @ axis), cloud.ring)
    scattered = np.random.default_rng(0).uniform(-0.2, 0.2, 30_000)
    assert set(levels(scattered)) == {-1}


def test_poles_in_a_real_recording() -> None:
    folder = SHARED / "pandar_scene1"
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}")
    cloud = read_cloud(folder / "p64.pcd")
    beams = recorded_beams(cloud)
    own = beams.rings[: len(cloud)]
    assert np.array_equal(np.unique(own), np.arange(64))
    # It turns by 0.2° from beam to beam; the sky takes a part of them.
    assert 0.9 * 64 * 1800 < len(beams.ranges) <= 64 * 1800 + 64
    made = insert_poles(cloud, cloud, np.eye(4), np.random.default_rng(0))
    assert np.min(made.returns_on_poles) >= MIN_RETURNS
    changed = np.any(made.target.xyz[: len(cloud)] != cloud.xyz, axis=1)
    np.testing.assert_array_equal(changed, made.labels[0][: len(cloud)] >= 0)
