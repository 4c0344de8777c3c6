"""Distances between poles depend on nothing but the poles."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from retropole.alignment.posterior import State
from retropole.base.datatypes import Array
from retropole.certify.distances import Targets, distances, distances_of, places

pytestmark = pytest.mark.full


def lines(count: int, seed: int = 0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    n = rng.normal(size=(count, 3))
    return 3 * rng.normal(size=(count, 3)), n / np.linalg.norm(n, axis=1, keepdims=True)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_no_rigid_motion_changes_a_distance(count: int) -> None:
    points, directions = lines(count)
    rng = np.random.default_rng(1)
    R, t = Rotation.random(rng=rng).as_matrix(), 10 * rng.normal(size=3)
    # Another point of each line is as good.
    others = (points + rng.normal(size=(count, 1)) * directions) @ R.T + t
    offsets = rng.normal(size=count)
    there = distances(others, directions @ R.T, offsets)
    assert there == pytest.approx(distances(points, directions, offsets), abs=1e-9)


def test_the_order_of_two_poles_makes_no_difference_with_two() -> None:
    # Two lines have four half turns: whichever pole is which, their distance is the same.
    points, directions = lines(2)
    one = distances(points, directions, np.array([0.4, -1.2]))
    other = distances(points[::-1], directions[::-1], np.array([0.4, -1.2]))
    assert one == pytest.approx(other)


def test_a_place_is_the_nearest_to_all_other_lines() -> None:
    points, directions = lines(4)
    at = places(points, directions)

    def far(k: int, along: float) -> float:
        from_others = at[k] + along * directions[k] - points
        across = np.linalg.norm(np.cross(from_others, directions), axis=1)
        return float((np.delete(across, k) ** 2).sum())

    assert all(far(k, 0) < min(far(k, 0.01), far(k, -0.01)) for k in range(4))


def test_a_scale_shows_in_every_distance() -> None:
    points, directions = lines(4)
    offsets = np.ones(4)
    longer = distances(1.01 * points, directions, 1.01 * offsets)
    assert longer == pytest.approx(1.01 * distances(points, directions, offsets))


def test_derivatives_are_those_of_the_steps() -> None:
    points, directions = lines(4)
    state = State(np.eye(4), np.zeros(2), 0.02, points, directions)
    targets = [
        Targets(np.array([0, 2]), np.array([1.0, -1.0]), np.array([0.3, -0.2])),
        Targets(np.array([1, 3]), np.array([1.0, 1.0]), np.zeros(2)),
    ]
    lengths, by_axes = distances_of(state, targets)
    step = 1e-4 * np.random.default_rng(2).normal(size=16)
    moved, _ = distances_of(state.moved(np.r_[np.zeros(9), step]), targets)
    assert moved - lengths == pytest.approx(by_axes @ step, abs=1e-6)
    # The second placement does not depend on the axes of the first.
    assert not by_axes[1, [0, 1, 2, 3, 8, 9, 10, 11]].any()
