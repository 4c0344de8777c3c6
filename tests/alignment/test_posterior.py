"""What is estimated from the poles: where each parameter stands, and what a step does."""

import numpy as np

from retropole.alignment.posterior import JointState
from retropole.base import se3
from retropole.base.datatypes import Array
from tests.numeric import numeric_jacobian


def drawn(lidars: int = 3, axes: int = 4, control: int = 2) -> JointState:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(axes, 3))
    return JointState(
        np.stack([se3.random(rng) for _ in range(lidars)]),
        rng.normal(size=lidars) * 0.01,
        0.02,
        rng.normal(size=(axes, 3)),
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        rng.normal(size=(control, 3)),
    )


def values_of(state: JointState) -> Array:
    """Everything in a state, one after the other."""
    parts = (state.T, state.offsets, [state.radius], state.points, state.directions, state.control)
    return np.concatenate([np.asarray(part).reshape(-1) for part in parts])


def test_every_parameter_of_a_step_has_a_place_of_its_own() -> None:
    state = drawn()
    control = state.control_points()
    places = np.r_[
        0 : state.first_axis, state.axes(np.arange(4)), np.arange(control.start, control.stop)
    ]
    np.testing.assert_array_equal(np.sort(places), np.arange(state.size))
    J = numeric_jacobian(lambda step: values_of(state.moved(step)), state.size)
    assert np.linalg.matrix_rank(J, tol=1e-6) == state.size


def test_each_part_of_a_step_moves_what_it_stands_for_alone() -> None:
    state = drawn()
    step = np.zeros(state.size)
    step[6:12] = 0.1
    moved = state.moved(step)
    np.testing.assert_allclose(moved.T[1], se3.retract(state.T[1], np.full(6, 0.1)))
    np.testing.assert_array_equal(moved.T[[0, 2]], state.T[[0, 2]])
    np.testing.assert_array_equal(moved.points, state.points)
    step = np.zeros(state.size)
    step[state.axes(np.array([2]))] = 0.1
    moved = state.moved(step)
    assert np.all(moved.points[2] != state.points[2])
    np.testing.assert_array_equal(moved.points[[0, 1, 3]], state.points[[0, 1, 3]])
    np.testing.assert_allclose(np.linalg.norm(moved.directions, axis=1), 1.0)
    np.testing.assert_array_equal(moved.control, state.control)


def test_one_lidar_sees_its_own_axes_through_its_own_pose() -> None:
    state, own = drawn(), np.array([3, 1])
    seen = state.of(2, own)
    np.testing.assert_array_equal(seen.T, state.T[2])
    np.testing.assert_array_equal(seen.points, state.points[own])
    assert seen.offsets[1] == state.offsets[2]
    # A step of the site is the step of what one LiDAR sees, at the places of its parameters.
    rng = np.random.default_rng(1)
    step = 1e-3 * rng.normal(size=state.size)
    part = np.r_[step[12:18], 0.0, step[20], step[21], step[state.axes(own)]]
    alone, together = seen.moved(part), state.moved(step).of(2, own)
    np.testing.assert_allclose(alone.T, together.T)
    np.testing.assert_allclose(alone.points, together.points)
    np.testing.assert_allclose(alone.directions, together.directions)
