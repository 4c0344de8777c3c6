"""Roll, pitch and height over the ground: laws, derivatives and covariance."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import Refusal
from retropole.base.systematic import DEVICE_KINDS, RING_KINDS, Sizes
from retropole.ground.level import Cells, cells_on, ground_frame, level, plane_of
from retropole.ground.surface import find_ground, level_axes
from tests.ground.grounds import pose, rings, viewer

AT = rings(12, far=14.0)
FLAT, NONE = np.zeros(len(AT)), np.zeros((0, 2))


def test_the_pose_over_level_ground_is_found() -> None:
    for roll, pitch, height in ((-12.0, 8.0, 2.5), (178.0, 4.0, 2.0)):
        (found,) = level([viewer(AT, FLAT, pose(height, roll, pitch, 40.0))]).lidars
        got = [*np.degrees([found.roll, found.pitch]), found.height]
        assert np.allclose(got, [roll, pitch, height], atol=1e-3)
        assert np.allclose(found.T_ground_lidar[:2, 3], 0, atol=1e-9)
        assert np.allclose(np.diag(found.covariance)[[3, 4]], 0, atol=1e-12)


@pytest.mark.full
def test_the_order_of_the_points_makes_no_difference() -> None:
    one = viewer(AT, 0.01 * np.sin(AT[:, 0]), pose(2.0, 2.0))
    mixed = np.random.default_rng(1).permutation(len(AT))
    other = replace(one, cloud=PointCloud(one.cloud.xyz[mixed]))
    a, b = (level([each]).lidars[0] for each in (one, other))
    assert np.allclose(a.T_ground_lidar, b.T_ground_lidar, atol=1e-7)


@pytest.mark.full
def test_two_lidars_have_one_ground_and_stay_as_they_were_calibrated() -> None:
    poses = pose(2.0, 2.0), pose(1.5, -4.0, 6.0, 90.0)
    T = se3.inverse(poses[0]) @ poses[1]
    first = viewer(AT, FLAT, poses[0])
    second = replace(viewer(AT, FLAT, poses[1], "b"), T=T)
    covariance = np.zeros((12, 12))
    covariance[6:, 6:] = np.diag(np.r_[[np.radians(0.1)] * 3, [0.01] * 3] ** 2)
    found = level([first, second], covariance).lidars
    assert np.allclose(se3.inverse(found[0].T_ground_lidar) @ found[1].T_ground_lidar, T, atol=1e-9)
    assert found[1].height == pytest.approx(1.5, abs=1e-3)
    # Of the other, its pose errs, too.
    assert found[1].roll_pitch_height[0, 0] > np.radians(0.09) ** 2
    assert found[1].roll_pitch_height[0, 0] > 4 * found[0].roll_pitch_height[0, 0]


def test_derivatives_are_those_of_the_heights() -> None:
    sizes = Sizes()
    one = viewer(AT, FLAT, pose(2.0, 5.0, 3.0))
    ground = find_ground([one], 10.0)
    cells = cells_on(ground, [one])
    rays = one.cloud.xyz / se3.lengths(one.cloud.xyz)[:, None]
    # Longer ranges and a turned LiDAR move the heights as the table says.
    for step, column in (((0.01, 0.0), 0), ((0.0, 0.001), 1)):
        moved = one.cloud.xyz + (step[0] + step[1] * se3.lengths(one.cloud.xyz))[:, None] * rays
        again = cells_on(ground, [replace(one, cloud=PointCloud(moved))])
        # The table is of the measured heights by the errors that are added to the ranges.
        by = cells.by_errors[:, column] * sum(step)
        off = again.at[:, 2] - cells.at[:, 2]
        assert np.abs(off - by).max() < 0.02 * np.abs(by).max()
    assert cells.errors[0] == sizes.zero
    turn = np.array([1e-4, -2e-4, 0.0, 0.0, 0.0, 1e-3])
    moved = se3.apply(ground.T_rough_frame, se3.apply(se3.retract(np.eye(4), -turn), one.cloud.xyz))
    before = se3.apply(ground.T_rough_frame, one.cloud.xyz)
    arms = np.c_[-np.cross(one.cloud.xyz, ground.T_rough_frame[2, :3]), 0 * one.cloud.xyz]
    arms[:, 3:] = -ground.T_rough_frame[2, :3]
    assert np.allclose((moved - before)[:, 2], arms @ turn, atol=1e-6)
    assert cells.by_poses.shape == (len(cells.at), 6)


@pytest.mark.full
def test_the_covariance_is_that_of_drawn_errors() -> None:
    one = viewer(AT, FLAT, pose(2.0))
    ground = find_ground([one], 10.0)
    cells = cells_on(ground, [one])
    none = np.zeros((6, 6))
    rng, off = np.random.default_rng(3), []
    for _ in range(24):
        drawn = cells.by_errors @ (cells.errors * rng.normal(size=len(cells.errors)))
        at = cells.at.copy()
        at[:, 2] += drawn + rng.normal(0, 0.001, len(at))
        plane = plane_of(replace(cells, at=at), none, np.zeros(2), 10.0, NONE)
        off.append(np.linalg.solve(np.linalg.cholesky(plane.covariance[:3, :3]), plane.mean[:3]))
    square = np.square(off).mean()
    # 72 squares of a normal error have a mean of 1 ± 0.17.
    assert 0.5 < square < 1.4


@pytest.mark.full
def test_a_ridge_is_averaged_over_the_disc() -> None:
    at = rings(24)
    (found,) = level([viewer(at, -0.04 * np.abs(at[:, 1]), pose(2.0))]).lidars
    # The mean of |y| over a disc of radius 10 m is 40 / 3π.
    assert found.height == pytest.approx(2.0 + 0.04 * 40 / (3 * np.pi), abs=0.006)
    assert abs(np.degrees(found.roll)) < 0.03


def test_strips_and_far_patches_are_refused() -> None:
    strip = AT[np.abs(AT[:, 1]) < 0.5]
    with pytest.raises(Refusal) as refusal:
        level([viewer(strip, np.zeros(len(strip)), pose(2.0))])
    assert refusal.value.code == "too_little_ground"
    assert float(refusal.value.values["spread_m"]) < 0.5
    few = AT[:60]
    with pytest.raises(Refusal):
        level([viewer(few, np.zeros(len(few)), pose(2.0))])


def test_the_frame_of_the_ground_is_level() -> None:
    T = ground_frame(np.array([0.3, 0.02, -0.01]), se3.from_rt(np.eye(3), np.array([0.0, 0, 2])))
    foot = se3.apply(se3.inverse(T), np.zeros((1, 3)))[0]
    assert T[0, 3] == pytest.approx(0, abs=1e-12)
    assert foot[2] + 2 == pytest.approx(0.3 + 0.02 * foot[0] - 0.01 * foot[1])
    for up in (np.array([0.0, 0, 1]), np.array([1.0, 0, 0]), np.array([0.6, 0, 0.8])):
        R = level_axes(up)
        assert np.allclose(R @ R.T, np.eye(3))
        assert np.allclose(R[2], up)


def test_cells_without_errors_give_their_plane() -> None:
    at = np.c_[AT, 0.05 + 0.001 * AT[:, 0]]
    zero = np.zeros((len(at), 1))
    cells = Cells(np.zeros(len(at), int), at, zero[:, 0], zero, np.zeros((len(at), 6)), np.ones(1))
    some = np.arange(0, len(at), 40)
    cells = Cells(*(each[some] if len(each) == len(at) else each for each in vars(cells).values()))
    plane = plane_of(cells, np.zeros((6, 6)), np.zeros(2), 10.0, NONE)
    assert np.allclose(plane.mean[:3], [0.05, 0.001, 0], atol=1e-4)


def test_a_road_next_to_a_pavement_is_levelled_alone() -> None:
    on_road = np.abs(AT[:, 1]) < 3.5
    z = np.where(on_road, 0.02 * AT[:, 1], 0.2)
    (found,) = level([viewer(AT, z, pose(2.0))]).lidars
    assert np.degrees(found.roll) == pytest.approx(-np.degrees(np.arctan(0.02)), abs=0.05)
    assert found.height == pytest.approx(2.0, abs=0.005)


def test_each_ring_has_errors_of_its_own() -> None:
    one = viewer(AT, FLAT, pose(2.0))
    ring = np.arange(len(AT)) % 7
    named = replace(one, cloud=replace(one.cloud, ring=ring))
    cells = cells_on(find_ground([named], 10.0), [named])
    assert len(cells.errors) == len(DEVICE_KINDS) + 7 * len(RING_KINDS)
