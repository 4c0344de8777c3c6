"""Returns that lie beside their pole: a LiDAR that sees it stand clearly elsewhere.

A return far from the axis counts as an outlier, and pulls no more: the quadratic form of such
returns says that nothing is wrong. What an axis of its own would gain them is found in full.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..alignment.joint import Sight
from ..alignment.maximum import MIN_INLIER_SHARE
from ..alignment.network import Network
from ..alignment.posterior import Posterior, State, evaluate_lidar
from ..alignment.state import JointState
from ..base import se3
from ..base.datatypes import Array
from .axes import maximise_from_lines


def find_outlying(
    end: Posterior[JointState], network: Network, sights: Sequence[Sight]
) -> Iterator[tuple[int, int, float]]:
    """Find the poles beside which most of a LiDAR's returns on them lie.

    Parameters
    ----------
    end
        The maximum of the posterior of poles and survey.
    network
        The observations about it.
    sights
        What each LiDAR saw.

    Yields
    ------
    lidar, pole, chi2
        Indices, and twice the logarithm of the likelihood that an axis of its own would gain: χ²
        with four degrees of freedom where the pole stands at one place.
    """
    by_lidar = {sight.lidar: sight for sight in sights}
    for one in network.observations:
        if one.poles is None or one.share is None:
            continue
        assert one.lidar is not None
        for pole in one.poles[one.share < MIN_INLIER_SHARE]:
            yield one.lidar, int(pole), _gain(end, by_lidar[one.lidar], int(pole))


def _gain(end: Posterior[JointState], sight: Sight, pole: int) -> float:
    """Twice the logarithm of the likelihood that an axis of its own gains a LiDAR's returns."""
    beams = sight.beams.of_poles(np.flatnonzero(sight.own == pole))
    state, log_noise = end.state, end.log_noise[sight.lidar]
    to_lidar = se3.inverse(state.T[sight.lidar])
    common = State(
        np.eye(4),
        np.array([state.offsets[sight.lidar], 0.0]),
        state.radius,
        se3.apply(to_lidar, state.points[[pole]]),
        state.directions[[pole]] @ to_lidar[:3, :3].T,
    )
    own, _ = maximise_from_lines(beams, state.radius, log_noise)

    def log_at(points: Array, directions: Array) -> float:
        at = State(common.T, common.offsets, common.radius, points, directions)
        return float(evaluate_lidar(at, 0, beams, np.exp(log_noise))[0].log)

    found = log_at(own.points, own.directions) - log_at(common.points, common.directions)
    return max(2.0 * found, 0.0)
