"""A mast that sways: its returns are brought to rest, and how far off that may be is stated.

The motion comes from the sweeps (`sweeps`), and where it rests from how masts move (`oscillation`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array, PointCloud
from ..base.systematic import Sway, stated_sway
from .ordering import numbered
from .oscillation import SIZES, Asked, Motion, hypotheses, infer, length_of, ways_of
from .static import MAX_TURN, MIN_FRAMES, turned_by
from .sweeps import Observed, Timed, observe, timed, without

PASSES, AT_REST = 8, float(np.radians(2e-4))
"""The cells of the returns are made without the motion as it is known, and the motion estimated
anew, so many times at most, or until it changes by less, rad."""

GROUPS = 50
"""Of sweeps, by which the noise of the motion is judged."""

MEDIAN_SQUARE = 0.4549
"""Median of χ² with one degree of freedom."""

STORED = 200
"""Values of the motion that are kept to be drawn."""


class Steadied(NamedTuple):
    """A cloud at rest; how it swayed, or None; and the motion (B, 6) that was taken out, or None:
    turn and shift from rest of each part of the recording."""

    cloud: PointCloud
    sway: Sway | None = None
    motion: Array | None = None


def steadied(cloud: PointCloud, stated: float | None = None) -> Steadied:
    """Bring the returns of all sweeps to where the LiDAR rests.

    Parameters
    ----------
    cloud
        Without what moved in the scene.
    stated
        1 σ of the angle that the mast is said to sway by, rad; None where nothing is said: then
        only what is seen counts.

    Returns
    -------
    Steadied
        The same cloud and no motion where it is not seen to sway, or moved otherwise.
    """
    as_it_is = Steadied(cloud, None if stated is None else stated_sway(stated))
    if cloud.frame is None or len(numbered(cloud.frame)[0]) < MIN_FRAMES:
        return as_it_is
    when = timed(cloud)
    sizes = SIZES if stated is None else stated * np.array([0.5, 1.0, 2.0])
    found = motion_of(cloud, when, sizes)
    if found is None or (stated is None and not found.is_seen) or turned_by(cloud) > MAX_TURN:
        # What turned by more is refused: a LiDAR that was bumped does not sway.
        return as_it_is
    still = without(cloud.xyz, cloud.origin, found.motion[when.of_all])
    return Steadied(replace(cloud, xyz=still), _stated(found, when), found.motion)


def motion_of(cloud: PointCloud, when: Timed, sizes: Array) -> Motion | None:
    """Estimate the motion, from cells that are made anew without it until it rests.

    None where the returns lie on no flat cell.
    """
    xyz = cloud.xyz[when.index]
    found = None
    motion, noise = np.zeros((len(when.times), 6)), 1.0
    tried = list(hypotheses(when.times))
    for _ in range(PASSES):
        observed = observe(xyz, cloud.origin, when, motion)
        if not len(observed.plane):
            return None
        found, noise = judged(observed, list(ask(observed, tried)), sizes, motion, noise)
        change = float(np.abs(found.motion - motion)[:, :3].max())
        motion = found.motion
        if not found.is_seen or change < AT_REST:
            break
    return found


def ask(observed: Observed, tried: Iterable[tuple[float, float, Array]]) -> Iterator[Asked]:
    """Ask the returns about the features of some `hypotheses`."""
    for frequency, share, features in tried:
        yield Asked(frequency, share, features, *observed.about(features))


def judged(
    observed: Observed, asked: Sequence[Asked], sizes: Array, motion: Array, noise: float = 1.0
) -> tuple[Motion, float]:
    """Weigh all hypotheses by what the returns were asked, and by their noise as it comes out.

    Parameters
    ----------
    observed, asked
        What the returns say, and what of the hypotheses.
    sizes
        As of `oscillation.infer`.
    motion, noise
        (B, 6) the motion, and the noise, as they are known.
    """
    ways = ways_of(motion)
    found = infer(asked, sizes, ways, noise)
    after = noise_of(observed, *found.best)
    return (found if after == noise else infer(asked, sizes, ways, after)), after


def noise_of(observed: Observed, features: Array, coefficients: Array) -> float:
    """How many times the variance that the returns state what the motion leaves has; 1 at least.

    Returns of one wall err alike; the sweeps then scatter by more than each one's returns let
    expect. The motion is given by features (B, F) and their coefficients (F, 6).
    """
    parts = len(features)
    group = np.arange(parts) * min(GROUPS, parts) // parts
    own = (group[:, None] == np.arange(group[-1] + 1)).astype(np.float64)
    left, pull = observed.about(np.concatenate([own, features], axis=1))
    size = 6 * own.shape[1]
    rest = pull[:size] - left[:size, size:] @ coefficients.reshape(-1)
    value, way = np.linalg.eigh(left[:size, :size])
    told = value > 1e-6 * value[-1]
    square = (way.T @ rest)[told] ** 2 / value[told]
    return max(1.0, float(np.median(square)) / MEDIAN_SQUARE)


class Velocity(NamedTuple):
    """What the sweeps say of a steady motion: (6, 6) information and (6,) gradient at rest of its
    turn and shift per second, rad/s and m/s in the LiDAR's frame, the shift that of the beams'
    origin."""

    information: Array
    pull: Array


def velocity_of(cloud: PointCloud, prior: Array) -> Velocity | None:
    """Ask the sweeps of a recording how their LiDAR moved on steadily; None where they do not tell.

    Parameters
    ----------
    cloud
        Without what moved in the scene.
    prior
        (6, 6) covariance of the turn and shift per second that there may be.
    """
    if cloud.frame is None or len(numbered(cloud.frame)[0]) < 2:
        return None
    when = timed(cloud)
    features = (when.times - when.times.mean())[:, None]
    xyz, most, noise = cloud.xyz[when.index], np.asarray(np.linalg.inv(prior)), 1.0
    rate: Array = np.zeros((1, 6))
    found = None
    for _ in range(PASSES):
        observed = observe(xyz, cloud.origin, when, features @ rate)
        if not len(observed.plane):
            return None
        left, pull = observed.about(features)
        after = np.asarray(np.linalg.solve(left / noise + most, pull / noise)[None])
        change = float(np.abs(features @ (after - rate))[:, :3].max())
        rate, noise = after, noise_of(observed, features, after)
        found = Velocity(left / noise, pull / noise)
        if change < AT_REST:
            break
    return found


def without_velocity(cloud: PointCloud, rate: Array, later: float) -> PointCloud:
    """Bring the returns of a LiDAR that moves on steadily to where they were at one moment.

    Parameters
    ----------
    cloud
        The recording.
    rate
        (6,) turn and shift per second, as of `velocity_of`.
    later
        Seconds from the moment to the middle of the recording.
    """
    if cloud.frame is None:
        after = np.full(len(cloud), later)
    else:
        when = timed(cloud)
        after = (when.times - when.times.mean() + later)[when.of_all]
    return replace(cloud, xyz=without(cloud.xyz, cloud.origin, after[:, None] * rate))


def _stated(found: Motion, when: Timed) -> Sway:
    """State the motion: its size, its frequency, and how it went."""
    return Sway(
        found.angle,
        found.frequency,
        length_of(when.times),
        found.covariance,
        drawn(when.times),
        drawn(main_angles(found.motion)),
    )


def main_angles(motion: Array) -> Array:
    """(B,) angle of a motion (B, 6) in its main direction, rad."""
    turn = motion[:, :3]
    return np.asarray(turn @ np.linalg.svd(turn, full_matrices=False)[2][0])


def drawn(values: Array) -> tuple[float, ...]:
    """Those of many values (B,) that are kept to be drawn."""
    return tuple(values[:: max(1, -(-len(values) // STORED))].tolist())
