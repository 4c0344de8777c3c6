"""What the returns of a carried pole measure: one row for each ring of each sweep.

The hits of one ring are a few steps across the pole. How deep they lie before the axis, and how far
their middle may be off it sideways, follows from how many there are: k hits with the step s need
the axis within::

    w = min(R − (k−1)s/2, (k+1)s/2 − R)

of their middle, R being the radius of the pole with the beam, so that its standard deviation is
w/√3. Rings whose beams have one azimuth leave the same uncertainty: they count as one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array, IntArray
from ..base.sensors import Sensor
from .track import Track

DIVERGENCE, RANGE_NOISE, STEP = 0.003, 0.015, float(np.radians(0.2))
"""Of a sensor that is not known: full angle of the beam, rad, 1 σ of the range, metres, and step
between beams, rad: as those of the table of sensors mostly are."""

NARROWEST = 0.1
"""A middle is not known better than this part of a step, whatever the interval says: beams are as
far from even."""

TOO_FEW = 0.25
"""Of hits that leave the pole wider by more than this part of a step than it is, some are missing:
the end of the tape, or something in front."""

WIDEST = 0.015
"""No beam is wider, rad."""

SAME_AZIMUTH = 0.3
"""Neighbouring rings whose middles differ by less than this part of a step leave the same
uncertainty."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Rings of sweeps that hit the pole, of one LiDAR, in its frame.

    Attributes
    ----------
    directions, ranges, times
        (N, 3) unit vectors, (N,) metres and (N,) s: means of each ring's hits.
    hits, span, step
        (N,) how many, the angle from the first to the last, and between two, rad.
    rings, sweep
        (N,) ring, −1 where none are numbered, and place of the sweep in the track.
    sharing
        (N,) how many rings leave the same uncertainty across the pole.
    divergence
        Full angle of the beams as the widths of the pole show it, rad.
    range_noise
        1 σ of one range, metres.
    """

    directions: Array
    ranges: Array
    times: Array
    hits: Array
    span: Array
    step: float
    rings: IntArray
    sweep: IntArray
    sharing: Array
    divergence: float
    range_noise: float


def rows_of(track: Track, sensor: Sensor | None, radius: float) -> Rows:
    """Make rows of a track.

    Parameters
    ----------
    track
        As `find_track` gives it.
    sensor
        What recorded it; None if it is not known.
    radius
        Of the pole, metres.
    """
    noise = RANGE_NOISE if sensor is None else sensor.range_noise
    wide = DIVERGENCE if sensor is None else sensor.divergence
    ranges = np.linalg.norm(track.xyz, axis=1)
    rays = track.xyz / ranges[:, None]
    if track.rings[0] < 0 or (sensor is not None and sensor.pattern == "rosette"):
        some = track.is_whole
        one = np.ones(np.count_nonzero(some))
        return Rows(
            rays[some], ranges[some], track.stamps[some], one, 0 * one, np.inf,
            -1 + 0 * track.rings[some], track.sweep[some], one, wide, noise,
        )  # fmt: skip
    middle = np.arctan2(track.points[:, 1], track.points[:, 0])[track.sweep]
    azimuth = _wrapped(np.arctan2(rays[:, 1], rays[:, 0]) - middle)
    order = np.lexsort((azimuth, track.rings, track.sweep))
    rays, ranges, azimuth = rays[order], ranges[order], azimuth[order]
    ring, sweep, stamp = track.rings[order], track.sweep[order], track.stamps[order]
    same = (np.diff(ring) == 0) & (np.diff(sweep) == 0)
    steps = np.diff(azimuth)
    step = float(np.median(steps[same])) if np.count_nonzero(same) > 20 else STEP
    first = np.flatnonzero(np.r_[True, ~same])
    counts = np.diff(np.r_[first, len(ring)])

    def mean(values: Array) -> Array:
        summed = np.add.reduceat(values, first, axis=0)
        return np.asarray(summed / (counts if values.ndim == 1 else counts[:, None]))

    direction = mean(rays)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    span = azimuth[first + counts - 1] - azimuth[first]
    hits = 1 + np.round(span / step)
    # A gap within, hits of another turn, or a part that is hidden: not the middle of the pole.
    sound = (hits <= counts + 1) & (span < 0.3)
    sound &= np.logical_and.reduceat(track.is_whole[order], first)
    # Across the end of the tape of a pole that leans, a ring hits a part of its width.
    of_sweep = sweep[first]
    sound &= np.r_[False, np.diff(of_sweep) == 0] & np.r_[np.diff(of_sweep) == 0, False]
    own, of_ring = mean(azimuth), ring[first]
    beside = (np.diff(of_sweep) == 0) & (np.diff(of_ring) <= 2)
    beside &= np.abs(np.diff(own)) < SAME_AZIMUTH * step
    beside &= np.diff(hits) == 0
    run = np.cumsum(np.r_[True, ~beside])
    sharing = np.bincount(run)[run].astype(float)
    away = mean(ranges)
    # Across a pole that leans, an azimuth moves less than sideways.
    east = np.stack([-direction[:, 1], direction[:, 0], 0 * away], axis=1)
    aside = np.cross(track.directions[of_sweep], direction)
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    width = hits * step * away * np.abs(np.einsum("ni,ni->n", east, aside))
    several = sound & (hits > 1)
    if np.count_nonzero(several) > 50:
        wide = float(np.clip(np.mean((width - 2 * radius)[sound] / away[sound]), 0.0, WIDEST))
    return Rows(
        direction[sound], away[sound], mean(stamp)[sound], hits[sound], span[sound], step,
        of_ring[sound], of_sweep[sound], sharing[sound], wide, noise,
    )  # fmt: skip


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


class Open(NamedTuple):
    """Depth of each row before the axis, and 1 σ of its middle across the pole, (N,) metres.

    σ is infinite where hits are missing. ``beyond`` is the share of each row's hits whose middle
    passes next to the pole: only an edge of the beam, or a glow, hit it.
    """

    depth: Array
    sigma: Array
    beyond: Array


def left_open(rows: Rows, across: Array, radius: float, wider: float = 0.0) -> Open:
    """State the uncertainty that the hits of each row leave.

    Parameters
    ----------
    rows
        As `rows_of` gives them.
    across
        (N,) how far the middle moves across the pole by an angle of azimuth, metres a radian.
    radius
        Of the pole, metres.
    wider
        Logarithm of how much wider than taken beams are.
    """
    reach = radius + 0.5 * rows.divergence * np.exp(wider) * rows.ranges
    single = not np.isfinite(rows.step)
    step = 2 * reach if single else rows.step * across
    span = np.zeros_like(reach) if single else (rows.hits - 1) * step
    whole = np.minimum(reach - span / 2, span / 2 + step - reach)
    half = reach if single else np.clip(whole, NARROWEST * step, reach)
    depth, beyond = np.zeros_like(reach), np.zeros_like(reach)
    number = np.arange(int(rows.hits.max(initial=1)))
    for k in number:
        there = k < rows.hits
        place = k * step - span / 2
        mean = (_area(place + half, radius) - _area(place - half, radius)) / (2 * half)
        inside = np.clip(place + half, -radius, radius) - np.clip(place - half, -radius, radius)
        depth += np.where(there, mean, 0.0)
        beyond += np.where(there, 1 - inside / (2 * half), 0.0)
    missing = span / 2 + step - reach < -TOO_FEW * step
    sigma = np.where(missing, np.inf, half / np.sqrt(3))
    return Open(depth / rows.hits, sigma, beyond / rows.hits)


def _area(y: Array, radius: float) -> Array:
    """Integral of the depth √(r² − y²) of a cylinder from its middle to y."""
    y = np.clip(y, -radius, radius)
    return np.asarray(0.5 * (y * np.sqrt(radius**2 - y**2) + radius**2 * np.arcsin(y / radius)))
