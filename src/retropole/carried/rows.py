"""What the returns of a carried pole measure: one row for each ring of each sweep.

The hits of one ring are a few steps across the pole. How deep they lie before the axis, and how far
their middle may be off it sideways, follows from how many there are: k hits with the step s need
the axis within::

    w = min(R − (k−1)s/2, (k+1)s/2 − R)

of their middle, R being the radius of the pole with the beam, so that its standard deviation is
w/√3. Rings whose beams have one azimuth leave the same uncertainty: they count as one, and so do
sweeps in which the pole rests.

Where rings are not known, each return is a row. Those of one passage of the beams over a half of
the pole, from y₁ to y₂ across it, need the axis within ``w = R − (y₂ − y₁)/2`` of their middle,
however many they are: a column of returns has one azimuth. They are moved to that middle, and
count as one across the pole. How deep hits lie is as open as where they are across: what the depth
of the cylinder varies by within ± w is theirs in common.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array, IntArray
from ..base.sensors import Sensor
from .track import Track, takes_its_time

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
"""Rings and sweeps whose middles differ by less than this part of a step leave the same
uncertainty."""

PASSAGE = 0.002
"""Returns follow each other by less, s, while beams pass over a pole: columns of spinning LiDARs
are 0.05 to 0.2 ms apart, and a carried pole moves by 3 mm."""

SEEN_WIDTH = 0.9
"""Of single returns, so large a share lies no wider than the pole with the beam (chosen: others are
of passages whose line is off)."""

NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(6)
"""Where the depth is taken within what is open, for its variance, and with which weights."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Rings of sweeps that hit the pole, of one LiDAR, in its frame.

    Attributes
    ----------
    directions, ranges, times
        (N, 3) unit vectors, (N,) metres and (N,) s: means of each ring's hits.
    hits, step
        (N,) how many, and the angle between two, rad; infinite where each return is a row.
    span, aside
        (N,) of the returns that leave the same open the angle from first to last, and how far each
        row was moved to their middle, rad; 0 where rings are known.
    rings, sweep
        (N,) ring, −1 where none are numbered, and place of the sweep in the track.
    sharing
        (N,) how many rows leave the same uncertainty across the pole.
    divergence
        Full angle of the beams as the widths of the pole show it, rad.
    range_noise
        1 σ of one range, metres.
    """

    directions: Array
    ranges: Array
    times: Array
    hits: Array
    step: float
    span: Array
    aside: Array
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
    if track.rings[0] < 0 or takes_its_time(sensor):
        return _single(track, rays, ranges, radius, wide, noise)
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
    own, of_ring = np.arctan2(direction[:, 1], direction[:, 0]), ring[first]
    sharing = np.ones(len(own))
    # From ring to ring within a sweep, and from sweep to sweep within a ring.
    for major, minor in ((of_sweep, of_ring), (of_ring, of_sweep)):
        by = np.lexsort((minor, major))
        beside = (np.diff(major[by]) == 0) & (np.diff(minor[by]) <= 2)
        beside &= np.abs(_wrapped(np.diff(own[by]))) < SAME_AZIMUTH * step
        beside &= np.diff(hits[by]) == 0
        run = np.cumsum(np.r_[True, ~beside])
        sharing[by] *= np.bincount(run)[run]
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
        direction[sound], away[sound], mean(stamp)[sound], hits[sound], step, 0 * away[sound],
        0 * away[sound], of_ring[sound], of_sweep[sound], sharing[sound], wide, noise,
    )  # fmt: skip


def _single(
    track: Track, rays: Array, ranges: Array, radius: float, wide: float, noise: float
) -> Rows:
    """Make a row of each return, moved to the middle of those that leave the same open."""
    order = np.lexsort((track.stamps, track.sweep))
    order = order[track.is_whole[order]]
    rays, ranges, sweep = rays[order], ranges[order], track.sweep[order]
    n, stamps = track.directions[sweep], track.stamps[order]
    across = np.cross(n, rays)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    off = track.xyz[order] - track.points[sweep]
    y, z = np.einsum("ni,ni->n", off, across), np.einsum("ni,ni->n", off, n)
    follows = (np.diff(sweep) == 0) & (np.diff(stamps) < PASSAGE)
    passage = np.cumsum(np.r_[False, ~follows])
    low, high = np.full(passage[-1] + 1, np.inf), np.full(passage[-1] + 1, -np.inf)
    np.minimum.at(low, passage, z)
    np.maximum.at(high, passage, z)
    # Of a line, two ends are all that returns leave open.
    half = np.unique(2 * passage + (z > (low + high)[passage] / 2), return_inverse=True)[1]
    low, high = np.full(half.max() + 1, np.inf), np.full(half.max() + 1, -np.inf)
    np.minimum.at(low, half, y)
    np.maximum.at(high, half, y)
    aside = (y - (low + high)[half] / 2) / ranges
    seen = (high - low)[half]
    # Where tape glows, returns reach farther than beams are wide.
    widest = float(np.quantile((seen - 2 * radius) / ranges, SEEN_WIDTH))
    wide = float(np.clip(widest, wide, max(wide, WIDEST)))
    moved = rays - aside[:, None] * across
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    return Rows(
        moved, ranges, stamps, np.ones(len(ranges)), np.inf, seen / ranges,
        aside, np.full(len(ranges), -1), sweep, np.bincount(half)[half].astype(float), wide, noise,
    )  # fmt: skip


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


class Open(NamedTuple):
    """Depth of each row before the axis, and 1 σ of it and of its middle across, (N,) metres.

    σ across is infinite where hits are missing. ``beyond`` is the share of each row's hits whose
    middle passes next to the pole: only an edge of the beam, or a glow, hit it.
    """

    depth: Array
    depth_sigma: Array
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
    nominal = radius + 0.5 * rows.divergence * rows.ranges
    reach = radius + (nominal - radius) * np.exp(wider)
    # Whether hits are missing does not depend on the width found: it would on them, to and fro.
    if np.isfinite(rows.step):
        step, middle = rows.step * across, 0.0 * reach
        span = (rows.hits - 1) * step
        whole = np.minimum(reach - span / 2, span / 2 + step - reach)
        half = np.clip(whole, NARROWEST * step, reach)
        missing = span / 2 + step - nominal < -TOO_FEW * step
    else:
        step, middle = 0.0 * reach, rows.aside * rows.ranges
        span = 0.0 * reach
        whole = reach - rows.span * rows.ranges / 2
        half = np.clip(whole, NARROWEST * reach, reach)
        missing = nominal - rows.span * rows.ranges / 2 < -TOO_FEW * nominal
    depth, beyond = np.zeros_like(reach), np.zeros_like(reach)
    at_nodes = np.zeros((len(NODES), len(reach)))
    number = np.arange(int(rows.hits.max(initial=1)))
    for k in number:
        there = np.flatnonzero(k < rows.hits)
        place, room = (middle + k * step - span / 2)[there], half[there]
        low, high = place - room, place + room
        inside = np.clip(high, -radius, radius) - np.clip(low, -radius, radius)
        depth[there] += (_area(high, radius) - _area(low, radius)) / (2 * room)
        beyond[there] += 1 - inside / (2 * room)
        off = np.clip(place + NODES[:, None] * room, -radius, radius)
        at_nodes[:, there] += np.sqrt(radius**2 - off**2)
    at_nodes /= rows.hits
    mean = NODE_WEIGHTS @ at_nodes / 2
    varied = np.maximum(NODE_WEIGHTS @ at_nodes**2 / 2 - mean**2, 0.0)
    sigma = np.where(missing, np.inf, half / np.sqrt(3))
    return Open(depth / rows.hits, np.sqrt(varied), sigma, beyond / rows.hits)


def _area(y: Array, radius: float) -> Array:
    """Integral of the depth √(r² − y²) of a cylinder from its middle to y."""
    y = np.clip(y, -radius, radius)
    return np.asarray(0.5 * (y * np.sqrt(radius**2 - y**2) + radius**2 * np.arcsin(y / radius)))
