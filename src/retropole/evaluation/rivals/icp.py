"""ICP and generalised ICP alone, from the identity.

Point to point (Besl and McKay 1992), the other rival of Xue et al. 2019, Table IV; and plane to
plane (Segal, Haehnel and Thrun 2009). Both start as if the two frames were one.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ...base.datatypes import PointCloud, PoseEstimate
from .registration import register_clouds

ICP_CORRESPONDENCE_DISTANCES = (3.0, 1.0, 0.3)
"""Largest distances of corresponding points, one after the other, metres (chosen: from the error
of a bad start to that of a good one)."""


def icp(target: PointCloud, source: PointCloud, rng: np.random.Generator) -> PoseEstimate:
    """Register two clouds by point-to-point ICP.

    Parameters
    ----------
    target, source
        Clouds, each in its own frame. Intensities are not used.
    rng
        Not used: nothing is drawn.

    Raises
    ------
    Refusal
        As `registration.register_clouds`.
    """
    return _from_identity(target, source, "ICP")


def gicp(target: PointCloud, source: PointCloud, rng: np.random.Generator) -> PoseEstimate:
    """Register two clouds by GICP (small_gicp).

    Parameters
    ----------
    target, source
        Clouds, each in its own frame. Intensities are not used.
    rng
        Not used: nothing is drawn.

    Raises
    ------
    Refusal
        As `registration.register_clouds`.
    """
    return _from_identity(target, source, "GICP")


def _from_identity(
    target: PointCloud, source: PointCloud, method: Literal["ICP", "GICP"]
) -> PoseEstimate:
    return register_clouds(
        target,
        source,
        [np.eye(4)],
        method=method,
        max_correspondence_distances=ICP_CORRESPONDENCE_DISTANCES,
    )
