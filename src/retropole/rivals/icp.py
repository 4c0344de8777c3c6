"""ICP alone: point to point, from the identity (Besl and McKay 1992; the other rival of M9)."""

from __future__ import annotations

import numpy as np

from ..datatypes import PointCloud, Stage
from .scene import register_scene

REACHES = (3.0, 1.0, 0.3)
"""Of corresponding points, metres."""

MAX_ITERATIONS = 100
"""For each reach: the identity may be far off."""


def icp(target: PointCloud, source: PointCloud) -> Stage:
    """Register by point-to-point ICP, as if the LiDARs stood in one place and looked one way.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame. Intensities are not used.

    Raises
    ------
    Refusal
        As `scene.register_scene`.
    """
    return register_scene(
        target,
        source,
        np.eye(4),
        method="ICP",
        reaches=REACHES,
        max_iterations=MAX_ITERATIONS,
    )
