"""Whether a line is a band on something that stands about it, as on a person.

A band is worn, or held: the body goes on above it and below it, and has air around. A pole stands
on the ground and is as high as a person, so that nothing near it goes on beyond both of its ends.
A wall does, but has no end beside the line either.
"""

from __future__ import annotations

import numpy as np

from ..base.datatypes import BoolArray, PointCloud
from ..base.quantities import counted
from ..base.se3 import lengths
from .acceptance_shape import Failure
from .lines import LITTLE, MIN_LINE_POINTS, MOST, Line, distance_and_place, to_nearest

BODY_REACH = 0.65
"""A body lies no farther from its band, metres: held off by an arm's length of half a metre, and
0.3 m deep, half of it seen."""

AIR = 1.1
"""Up to this distance from the band, metres, there is air about a body."""

BEYOND_BAND = 0.15
"""A body goes on beyond both ends by this and by a step from ring to ring, metres."""


def worn_by_a_body(cloud: PointCloud, line: Line) -> Failure | None:
    """Say that a line is a band on a body; None where it is not.

    Parameters
    ----------
    cloud, line
        The cloud, and the line found in it.
    """
    low, high = line.low, line.high
    beyond = max(BEYOND_BAND, line.step)
    half = max(high, -low) + 2 * beyond + line.step
    reach = float(np.hypot(half, AIR))
    near = cloud.xyz[np.abs(cloud.xyz[:, 0] - line.point[0]) < reach]
    near = near[lengths(near - line.point) < reach]
    distance, along = distance_and_place(near, line.point, line.direction)
    body = (distance > line.tube) & (distance <= BODY_REACH)
    around = (distance > BODY_REACH) & (distance <= AIR)

    def is_free(part: BoolArray) -> bool:
        """Whether there is something of a body in a part (M,), and air about it."""
        own = np.count_nonzero(body & part)
        return bool(own >= MIN_LINE_POINTS and np.count_nonzero(around & part) <= LITTLE * own)

    if not is_free((along >= low) & (along <= high)):
        return None
    if np.mean(to_nearest(along[body], line.along) < line.step) < MOST:
        return None
    above = (along > high) & (along < high + beyond + line.step)
    below = (along < low) & (along > low - beyond - line.step)
    if not (is_free(above) and is_free(below)):
        return None
    count = int(np.count_nonzero(body & (along >= low) & (along <= high)))

    return Failure(
        "on_a_body",
        f"{counted(count, 'return')} up to {BODY_REACH:g} m beside it "
        f"{'goes' if count == 1 else 'go'} on beyond both its ends, with air about "
        "them: a band that a person wears or holds",
    )
