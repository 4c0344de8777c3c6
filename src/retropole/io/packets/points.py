"""Packets that give the position of each point: angles and a distance, a vector and a distance, or
coordinates. RoboSense's M1 and E1, and Livox.

A sweep is a frame that the LiDAR counts, or of one that never repeats its pattern a tenth of a
second. Livox' tags rate how likely a point is noise; no manual advises to drop any, so none is.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ...base.datatypes import Array, BoolArray
from .clocks import seconds
from .models import Angles, Model, Points, Returns, is_other, parts_in_cache, taking

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
) -> Iterator[Returns]:
    """Decode packets to returns, in the order of blocks and points; `angles` are not needed."""
    layout = _layout(model)
    sent, late = seconds(layout.clock, packets, layout.stamp), _late(layout, packets)
    began = (sent[:, None] + late)[:, :, None]
    share = 0 if layout.counter else late / layout.sweep_s
    turn = np.floor(positions[:, :1] + share).astype(np.int64)[:, :, None]
    blocks = _blocks(layout, packets)
    second = _seconds_of_two(layout, model.distance_m, blocks)
    for part in parts_in_cache(len(packets), layout.slots):
        points = blocks["points"][part]
        (x, y, z), distance = _placed(layout, model.distance_m, points)
        kept = (distance >= model.range_m[0] - 1e-9) & (distance <= model.range_m[1] + 1e-9)
        if second is not None:
            kept &= second[part]
        take = taking(kept)
        yield Returns(
            xyz=take(x, y, z).T,
            intensity=take(points["intensity"])[0],
            ring=None,
            time=take(began[part])[0],
            turn=take(turn[part])[0],
            packet=take(np.arange(part.start, part.stop)[:, None, None])[0],
        )


def _seconds_of_two(layout: Points, unit: float, blocks: NDArray[np.void]) -> BoolArray | None:
    """Find the returns (N, B, P) that remain where firings may have two; None if they do not."""
    has_numbers = "number" in (blocks.dtype.names or ())
    first = np.zeros(0, np.int64)
    if has_numbers:
        number = blocks["number"].ravel()
        first = np.flatnonzero((number[:-1] == 1) & (number[1:] == 2))
    if not (layout.is_dual or len(first)):
        return None
    _, distance = _placed(layout, unit, blocks["points"])
    kept = np.ones(distance.shape, bool)
    if layout.is_dual:
        kept[:, :, 0] = is_other(distance[:, :, 0], distance[:, :, 1])
    else:
        rows = distance.reshape(-1, layout.points)
        kept.reshape(rows.shape)[first] = is_other(rows[first], rows[first + 1])
    return kept


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


def _placed(layout: Points, unit: float, points: NDArray[np.void]) -> tuple[list[Array], Array]:
    """Coordinates x, y and z, and distance of points, each (N, B, P), metres."""
    if layout.form == "coordinates":
        xyz = [np.multiply(points[axis], unit, dtype=np.float64) for axis in "xyz"]
        return xyz, np.sqrt(sum(each**2 for each in xyz))
    distance = np.multiply(points["distance"], unit, dtype=np.float64)
    if layout.form == "vector":
        ways = [points[axis] / 2**15 for axis in "xyz"]
    else:
        # From the horizontal plane, or down from the zenith.
        pitch = np.subtract(points["pitch"], layout.zero, dtype=np.int64)
        up = pitch if layout.form == "elevation" else 9000 - pitch
        turned = np.subtract(points["yaw"], layout.zero, dtype=np.int64)
        sine, cosine = _circle()
        out = np.take(cosine, up, mode="wrap")
        ways = [
            out * np.take(cosine, turned, mode="wrap"),
            out * np.take(sine, turned, mode="wrap"),
            np.take(sine, up, mode="wrap"),
        ]
    return [way * distance for way in ways], distance


@cache
def _circle() -> tuple[Array, Array]:
    """Give sine and cosine of each 0.01° of a circle (36000,)."""
    angle = np.radians(np.arange(36_000) / 100)
    return np.sin(angle), np.cos(angle)
