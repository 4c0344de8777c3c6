"""The beams that a LiDAR sent at the poles: those that returned, and those that passed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..datatypes import Array, IntArray, PointCloud, Pole
from ..sensors import Sensor
from .likelihood import closest_approach

RING_BAND = np.radians(0.4)
"""Returns within a band of elevation of this width are taken as one beam's where rings are not
known."""

DIVERGENCE = 0.003
"""Full angle of the beams of a sensor that is not known, rad: makers state 1.5 to 8 mrad."""

PASSING, PASSED_BEHIND = 0.015, 0.3
"""A beam passes a pole within the first distance of its surface, and returns from so far behind it,
metres."""


@dataclass(frozen=True, eq=False)
class Beams:
    """Beams of one LiDAR at the poles, in its own frame.

    Attributes
    ----------
    origin
        (3,) where they start.
    directions, ranges
        (N, 3) and (N,) of the returns.
    pole, ring
        (N,) which pole each lies on, and which beam of the LiDAR it came from.
    half_width
        (N,) half of the beam's width at the return, metres; zero where the sensor is not known.
    passing, passed
        (M, 3) directions of beams that went on behind a pole, and (M,) which pole.
    passing_half_width
        (M,) half of their width at the pole.
    """

    origin: Array
    directions: Array
    ranges: Array
    pole: IntArray
    ring: IntArray
    half_width: Array
    passing: Array
    passed: IntArray
    passing_half_width: Array


def beams_of(
    poles: Sequence[Pole], clouds: Sequence[PointCloud], sensor: Sensor | None = None
) -> Beams:
    """Turn the returns on poles, and those from close behind them, into beams.

    Parameters
    ----------
    poles
        One LiDAR's poles.
    clouds
        The cloud that each pole was found in. All share the beam origin.
    sensor
        What recorded them. Where it is known, the width of its beams is, and beams that passed
        close beside a pole are told from those that met its edge.
    """
    origin = clouds[0].origin
    divergence = DIVERGENCE if sensor is None else sensor.divergence
    ray = np.concatenate([pole.xyz for pole in poles]) - origin
    ranges = np.linalg.norm(ray, axis=1)
    own = np.repeat(np.arange(len(poles)), [len(pole.xyz) for pole in poles])
    if all(cloud.ring is not None for cloud in clouds):
        ring = np.concatenate(
            [
                cloud.ring[pole.index]
                for pole, cloud in zip(poles, clouds, strict=True)
                if cloud.ring is not None
            ]
        )
    else:
        ring = np.floor(np.arcsin(ray[:, 2] / ranges) / RING_BAND)
    beyond = [
        np.zeros((0, 3)) if sensor is None else _passing(pole, cloud, divergence)
        for pole, cloud in zip(poles, clouds, strict=True)
    ]
    passed = np.repeat(np.arange(len(poles)), [len(rays) for rays in beyond])
    away = np.array([np.linalg.norm(pole.point - origin) for pole in poles])
    return Beams(
        origin=origin,
        directions=ray / ranges[:, None],
        ranges=ranges,
        pole=own,
        ring=np.unique(ring, return_inverse=True)[1].reshape(-1).astype(np.int64),
        half_width=0.5 * divergence * ranges,
        passing=np.concatenate(beyond),
        passed=passed,
        passing_half_width=0.5 * divergence * away[passed],
    )


def _passing(pole: Pole, cloud: PointCloud, divergence: float) -> Array:
    """Directions (M, 3) of the beams that passed close beside a pole and returned from behind."""
    ray = cloud.xyz - cloud.origin
    ranges = np.linalg.norm(ray, axis=1)
    away = float(np.linalg.norm(pole.point - cloud.origin))
    reach = np.sin(np.arctan2(0.5 * pole.length + 0.5, away))
    toward = ray @ ((pole.point - cloud.origin) / away)
    nearby = np.flatnonzero((ranges > 0.7 * away) & (toward > np.sqrt(1 - reach**2) * ranges))
    directions = ray[nearby] / ranges[nearby, None]
    by = closest_approach(cloud.origin, directions, pole.point, pole.direction)
    along = (cloud.origin + by.nearest[:, None] * directions - pole.point) @ pole.direction
    own = (pole.xyz - pole.point) @ pole.direction
    close = np.abs(by.miss) < 2 * np.abs(pole.rms) + PASSING + 0.5 * divergence * away
    close &= (along > own.min()) & (along < own.max())
    return np.asarray(directions[close & (ranges[nearby] > by.nearest + PASSED_BEHIND)])
