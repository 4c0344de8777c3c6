"""Packets of Hesai: blocks of channels with one azimuth each, to which each channel adds an offset.

A channel's sweep begins where its azimuth passes 0°, so packets hold parts of two sweeps there;
a firing at 0° exactly ends the sweep before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...base.datatypes import Array, BoolArray, IntArray
from .clocks import days_since_1970
from .models import (
    NEAR_TWIN,
    Angles,
    Blocks,
    Model,
    Returns,
    is_other,
    parts_in_cache,
    taking,
    wrapped,
)

CIRCLE = 36_000
"""Units of an azimuth in a whole turn."""

ECHOES = {mode: 2 for mode in (0x39, 0x3A, 0x3B, 0x3C, 0x3E)} | {0x3D: 3}
"""Returns of a firing by the mode that a packet names; one in any other."""


class Fired(NamedTuple):
    """What some packets hold, of which every slot has its place, N x B x C.

    Attributes
    ----------
    part
        Which packets.
    take
        From values of the K slots those of the returns that are kept (K, M).
    distance
        (N, B, C) m.
    intensity, time, packet
        (M,) of the returns.
    """

    part: slice
    take: Callable[..., NDArray[Any]]
    distance: Array
    intensity: NDArray[np.uint8]
    time: Array
    packet: IntArray


def positions(model: Model, packets: NDArray[np.uint8]) -> Array:
    """Give the turns, whole and part, at the first and the last block of each packet (N, 2).

    Parameters
    ----------
    model, packets
        Of one model, and (N, size) what it sent.
    """
    azimuth = azimuths(_layout(model), packets)[:, [0, -1]].reshape(-1)
    return unwrapped(azimuth, CIRCLE).reshape(-1, 2) / CIRCLE


def decode(
    model: Model, packets: NDArray[np.uint8], angles: Angles | None, positions: Array
) -> Iterator[Returns]:
    """Decode packets of a few sweeps, part by part.

    Parameters
    ----------
    model, packets
        As `positions` takes them.
    angles
        Of the unit; None for those of the table.
    positions
        (N, 2) of the packets, in turns.
    """
    angles = angles or model.angles
    azimuth = azimuths(_layout(model), packets)
    turned = np.radians(azimuth / 100)[..., None]
    sines, cosines = np.sin(turned), np.cos(turned)
    ahead, aside, up = angles.ways
    start = np.round(positions[:, :1] * CIRCLE)
    whole = ((start + wrapped(azimuth - azimuth[:, :1], CIRCLE)) / CIRCLE)[..., None]
    turns = angles.azimuth / (2 * np.pi)
    for own in fired(model, packets):
        sine, cosine, distance = sines[own.part], cosines[own.part], own.distance
        xyz = own.take(
            distance * (sine * ahead + cosine * aside),
            distance * (cosine * ahead - sine * aside),
            distance * up,
        )
        # But for the blocks around 0°, all channels of one are in the same turn.
        turn, last = (
            np.ceil(whole[own.part] + each).astype(np.int64) - 1
            for each in (turns.min(), turns.max())
        )
        if (turn != last).any():
            turn = np.ceil(whole[own.part] + turns).astype(np.int64) - 1
        yield Returns(
            xyz.T, own.intensity, own.take(angles.ring)[0], own.time, own.take(turn)[0], own.packet
        )


def _layout(model: Model) -> Blocks:
    assert isinstance(model.layout, Blocks)
    return model.layout


def azimuths(layout: Blocks, packets: NDArray[np.uint8]) -> IntArray:
    """Read the azimuth of each block (N, B), in units of 0.01°."""
    return of_blocks(layout, packets, layout.azimuth, "<u2").astype(np.int64)


def unwrapped(azimuth: IntArray, circle: int) -> IntArray:
    """Count azimuths (N,) on over whole turns; from one to the next it is less than half a one."""
    counted = np.cumsum(wrapped(np.diff(azimuth, prepend=azimuth[:1]), circle))
    return counted + azimuth[:1] if len(azimuth) else azimuth


def fired(model: Model, packets: NDArray[np.uint8]) -> Iterator[Fired]:
    """Keep the returns of packets within the range of the model, the last of equal ones."""
    layout = _layout(model)
    near, far = (np.array(model.range_m) / model.distance_m).round(6)
    # Zero is not a return.
    least, most = max(math.ceil(near), 1), min(math.floor(far), 2**16 - 1)
    modes = _of_packets(packets, layout.returns, "u1") if layout.returns else np.zeros(1, np.uint8)
    echoes = ECHOES.get(int(np.bincount(modes).argmax()), 1) if len(packets) else 1
    echoes = echoes if layout.count % echoes == 0 else 1
    began = (_times(layout, packets)[:, None] + _blocks_s(layout, echoes))[..., None]
    states = _states(layout, packets, echoes)
    firing = model.firing_s
    for part in parts_in_cache(len(packets), layout.slots):
        sent = np.ascontiguousarray(_of_channels(layout, packets[part], 0, "<u2"))
        kept = (sent >= least) & (sent <= most)
        if echoes > 1:
            groups = sent.reshape(len(sent), -1, echoes, layout.channels)
            own = kept.reshape(groups.shape)
            for k in range(echoes - 1):
                for other in range(k + 1, echoes):
                    same = _are_same(groups[:, :, k], groups[:, :, other], model.distance_m)
                    own[:, :, k] &= ~same
        take = taking(kept)
        yield Fired(
            part,
            take,
            np.multiply(sent, model.distance_m, dtype=np.float64),
            take(_of_channels(layout, packets[part], 2, "u1"))[0],
            take(began[part] + (firing[states[part]] if len(firing) > 1 else firing[0]))[0],
            take(np.arange(part.start, part.stop)[:, None, None])[0],
        )


def _are_same(one: NDArray[np.uint16], two: NDArray[np.uint16], unit: float) -> BoolArray:
    difference = np.abs(np.subtract(one, two, dtype=np.int32))
    limit = round(NEAR_TWIN / unit)
    same: BoolArray = difference < limit
    # As floats of 32 bits these may be nearer or not.
    edge = np.nonzero(difference == limit)
    first, second = (np.multiply(each[edge], unit, dtype=np.float64) for each in (one, two))
    same[edge] = ~is_other(first, second)
    return same


def _blocks_s(layout: Blocks, echoes: int) -> Array:
    """Give when each block (B,) fires after the packet's time, s."""
    group = np.arange(layout.count) // echoes
    behind = group[-1] if layout.is_counted_back else 0
    return (layout.block_us + layout.step_us * (group - behind)) / 1e6


def _states(layout: Blocks, packets: NDArray[np.uint8], echoes: int) -> IntArray:
    """Find for each block (N, B) which of the firing times belong to it."""
    shape = (len(packets), layout.count)
    states = np.zeros(shape, np.int64)
    if layout.states == "loops":
        # Two sets of channels take turns; the flag names the one of the first block.
        group = np.arange(layout.count) // echoes
        flag = _of_packets(packets, layout.state, "u1").astype(np.int64)
        states = (flag[:, None] + 1 + group) % 2
    elif layout.states == "bits":
        # Two bits for each block from the top; where all channels fire, they do not matter.
        flags = _of_packets(packets, layout.state, "<u2").astype(np.int64)
        standard = _of_packets(packets, layout.state + 2, "u1") != 0
        bits = (flags[:, None] >> (14 - 2 * np.arange(layout.count))) & 1
        states = np.where(standard[:, None], 2, bits)
    return states


def _times(layout: Blocks, packets: NDArray[np.uint8]) -> Array:
    """Read the time of each packet (N,), Unix seconds."""
    date = packets[:, layout.date : layout.date + 6].astype(np.int64)
    # Years count from 1900, in some older firmware from 2000; without a year, seconds follow.
    year = date[:, 0] + np.where(date[:, 0] < 70, 2000, 1900)
    days = days_since_1970(year, date[:, 1], date[:, 2])
    of_day = date[:, 3] * 3600 + date[:, 4] * 60 + date[:, 5]
    plain = date[:, 1:] @ (256 ** np.arange(4, -1, -1))
    seconds = np.where(date[:, 0] == 0, plain, days * 86_400 + of_day)
    return seconds + _of_packets(packets, layout.microseconds, "<u4") / 1e6


def _of_packets(packets: NDArray[np.uint8], at: int, kind: str) -> NDArray[np.uint32]:
    """View a number of each packet (N,)."""
    size = np.dtype(kind).itemsize
    return np.ascontiguousarray(packets[:, at : at + size]).view(kind)[:, 0]


def of_blocks(layout: Blocks, packets: NDArray[np.uint8], at: int, kind: str) -> NDArray[np.uint16]:
    """View a number of each block (N, B) that is at one of its bytes."""
    shape = (len(packets), layout.count)
    strides = (packets.strides[0], layout.block)
    contiguous = np.ascontiguousarray(packets)
    return np.ndarray(shape, kind, contiguous.data, layout.start + at, strides)


def _of_channels(
    layout: Blocks, packets: NDArray[np.uint8], at: int, kind: str
) -> NDArray[np.uint16]:
    """View a number of each channel (N, B, C)."""
    shape = (len(packets), layout.count, layout.channels)
    strides = (packets.strides[0], layout.block, layout.channel)
    start = layout.start + layout.distance + at
    return np.ndarray(shape, kind, np.ascontiguousarray(packets).data, start, strides)
