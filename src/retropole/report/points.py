"""A cloud as a page carries it: a part of its points, quantised, in base64."""

from __future__ import annotations

import base64

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import Array, Detection, PointCloud

IntpArray = NDArray[np.intp]

COORDINATE_STEPS = 65535
"""Steps of a coordinate over its extent: 16 bits."""

MAX_SHOWN_RANGE = 300.0
"""Points further than this from the beam origin, metres, are left out of the view: one stray
return would coarsen all coordinates, and the box stays under 600 m, so a step under 1 cm."""


SHOWN_RADIUS = (4.0, 30.0)
"""Least and largest radius of what the camera starts by looking at, metres."""

DEFAULT_RANGE = 10.0
"""What a cloud without points is taken to span, metres."""


class PackedPoints(msgspec.Struct, frozen=True):
    """Points for the code of the page.

    Attributes
    ----------
    xyz
        Base64 of little-endian uint16 (n, 3); a point is ``low + size * xyz / 65535``, metres.
    low, size
        (3,) corner and extent of the points, metres.
    """

    xyz: str
    low: list[float]
    size: list[float]


class Levels(msgspec.Struct, frozen=True):
    """Intensities of packed points, for a threshold that the reader of the page moves.

    Attributes
    ----------
    values
        Base64 of little-endian uint16 (n,); an intensity is ``low + (high - low) value / 65535``.
    low, high, median
        Of the whole cloud.
    threshold
        The one to begin with.
    """

    values: str
    low: float
    high: float
    median: float
    threshold: float


class PackedCloud(PackedPoints, frozen=True):
    """A cloud for the code of the page.

    Attributes
    ----------
    levels
        Intensities in full; None if the page has no threshold to move.
    intensity
        Base64 of uint8 (n,), 1 % to 99 % of the scale of the cloud; None if that gives no
        information.
    on_poles
        How many points are on poles; they come first, then those in rejected clusters.
    shown, total, far
        How many points are packed, the cloud has, and are left out as too far.
    origin, centre, radius
        (3,) where the beams start, and what to look at: (3,) its centre and its radius, metres.
    """

    levels: Levels | None
    intensity: str | None
    on_poles: int
    shown: int
    total: int
    far: int
    origin: list[float]
    centre: list[float]
    radius: float


def _clusters(detection: Detection | None) -> tuple[IntpArray, IntpArray]:
    """Indices of the points on poles, and of those in rejected clusters."""
    empty = np.zeros(0, dtype=np.intp)
    if detection is None:
        return empty, empty
    poles = np.concatenate([empty, *(p.index for p in detection.poles)]).astype(np.intp)
    rejected = np.concatenate([empty, *(r.index for r in detection.rejected)]).astype(np.intp)
    return np.unique(poles), np.setdiff1d(rejected, poles)


def _draw(ranges: Array, others: IntpArray, room: int) -> IntpArray:
    """Draw points by their range, as many as there is room for.

    A spinning LiDAR crowds its returns near itself; weights that grow with range leave the far
    ones, which carry the shape of the scene. The draw is by exponential keys (Efraimidis and
    Spirakis 2006) with a fixed seed: the same cloud gives the same page.
    """
    if len(others) <= room or room == 0:
        return others[:room]
    keys = np.random.default_rng(0).exponential(size=len(others)) / np.maximum(ranges[others], 1.0)
    return np.sort(others[np.argpartition(keys, room)[:room]])


def pack_cloud(
    cloud: PointCloud,
    detection: Detection | None = None,
    *,
    max_points: int,
    threshold: float | None = None,
) -> PackedCloud:
    """Pack a cloud for the page.

    Parameters
    ----------
    cloud
        N points in their LiDAR's frame.
    detection
        What was found in it; points on poles and in rejected clusters come first and are kept
        before all others.
    max_points
        At most this many points are packed.
    threshold
        Intensity from which points are kept before those that are dimmer, up to half of all, and
        from which the reader of the page may move it; None if he may not.
    """
    offset = cloud.xyz - cloud.origin
    ranges = np.sqrt(np.einsum("ij,ij->i", offset, offset))
    near = ranges <= MAX_SHOWN_RANGE
    poles, rejected = (index[near[index]] for index in _clusters(detection))
    poles, rejected = poles[:max_points], rejected[: max(max_points - len(poles), 0)]
    kept = np.concatenate([poles, rejected])
    rest = near.copy()
    rest[kept] = False
    if threshold is not None and cloud.intensity is not None:
        bright = np.flatnonzero(rest & (cloud.intensity >= threshold))
        kept = np.concatenate([kept, _draw(ranges, bright, (max_points - len(kept)) // 2)])
        rest[kept] = False
    drawn = _draw(ranges, np.flatnonzero(rest), max_points - len(kept))
    shown = np.concatenate([kept, drawn])

    packed = pack_points(cloud.xyz[shown])
    seen = [pole.point for pole in detection.poles] if detection else []
    centre = np.mean([cloud.origin, *seen], axis=0)
    spread = np.quantile(ranges[near], 0.75) if near.any() else DEFAULT_RANGE
    farthest = max((float(np.linalg.norm(p - cloud.origin)) for p in seen), default=0.0)
    return PackedCloud(
        xyz=packed.xyz,
        levels=_levels(cloud.intensity, shown, threshold),
        intensity=_intensity(cloud.intensity, shown),
        low=packed.low,
        size=packed.size,
        on_poles=len(poles),
        shown=len(shown),
        total=len(cloud),
        far=int(np.count_nonzero(~near)),
        origin=cloud.origin.tolist(),
        centre=centre.tolist(),
        radius=float(np.clip(max(spread, 1.5 * farthest), *SHOWN_RADIUS)),
    )


def pack_points(xyz: Array) -> PackedPoints:
    """Quantise points (n, 3), metres."""
    low = xyz.min(axis=0) if len(xyz) else np.zeros(3)
    size = np.maximum(xyz.max(axis=0) - low, 1e-3) if len(xyz) else np.ones(3)
    quantised = np.rint((xyz - low) * (COORDINATE_STEPS / size)).astype("<u2")
    return PackedPoints(base64.b64encode(quantised.tobytes()).decode(), low.tolist(), size.tolist())


def _levels(intensity: Array | None, shown: IntpArray, threshold: float | None) -> Levels | None:
    if intensity is None or threshold is None:
        return None
    values = np.nan_to_num(intensity)
    low, median, high = map(float, np.quantile(values, [0.0, 0.5, 1.0]))
    steps = np.rint((values[shown] - low) * (COORDINATE_STEPS / (high - low))).astype("<u2")
    return Levels(base64.b64encode(steps.tobytes()).decode(), low, high, median, threshold)


def _intensity(intensity: Array | None, shown: IntpArray) -> str | None:
    """Intensity as uint8 between the cloud's 1 % and 99 %, on a square-root scale."""
    if intensity is None or not len(shown):
        return None
    values = np.nan_to_num(intensity[shown])
    low, high = np.quantile(values, [0.01, 0.99])
    if high <= low:
        return None
    level = np.sqrt(np.clip((values - low) / (high - low), 0.0, 1.0))
    return base64.b64encode(np.rint(255 * level).astype(np.uint8).tobytes()).decode()
