"""What to do next with a carried pole: the continuation that lowers the predicted error most.

Each candidate is a few seconds of walking and leaning from where the pole is now. The rows that it
would give (`rows`) are linearised as the recorded ones (`linear`), and its unknown motion is
eliminated; the information left is added to that of the walk about pose, clocks and errors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.sensors import Sensor
from ..base.uncertainty import floor, predicted_error
from .adjustment import Adjusted, information_of
from .linear import KNOT, POSE, axes_at, linearised, ring_bands
from .rows import Rows

SECONDS, SWEEP, PACE, WAY = 5.0, 0.1, 1.0, 3.0
"""Length of a continuation and of a sweep, s; how fast a person walks, m/s, and how far, metres."""

LEAN, SWING, LIFT = float(np.tan(np.radians(20.0))), 2.5, 0.4
"""Slope of a pole that is leaned, time of a swing to and fro, s, and how far it is raised, m."""

NEAREST = 1.5
"""Nearer to a LiDAR a pole is treated as not seen, metres."""

HEIGHTS = 24
"""Places along the pole between which a ring's height on it is interpolated."""


class Continuation(NamedTuple):
    """A way to go on: what it is called, what is done, and 1 σ at a range after it, metres."""

    code: str
    text: str
    sigma: float


class _Candidate(NamedTuple):
    """Where to walk, (2,), where to lean to, (2,), and how far to raise the pole, metres."""

    code: str
    text: str
    way: Array
    lean: Array
    lift: float = 0.0


def next_steps(
    found: Adjusted,
    sensors: tuple[Sensor | None, Sensor | None],
    name: str,
    at: float,
    surroundings: Array | None = None,
) -> tuple[float, list[Continuation]]:
    """Predict the error now, 1 σ in metres, and after each candidate, the least first.

    Parameters
    ----------
    found
        The walk until now.
    sensors
        Of the target and the source; None where it is not known.
    name
        How the text calls the target, from which left and right are seen.
    at
        Range at which the error is predicted, metres.
    surroundings
        (6, 6) information about the pose from them, about the start of the beams.
    """
    known = np.linalg.inv(found.border)
    if surroundings is not None:
        known[POSE, POSE] += surroundings
    poses = [found.frame.T_walk_target, found.frame.T_walk_target @ found.state.T[1]]
    now = error_of(np.asarray(np.linalg.inv(known)), at)
    steps = []
    for each in _candidates(found, poses, name):
        more = _information(found, each, sensors, poses)
        sigma = error_of(np.asarray(np.linalg.inv(known + more)), at)
        steps.append(Continuation(each.code, each.text, sigma))
    return now, sorted(steps, key=lambda step: step.sigma)


def error_of(covariance: Array, at: float) -> float:
    """1 σ of a point at a range, metres, by a border's covariance and with unmodelled errors."""
    return predicted_error(covariance[POSE, POSE] + floor(), (at,))[0].sigma_m


def _candidates(found: Adjusted, poses: list[Array], name: str) -> Iterator[_Candidate]:
    """Ways to walk and to lean, as seen from the target."""
    ahead = _last(found)[:2] - poses[0][:2, 3]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    # Most LiDARs have their z axis upwards; the axis of a pole has no sign.
    up = 1.0 if poses[0][2, 2] + poses[1][2, 2] >= 0 else -1.0
    left = up * np.array([-ahead[1], ahead[0]])
    none = np.zeros(2)
    ways = {
        "stay": ("", none),
        "left": (f"walk {WAY:g} m to the left, as seen from {name}", left),
        "right": (f"walk {WAY:g} m to the right, as seen from {name}", -left),
        "closer": (f"walk {WAY:g} m closer to {name}", -ahead),
        "farther": (f"walk {WAY:g} m farther from {name}", ahead),
    }
    leans = {
        "": ("", none),
        "sides": ("lean the pole to the left and right", left),
        "ahead": (f"lean the pole towards {name} and away from it", ahead),
    }
    for (way, (walk, to)), (lean, (said, side)) in product(ways.items(), leans.items()):
        if way != "stay" or lean:
            code = "_".join(filter(None, (way, lean)))
            yield _Candidate(code, _sentence(walk, said), to, side)
    yield _Candidate("raise", f"Raise the pole by {LIFT:g} m.", none, none, up * LIFT)


def _sentence(*parts: str) -> str:
    said = ", and ".join(filter(None, parts))
    return f"{said[0].upper()}{said[1:]}."


def _last(found: Adjusted) -> Array:
    """(4,) x, y, u and v of the pole where it was seen last."""
    last: Array = axes_at(found.frame, found.state.coefs, np.array([found.times.max()]))[0]
    return last


def _information(
    found: Adjusted,
    to: _Candidate,
    sensors: tuple[Sensor | None, Sensor | None],
    poses: list[Array],
) -> Array:
    """Information (C, C) about the border from both LiDARs in a continuation."""
    begin = float(found.times.max())
    times: Array = begin + SWEEP * np.arange(1.0, 1 + round(SECONDS / SWEEP))
    given = zip((0, 1), poses, sensors, strict=True)
    rows = [_rows(found, to, lidar, T, sensor, times) for lidar, T, sensor in given]
    if not all(len(each.ranges) for each in rows):
        # Rows of one LiDAR alone give no information about the pose.
        return np.zeros_like(found.border)
    first, count = begin - KNOT, round(SECONDS / KNOT) + 6
    seen = tuple(replace(each, rows=own) for each, own in zip(found.frame.seen, rows, strict=True))
    frame = replace(found.frame, first=first, count=count, seen=seen)
    # Coefficients of a smooth spline are near its values at their knots.
    coefs = _axis(found, to, np.asarray(first + KNOT * (np.arange(count) - 1.0)))
    system = linearised(frame, found.state._replace(coefs=coefs), found.spread)
    shares = np.array([_share(found, lidar, own) for lidar, own in enumerate(rows)])
    return information_of(frame, system, np.repeat(shares[system.lidar], 2), found.motion)


def _axis(found: Adjusted, to: _Candidate, times: Array) -> Array:
    """(N, 4) x, y, u and v of the pole in a continuation."""
    since = times - found.times.max()
    gone = np.clip(PACE * since, 0.0, WAY)[:, None] * to.way
    swing = LEAN * np.sin(2 * np.pi * since / SWING)[:, None] * to.lean
    return np.hstack([_last(found)[:2] + gone, swing])


def _rows(
    found: Adjusted,
    to: _Candidate,
    lidar: int,
    T_walk: Array,
    sensor: Sensor | None,
    times: Array,
) -> Rows:
    """Rows where the rings of a LiDAR that hit the pole until now would hit it."""
    frame, rows = found.frame, found.frame.seen[lidar].rows
    bands, own = np.unique(ring_bands(rows), return_inverse=True)
    level = np.arcsin(np.bincount(own, rows.directions[:, 2]) / np.bincount(own))
    axis = _axis(found, to, times)
    # Between the heights at which most rows hit the pole.
    met = se3.apply(T_walk, rows.directions * rows.ranges[:, None])[:, 2]
    low, high = np.quantile(met, [0.1, 0.9]) + to.lift
    heights = np.linspace(float(low), float(high), HEIGHTS)
    z = np.broadcast_to(heights, (len(times), HEIGHTS))
    xy = axis[:, None, :2] + axis[:, None, 2:] * z[:, :, None]
    points = se3.apply(se3.inverse(T_walk), np.dstack([xy, z]).reshape(-1, 3))
    points = points.reshape(len(times), HEIGHTS, 3)
    up = np.arctan2(points[:, :, 2], np.hypot(points[:, :, 0], points[:, :, 1]))
    off = up[:, :, None] - level
    crossed = off[:, :-1] * off[:, 1:] <= 0
    sweep, at, band = np.nonzero(crossed)
    part = off[sweep, at, band] / (off[sweep, at, band] - off[sweep, at + 1, band] + 1e-15)
    hit = points[sweep, at] + part[:, None] * (points[sweep, at + 1] - points[sweep, at])
    ranges = np.linalg.norm(hit, axis=1)
    # No farther than it has been seen: tape gets dim.
    seen = (ranges > NEAREST) & (ranges < max(float(rows.ranges.max()), NEAREST))
    if sensor is not None:
        seen &= sensor.has_in_view(hit)
    sweep, band, hit, ranges = sweep[seen], band[seen], hit[seen], ranges[seen]
    ahead, drift = found.state.clocks[lidar]
    stamp = times[sweep] + ahead + drift * (times[sweep] - frame.middles[lidar])
    hits = np.ones_like(ranges)
    if np.isfinite(rows.step):
        reach = frame.radius + 0.5 * rows.divergence * ranges
        hits = np.maximum(np.round(2 * reach / (rows.step * np.hypot(hit[:, 0], hit[:, 1]))), 1.0)
    return Rows(
        hit / ranges[:, None], ranges, stamp, hits, rows.step,
        np.full(len(ranges), float(rows.span.mean())), np.zeros(len(ranges)),
        bands[band] if rows.rings[0] >= 0 else -np.ones(len(band), dtype=np.int64),
        sweep, np.full(len(ranges), float(rows.sharing.mean())), rows.divergence,
        rows.range_noise,
    )  # fmt: skip


def _share(found: Adjusted, lidar: int, rows: Rows) -> float:
    """How many rows a sweep really gives, of those that its rings could: hands and bodies hide."""
    given = found.frame.seen[lidar].rows
    weighed = float(found.weights[found.lidar == lidar].mean())
    real = weighed * len(given.ranges) / len(np.unique(given.sweep))
    return min(real / (len(rows.ranges) / len(np.unique(rows.sweep))), 1.0)
