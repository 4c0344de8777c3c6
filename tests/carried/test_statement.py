"""What is stated of a walk: its parts add up, and move with the frames of the recordings."""

from dataclasses import replace

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Placement, PointCloud, Scan
from retropole.base.uncertainty import floor
from retropole.carried.adjustment import in_recordings
from retropole.carried.statement import scene_beside, state_walk
from retropole.carried.walk import WalkCalibration, apart, calibrate_tracks
from tests.carried.walks import RADIUS, SeenWalk, seen_walk


@pytest.fixture(scope="module")
def walk() -> SeenWalk:
    return seen_walk(6.0)


@pytest.fixture(scope="module")
def found(walk: SeenWalk) -> WalkCalibration:
    return calibrate_tracks(walk.tracks, (None, None), RADIUS)


def test_the_parts_of_what_is_stated_add_up(walk: SeenWalk, found: WalkCalibration) -> None:
    nothing = Scan(PointCloud(np.ones((1, 3)), np.ones(1)))
    answer = state_walk(found, Placement(nothing, nothing), {}, scene=False)
    assert answer.walk is not None
    assert answer.uncertainty is not None
    assert answer.covariance is not None
    np.testing.assert_allclose(answer.uncertainty.covariance, answer.covariance, rtol=1e-6)
    assert sum(entry.share_at_30m for entry in answer.uncertainty.budget) == pytest.approx(1.0)
    assert np.linalg.eigvalsh(found.adjusted.random).min() > 0
    # Added to the source's times it gives the target's.
    assert answer.walk.clock_offset_s == pytest.approx(-walk.offset, abs=3e-3)
    assert answer.walk.found == (60, 60)


def test_an_answer_moves_with_the_frames_of_the_recordings(found: WalkCalibration) -> None:
    rng = np.random.default_rng(3)
    A, B = se3.random(rng), se3.random(rng)
    moved = in_recordings(found.adjusted, A, B)
    np.testing.assert_allclose(moved.T_target_source, A @ found.T_target_source @ se3.inverse(B))
    step = 1e-6 * rng.normal(size=6)
    off = se3.local(
        moved.T_target_source, A @ se3.retract(found.T_target_source, step) @ se3.inverse(B)
    )
    before = step @ np.linalg.solve(found.adjusted.covariance[:6, :6], step)
    after = off @ np.linalg.solve(moved.covariance[:6, :6], off)
    assert after == pytest.approx(before, rel=1e-3)
    back = in_recordings(moved, se3.inverse(A), se3.inverse(B))
    np.testing.assert_allclose(back.covariance, found.adjusted.covariance, atol=1e-12)
    assert np.all(np.diag(found.covariance) >= np.diag(floor()))


def test_who_carries_the_pole_does_not_count_as_the_scene() -> None:
    """A person all along the way is left out, a post 2 m beside it is not."""
    rng = np.random.default_rng(4)
    ground = np.column_stack([rng.uniform(-8, 8, (6000, 2)), np.full(6000, -1.5)])
    way = np.column_stack([np.full(40, 4.0), np.linspace(-3, 3, 40), np.zeros(40)])
    post = np.column_stack([rng.normal(2.0, 0.05, (600, 2)), rng.uniform(-1.4, 0.5, 600)])
    person = way[rng.integers(40, size=600)] + rng.uniform(-0.5, 0.5, (600, 3)) * [1, 1, 2]
    xyz = np.concatenate([ground, post, person])
    scan = Scan(PointCloud(xyz, np.ones(len(xyz))))
    T = se3.from_rt(se3.exp_so3(np.array([0.02, 0.0, 1.0])), np.array([1.0, 0.5, 0.1]))
    moved = Scan(PointCloud(se3.apply(se3.inverse(T), xyz), np.ones(len(xyz))))
    ways = way, se3.apply(se3.inverse(T), way)
    for objects, pose in zip(
        scene_beside(Placement(scan, moved), ways), (np.eye(4), T), strict=True
    ):
        kept = se3.apply(pose, objects.points)
        assert len(kept) > 20
        assert np.all(kept[:, 0] < 3.0)


def test_clocks_that_are_far_apart_begin_together(walk: SeenWalk) -> None:
    target, source = walk.tracks
    late = source.times + 100.0
    assert not apart([target, source]).any()
    both = [target, replace(source, times=late), replace(source, times=late + 0.5)]
    assert apart(both) == pytest.approx([0.0, *2 * [late[0] - target.times[0]]])
