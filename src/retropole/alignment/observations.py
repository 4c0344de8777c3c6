"""The beams that a LiDAR sent at the poles: those that returned, and those that passed close by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import Array, IntArray, PointCloud, Pole
from ..base.sensors import Sensor
from ..extraction.sensor_pattern import ORDINARY_DIVERGENCE
from .likelihood import OUTLIER_RADIUS, closest_approach

PASSING = 0.015
"""A beam passes next to a pole within this distance of its surface, and returns from farther behind
it than outliers lie, metres."""

NEXT_TO_POLE = 0.2
"""Beams this much further aside, along such a stretch of the pole, show whether those next to it
are recorded, metres: beams of the coarsest sensor of the table have 0.08 m between them at 8 m."""

MOST_RETURNS = 1000
"""Of one pole, no more are worked on: their noise then leaves the axis uncertain by 1 mm, less than
the errors that all of them share. Of streets recorded with 10 and 30 sweeps (seeds 501 to 504), the
poses are as near the truth as with all returns, and the model, which knows no smaller errors, is
not tied to what it cannot explain."""

FEW_RETURNS = 300
"""Where a cloud was downsampled, this many returns of a pole stay all the same: those of one
sweep."""

RMS_MARGIN = 2.0
"""Beams within this many times the pole's rms of its surface are treated as close: the axis is not
known better."""


@dataclass(frozen=True, eq=False)
class Beams:
    """Beams of one LiDAR at the poles, in its frame.

    Attributes
    ----------
    origin, axis
        (3,) where they start, and the direction about which they turn.
    directions, ranges
        (N, 3) and (N,) of the returns.
    pole
        (N,) which pole each lies on.
    half_width
        (N,) half of the beam's width at the return, metres.
    passed_share
        (N,) share of the beams next to the pole, at each return, that are recorded: 1 if
        something is behind on both sides, ½ on one, 0 before the sky.
    passed_directions, passed_pole
        (M, 3) directions of beams that went on behind a pole, and (M,) which pole.
    passed_half_width
        (M,) half of their width at the pole.
    """

    origin: Array
    axis: Array
    directions: Array
    ranges: Array
    pole: IntArray
    half_width: Array
    passed_share: Array
    passed_directions: Array
    passed_pole: IntArray
    passed_half_width: Array

    def of_poles(self, poles: IntArray) -> Beams:
        """Give the beams at some of the poles (K,), which are then numbered in that order."""
        number = np.full(1 + max(self.pole.max(initial=-1), poles.max(initial=-1)), -1)
        number[poles] = np.arange(len(poles))
        hit_pole, passed = number[self.pole], number[self.passed_pole]
        on, by = hit_pole >= 0, passed >= 0
        return replace(
            self,
            directions=self.directions[on],
            ranges=self.ranges[on],
            pole=hit_pole[on],
            half_width=self.half_width[on],
            passed_share=self.passed_share[on],
            passed_directions=self.passed_directions[by],
            passed_pole=passed[by],
            passed_half_width=self.passed_half_width[by],
        )

    def wider(self, by: float) -> Beams:
        """Give the same beams, ``exp(by)`` times as wide."""
        times = np.exp(by)
        return replace(
            self,
            half_width=times * self.half_width,
            passed_half_width=times * self.passed_half_width,
        )


def beams_of(seen: Sequence[tuple[Pole, PointCloud]], sensor: Sensor | None = None) -> Beams:
    """Turn the returns on poles, and those from close behind them, into beams.

    Parameters
    ----------
    seen
        One LiDAR's poles, each with the cloud that it was found in. All clouds share the beam
        origin.
    sensor
        What recorded them, and how wide its beams are; `ORDINARY_DIVERGENCE` where it is not known.
    """
    origin = seen[0][1].origin
    divergence = ORDINARY_DIVERGENCE if sensor is None else sensor.divergence
    found = [_near(pole, cloud, divergence) for pole, cloud in seen]
    ray = np.concatenate([near.returns for near in found]) - origin
    ranges = np.linalg.norm(ray, axis=1)
    passed_pole = np.repeat(np.arange(len(seen)), [len(near.passed) for near in found])
    away = np.array([np.linalg.norm(pole.point - origin) for pole, _ in seen])
    return Beams(
        origin=origin,
        axis=seen[0][1].axis,
        directions=ray / ranges[:, None],
        ranges=ranges,
        pole=np.repeat(np.arange(len(seen)), [len(near.returns) for near in found]),
        half_width=0.5 * divergence * ranges,
        passed_share=np.concatenate([near.passed_share for near in found]),
        passed_directions=np.concatenate([near.passed for near in found]),
        passed_pole=passed_pole,
        passed_half_width=0.5 * divergence * away[passed_pole],
    )


def _shares(returns: int, cloud: PointCloud) -> tuple[float, float]:
    """Which share of a pole's returns, and of the beams that passed next to it, is worked on.

    Together they determine where the pole ends: as many of either must be left out. Where the cloud
    was thinned (`io.recordings`), beams next to the pole are fewer already; its returns, bright,
    are not.
    """
    left = len(cloud) / (len(cloud) + cloud.thinned)
    share = max(min(left, MOST_RETURNS / returns), min(FEW_RETURNS / returns, 1.0))
    return share, min(share / left, 1.0)


def _evenly(along: Array, share: float) -> IntArray:
    """Choose a share of places (N,) along a pole, evenly, with both ends."""
    if share == 1.0 or not len(along):
        return np.arange(len(along))
    rank = np.linspace(0, len(along) - 1, max(round(share * len(along)), 1)).astype(np.int64)
    return np.asarray(np.sort(np.argsort(along)[rank]))


class _Near(NamedTuple):
    """Returns (N, 3) on a pole, share (N,) of the two sides of each that have beams which passed,
    and directions (M, 3) of these.
    """

    returns: Array
    passed_share: Array
    passed: Array


def _near(pole: Pole, cloud: PointCloud, divergence: float) -> _Near:
    """Find the beams that hit a pole, and those that passed close by and returned from behind."""
    away = float(np.linalg.norm(pole.point - cloud.origin))
    own = (pole.xyz - pole.point) @ pole.direction
    room = RMS_MARGIN * pole.rms + PASSING + 0.5 * divergence * away
    # What is farther from the middle of the pole across the ray, or nearer along it, plays no part.
    reach = np.abs(own).max() + room + 2 * NEXT_TO_POLE
    ahead = (pole.point - cloud.origin) / away
    cosine = np.sqrt(max(1.0 - (reach / away) ** 2, 0.0))
    toward = cloud.xyz @ ahead - cloud.origin @ ahead
    # The cloud is large, and little of it lies there.
    some = np.flatnonzero(toward > cosine * max(away - reach, 0.0))
    ray, toward = cloud.xyz.take(some, axis=0) - cloud.origin, toward[some]
    ranges = se3.lengths(ray)
    nearby = (ranges > away - reach) & (toward > cosine * ranges)
    # A ray passes the axis at no less than its part across the plane of the axis and the origin.
    across = np.abs(ray @ np.cross(pole.direction, pole.point - cloud.origin))
    nearby &= across < (room + NEXT_TO_POLE) * ranges
    ray, ranges = ray[nearby], ranges[nearby]
    directions = ray / ranges[:, None]
    by = closest_approach(cloud.origin, directions, pole.point, pole.direction)
    along = (cloud.origin + by.ranges[:, None] * directions - pole.point) @ pole.direction
    behind = ranges > by.ranges + OUTLIER_RADIUS
    within = (along > own.min()) & (along < own.max())
    passed = np.flatnonzero(behind & within & (np.abs(by.lateral_offset) < room))
    stretches = max(int(np.ptp(own) / NEXT_TO_POLE), 1)
    length = max(float(np.ptp(own)) / stretches, NEXT_TO_POLE)

    def stretch(along: Array) -> IntArray:
        place = np.clip((along - own.min()) / length, 0, stretches - 1)
        return np.asarray(place, dtype=np.int64)

    near = behind & (np.abs(by.lateral_offset) < room + NEXT_TO_POLE)
    near &= (along > own.min() - NEXT_TO_POLE) & (along < own.max() + NEXT_TO_POLE)
    weight_nearby = np.zeros(len(own))
    for side in (near & (by.lateral_offset < 0), near & (by.lateral_offset > 0)):
        seen = np.bincount(stretch(along[side]), minlength=stretches) > 0
        weight_nearby += 0.5 * seen[stretch(own)]
    of_returns, of_passed = _shares(len(own), cloud)
    kept = _evenly(own, of_returns)
    passed = passed[_evenly(along[passed], of_passed)]
    return _Near(pole.xyz[kept], weight_nearby[kept], directions[passed])
