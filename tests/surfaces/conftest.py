"""Two views of one room, with the pose between them."""

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud


def room(sensor: Array, rng: np.random.Generator, count: int = 20000) -> PointCloud:
    """What a LiDAR at ``sensor`` (3,) sees in every direction of a 10 × 6 × 3 m room with a box."""
    rays = rng.normal(size=(count, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)

    def slab(low: Array, high: Array) -> tuple[Array, Array]:
        first, second = (low - sensor) / rays, (high - sensor) / rays
        return np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)

    _, walls = slab(np.array([-5.0, -3.0, 0.0]), np.array([5.0, 3.0, 3.0]))
    enter, leave = slab(np.array([2.5, -3.0, 0.0]), np.array([4.0, -1.5, 1.2]))
    box = (enter > 0) & (enter < leave)
    return PointCloud(rays * np.where(box, enter, walls)[:, None])


@pytest.fixture(scope="module")
def views() -> tuple[PointCloud, PointCloud, Array]:
    rng = np.random.default_rng(0)
    T_world_target = se3.from_rt(np.eye(3), np.array([-2.0, 1.0, 1.5]))
    T_world_source = se3.from_rt(np.eye(3), np.array([1.0, 0.5, 1.2]))
    target = room(T_world_target[:3, 3], rng)
    source = room(T_world_source[:3, 3], rng)
    return target, source, se3.inverse(T_world_target) @ T_world_source


def flipped(T: Array) -> Array:
    """Turn the source by half a turn about a vertical axis through the target."""
    return se3.from_rt(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) @ T
