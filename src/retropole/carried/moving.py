"""The carried pole as a line that moves: for beams that are spread over the time of a sweep.

A spinning LiDAR passes over a pole within milliseconds. Other patterns spread a few returns over
the whole sweep, in which the pole moves by more than it is thick: only in some sweeps is it found
as a line at rest. Near these, in a frame whose z axis is the mean direction of the pole, its
returns of half a second are on::

    x = a₀ + a₁ z + a₂ t + a₃ t z,     y = b₀ + b₁ z + b₂ t + b₃ t z,

z being the height above their middle: linear in all unknowns. What lies on that line is the pole in
the sweeps next to it, from which the next are reached.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..base.datatypes import Array, BoolArray, IntArray

HALF = 0.25
"""Half of the time over which the motion is taken for even, s: with an acceleration of 1 m/s² the
pole is 3 cm off at its ends."""

NEAR, ON = 0.2, 0.06
"""Returns are looked for at this distance from where the pole is expected, metres, and belong to it
at this distance from the line that moves: its radius, half of a beam, and an uneven motion."""

STEEP, MOVES, LEANS, SCATTER = 1.0, 1.0, 0.7, 0.02
"""1 σ of the slope of the pole, of its speed, m/s, of the rate of its lean, rad/s, and of a return
across it, metres."""

FEWEST, MAX_LEAN_SIGMA = 8, 0.05
"""A line has no fewer returns (it has eight unknowns, of which six have a prior), and a direction
with a smaller 1 σ, rad."""

AGREED = 0.6
"""Share of the returns near the expected pole that are on its line."""

LONGEST = 1.5
"""No part of a pole is further from the middle of its returns, metres."""

ROUNDS, STEPS = 12, 4
"""A gap is entered from either side by `HALF` each time, 3 s in all; a line converges in a few
steps."""


class Returns(NamedTuple):
    """Bright returns (M, 3) metres, their (M,) times, s, sweeps and rings, and `Track.is_whole`."""

    xyz: Array
    times: Array
    sweep: IntArray
    rings: IntArray
    is_whole: BoolArray

    def select(self, index: BoolArray | IntArray) -> Returns:
        """Select some returns."""
        columns = self.xyz[index], self.times[index], self.sweep[index], self.rings[index]
        return Returns(*columns, self.is_whole[index])


def joined(parts: Sequence[Returns]) -> Returns:
    """Put the returns of several sweeps together."""
    columns: list[Any] = [np.concatenate(each) for each in zip(*parts, strict=True)]
    return Returns(*columns)


class Line(NamedTuple):
    """The pole at a time: a point (3,), its direction (3,), and the index of its returns."""

    time: float
    point: Array
    direction: Array
    returns: IntArray


def follow(times: Array, points: Array, directions: Array, returns: Returns) -> list[Line]:
    """Follow the pole from the sweeps in which it was found to those between and next to them.

    Parameters
    ----------
    times, points, directions
        (S,) s in order, (S, 3) metres and (S, 3) unit vectors that run on: where it was found.
    returns
        All that shine, sweep by sweep.

    Returns
    -------
    list of Line
        One for each sweep with returns of the pole, in order.
    """
    up = directions.sum(axis=0, keepdims=True)
    R = Rotation.align_vectors([[0.0, 0.0, 1.0]], up)[0].as_matrix()
    by_time = np.argsort(returns.times, kind="stable")
    xyz, at = (returns.xyz @ R.T)[by_time], returns.times[by_time]
    first = np.flatnonzero(np.r_[True, np.diff(returns.sweep) > 0])
    middles = np.add.reduceat(returns.times, first) / np.diff(np.r_[first, len(returns.times)])
    sweep = returns.sweep[by_time]
    slopes = directions @ R.T
    slopes = slopes[:, :2] / slopes[:, 2:]
    middle = points @ R.T
    known = np.c_[times, middle, slopes]
    lines: list[Line] = []
    for _ in range(ROUNDS):
        near = _near(known, xyz, at)
        lines, rows = [], []
        for number, time in zip(returns.sweep[first], middles, strict=True):
            low, high = np.searchsorted(at, (time - HALF, time + HALF))
            window = low + np.flatnonzero(near[low:high])
            fit = _fit(xyz[window], at[window] - time)
            own = window[fit.on][sweep[window[fit.on]] == number] if fit is not None else []
            if fit is None or not len(own):
                continue
            rows.append(np.r_[time, fit.point, fit.slope])
            along = np.r_[fit.slope, 1.0] / np.sqrt(1 + fit.slope @ fit.slope)
            lines.append(Line(float(time), fit.point @ R, along @ R, np.sort(by_time[own])))
        if len(rows) <= len(known) or not rows:
            break
        known = np.array(rows)
    return lines


def _near(known: Array, xyz: Array, at: Array) -> BoolArray:
    """Which returns are near a pole that is known at some times: rows of time, point and slope."""
    expected = np.stack([np.interp(at, known[:, 0], each) for each in known[:, 1:].T], axis=1)
    after = np.clip(np.searchsorted(known[:, 0], at), 1, len(known) - 1)
    ago = np.abs(at[:, None] - known[:, 0][np.stack([after - 1, after], axis=1)]).min(axis=1)
    off = xyz - expected[:, :3]
    aside = off[:, :2] - expected[:, 3:] * off[:, 2:]
    within = np.abs(off[:, 2]) < LONGEST
    return np.asarray((ago < HALF) & within & (np.linalg.norm(aside, axis=1) < NEAR))


class Fit(NamedTuple):
    """A point (3,) of the axis at t = 0, its slopes (2,), and which returns (M,) are on it."""

    point: Array
    slope: Array
    on: BoolArray


def _fit(xyz: Array, t: Array) -> Fit | None:
    """Fit a line that moves to returns (M, 3) at times (M,); None where they make none."""
    if len(xyz) < FEWEST:
        return None
    height, on = xyz[:, 2].mean(), np.ones(len(xyz), dtype=bool)
    z = xyz[:, 2] - height
    A = np.stack([np.ones(len(z)), z, t, t * z], axis=1)
    prior = np.diag([0.0, SCATTER / STEEP, SCATTER / MOVES, SCATTER / LEANS])
    for _ in range(STEPS):
        if np.count_nonzero(on) < FEWEST:
            return None
        rows = np.r_[A[on], prior]
        normal = rows.T @ rows
        coefs = np.linalg.solve(normal, A[on].T @ xyz[on, :2])
        before, on = on, np.linalg.norm(xyz[:, :2] - A @ coefs, axis=1) < ON
        if np.array_equal(on, before):
            break
    lean_sigma = SCATTER * np.sqrt(np.linalg.inv(normal)[1, 1])
    if np.count_nonzero(on) < max(FEWEST, AGREED * len(on)) or lean_sigma > MAX_LEAN_SIGMA:
        return None
    return Fit(np.r_[coefs[0], height], coefs[1], on)
