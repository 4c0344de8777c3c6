"""Whether both LiDARs of a pair saw the poles stand to each other alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.datatypes import Array, IntArray
from .network import Network
from .unknowns import POSE


@dataclass(frozen=True, eq=False)
class AxesTest:
    """Whether both LiDARs see the poles stand to each other alike.

    Attributes
    ----------
    chi2, freedom
        By how much freeing the axes for each LiDAR would raise twice the logarithm of the
        posterior, and how many more parameters that has: χ² where the poles stand alike.
    by_pole
        (K,) the same where only that pole's axis is freed.
    """

    chi2: float
    freedom: int
    by_pole: Array


def compare_axes(network: Network, precision: Array, considered: Array) -> AxesTest:
    """Test whether the poles stood alike when each LiDAR recorded them (score test, Rao 1948).

    The source's axes get a displacement of their own, beside pose, errors and common axes. Six of
    its directions are the pose's; two poles leave two to test, their angle and their distance.

    Parameters
    ----------
    network
        Of both LiDARs, about the maximum.
    precision
        (B,) of the prior of the errors.
    considered
        (B,) 1 σ of errors that are not estimated, and may be the cause all the same; 0 of others.
    """
    unknowns, poles = network.unknowns, network.unknowns.axes
    whole, slope = network.total()
    source, pull = network.of_lidar(1).total()
    index = np.arange(unknowns.poses, unknowns.kept)
    errors = index[np.flatnonzero(considered)]
    by_errors = whole[:, errors].copy()
    whole[index, index] += precision
    slope[index] -= precision * network.start[index]
    free = np.flatnonzero(np.r_[network.free, np.ones(unknowns.size - unknowns.poses, dtype=bool)])

    def gain(own: IntArray) -> float:
        cross = source[:, own]
        known = np.zeros((unknowns.size, len(own) + 1))
        known[free] = np.linalg.solve(
            whole[np.ix_(free, free)], np.column_stack([cross, slope])[free]
        )
        score = pull[own] - cross.T @ known[:, -1]
        left = source[np.ix_(own, own)] - cross.T @ known[:, :-1]
        # What is considered moves the score by so much.
        by = (source[np.ix_(own, errors)] - known[:, :-1].T @ by_errors) * considered[
            errors - unknowns.poses
        ]
        left = left + by @ by.T
        return float(score @ np.linalg.pinv(left, rcond=1e-9, hermitian=True) @ score)

    by_pole = [gain(unknowns.axis(np.array([k]))) for k in range(poles)]
    return AxesTest(
        gain(unknowns.axis(np.arange(poles))), max(4 * poles - POSE, 1), np.array(by_pole)
    )
