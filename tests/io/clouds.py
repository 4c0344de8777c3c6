"""Clouds for the tests of bags and of live sources."""

import numpy as np

from retropole.base.datatypes import PointCloud


def random_cloud(seed: int = 0, count: int = 50) -> PointCloud:
    """Make a cloud that a message or a file holds without loss."""
    rng = np.random.default_rng(seed)
    return PointCloud(
        rng.uniform(-9, 9, (count, 3)).astype("f4").astype(float),
        intensity=rng.integers(0, 256, count).astype(float),
        ring=rng.integers(0, 16, count),
    )


def assert_same(read: PointCloud, written: PointCloud) -> None:
    """Whether points are those that were written."""
    np.testing.assert_array_equal(read.xyz, written.xyz)
    np.testing.assert_array_equal(read.intensity, written.intensity)
    np.testing.assert_array_equal(read.ring, written.ring)
