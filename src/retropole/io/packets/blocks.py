"""Packets of Hesai: blocks of channels with one azimuth each, to which each channel adds its own.

A channel's sweep begins where its own azimuth passes 0°, so packets hold parts of two sweeps there;
a firing at 0° exactly ends the sweep before.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...base.datatypes import Array, BoolArray, IntArray
from .clocks import days_since_1970
from .models import NEAR_TWIN, Angles, Blocks, Model, Returns, is_other

CIRCLE = 36_000
"""Units of an azimuth in a whole turn."""

ECHOES = {mode: 2 for mode in (0x39, 0x3A, 0x3B, 0x3C, 0x3E)} | {0x3D: 3}
"""Returns of a firing by the mode that a packet names; one in any other."""


class Kept(NamedTuple):
    """The returns of packets that are kept.

    Attributes
    ----------
    counts
        How many each block has, one block after the other.
    channel, packet
        Of each return.
    distance, intensity, time
        What was measured, m, and when, s.
    """

    counts: IntArray
    channel: IntArray
    packet: IntArray
    distance: Array
    intensity: Array
    time: Array


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
) -> Returns:
    """Decode packets of a few sweeps.

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
    kept = returns_of(model, packets)
    # To repeat what a block has, and to take by indices, is several times faster than to index.
    sine, cosine = (np.repeat(f(np.radians(azimuth / 100)), kept.counts) for f in (np.sin, np.cos))
    ahead, aside, up = (np.take(each, kept.channel) for each in angles.ways)
    xyz = np.empty((len(kept.channel), 3))
    xyz[:, 0] = kept.distance * (sine * ahead + cosine * aside)
    xyz[:, 1] = kept.distance * (cosine * ahead - sine * aside)
    xyz[:, 2] = kept.distance * up
    start = np.round(positions[:, :1] * CIRCLE)
    whole = (start + steps(azimuth - azimuth[:, :1], CIRCLE)) / CIRCLE
    own = np.repeat(whole, kept.counts) + np.take(angles.azimuth / (2 * np.pi), kept.channel)
    turn = (np.ceil(own) - 1).astype(np.int64)
    ring = np.take(angles.ring, kept.channel)
    return Returns(xyz, kept.intensity, ring, kept.time, turn, kept.packet)


def _layout(model: Model) -> Blocks:
    assert isinstance(model.layout, Blocks)
    return model.layout


def azimuths(layout: Blocks, packets: NDArray[np.uint8]) -> IntArray:
    """Read the azimuth of each block (N, B), in units of 0.01°."""
    return of_blocks(layout, packets, layout.azimuth, "<u2").astype(np.int64)


def steps(differences: IntArray, circle: int) -> IntArray:
    """Bring differences of azimuths to within half a circle."""
    return (differences + circle // 2) % circle - circle // 2


def unwrapped(azimuth: IntArray, circle: int) -> IntArray:
    """Count azimuths (N,) on over whole turns; from one to the next it is less than half a one."""
    counted = np.cumsum(steps(np.diff(azimuth, prepend=azimuth[:1]), circle))
    return counted + azimuth[:1] if len(azimuth) else azimuth


def returns_of(model: Model, packets: NDArray[np.uint8]) -> Kept:
    """Take the returns of packets within the range of the model, of equal ones the last."""
    layout = _layout(model)
    shape = (len(packets), layout.count, layout.channels)
    distance = np.ascontiguousarray(_of_channels(layout, packets, 0, "<u2"))
    near, far = (np.array(model.range_m) / model.distance_m).round(6)
    # Zero is no return.
    kept = (distance >= max(np.ceil(near), 1)) & (distance <= np.floor(far))
    modes = _of_packets(packets, layout.returns, "u1") if layout.returns else np.zeros(1, np.uint8)
    echoes = ECHOES.get(int(np.bincount(modes).argmax()), 1) if len(packets) else 1
    echoes = echoes if layout.count % echoes == 0 else 1
    if echoes > 1:
        groups = distance.reshape(len(packets), -1, echoes, layout.channels)
        own = kept.reshape(groups.shape)
        for k in range(echoes - 1):
            for other in range(k + 1, echoes):
                same = _are_same(groups[:, :, k], groups[:, :, other], model.distance_m)
                own[:, :, k] &= ~same
    places = np.flatnonzero(kept)
    counts = np.count_nonzero(kept.reshape(-1, layout.channels), axis=1)
    channel = places - np.repeat(np.arange(len(counts)) * layout.channels, counts)
    packet = np.repeat(np.arange(len(packets)), counts.reshape(shape[:2]).sum(axis=1))
    began = _times(layout, packets)[:, None] + _blocks_s(layout, echoes)
    fired = np.take(model.firing_s, channel)
    if len(model.firing_s) > 1:
        states = _states(layout, packets, echoes)
        fired = model.firing_s[np.repeat(states, counts), channel]
    intensity = np.take(_of_channels(layout, packets, 2, "u1"), places)
    return Kept(
        counts,
        channel,
        packet,
        np.multiply(np.take(distance, places), model.distance_m, dtype=np.float64),
        intensity.astype(np.float64),
        np.repeat(began, counts) + fired,
    )


def _are_same(one: NDArray[np.uint16], two: NDArray[np.uint16], unit: float) -> BoolArray:
    apart = np.abs(np.subtract(one, two, dtype=np.int32))
    limit = round(NEAR_TWIN / unit)
    same: BoolArray = apart < limit
    # As floats of 32 bits these may be nearer or not.
    edge = np.nonzero(apart == limit)
    first, second = (np.multiply(each[edge], unit, dtype=np.float64) for each in (one, two))
    same[edge] = ~is_other(first, second)
    return same


def _blocks_s(layout: Blocks, echoes: int) -> Array:
    """Give when each block (B,) fires after the packet's time, s."""
    group = np.arange(layout.count) // echoes
    behind = group[-1] if layout.is_counted_back else 0
    return (layout.block_us + layout.step_us * (group - behind)) / 1e6


def _states(layout: Blocks, packets: NDArray[np.uint8], echoes: int) -> IntArray:
    """Tell for each block (N, B) which of the firing times are its own."""
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
    """View a number of each block (N, B) that is at a byte of it."""
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
