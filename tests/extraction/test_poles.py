"""Poles are found, other bright things are not, and neither motion nor order matters."""

from dataclasses import replace

import numpy as np
import pytest

from retropole import se3
from retropole.datatypes import Array, Detection, IntArray, PointCloud
from retropole.errors import Refusal
from retropole.extraction.clustering import clusters
from retropole.extraction.poles import extract_poles
from retropole.io import read_cloud
from retropole.sensors import find_sensor
from retropole.simulation import Box, Cylinder, Material, Rectangle, Surface, scan, simulate_pair
from tests.paths import SHARED

TAPE, PAINT = Material(0.9, retro=True), Material(0.5)
X, Y, Z = np.eye(3)
GROUND = Rectangle(np.array([0, 0, -1.2]), X, Y, (30, 30), Material(0.2))


def pole(
    foot: tuple[float, float], lean: Array | None = None, radius: float = 0.02, length: float = 2.0
) -> Cylinder:
    axis = Z + (np.zeros(3) if lean is None else lean)
    axis = axis / np.linalg.norm(axis)
    return Cylinder(np.array([*foot, -1.15]) + axis * length / 2, axis, radius, length, TAPE)


def seen(
    surfaces: list[Surface],
    sensor: str = "XT32",
    seed: int = 0,
    frames: int = 1,
    **changes: object,
) -> tuple[PointCloud, IntArray]:
    """Scan a few surfaces from the origin; give the cloud, and the surface of each point."""
    model = replace(find_sensor(sensor), **changes)  # type: ignore[arg-type]
    rng = np.random.default_rng(seed)
    scanned = scan([GROUND, *surfaces], model, np.eye(4), rng, frames=frames)
    return scanned.cloud, scanned.labels - 1


def labels_of(detection: Detection, labels: IntArray) -> list[int]:
    """Surface that most points of each detected pole lie on."""
    return [int(np.bincount(labels[pole.index] + 1).argmax()) - 1 for pole in detection.poles]


def codes(detection: Detection) -> set[str]:
    return {cluster.code for cluster in detection.rejected}


@pytest.mark.parametrize("sensor", ["VLP-16", "HDL-32E", "XT32", "OS1", "Pandar64", "Mid-360"])
@pytest.mark.parametrize("radius", [0.02, 0.05])
def test_standing_and_leaning_poles_are_found(sensor: str, radius: float) -> None:
    poles = [pole((4, 0.7), radius=radius), pole((4.5, -1), 0.5 * Y + 0.2 * X, radius)]
    # A sensor that does not repeat its scan needs a second to put as many returns on a pole.
    cloud, labels = seen(list(poles), sensor, frames=10 if sensor == "Mid-360" else 1)
    found = extract_poles(cloud, radius=radius)
    assert sorted(labels_of(found, labels)) == [0, 1]
    for detected, label in zip(found.poles, labels_of(found, labels), strict=True):
        truth = poles[label]
        assert np.mean(labels[detected.index] == label) > 0.95
        assert np.linalg.norm(np.cross(detected.direction, truth.axis)) < np.sin(np.radians(2))
        offset = detected.point - truth.centre
        gap = np.linalg.norm(offset - (offset @ truth.axis) * truth.axis)
        assert gap < radius + 0.02, "points lie on the surface"
        np.testing.assert_allclose(detected.point, cloud.xyz[detected.index].mean(axis=0))
        np.testing.assert_array_equal(detected.xyz, cloud.xyz[detected.index])
        assert np.linalg.norm(detected.direction) == pytest.approx(1)


def test_best_supported_pole_comes_first() -> None:
    cloud, _ = seen([pole((7, 1)), pole((3, -1), 0.3 * Y)])
    counts = [len(p.index) for p in extract_poles(cloud).poles]
    assert len(counts) == 2
    assert counts == sorted(counts, reverse=True)


@pytest.mark.parametrize("columns", [2, 3])
@pytest.mark.parametrize("with_rings", [True, False])
def test_two_points_on_three_rings_at_5_m_make_a_pole(columns: int, with_rings: bool) -> None:
    cloud, labels = seen([pole((5, 0), 0.2 * Y)], "VLP-16", seed=3)
    assert cloud.ring is not None
    on_it = labels == 0
    rings = np.unique(cloud.ring[on_it])[2:5]
    kept = [np.flatnonzero(on_it & (cloud.ring == ring))[:columns] for ring in rings]
    assert [len(k) for k in kept] == [columns] * 3
    few = cloud.select(np.sort(np.r_[np.flatnonzero(~on_it), np.concatenate(kept)]))
    if not with_rings:
        few = replace(few, ring=None)
    found = extract_poles(few, sensor=find_sensor("VLP-16"))
    assert [len(p.index) for p in found.poles] == [3 * columns]
    assert found.poles[0].rings >= 3


@pytest.mark.parametrize("lean", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("sensor", ["VLP-16", "XT32", "OS1"])
def test_crossing_poles_are_two(lean: float, sensor: str) -> None:
    cloud, labels = seen([pole((4, -lean), lean * Y), pole((4.1, lean), -lean * Y)], sensor)
    found = extract_poles(cloud)
    assert sorted(labels_of(found, labels)) == [0, 1]
    for detected, label in zip(found.poles, labels_of(found, labels), strict=True):
        assert np.mean(labels[detected.index] == label) > 0.8


@pytest.mark.parametrize("gap", [0.25, 0.5])
def test_poles_near_each_other_are_two(gap: float) -> None:
    cloud, labels = seen([pole((4, 0)), pole((4, gap), 0.35 * Y)])
    assert sorted(labels_of(extract_poles(cloud), labels)) == [0, 1]


@pytest.mark.parametrize("aside", [0.0, 0.12, 0.3])
@pytest.mark.parametrize("sensor", ["VLP-16", "XT32", "OS1"])
def test_vest_at_a_pole_does_not_hide_it(aside: float, sensor: str) -> None:
    person = [
        Box(np.array([4.2, 0.25 + aside, -0.35]), np.eye(3), np.array([0.12, 0.22, 0.85]), PAINT),
        *(
            Box(np.array([4.2, 0.25 + aside, z]), np.eye(3), np.array([0.14, 0.24, 0.025]), TAPE)
            for z in (-0.15, 0.1)
        ),
    ]
    cloud, labels = seen([pole((4, 0)), *person], sensor)
    found = extract_poles(cloud)
    assert labels_of(found, labels) == [0]
    assert np.mean(labels[found.poles[0].index] == 0) > 0.8


def test_half_hidden_pole_is_one() -> None:
    bar = Box(np.array([3.5, 0, -0.1]), np.eye(3), np.array([0.02, 1.0, 0.25]), PAINT)
    cloud, labels = seen([pole((4, 0), 0.2 * Y), bar])
    found = extract_poles(cloud)
    assert labels_of(found, labels) == [0]
    assert found.poles[0].length > 1.0


@pytest.mark.parametrize("distance", [0.15, 0.4])
def test_wall_behind_a_pole_does_not_hide_it(distance: float) -> None:
    wall = Rectangle(np.array([4 + distance, 0, 0]), Y, Z, (4, 2), PAINT)
    cloud, labels = seen([pole((4, 0), 0.2 * Y), wall])
    assert labels_of(extract_poles(cloud), labels) == [0]


def turned(yaw: float) -> Array:
    return np.array([np.cos(yaw), np.sin(yaw), 0.0])


NO_POLES: dict[str, list[Surface]] = {
    "sign": [
        Cylinder(np.array([6, 0, 0]), Z, 0.03, 2.4, PAINT),
        Rectangle(np.array([5.9, 0, 0.8]), Y, Z, (0.3, 0.3), TAPE),
    ],
    "sign seen obliquely": [Rectangle(np.array([5, 0, 0]), turned(0.4), Z, (0.35, 0.35), TAPE)],
    "stripe on a wall": [
        Rectangle(np.array([5, 0, 0]), Y, Z, (4, 2), PAINT),
        Rectangle(np.array([4.99, 0, 0]), Y, Z, (0.025, 0.9), TAPE),
    ],
    "marked corner of a box": [
        Box(np.array([5, 0, 0]), np.stack([turned(0.8), turned(0.8 + np.pi / 2), Z], 1),
            np.array([0.7, 0.7, 1.2]), PAINT),
        Box(np.array([5 - 0.99, 0, 0]), np.eye(3), np.array([0.03, 0.03, 0.9]), TAPE),
    ],
    "lane mark": [Rectangle(np.array([5, 0.5, -1.19]), X, Y, (1.5, 0.07), TAPE)],
    "number plate": [
        Box(np.array([6, 0, -0.6]), np.eye(3), np.array([2.0, 0.9, 0.5]), PAINT),
        Rectangle(np.array([3.98, 0, -0.6]), Y, Z, (0.26, 0.055), TAPE),
    ],
    "lamps": [
        Box(np.array([6, 0, -0.6]), np.eye(3), np.array([2.0, 0.9, 0.5]), PAINT),
        *(Rectangle(np.array([3.98, y, -0.5]), Y, Z, (0.1, 0.2), TAPE) for y in (-0.8, 0.8)),
    ],
    "cone": [
        Cylinder(np.array([4, 0, -0.85]), Z, 0.1, 0.7, PAINT),
        Cylinder(np.array([4, 0, -0.8]), Z, 0.11, 0.15, TAPE),
    ],
    "vest": [
        Box(np.array([4, 0, -0.35]), np.eye(3), np.array([0.12, 0.22, 0.85]), PAINT),
        *(
            Box(np.array([4, 0, z]), np.eye(3), np.array([0.14, 0.24, 0.025]), TAPE)
            for z in (-0.15, 0.1)
        ),
    ],
    "bright ground": [Rectangle(np.array([4, 0, -1.19]), X, Y, (2.5, 2.5), TAPE)],
    "thick bare post": [Cylinder(np.array([5, 0, 0]), Z, 0.3, 2.4, TAPE)],
}  # fmt: skip


@pytest.mark.parametrize("name", NO_POLES)
@pytest.mark.parametrize("sensor", ["VLP-16", "XT32", "OS1", "Pandar64"])
@pytest.mark.parametrize("with_rings", [True, False])
def test_other_bright_things_are_no_poles(name: str, sensor: str, with_rings: bool) -> None:
    cloud, _ = seen(NO_POLES[name], sensor)
    if not with_rings:
        cloud = replace(cloud, ring=None)
    found = extract_poles(cloud, sensor=find_sensor(sensor))
    assert found.poles == (), [p.length for p in found.poles]
    retro = sum(len(cluster.index) for cluster in found.rejected)
    assert retro == found.retro_points, "every bright return is accounted for"
    for cluster in found.rejected:
        assert cluster.code
        assert any(character.isdigit() for character in cluster.reason)
        np.testing.assert_allclose(cluster.centre, cloud.xyz[cluster.index].mean(axis=0))


@pytest.mark.parametrize("name", NO_POLES)
def test_poles_are_found_among_them(name: str) -> None:
    stands = pole((3.4, -1.6), 0.25 * Y), pole((3.6, 1.9))
    cloud, labels = seen([*stands, *NO_POLES[name]])
    assert sorted(labels_of(extract_poles(cloud), labels)) == [0, 1]


def test_third_post_is_a_pole_too() -> None:
    cloud, labels = seen([pole((4, 0)), pole((4, 1.5), 0.3 * Y), pole((5, -1.5), radius=0.06)])
    assert sorted(labels_of(extract_poles(cloud), labels)) == [0, 1, 2]


def test_stray_returns_are_not_poles() -> None:
    rng = np.random.default_rng(4)
    cloud, _ = seen([])
    bright = rng.permutation(len(cloud))[:40]
    assert cloud.intensity is not None
    intensity = cloud.intensity.copy()
    intensity[bright] = 255.0
    assert extract_poles(replace(cloud, intensity=intensity)).poles == ()


def same_poles(a: Detection, b: Detection, T: Array, order: IntArray | None = None) -> None:
    assert len(a.poles) == len(b.poles)
    assert [len(r.index) for r in a.rejected] == [len(r.index) for r in b.rejected]
    for p, q in zip(a.poles, b.poles, strict=True):
        index = q.index if order is None else np.sort(order[q.index])
        np.testing.assert_array_equal(p.index, index)
        np.testing.assert_allclose(se3.apply(T, p.point[None])[0], q.point, atol=1e-7)
        assert abs(q.direction @ (T[:3, :3] @ p.direction)) == pytest.approx(1, abs=1e-9)
        assert (p.length, p.rms) == pytest.approx((q.length, q.rms), abs=1e-7)
        assert p.rings == q.rings


@pytest.mark.parametrize("origin", ["moved along", "false"])
@pytest.mark.parametrize("with_rings", [True, False])
@pytest.mark.parametrize("scene", ["corridor", "street", "harbor"])
def test_rigid_motion_changes_nothing(scene: str, with_rings: bool, origin: str) -> None:
    pair = simulate_pair(scene, np.random.default_rng(2))
    for k, cloud in enumerate((pair.target, pair.source)):
        still = cloud if with_rings else replace(cloud, ring=None)
        T = se3.random(np.random.default_rng(k), 50.0)
        moved = still.transformed(T)
        if origin == "false":
            moved = replace(moved, origin=np.zeros(3))
        same_poles(extract_poles(still), extract_poles(moved), T)


@pytest.mark.parametrize("shift", [(5e3, 3e3, 0.0), (448_000.0, 5_410_000.0, 300.0)])
@pytest.mark.parametrize("with_rings", [True, False])
def test_map_coordinates_with_a_false_origin_lose_no_pole(
    with_rings: bool, shift: tuple[float, float, float]
) -> None:
    cloud = simulate_pair("harbor", np.random.default_rng(1)).target
    still = cloud if with_rings else replace(cloud, ring=None)
    moved = replace(still, xyz=still.xyz + np.array(shift))
    for p, q in zip(extract_poles(still).poles, extract_poles(moved).poles, strict=True):
        np.testing.assert_array_equal(p.index, q.index)
        assert abs(p.direction @ q.direction) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("scene", ["corridor", "street"])
def test_order_of_the_points_changes_nothing(scene: str) -> None:
    cloud = simulate_pair(scene, np.random.default_rng(3)).target
    order = np.random.default_rng(0).permutation(len(cloud))
    same_poles(extract_poles(cloud), extract_poles(cloud.select(order)), np.eye(4), order)


def test_detection_accounts_for_every_point_once() -> None:
    cloud = simulate_pair("street", np.random.default_rng(5)).target
    found = extract_poles(cloud)
    rows = np.concatenate([p.index for p in found.poles] + [r.index for r in found.rejected])
    assert len(np.unique(rows)) == len(rows)
    assert cloud.intensity is not None
    assert np.all(cloud.intensity[rows] >= found.threshold)
    assert found.retro_points == np.count_nonzero(cloud.intensity >= found.threshold)


@pytest.mark.parametrize("intensity", [None, np.full(50, 7.0)])
def test_no_intensity_is_refused(intensity: Array | None) -> None:
    xyz = np.random.default_rng(0).normal(size=(50, 3))
    with pytest.raises(Refusal) as caught:
        extract_poles(PointCloud(xyz, intensity))
    assert caught.value.code == "no_intensity"


def test_no_return_above_the_threshold_is_an_answer() -> None:
    cloud, _ = seen([])
    found = extract_poles(cloud, threshold=1e9)
    assert (found.poles, found.rejected, found.retro_points) == ((), (), 0)
    assert found.threshold_source == "given"


def test_clusters_are_what_short_steps_connect() -> None:
    rng = np.random.default_rng(1)
    for count in (200, 3000):  # beyond a number, cells stand for points
        xyz = rng.uniform(0, 1, (count, 3)) + rng.integers(0, 3, count)[:, None] * [5.0, 0, 0]
        groups = clusters(xyz)
        assert sorted(len(g) for g in groups) == sorted(np.bincount((xyz[:, 0] // 5).astype(int)))
    assert clusters(np.zeros((0, 3))) == []


needs_data = pytest.mark.skipif(not SHARED.exists(), reason="no folder ../shared/data")


@needs_data
@pytest.mark.parametrize("name", ["left", "right"])
@pytest.mark.parametrize("threshold", [None, 200.0])
def test_saturated_ground_has_no_poles(name: str, threshold: float | None) -> None:
    cloud = read_cloud(SHARED / "pandar_0001" / f"{name}.pcd")
    found = extract_poles(cloud, threshold=threshold)
    assert found.retro_points > 0.4 * len(cloud)
    assert found.poles == ()


@needs_data
@pytest.mark.parametrize("name", ["pandar64", "pandargt"])
def test_signs_and_trucks_are_no_poles(name: str) -> None:
    found = extract_poles(read_cloud(SHARED / "pandaset" / f"pandaset002_00_{name}.pcd"))
    assert found.retro_points > 150
    assert found.poles == ()


@needs_data
@pytest.mark.parametrize(("threshold", "least"), [(None, 9), (150.0, 9), (200.0, 8)])
def test_posts_along_the_road_are_found_and_no_car(threshold: float | None, least: int) -> None:
    cloud = read_cloud(SHARED / "pandar_scene1" / "p64.pcd")
    found = extract_poles(cloud, threshold=threshold)
    assert len(found.poles) >= least
    for pole in found.poles:  # two rows of short posts line the road, nothing else is a pole
        assert 4.5 < abs(pole.point[0]) < 6.5
        assert abs(pole.direction[2]) > np.cos(np.radians(20))
        assert pole.length < 0.6
