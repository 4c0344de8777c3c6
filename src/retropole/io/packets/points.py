"""Packets that say of each point where it is: angles and a distance, a vector and a distance, or
coordinates. RoboSense's M1 and E1, and Livox.

A sweep is a frame that the LiDAR counts, or of one that never repeats its pattern a tenth of a
second. Livox' tags say how likely a point is noise; no manual says to drop any, so none is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...base.datatypes import Array
from .clocks import seconds
from .models import Angles, Model, Points, Returns, is_other

LATE = 10
"""By how many packets a counter may step back and yet count the same frame: some came late."""


def positions(model: Model, packets: NDArray[np.uint8]) -> Array:
    """Position of the first and the last point of each packet (N, 2), sweeps."""
    layout = _layout(model)
    if layout.counter is None:
        first = seconds(layout.clock, packets, layout.stamp) / layout.sweep_s
        return np.column_stack([first, first + _late(layout, packets)[:, -1] / layout.sweep_s])
    high, low = (packets[:, layout.counter + k].astype(np.int64) for k in (0, 1))
    count = high << 8 | low
    frame = np.cumsum(np.diff(count, prepend=count[:1]) < -LATE)
    # Where in its frame a packet is matters only as an order.
    return np.repeat((frame + count / 2**16)[:, None], 2, axis=1)


def decode(
    model: Model, packets: NDArray[np.uint8], angles: Angles | None, positions: Array
) -> Returns:
    """Decode packets to returns, in the order of blocks and points; `angles` are not needed."""
    layout = _layout(model)
    blocks = _blocks(layout, packets)
    points = blocks["points"]
    xyz, distance = _placed(layout, model.distance_m, points)
    kept = (distance >= model.range_m[0] - 1e-9) & (distance <= model.range_m[1] + 1e-9)
    if layout.is_dual:
        kept[:, :, 0] &= is_other(distance[:, :, 0], distance[:, :, 1])
    elif "number" in (blocks.dtype.names or ()):
        number, rows = blocks["number"].ravel(), distance.reshape(-1, layout.points)
        first = np.flatnonzero((number[:-1] == 1) & (number[1:] == 2))
        flat = kept.reshape(rows.shape)
        flat[first] &= is_other(rows[first], rows[first + 1])
    packet, block, point = np.nonzero(kept)
    late = _late(layout, packets)[packet, block]
    turn = np.floor(positions[packet, 0] + (0 if layout.counter else late / layout.sweep_s))
    return Returns(
        xyz=xyz[packet, block, point],
        intensity=points["intensity"][packet, block, point].astype(np.float64),
        ring=None,
        time=seconds(layout.clock, packets, layout.stamp)[packet] + late,
        turn=turn.astype(np.int64),
        packet=packet,
    )


def _layout(model: Model) -> Points:
    assert isinstance(model.layout, Points)
    return model.layout


def _blocks(layout: Points, packets: NDArray[np.uint8]) -> NDArray[np.void]:
    """Blocks of packets (N, B), as the table describes them."""
    point = np.dtype([(name, kind) for name, kind in layout.point])
    heads = [(name, kind) for name, kind in layout.block]
    block = np.dtype([*heads, ("points", point, (layout.points,))])
    size = layout.count * block.itemsize
    body = np.ascontiguousarray(packets[:, layout.start : layout.start + size])
    return body.view(block)


def _late(layout: Points, packets: NDArray[np.uint8]) -> Array:
    """How long after the packet's time each block is (N, B), seconds."""
    if "late" in dict(layout.block):
        return _blocks(layout, packets)["late"] * 1e-6
    place = np.arange(layout.count)
    if layout.span is None:
        return np.tile(place * layout.gap_us * 1e-6, (len(packets), 1))
    low, high = (packets[:, layout.span + k].astype(np.float64) for k in (0, 1))
    # From the first to the last point, in steps of 0.1 microseconds.
    return (low + 256 * high)[:, None] * 1e-7 * place / layout.count


def _placed(layout: Points, unit: float, points: NDArray[np.void]) -> tuple[Array, Array]:
    """Coordinates (N, B, P, 3) and distance (N, B, P) of points, metres."""
    if layout.form == "coordinates":
        xyz = np.stack([points[axis] * unit for axis in "xyz"], axis=-1)
        return xyz, np.sqrt((xyz**2).sum(axis=-1))
    distance = points["distance"] * unit
    if layout.form == "vector":
        ways = [points[axis] / 2**15 for axis in "xyz"]
    else:
        up, turned = ((points[n].astype(np.int64) - layout.zero) * 1e-2 for n in ("pitch", "yaw"))
        # From the horizontal plane, or down from the zenith.
        up = np.deg2rad(up if layout.form == "elevation" else 90 - up)
        out, turned = np.cos(up), np.deg2rad(turned)
        ways = [out * np.cos(turned), out * np.sin(turned), np.sin(up)]
    return np.stack([way * distance for way in ways], axis=-1), distance
