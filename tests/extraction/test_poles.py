"""Poles are found, other bright things are not, and neither motion nor order matters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, Detection, IntArray, PointCloud
from retropole.base.errors import Refusal
from retropole.base.sensors import find_sensor
from retropole.extraction import lines, surroundings
from retropole.extraction.poles import extract_poles
from retropole.io import read_cloud
from retropole.simulation import Box, Rectangle, simulate_pair
from tests.extraction.scenes import (
    NO_POLES,
    PAINT,
    TAPE,
    X,
    Y,
    Z,
    labels_of,
    pole,
    seen,
    without_rings,
)
from tests.paths import SHARED
from tests.tiers import first_of


@pytest.mark.parametrize("sensor", ["VLP-16", "HDL-32E", "XT32", "OS1", "Pandar64", "Mid-360"])
@pytest.mark.parametrize("radius", [0.02, 0.05])
def test_standing_and_leaning_poles_are_found(sensor: str, radius: float) -> None:
    standing = [pole((4, 0.7), radius=radius), pole((4.5, -1), 0.5 * Y + 0.2 * X, radius)]
    # A sensor that does not repeat its scan needs a second to put as many returns on a pole.
    cloud, labels = seen(list(standing), sensor, frames=10 if sensor == "Mid-360" else 1)
    found = extract_poles(cloud, radius=radius)
    assert sorted(labels_of(found, labels)) == [0, 1]
    for detected, label in zip(found.poles, labels_of(found, labels), strict=True):
        truth = standing[label]
        assert np.mean(labels[detected.index] == label) > 0.95
        assert np.linalg.norm(np.cross(detected.direction, truth.axis)) < np.sin(np.radians(2))
        offset = detected.point - truth.centre
        gap = np.linalg.norm(offset - (offset @ truth.axis) * truth.axis)
        assert gap < radius + 0.02, "points lie on the surface"
        np.testing.assert_allclose(detected.point, cloud.xyz[detected.index].mean(axis=0))
        np.testing.assert_array_equal(detected.xyz, cloud.xyz[detected.index])
        assert np.linalg.norm(detected.direction) == pytest.approx(1)


@pytest.mark.parametrize("radius", [0.015, 0.02, 0.055, 0.08])
def test_the_line_of_a_thick_pole_is_moved_to_where_that_of_a_thin_one_would_be(
    radius: float,
) -> None:
    standing = [pole((4, 0.7), radius=radius), pole((4.5, -1), 0.5 * Y + 0.2 * X, radius)]
    cloud, labels = seen(list(standing), "OS1")
    found = extract_poles(cloud, radius=radius)
    assert len(found.poles) == 2
    for detected, label in zip(found.poles, labels_of(found, labels), strict=True):
        truth = standing[label]
        offset = detected.inner_point - truth.centre
        gap = np.linalg.norm(offset - (offset @ truth.axis) * truth.axis)
        assert gap == pytest.approx(np.pi / 4 * min(radius, 0.02), abs=0.008)
        assert np.any(detected.to_axis != 0) == (radius > 0.02)


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
        few = without_rings(few)
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


@pytest.mark.parametrize("sensor", ["XT32", "OS1", "Pandar64"])
def test_half_hidden_pole_next_to_a_sign_is_one(sensor: str) -> None:
    """The sign is most of the cluster, and without it the pole is two groups."""
    bar = Box(np.array([3.5, 0, -0.1]), np.eye(3), np.array([0.02, 0.5, 0.25]), PAINT)
    sign = Rectangle(np.array([4.6, 1.0, 0]), Y, Z, (0.4, 0.6), TAPE)
    cloud, labels = seen([pole((4, 0), 0.1 * Y), bar, sign], sensor)
    found = extract_poles(cloud)
    assert labels_of(found, labels) == [0]
    assert found.poles[0].length > 1.5


@pytest.mark.parametrize("distance", [0.15, 0.4])
def test_wall_behind_a_pole_does_not_hide_it(distance: float) -> None:
    wall = Rectangle(np.array([4 + distance, 0, 0]), Y, Z, (4, 2), PAINT)
    cloud, labels = seen([pole((4, 0), 0.2 * Y), wall])
    assert labels_of(extract_poles(cloud), labels) == [0]


@pytest.mark.parametrize("name", NO_POLES)
@pytest.mark.parametrize("sensor", first_of(["VLP-16", "XT32", "OS1", "Pandar64"], 2))
@pytest.mark.parametrize("with_rings", first_of([True, False]))
def test_other_bright_things_are_no_poles(name: str, sensor: str, with_rings: bool) -> None:
    cloud, _ = seen(NO_POLES[name], sensor)
    if not with_rings:
        cloud = without_rings(cloud)
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


def test_third_post_is_a_pole_where_it_is_as_thick_as_the_poles() -> None:
    stands = [pole((4, 0)), pole((4, 1.5), 0.3 * Y), pole((5, -1.5), radius=0.06)]
    cloud, labels = seen(list(stands))
    found = extract_poles(cloud)
    assert sorted(labels_of(found, labels)) == [0, 1]
    assert labels_of(replace(found, poles=found.candidates), labels) == [2]
    assert sorted(labels_of(extract_poles(cloud, radius=0.06), labels)) == [0, 1, 2]


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
@pytest.mark.parametrize("scene", first_of(["corridor", "street", "harbor"]))
@pytest.mark.full
def test_rigid_motion_changes_nothing(scene: str, with_rings: bool, origin: str) -> None:
    pair = simulate_pair(scene, np.random.default_rng(2))
    for k, cloud in enumerate((pair.target, pair.source)):
        still = cloud if with_rings else without_rings(cloud)
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
    still = cloud if with_rings else without_rings(cloud)
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
    index = np.concatenate([p.index for p in found.poles] + [r.index for r in found.rejected])
    assert len(np.unique(index)) == len(index)
    assert cloud.intensity is not None
    assert np.all(cloud.intensity[index] >= found.threshold)
    assert found.retro_points == np.count_nonzero(cloud.intensity >= found.threshold)


@pytest.mark.parametrize("scene", ["corridor", "street", "harbor", "bare"])
@pytest.mark.full
def test_more_rounds_of_fitting_give_the_same_poles(
    scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    clouds = [simulate_pair(scene, np.random.default_rng(seed)).target for seed in range(3)]
    before = [extract_poles(cloud) for cloud in clouds]
    for module in (lines, surroundings):
        monkeypatch.setattr(module, "FIT_ROUNDS", 5 * lines.FIT_ROUNDS)
    for cloud, found in zip(clouds, before, strict=True):
        same_poles(extract_poles(cloud), found, np.eye(4))


@pytest.mark.full
def test_a_large_sign_is_rejected_as_a_surface() -> None:
    cloud, _ = seen([Rectangle(np.array([4.0, 0, 0]), Y, Z, (1.0, 1.0), TAPE)], "OS1")
    (sign,) = extract_poles(cloud).rejected
    assert sign.code == "part_of_a_surface"
    assert "inside a bright surface" in sign.reason


@pytest.mark.parametrize(
    ("intensity", "said"),
    [
        (None, "has no intensity in any of its 50 points"),
        (np.full(50, 7.0), "has the intensity 7 in all of its 50 points"),
    ],
)
def test_no_intensity_is_refused(intensity: Array | None, said: str) -> None:
    xyz = np.random.default_rng(0).normal(size=(50, 3))
    with pytest.raises(Refusal) as caught:
        extract_poles(PointCloud(xyz, intensity))
    assert caught.value.code == "no_intensity"
    assert said in caught.value.message


def test_a_threshold_that_most_of_a_large_cloud_passes_is_refused() -> None:
    rng = np.random.default_rng(0)
    xyz, intensity = rng.uniform(-20, 20, (50_000, 3)), rng.uniform(0, 100, 50_000)
    with pytest.raises(Refusal) as caught:
        extract_poles(PointCloud(xyz, intensity), threshold=1.0)
    assert caught.value.code == "threshold_too_low"
    assert float(caught.value.values["bright"]) > 49_000
    few = PointCloud(xyz[:300], intensity[:300])
    assert extract_poles(few, threshold=1.0).retro_points > 290


def test_no_return_above_the_threshold_is_an_answer() -> None:
    cloud, _ = seen([])
    found = extract_poles(cloud, threshold=1e9)
    assert (found.poles, found.rejected, found.retro_points) == ((), (), 0)
    assert found.threshold_source == "given"


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
@pytest.mark.parametrize("name", first_of(["pandar64", "pandargt"]))
def test_signs_and_trucks_are_no_poles(name: str) -> None:
    found = extract_poles(read_cloud(SHARED / "pandaset" / f"pandaset002_00_{name}.pcd"))
    assert found.retro_points > 150
    assert found.poles == ()


@needs_data
@pytest.mark.parametrize(("threshold", "least"), [(None, 9), (150.0, 9), (200.0, 8)])
def test_posts_along_the_road_are_found_and_no_car(threshold: float | None, least: int) -> None:
    cloud = read_cloud(SHARED / "pandar_scene1" / "p64.pcd")
    found = extract_poles(cloud, threshold=threshold)
    assert found.poles == (), "they are thicker than the poles"
    assert len(found.candidates) >= least
    for post in found.candidates:  # two rows of short posts line the road, nothing else is a pole
        assert 4.5 < abs(post.point[0]) < 6.5
        assert abs(post.direction[2]) > np.cos(np.radians(20))
        assert post.length < 0.6


@pytest.mark.parametrize("sensor", ["PandarQT", "OS1", "VLP-16"])
@pytest.mark.parametrize("is_edge", [True, False])
def test_dim_edges_are_no_gap_in_the_tape_but_dim_stretches_are(sensor: str, is_edge: bool) -> None:
    cloud, labels = seen([pole((4.5, 0))], sensor)
    assert cloud.intensity is not None
    on_it = np.flatnonzero(labels == 0)
    aside = np.abs(np.arctan2(cloud.xyz[on_it, 1], cloud.xyz[on_it, 0]))
    bands = cloud.xyz[on_it, 2] % 0.5 < 0.33
    dim = on_it[aside > np.quantile(aside, 0.4) if is_edge else bands]
    intensity = cloud.intensity.copy()
    intensity[dim] = 20.0
    found = extract_poles(replace(cloud, intensity=intensity), sensor=find_sensor(sensor))
    assert len(found.poles) == (1 if is_edge else 0)
