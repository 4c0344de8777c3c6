"""The pose of one LiDAR of a site in the frame of another, with the covariance of both together."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from . import se3
from .datatypes import Array


class RelativePose(NamedTuple):
    """Where LiDAR j stands for LiDAR i.

    Attributes
    ----------
    T_i_j
        (4, 4) maps points of j into the frame of i.
    covariance
        (6, 6) over ``[φ, δ]``, rad and m, axes of i: ``R_true = Exp(φ) R``, ``t_true = t + δ``.
    """

    T_i_j: Array
    covariance: Array


def relative(T_i: Array, T_j: Array, joint: Array) -> RelativePose:
    """Take the pose of one LiDAR in another's frame, and how certain it is.

    What both poses have in common (the datum, poles that both saw) cancels, so that two LiDARs far
    from the origin of the site may be certain to each other.

    Parameters
    ----------
    T_i, T_j
        (4, 4) map points of LiDARs i and j into one frame.
    joint
        (12, 12) covariance of both poses together, over ``[φ_i, δ_i, φ_j, δ_j]``, rad and m, axes
        of that frame.

    Returns
    -------
    RelativePose
        ``T_i_j`` and its covariance to first order.
    """
    J = relative_jacobian(T_i, T_j)
    covariance = J @ joint @ J.T
    return RelativePose(se3.inverse(T_i) @ T_j, (covariance + covariance.T) / 2)


def relative_jacobian(T_i: Array, T_j: Array) -> Array:
    """(..., 6, 12) derivative of `relative` by steps of both poses, ``[φ_i, δ_i, φ_j, δ_j]``."""
    to_i = np.swapaxes(T_i[..., :3, :3], -1, -2)
    arm = T_j[..., :3, 3] - T_i[..., :3, 3]
    # R_iᵀ Exp(−φ_i) Exp(φ_j) R_j, and R_iᵀ Exp(−φ_i) (arm + δ_j − δ_i), to first order.
    J = np.zeros((*T_i.shape[:-2], 6, 12))
    J[..., :3, :3], J[..., :3, 6:9] = -to_i, to_i
    J[..., 3:, :3] = to_i @ se3.hat(arm)
    J[..., 3:, 3:6], J[..., 3:, 9:] = -to_i, to_i
    return J


def joint_of(covariance: Array, i: int, j: int) -> Array:
    """Cut out (12, 12) for LiDARs i and j of the (6 L, 6 L) covariance of all poses of a site."""
    rows = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
    return np.asarray(covariance[np.ix_(rows, rows)])
