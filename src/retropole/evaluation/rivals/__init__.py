"""Other ways to the same transform, to set beside our own.

Every method takes target and source and gives a `PoseEstimate`, or raises `Refusal`. None of them uses
the poles.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

import numpy as np

from ...datatypes import PointCloud, PoseEstimate
from .fpfh import fpfh_ransac
from .icp import gicp, icp
from .kiss import kiss_matcher
from .planes import planar_surfaces

__all__ = [
    "EXTRAS",
    "METHODS",
    "fpfh_ransac",
    "gicp",
    "icp",
    "kiss_matcher",
    "missing_extra",
    "planar_surfaces",
]

Method = Callable[[PointCloud, PointCloud, np.random.Generator], PoseEstimate]

METHODS: dict[str, Method] = {
    "planes": lambda target, source, rng: planar_surfaces(target, source, rng=rng),
    "icp": lambda target, source, rng: icp(target, source),
    "gicp": lambda target, source, rng: gicp(target, source),
    "kiss": lambda target, source, rng: kiss_matcher(target, source),
    "fpfh": lambda target, source, rng: fpfh_ransac(target, source, rng=rng),
}
"""Every rival by its name; those that draw nothing leave the generator alone."""

EXTRAS = {"kiss": ("kiss", "kiss_matcher"), "fpfh": ("open3d", "open3d")}
"""The extra that brings what a rival needs, and the module that tells whether it is there."""


def missing_extra(method: str) -> str | None:
    """Name the extra that a rival lacks; None where it can run."""
    if method not in EXTRAS:
        return None
    extra, module = EXTRAS[method]
    return extra if find_spec(module) is None else None
