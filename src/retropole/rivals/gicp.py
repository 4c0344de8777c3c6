"""Generalised ICP alone: plane to plane, from the identity (Segal, Haehnel and Thrun 2009)."""

from __future__ import annotations

import numpy as np

from ..datatypes import PointCloud, Stage
from .scene import register_scene

REACHES = (3.0, 1.0, 0.3)
"""Of corresponding points, metres."""

MAX_ITERATIONS = 100
"""For each reach: the identity may be far off."""


def gicp(target: PointCloud, source: PointCloud) -> Stage:
    """Register by GICP (small_gicp), as if the LiDARs stood in one place and looked one way.

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
        method="GICP",
        reaches=REACHES,
        max_iterations=MAX_ITERATIONS,
    )
