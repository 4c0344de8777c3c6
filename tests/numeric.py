"""What tests of estimates share: derivatives by differences, and distances in stated sigmas."""

from collections.abc import Callable

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array, PoseEstimate

CHI2_6_95 = 12.59
"""χ² with 6 degrees of freedom is below this in 95 % of cases, …"""

CHI2_6_MEDIAN = 5.35
"""… and below this in half of them."""


def numeric_jacobian(function: Callable[[Array], Array], size: int, step: float = 1e-6) -> Array:
    """Derivative (..., size) of a function of a step (size,) at zero, by central differences."""
    columns = [
        (np.asarray(function(step * e)) - np.asarray(function(-step * e))) / (2 * step)
        for e in np.eye(size)
    ]
    return np.stack(columns, axis=-1)


def covariance_of(pose: PoseEstimate) -> Array:
    """The covariance of a pose that must have one."""
    assert pose.covariance is not None
    return pose.covariance


def mahalanobis_sq(pose: PoseEstimate, T_true: Array) -> float:
    """Squared distance of a pose from the truth in its own stated uncertainty."""
    error = se3.local(pose.T_target_source, T_true)
    return float(error @ np.linalg.solve(covariance_of(pose), error))
