"""ICP and generalised ICP alone, from the identity.

Point to point (Besl and McKay 1992; the other rival of M9), and plane to plane (Segal, Haehnel and
Thrun 2009), as if the LiDARs stood in one place and looked one way.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ...datatypes import PointCloud, PoseEstimate
from .scene import register_scene

ICP_CORRESPONDENCE_DISTANCES = (3.0, 1.0, 0.3)
"""Of corresponding points, metres."""

MAX_ICP_ITERATIONS = 100
"""For each reach: the identity may be far off."""


def icp(target: PointCloud, source: PointCloud) -> PoseEstimate:
    """Register two clouds, each in its own frame, by point-to-point ICP.

    Raises
    ------
    Refusal
        As `scene.register_scene`.
    """
    return _from_identity(target, source, "ICP")


def gicp(target: PointCloud, source: PointCloud) -> PoseEstimate:
    """Register two clouds, each in its own frame, by GICP (small_gicp).

    Raises
    ------
    Refusal
        As `scene.register_scene`.
    """
    return _from_identity(target, source, "GICP")


def _from_identity(
    target: PointCloud, source: PointCloud, method: Literal["ICP", "GICP"]
) -> PoseEstimate:
    return register_scene(
        target,
        source,
        np.eye(4),
        method=method,
        reaches=ICP_CORRESPONDENCE_DISTANCES,
        max_iterations=MAX_ICP_ITERATIONS,
    )
