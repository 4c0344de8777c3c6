"""Points on surfaces, as scans have them."""

import numpy as np

from retropole.base.datatypes import Array


def floor_and_wall(n: int, seed: int) -> Array:
    """Points (N, 3) on a floor and a wall, denser towards the sensor."""
    rng = np.random.default_rng(seed)
    floor = rng.normal(scale=(2.0, 2.0, 0.01), size=(n // 2, 3))
    wall = rng.normal(scale=(0.01, 2.0, 1.0), size=(n - n // 2, 3)) + np.array([3.0, 0, 1])
    return np.concatenate([floor, wall])
