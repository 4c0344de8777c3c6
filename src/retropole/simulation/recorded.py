"""The beams of a recorded cloud, those that returned and those between them, and poles put into it.

Surroundings, other bright things and the pattern of the beams stay as they were recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..base import se3
from ..base.datatypes import PER_POINT, Array, IntArray, PointCloud
from ..base.sensors import Sensor
from .raycast import Cylinder, Hits, cast
from .returns import RETRO_GRAZING, RETRO_INCIDENCE, saturation

TILT_STEPS = tuple(np.radians([0.8, 0.4, 0.2, 0.1, 0.05, 0.025, 0.0125]))
"""The axis of the rings is searched in steps that shrink, rad. The first two reach 2.4° from the
cloud's z axis: clouds come in the frame of a vehicle rather than of the LiDAR."""

SHARPNESS_POINTS = 20_000
"""The axis is searched with at most this many points (chosen: 10 ms a step)."""

LEVEL_BIN = float(np.radians(0.02))
"""The histogram of elevations has bins of this size, rad: a fifth of the closest rings (chosen)."""

LEVEL_SHARE = 0.7
"""Elevations are rings if so large a share of the returns lies on the rings (chosen; recordings of
spinning LiDARs have 0.9 and more, a raster of directions has none)."""

ON_RING = float(np.radians(0.2))
"""A return lies on a ring of the table within this elevation, rad: calibrated rings differ from it
by tenths of a degree."""

MIN_GAP = 1.5
"""A ring has lost returns where two of its neighbours differ by more than this many steps."""

MAX_GAP = float(np.radians(45.0))
"""Wider gaps are not filled, rad: behind them may be the vehicle itself, or no beam at all
(chosen)."""


@dataclass(frozen=True, eq=False)
class RecordedBeams:
    """Beams of one recording, in its frame; the first N are those of its N returns.

    Attributes
    ----------
    origin
        (3,) where they start, metres.
    directions
        (M, 3) unit vectors.
    ranges
        (M,) metres; infinite where there was no return.
    rings
        (M,) index of the ring; −1 where it is not known.
    like
        (M,) index of a return on the same ring next to it; of a return, its index.
    """

    origin: Array
    directions: Array
    ranges: Array
    rings: IntArray
    like: IntArray


def recorded_beams(cloud: PointCloud, sensor: Sensor | None = None) -> RecordedBeams:
    """Find the beams of a recording.

    A recording shows nothing of a beam without a return. Where neighbours on one ring differ by
    more than `MIN_GAP` steps, the beams between them are put back evenly, at the elevation of
    both, so that a pole against the sky is hit. Rings come from the cloud, or else from
    elevations that come in sharp levels. Without rings, as of a solid-state LiDAR, no beam is
    put back. Where a sensor that spins is given and the returns lie on its rings, all beams that
    it sends are there, above the horizon too.
    """
    rays = cloud.xyz - cloud.origin
    ranges = np.linalg.norm(rays, axis=1)
    directions = rays / ranges[:, None]
    if sensor is not None and _is_of(directions, cloud.axis, sensor):
        return _sent_beams(cloud, directions, ranges, sensor)
    given = cloud.ring is not None and len(np.unique(cloud.ring)) > 1
    axis = cloud.axis if given else sharpest_axis(directions)
    rings = cloud.ring if given and cloud.ring is not None else levels(directions @ axis)
    missing, like = _between(directions, rings, axis, cloud.frame)
    own = np.arange(len(cloud))
    return RecordedBeams(
        origin=cloud.origin,
        directions=np.concatenate([directions, missing]),
        ranges=np.concatenate([ranges, np.full(len(missing), np.inf)]),
        rings=np.concatenate([rings, rings[like]]),
        like=np.concatenate([own, like]),
    )


def _is_of(directions: Array, axis: Array, sensor: Sensor) -> bool:
    """Whether directions (N, 3) lie on the rings of a sensor that spins."""
    if sensor.pattern != "spinning" or not len(directions):
        return False
    in_view = sensor.has_in_view(directions, -ON_RING)
    rings = _table_rings(directions, axis, sensor)
    off = np.abs(sensor.elevations[rings] - _level_up(directions, axis, sensor))
    return bool(np.mean((off < ON_RING) & in_view) > LEVEL_SHARE)


def _level(axis: Array) -> tuple[Array, Array]:
    """Two directions (3,) across an axis (3,), and across each other."""
    across = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    return across, np.cross(axis, across)


def _up(directions: Array, axis: Array) -> Array:
    return np.asarray(np.arcsin(np.clip(directions @ axis, -1.0, 1.0)))


def _table_rings(directions: Array, axis: Array, sensor: Sensor) -> IntArray:
    """Which of the sensor's rings (N,) directions (N, 3) are nearest to."""
    middles = (sensor.elevations[1:] + sensor.elevations[:-1]) / 2
    up = _level_up(directions, axis, sensor)
    return np.asarray(np.searchsorted(middles, up), dtype=np.int64)


def _level_up(directions: Array, axis: Array, sensor: Sensor) -> Array:
    """Elevations (N,) of directions (N, 3) without the rise of their lines, rad."""
    up = _up(directions, axis)
    if not len(sensor.rise):
        return up
    return up - sensor.risen(np.arctan2(directions[:, 1], directions[:, 0]))


def _sent_beams(
    cloud: PointCloud, directions: Array, ranges: Array, sensor: Sensor
) -> RecordedBeams:
    """Add to a recording's beams those that its sensor sends and nothing returned."""
    own = _table_rings(directions, cloud.axis, sensor)
    count = round(2 * np.pi / sensor.azimuth_step)
    basis = np.stack([*_level(cloud.axis), cloud.axis])
    flat = directions @ basis.T
    column = np.arctan2(flat[:, 1], flat[:, 0]) / sensor.azimuth_step
    # Beams keep their phase from ring to ring, near enough to determine which of them returned.
    seen = np.zeros((len(sensor.elevations), count), dtype=bool)
    seen[own, np.round(column).astype(np.int64) % count] = True
    ring, turn = np.nonzero(~seen)
    missing = _rays(np.asarray(turn * sensor.azimuth_step), sensor.elevations[ring]) @ basis
    if not sensor.sees_all_around:
        # Such lines are swept about the z axis of the sensor.
        kept = sensor.has_in_view(missing)
        azimuth, ring = np.arctan2(missing[kept, 1], missing[kept, 0]), ring[kept]
        missing = _rays(azimuth, sensor.elevations[ring] + sensor.risen(azimuth))
    return RecordedBeams(
        origin=cloud.origin,
        directions=np.concatenate([directions, missing]),
        ranges=np.concatenate([ranges, np.full(len(missing), np.inf)]),
        rings=np.concatenate([own, ring]),
        like=np.concatenate([np.arange(len(cloud)), np.zeros(len(missing), dtype=np.int64)]),
    )


def _rays(azimuth: Array, up: Array) -> Array:
    level = np.cos(up)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(up)], axis=1)


def in_frame(beams: RecordedBeams, T: Array) -> RecordedBeams:
    """Express beams in another frame by its pose (4, 4)."""
    origin = se3.apply(T, beams.origin[None])[0]
    return replace(beams, origin=origin, directions=beams.directions @ T[:3, :3].T)


def hits_on(beams: RecordedBeams, poles: Sequence[Cylinder], width: float) -> tuple[Hits, IntArray]:
    """Cast the beams at the poles; the index is of those that hit one before their return."""
    hits = cast(beams.origin, beams.directions, poles, width)
    return hits, np.flatnonzero(hits.ranges < beams.ranges)


def sharpest_axis(directions: Array) -> Array:
    """Find the axis (3,) about which the elevations of directions (N, 3) are sharpest.

    It lies near z. The sharpness is the entropy of the elevations' histogram.
    """
    some = directions[:: -(-len(directions) // SHARPNESS_POINTS)]
    tilt, offsets = np.zeros(2), np.arange(-2, 3)
    for step in TILT_STEPS:
        tried = [tilt + step * np.array([i, j]) for i in offsets for j in offsets]
        # The middle first: of equals it stays.
        tried.sort(key=lambda other: float(np.linalg.norm(other - tilt)))
        tilt = min(tried, key=lambda other: _entropy(some @ _axis(other), step))
    return _axis(tilt)


def _axis(tilt: Array) -> Array:
    axis = np.array([tilt[0], tilt[1], 1.0])
    return np.asarray(axis / np.linalg.norm(axis))


def _entropy(sines: Array, step: float) -> float:
    elevation = np.arcsin(np.clip(sines, -1, 1))
    share = np.bincount(((elevation + np.pi / 2) / step).astype(np.int64)) / len(sines)
    share = share[share > 0]
    return float(-(share * np.log(share)).sum())


def levels(sines: Array) -> IntArray:
    """Number the levels (N,) on which elevations lie, from the lowest up; −1 for those on none.

    Parameters
    ----------
    sines
        (N,) of the elevations.
    """
    rings = np.full(len(sines), -1, dtype=np.int64)
    elevation = np.arcsin(np.clip(sines, -1, 1))
    bins = ((elevation + np.pi / 2) / LEVEL_BIN).astype(np.int64)
    full = np.bincount(bins, minlength=int(np.pi / LEVEL_BIN) + 2) >= 15
    edges = np.flatnonzero(np.diff(np.r_[False, full, False].astype(np.int64)))
    starts, ends = edges[::2], edges[1::2]
    # Rings of the table of sensors differ by 8 bins or more.
    narrow = ends - starts <= 6
    for ring, (start, end) in enumerate(zip(starts[narrow], ends[narrow], strict=True)):
        # A neighbouring bin has what fell over its edge.
        rings[(bins >= start - 1) & (bins <= end)] = ring
    if np.count_nonzero(rings >= 0) < LEVEL_SHARE * len(rings):
        rings[:] = -1
    return rings


def _between(
    directions: Array, rings: IntArray, axis: Array, frame: IntArray | None
) -> tuple[Array, IntArray]:
    """Directions (K, 3) of beams that are missing in each ring, and a neighbour (K,) of each."""
    across, sideways = _level(axis)
    azimuth = np.arctan2(directions @ sideways, directions @ across)
    sines = directions @ axis
    frames = np.zeros(len(rings), dtype=np.int64) if frame is None else frame
    groups = [
        np.flatnonzero((rings == ring) & (frames == number))
        for number in np.unique(frames)
        for ring in np.unique(rings[rings >= 0])
    ]
    sorted_groups = [group[np.argsort(azimuth[group])] for group in groups if len(group) > 1]
    if not sorted_groups:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    gaps = [np.diff(azimuth[g], append=azimuth[g[0]] + 2 * np.pi) for g in sorted_groups]
    common = float(np.median(np.concatenate(gaps)))
    found, like = [], []
    for group, gap in zip(sorted_groups, gaps, strict=True):
        step = min(float(np.median(gap)), MIN_GAP * common)
        at = np.flatnonzero((gap > MIN_GAP * step) & (gap <= MAX_GAP))
        count = np.round(gap[at] / step).astype(np.int64) - 1
        left = np.repeat(at, count)
        number = np.arange(len(left)) - np.repeat(np.cumsum(count) - count, count) + 1
        share = number / np.repeat(count + 1, count)
        turned = azimuth[group[left]] + share * gap[left]
        following = group[(left + 1) % len(group)]
        sine = (1 - share) * sines[group[left]] + share * sines[following]
        level = np.sqrt(1 - sine**2)
        found.append(
            (level * np.cos(turned))[:, None] * across
            + (level * np.sin(turned))[:, None] * sideways
            + sine[:, None] * axis
        )
        like.append(group[left])
    return np.concatenate(found), np.concatenate(like)


DIVERGENCE = 0.003
"""Full angle of the beam, rad, where the sensor is not known: that of most of the table."""


def range_noise(sensor: Sensor | None) -> float:
    """1 σ of a LiDAR's ranges, metres."""
    # That of most of the table of sensors.
    return 0.010 if sensor is None else sensor.range_noise


def in_sensor_frame(poles: Sequence[Cylinder], T_target_cloud: Array) -> list[Cylinder]:
    """Express poles of the target's frame in a cloud's, by its pose (4, 4)."""
    T = se3.inverse(T_target_cloud)
    return [
        replace(pole, centre=se3.apply(T, pole.centre[None])[0], axis=T[:3, :3] @ pole.axis)
        for pole in poles
    ]


def with_poles(
    cloud: PointCloud,
    beams: RecordedBeams,
    poles: Sequence[Cylinder],
    width: float,
    sensor: Sensor | None,
    rng: np.random.Generator,
    biases: Array,
) -> tuple[PointCloud, IntArray]:
    """Replace what the poles hide by returns on them; the labels (N',) are their index or −1.

    The biases are those of ranges to tape, metres: of each ring, and last where none is known.
    """
    hits, seen_patches = hits_on(beams, poles, width)
    ranges = hits.ranges[seen_patches] + biases[beams.rings[seen_patches]]
    ranges += range_noise(sensor) * rng.normal(size=len(seen_patches))
    points = beams.origin + ranges[:, None] * beams.directions[seen_patches]
    # Returns stay in their places in the file; beams that had none come last.
    count = len(cloud)
    rows = np.concatenate([np.arange(count), beams.like[seen_patches[seen_patches >= count]]])
    place = np.where(seen_patches < count, seen_patches, 0)
    place[seen_patches >= count] = np.arange(count, len(rows))
    arrays: dict[str, Any] = {"xyz": cloud.xyz[rows]}
    for name in PER_POINT:
        value = getattr(cloud, name)
        arrays[name] = None if value is None else value[rows]
    if cloud.intensity is None:
        arrays["intensity"] = np.zeros(len(rows))
    labels = np.full(len(rows), -1, dtype=np.int64)
    arrays["xyz"][place] = points
    arrays["intensity"][place] = _tape(cloud.intensity, sensor, hits.cosine[seen_patches], rng)
    labels[place] = hits.surface[seen_patches]
    if cloud.ring is not None and np.array_equal(cloud.ring, beams.rings[:count]):
        # A beam that the sensor sends has no return next to it on a ring that hit nothing.
        arrays["ring"][place] = beams.rings[seen_patches]
    return replace(cloud, **arrays), labels


def _tape(
    recorded: Array | None, sensor: Sensor | None, cosine: Array, rng: np.random.Generator
) -> Array:
    """Intensities of tape on the scale of the recording, saturated at normal incidence."""
    # A cloud without intensity gets the scale of a byte, and its returns 0.
    top = 255.0 if recorded is None else float(recorded.max(initial=0.0))
    if sensor is None:
        # 8-bit sensors have the weakest tape at 200 of 255 (Xue et al. 2019, Table I).
        least = 0.8 * top
    else:
        scale = 1.0
        if recorded is not None and top <= 1.0 < sensor.threshold:
            scale = 1.0 / sensor.intensity_max
        least = scale * sensor.threshold
        top = scale * saturation(sensor)
    # As `NoiseModel.intensity_noise`.
    loss = 0.15 * np.abs(rng.normal(size=len(cosine)))
    strength = np.clip((RETRO_GRAZING + RETRO_INCIDENCE * cosine) * (1 - loss), 0, 1)
    bright = least + (top - least) * strength
    return np.asarray(np.round(bright) if top > 1.0 else bright)
