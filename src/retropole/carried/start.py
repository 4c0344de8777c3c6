"""Where to start: pose and clock offset from the two tracks, in closed form for each offset.

At a clock offset τ, the source's line at the target's time t is that of its track at t + τ. The
rotation is that which lays the source's directions on the target's (Kabsch), once for each sign,
as a line has no arrow; the translation solves::

    Σ (I − n nᵀ)(R c_s + t − c_t) = 0

over lines with direction n and a point c. The cost, an angle and a distance, falls in basins
of which each is a start.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from .track import Track

WIDEST = 5.0
"""Clocks are off by this amount at most, s."""

STEP, FINE_STEP = 0.02, 0.002
"""Between the offsets that are tried, s: 20 ms at 1 m/s is 2 cm, less than a basin is wide."""

GAP = 0.25
"""Between sweeps further apart a track is not interpolated, s."""

METRES_PER_RADIAN = 3.0
"""Weighs distances of lines with angles: the usual distance of a pole, metres."""

FEWEST = 30
"""At an offset where fewer sweeps are common it is not tried."""

AS_GOOD = 4.0
"""Basins with up to this many times the least cost are starts, too."""


class Poses(NamedTuple):
    """Poses (L, 4, 4) of all LiDARs in the frame of the first, and how far ahead clocks are, s."""

    T: Array
    offsets: Array


class Start(NamedTuple):
    """A pose to start from, (4, 4), with the clock offset, s, its cost, rad, and which sign.

    ``common`` is how many sweeps it rests on.
    """

    T_target_source: Array
    offset: float
    cost: float
    flipped: bool
    common: int = 0

    @property
    def poses(self) -> Poses:
        """Of both LiDARs."""
        return Poses(np.stack([np.eye(4), self.T_target_source]), np.array([0.0, self.offset]))


def find_starts(target: Track, source: Track) -> list[Start]:
    """Find the basins of pose and clock offset, the best first; none where tracks do not overlap.

    Parameters
    ----------
    target, source
        As `find_track` gives them, each by its own clock.
    """
    grid = np.arange(-WIDEST, WIDEST + STEP, STEP)
    starts: list[Start] = []
    for flipped in (False, True):
        coarse = [_at(target, source, float(tau), flipped) for tau in grid]
        cost = np.array([np.inf if each is None else each.cost for each in coarse])
        inner = np.r_[np.inf, cost, np.inf]
        lowest = np.flatnonzero((cost <= inner[:-2]) & (cost <= inner[2:]) & np.isfinite(cost))
        for k in lowest[np.argsort(cost[lowest])][:6]:
            fine = np.arange(grid[k] - STEP, grid[k] + STEP, FINE_STEP)
            tried = [_at(target, source, float(tau), flipped) for tau in fine]
            starts.append(min((each for each in tried if each is not None), key=lambda s: s.cost))
    starts.sort(key=lambda each: each.cost)
    return [each for each in starts if each.cost <= AS_GOOD * starts[0].cost]


def _at(target: Track, source: Track, tau: float, flipped: bool) -> Start | None:
    """Pose at one offset: the source's clock is tau ahead of the target's."""
    times = target.times + tau
    after = np.searchsorted(source.times, times)
    inside = (after > 0) & (after < len(source.times))
    after = np.clip(after, 1, len(source.times) - 1)
    apart = source.times[after] - source.times[after - 1]
    rows = np.flatnonzero(inside & (apart < GAP))
    if len(rows) < FEWEST:
        return None
    after = after[rows]
    part = ((times[rows] - source.times[after - 1]) / apart[rows])[:, None]
    point = (1 - part) * source.points[after - 1] + part * source.points[after]
    along = (1 - part) * source.directions[after - 1] + part * source.directions[after]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    if flipped:
        along = -along
    return _fit(target.points[rows], target.directions[rows], point, along, tau, flipped)


def _fit(
    to: Array, to_along: Array, point: Array, along: Array, tau: float, flipped: bool
) -> Start:
    kept = np.ones(len(to), dtype=bool)
    for _ in range(3):
        u, _, vt = np.linalg.svd(to_along[kept].T @ along[kept])
        R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        gap = _across(to_along, to - point @ R.T)
        normal = np.count_nonzero(kept) * np.eye(3) - to_along[kept].T @ to_along[kept]
        t = np.linalg.lstsq(normal, gap[kept].sum(axis=0), rcond=1e-6)[0]
        distance = np.linalg.norm(gap - _across(to_along, t), axis=1)
        angle = np.arccos(np.clip(np.einsum("ni,ni->n", to_along, along @ R.T), -1, 1))
        off = angle + distance / METRES_PER_RADIAN
        kept = off <= 3 * np.median(off)
    cost = float(np.median(angle) + np.median(distance) / METRES_PER_RADIAN)
    return Start(se3.from_rt(R, t), tau, cost, flipped, len(to))


def _across(along: Array, offsets: Array) -> Array:
    """Parts (N, 3) of offsets, (N, 3) or (3,), across unit vectors (N, 3)."""
    return np.asarray(offsets - (along * offsets).sum(axis=1)[:, None] * along)
