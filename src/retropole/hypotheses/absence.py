"""Poles that a LiDAR should see under a hypothesis, but does not.

A half turn about the bisector of two poles with equal lean maps them onto each other, and level
ground onto itself. The third pole is then in space that the other LiDAR saw to be empty: enough of
its beams pass there that some would have hit it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import pdtr

from ..alignment.likelihood import closest_approach
from ..base import se3
from ..base.datatypes import DEFAULT_RADIUS, Array, Hypothesis, Match, Placement, Pole, Scan
from ..base.sensors import Threshold
from ..extraction.lines import MIN_POLE_POINTS
from .choice import is_as_possible
from .correspondence import SAME_POSE_DISTANCE

ABSENT = np.exp(-float(MIN_POLE_POINTS))
"""A pole is absent if the probability of this number of bright returns, or fewer, is at most this:
that of none, if as many are expected as a pole needs."""


def without_absent(
    placement: Placement, hypotheses: Sequence[Hypothesis]
) -> tuple[Hypothesis, ...]:
    """Leave out hypotheses under which a pole is absent that another pairs.

    Parameters
    ----------
    placement
        With the poles that the hypotheses pair.
    hypotheses
        As the scene scored them.

    Returns
    -------
    tuple of Hypothesis
        In the same order. A hypothesis is kept if the scene rules out all others that pair
        three poles or more and leave none absent.
    """
    whole = [
        each
        for each in hypotheses
        if each.match.exact and len(each.match.pairs) > 2 and not absent(placement, each.match)
    ]

    def is_beaten(each: Hypothesis) -> bool:
        better = [one for one in whole if len(one.match.pairs) > len(each.match.pairs)]
        return any(is_as_possible(one, each) for one in better) and bool(
            absent(placement, each.match)
        )

    return tuple(each for each in hypotheses if not is_beaten(each))


def absent(placement: Placement, match: Match) -> int:
    """Count the poles, of both LiDARs, that a match leaves out although the other LiDAR would see
    them."""
    T = match.T_target_source
    sides = (
        (placement.source, placement.target, T, 1),
        (placement.target, placement.source, se3.inverse(T), 0),
    )
    return sum(
        _is_absent(pole, other, there)
        for scan, other, there, side in sides
        for k, pole in enumerate(scan.poles)
        if k not in {pair[side] for pair in match.pairs}
        and not any(pole is own for own in scan.candidates)
    )


def _is_absent(pole: Pole, seer: Scan, T: Array) -> bool:
    """Whether a LiDAR looks through a pole that ``T`` (4, 4) moves into its frame.

    Of the beams that pass within `SAME_POSE_DISTANCE` of the pole, and that nothing in front of
    it stops, the share ``r / SAME_POSE_DISTANCE`` hits a pole of radius r. Beams without any return
    are unknown, and not counted.
    """
    cloud, found = seer.cloud, seer.detection
    if found is None or cloud.intensity is None:
        return False
    rays = cloud.xyz - cloud.origin
    ranges = se3.lengths(rays)
    beams = rays / np.maximum(ranges, 1e-9)[:, None]
    point, axis = se3.apply(T, pole.point[None])[0], T[:3, :3] @ pole.direction
    toward = point - cloud.origin
    # Beams farther than this from the middle of the pole miss the whole pole.
    room = SAME_POSE_DISTANCE + pole.length / 2
    some = np.flatnonzero(toward @ toward - (beams @ toward) ** 2 <= room**2)
    by, ranges = closest_approach(cloud.origin, beams[some], point, axis), ranges[some]
    t, along = by.ranges, by.ranges * (beams[some] @ axis) - toward @ axis
    is_near = (np.abs(by.lateral_offset) <= SAME_POSE_DISTANCE) & (np.abs(along) <= pole.length / 2)
    reaches = is_near & (t > 0) & (ranges >= t - SAME_POSE_DISTANCE)
    expected = np.count_nonzero(reaches) * DEFAULT_RADIUS / SAME_POSE_DISTANCE
    threshold = Threshold(found.threshold, found.threshold_source, found.threshold_least)
    is_bright = cloud.intensity[some] >= threshold.at(ranges)
    seen = np.count_nonzero(reaches & is_bright & (ranges <= t + SAME_POSE_DISTANCE))
    return bool(pdtr(seen, expected) <= ABSENT)
