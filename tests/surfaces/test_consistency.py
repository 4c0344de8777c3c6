"""What stands in a scene: at the right pose it agrees, elsewhere it conflicts with the pose."""

from itertools import combinations

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.uncertainty.confirmation import Confirmation
from retropole.extraction.poles import extract_poles
from retropole.simulation import SimulatedPair, simulate_pair
from retropole.surfaces.consistency import (
    EXPECTED,
    PEAKS,
    SHARP,
    SceneObjects,
    _with_neighbours,
    best_lifts,
    best_shifts,
    blocks,
    consistency,
    contradicting_points,
    movable_objects,
    objects_in,
    verdicts,
)
from retropole.surfaces.visibility import OVERLAP_DISTANCE


def standing(pair: SimulatedPair) -> tuple[SceneObjects, SceneObjects]:
    rng = np.random.default_rng(0)
    return objects_in(pair.target, rng), objects_in(pair.source, rng)


def elsewhere(T: np.ndarray, angle: float, distance: float) -> np.ndarray:
    """Turn a pose about the height of a level target, and move it along the ground."""
    return se3.retract(T, np.array([0.0, 0.0, angle, distance, -distance, 0.0]))


@pytest.mark.parametrize("scene", ["corridor", "street", "harbor"])
@pytest.mark.full
def test_the_right_pose_is_confirmed_and_others_are_conflicting(scene: str) -> None:
    for seed in range(3):
        pair = simulate_pair(scene, np.random.default_rng(seed))
        target, source = standing(pair)
        right = consistency(target, source, pair.T_target_source)
        assert right.agreeing > 100
        assert right.contradicted < 0.06
        assert right.missing == 0
        wrong = consistency(target, source, elsewhere(pair.T_target_source, 1.0, 2.0))
        assert wrong.contradicted > 0.2
        assert wrong.agreeing < right.agreeing / 2


def test_bare_ground_confirms_nothing() -> None:
    pair = simulate_pair("bare", np.random.default_rng(0))
    rng = np.random.default_rng(0)
    poles = [
        extract_poles(cloud, sensor=None, threshold=None, radius=0.02).poles
        for cloud in (pair.target, pair.source)
    ]
    target, source = (
        objects_in(pair.target, rng, poles[0]),
        objects_in(pair.source, rng, poles[1]),
    )
    assert consistency(target, source, pair.T_target_source).total < 5
    # With the poles, any pose that they give looks good.
    assert consistency(*standing(pair), pair.T_target_source).agreeing > 5


@pytest.mark.parametrize("scene", ["corridor", "street", "harbor", "bare"])
@pytest.mark.full
def test_the_ground_is_no_wall(scene: str) -> None:
    for seed in range(4):
        pair = simulate_pair(scene, np.random.default_rng(seed))
        T = pair.T_world_target
        for found, pose in zip(standing(pair), (T, T @ pair.T_target_source), strict=True):
            assert abs((pose[:3, :3] @ found.up)[2]) > np.cos(np.radians(15))


def test_where_much_stands_in_both_and_nothing_agrees_it_is_missing() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    target, source = standing(pair)
    far = consistency(target, source, elsewhere(pair.T_target_source, 0.0, 1000.0))
    assert (far.agreeing, far.contradicting) == (0, 0)
    assert far.missing == round(EXPECTED * min(target.voxels, source.voxels)) > 60
    assert far.contradicted == 1


def test_both_directions_count_alike() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    target, source = standing(pair)
    T = elsewhere(pair.T_target_source, 0.1, 0.5)
    there = consistency(target, source, T)
    back = consistency(source, target, se3.inverse(T))
    # Up to rounding at the limits.
    assert abs(back.agreeing - there.agreeing) <= 2
    assert abs(back.contradicting - there.contradicting) <= 2
    assert there.total > 100


def test_nothing_denies_nothing() -> None:
    empty = objects_in(PointCloud(np.zeros((0, 3))), np.random.default_rng(0))
    found = consistency(empty, empty, np.eye(4))
    assert found == Confirmation(agreeing=0, contradicting=0)
    assert found.contradicted == 0


def test_the_points_that_contradict_are_those_of_the_places_that_deny() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    target, source = standing(pair)
    T = elsewhere(pair.T_target_source, 0.1, 0.5)
    points = contradicting_points(target, source, T)
    places = 0
    for own, found in zip((target, source), points, strict=True):
        index = {tuple(p): k for p, k in zip(own.points, own.voxel, strict=True)}
        places += len({index[tuple(point)] for point in found})
    assert places == consistency(target, source, T).contradicting
    assert sum(map(len, points)) >= places > 50


def test_the_points_that_contradict_stand_before_what_the_other_saw() -> None:
    pair = simulate_pair("corridor", np.random.default_rng(1))
    target, source = standing(pair)
    T = elsewhere(pair.T_target_source, 0.2, 1.0)
    _, points = contradicting_points(target, source, T)
    moved = se3.apply(T, points)
    assert len(moved) > 20
    # Along each ray, within the width of a cell, the target saw something farther away.
    rays = pair.target.xyz - pair.target.origin
    ranges = np.linalg.norm(rays, axis=1)
    for point in moved[::10] - pair.target.origin:
        distance = np.linalg.norm(point)
        near = rays @ point / (ranges * distance) > np.cos(np.radians(2.0))
        assert ranges[near].max() > distance + 0.15


def test_hardly_a_point_contradicts_the_right_pose_and_none_where_nothing_stands() -> None:
    pair = simulate_pair("street", np.random.default_rng(3))
    target, source = standing(pair)
    right = contradicting_points(target, source, pair.T_target_source)
    assert sum(map(len, right)) < 0.02 * (len(target.points) + len(source.points))
    nothing = objects_in(PointCloud(np.zeros((0, 3))), np.random.default_rng(0))
    for found in contradicting_points(nothing, source, np.eye(4)):
        assert found.shape == (0, 3)


POINTS = np.random.default_rng(0).uniform([-15, -15, 0.5], [15, 15, 4], (1500, 3))
"""A wood: nothing repeats."""
UP = np.array([0.0, 0.0, 1.0])


def test_a_shift_along_the_ground_is_found() -> None:
    for step in ([2.0, -1.0, 0.0], [-4.5, 3.0, 0.0], [0.0, 0.75, 0.0]):
        off = se3.from_rt(np.eye(3), np.array(step))
        found = best_shifts(POINTS, POINTS, UP, off)[0]
        np.testing.assert_allclose(found.step, -np.array(step), atol=0.26)
        assert found.gain > 3


def test_at_the_right_pose_no_shift_is_better() -> None:
    found = best_shifts(POINTS, POINTS, UP, np.eye(4))
    assert len(found) == PEAKS
    gains = [shift.gain for shift in found]
    assert gains == sorted(gains, reverse=True)
    assert gains[0] < 0.5
    steps = [np.zeros(3), *(shift.step for shift in found)]
    assert all(np.abs(a - b).max() > OVERLAP_DISTANCE for a, b in combinations(steps, 2))


def test_a_lift_off_the_ground_is_found_in_any_frame() -> None:
    turn = se3.from_rt(se3.exp_so3(np.array([0.5, -1.0, 0.3])), np.array([3.0, 2.0, 1.0]))
    for lift in (-2.1, 0.8, 5.5):
        off = se3.from_rt(np.eye(3), np.array([0.0, 0.0, lift]))
        for T in (np.eye(4), turn):
            up = T[:3, :3] @ UP
            found = best_lifts(se3.apply(T, POINTS), POINTS, up, T @ off)[0]
            np.testing.assert_allclose(found.step, -lift * up, atol=0.26)
            assert found.gain > 2
    assert max(shift.gain for shift in best_lifts(POINTS, POINTS, UP, np.eye(4))) < 0.5


def test_the_frame_does_not_matter() -> None:
    off = se3.from_rt(se3.exp_so3(np.array([0, 0, 0.4])), np.array([2.0, -1.0, 0.0]))
    source = se3.apply(se3.inverse(off), POINTS + np.array([3.0, 1.0, 0.0]))
    turn = se3.from_rt(se3.exp_so3(np.array([0.5, -1.0, 0.3])), np.array([3.0, 2.0, 1.0]))
    plain = best_shifts(POINTS, source, UP, off)[0]
    turned = best_shifts(se3.apply(turn, POINTS), source, turn[:3, :3] @ UP, turn @ off)[0]
    np.testing.assert_allclose(plain.step, [-3.0, -1.0, 0.0], atol=0.26)
    np.testing.assert_allclose(turned.step, turn[:3, :3] @ [-3.0, -1.0, 0.0], atol=0.5)


def test_nothing_to_compare_gives_nothing() -> None:
    for find in (best_shifts, best_lifts):
        assert find(POINTS, np.zeros((0, 3)), UP, np.eye(4)) == []


def test_a_cell_and_its_neighbours_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    for shape in ((1, 1), (1, 9), (7, 2), (30, 40)):
        grid = (rng.random(shape) < 0.1).astype(np.float32)
        np.testing.assert_array_equal(_with_neighbours(grid.copy()), maximum_filter(grid, 3))


def place_with_a_car(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Ground 2 m down, a car, and a wall."""
    ground = np.c_[rng.uniform(-20, 20, (20_000, 2)), rng.normal(-2, 0.01, 20_000)]
    car = rng.uniform([4, 3, -2.0], [8, 5, -0.4], (2_000, 3))
    wall = np.c_[np.full(4_000, 12.5), rng.uniform([-9, -2], [9, 3], (4_000, 2))]
    return ground, car, wall


def test_what_may_have_driven_off_is_one_object_down_to_its_wheels() -> None:
    """A car is; a wall is none, and of the ground only what is under the car."""
    rng = np.random.default_rng(3)
    ground, car, wall = place_with_a_car(rng)
    cloud = PointCloud(np.concatenate([ground, car, wall]), is_map=True)
    of_ground, of_car, of_wall = np.split(
        movable_objects(cloud, cloud.xyz), np.cumsum([len(ground), len(car)])
    )
    assert set(of_car) == {1}
    assert not of_wall.any()
    near = (np.abs(ground[:, :2] - [6, 4]) < [3.5, 2.5]).all(axis=1)
    assert not of_ground[~near].any()


def test_what_is_low_of_a_map_does_not_count_nor_what_a_lidar_looks_past() -> None:
    rng = np.random.default_rng(3)
    ground, car, wall = place_with_a_car(rng)
    far = wall + np.array([SHARP, 0.0, 0.0])
    cloud = PointCloud(np.concatenate([ground, car, wall, far]), is_map=True)
    points = objects_in(cloud, rng).points
    assert len(points) > 300
    np.testing.assert_allclose(points[:, 0], 12.5, atol=0.01)


def test_a_voxel_agrees_or_is_in_the_way_and_one_thing_is_few_blocks() -> None:
    rng = np.random.default_rng(3)
    ground, _, wall = place_with_a_car(rng)
    one = objects_in(PointCloud(np.concatenate([ground, wall])), rng)
    same = verdicts(one, one, np.eye(4))
    assert len(same) == 2 * one.voxels
    assert np.all(same == 1)
    nearer = se3.from_rt(np.eye(3), np.array([-3.0, 0.0, 0.0]))
    found = consistency(one, one, nearer)
    assert found.agreeing < len(same) / 10
    assert np.count_nonzero(verdicts(one, one, nearer) < 0) == found.contradicting > 0
    block = blocks(one, one, np.eye(4))
    half = len(block) // 2
    np.testing.assert_array_equal(block[:half], block[half:])
    assert len(np.unique(block)) <= 10
