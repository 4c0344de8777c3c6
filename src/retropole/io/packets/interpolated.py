"""Packets whose blocks say an azimuth each, between which that of each firing is interpolated:
RoboSense's spinning LiDARs, and Leishen's C series.

Of some LiDARs a block has two firings of all channels, of others two blocks have one. Here both
become rows, which begin at one azimuth. The beam leaves the LiDAR at a lens next to its axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...base.datatypes import Array, BoolArray
from ...base.errors import ReadError
from .clocks import seconds
from .models import (
    Angles,
    Interpolated,
    Model,
    Returns,
    is_other,
    parts_in_cache,
    taking,
    wrapped,
)

SMALL = 1e-6
"""Units by which the ends of a range, which are kept, may miss whole ones."""

WIDEST_STEP = 1.0
"""Degrees from a row to the next; where it is more, the LiDAR was configured to leave a sector out.
At 20 turns a second it is 0.4°, with two firings in a row 0.8°."""

STEP_BACK = 0.1
"""Turns by which packets that came late may be back."""

DIFOP_START = bytes.fromhex("a5ff005a")
"""First bytes of the packets in which a RoboSense or a Leishen shows what it is."""

MOST_APART = 3.0
"""Degrees by which an elevation may differ from that of the table, as Leishen's driver has it."""

UNSET = 0xFF
"""Sign of an angle that a LiDAR does not know."""

MANY = 0.4
"""Share of rows at the azimuth of the row before above which each firing is sent twice: then a half
of all has it, and of packets with three rows as many."""


class _Rows(NamedTuple):
    """Rows of N packets: N x R of S firings each.

    Attributes
    ----------
    azimuth
        (N, R) where each begins, degrees.
    distance, intensity
        (N, R, S) as sent.
    valid
        (N, R) whether its blocks begin as blocks do.
    """

    azimuth: Array
    distance: NDArray[np.uint16]
    intensity: NDArray[np.uint8]
    valid: BoolArray


def positions(model: Model, packets: NDArray[np.uint8]) -> Array:
    """Unwrapped position of the first and the last firing of each packet (N, 2), turns."""
    layout = _layout(model)
    blocks = _blocks(layout, packets)
    start, end = (_azimuth(layout, blocks[:, k]) / 360 for k in (0, -layout.blocks_in_row))
    steps = np.diff(start, prepend=start[:1])
    # A packet that came late steps back; it does not step on by a turn but for that little.
    first = start[:1] + np.cumsum(steps - np.floor(steps + STEP_BACK))
    return np.column_stack([first, first + (end - start) % 1])


def decode(
    model: Model, packets: NDArray[np.uint8], angles: Angles | None, positions: Array
) -> Iterator[Returns]:
    """Decode packets to returns, ordered by rows and channels, part by part.

    Raises
    ------
    ReadError
        If the model has no table of angles and none are given, or those of another model.
    """
    layout = _layout(model)
    own = angles or model.angles
    channels, most = len(own.elevation), len(layout.firing_us) * layout.together
    if not channels:
        raise ReadError(
            f"a {model.title} sends the angles of its channels in DIFOP packets, and none "
            "was received; give them with --angles FILE"
        )
    if channels != most and not (layout.is_halved and 2 * channels == most):
        raise ReadError(f"{own.found} has {channels} channels, a {model.title} {most}")
    sent = seconds(layout.clock, packets, layout.stamp)
    rows, firing, period = _firings(layout, _rows(layout, packets), channels, sent)
    least, most = np.array(model.range_m) / model.distance_m
    least, most = math.ceil(least - SMALL), math.floor(most + SMALL)
    kept = (rows.distance >= least) & (rows.distance <= min(most, 2**16 - 1))
    kept &= rows.valid[:, :, None]
    is_dual = _is_dual(rows.azimuth)
    if is_dual:
        kept &= _kept_of_two(rows, model.distance_m)
    # From a row to the one after it in its packet, which of a dual return is the next but one.
    change = wrapped(np.diff(rows.azimuth), 360)
    usual = change[(change > 0) & (change <= WIDEST_STEP)]
    nominal = float(np.median(usual)) if len(usual) else 0.0
    ahead = 2 if is_dual else 1
    step = np.full(rows.azimuth.shape, nominal)
    step[:, :-ahead] = wrapped(rows.azimuth[:, ahead:] - rows.azimuth[:, :-ahead], 360)
    step[(step <= 0) | (step > WIDEST_STEP)] = nominal
    turned = np.cumsum(np.pad(change, ((0, 0), (1, 0))), axis=1)
    late = np.rint(turned / nominal) * period if nominal else np.zeros(turned.shape)
    if layout.is_stamped_last:
        late -= late[:, -1:] + period
    # A sweep is cut between rows, as the makers' drivers do.
    turn = np.rint(positions[:, :1] - rows.azimuth[:, :1] / 360)
    turn = turn + np.rint((rows.azimuth[:, :1] + turned - rows.azimuth) / 360)
    turn, began = turn.astype(np.int64)[:, :, None], (sent[:, None] + late)[:, :, None]
    ring = own.ring[np.arange(kept.shape[2]) % channels]
    place = _placing(model, rows, step, firing / period, own)
    for part in parts_in_cache(len(packets), layout.slots):
        take = taking(kept[part])
        yield Returns(
            xyz=take(*place(part)).T,
            intensity=take(rows.intensity[part])[0],
            ring=take(ring)[0],
            time=take(began[part] + firing)[0],
            turn=take(turn[part])[0],
            packet=take(np.arange(part.start, part.stop)[:, None, None])[0],
        )


def reported_angles(model: Model, payload: bytes) -> Angles | None:
    """Read the angles of the unit from its DIFOP packet; None for any other, or if it has none.

    A LiDAR of half as many channels leaves the second half empty, or repeats the first.
    """
    reported = _layout(model).difop
    if reported is None or len(payload) not in model.sizes or not payload.startswith(DIFOP_START):
        return None
    if reported.below:
        bits = np.frombuffer(payload, np.uint8, 3 * len(model.elevation_deg), reported.at)
        elevation = bits.reshape(-1, 3) @ [2**16, 2**8, 1] * reported.unit
        elevation[: reported.below] *= -1
        azimuth = np.zeros(len(elevation))
    elif reported.order:
        elevation = np.frombuffer(payload, ">i2", len(reported.order), reported.at)[
            list(reported.order)
        ]
        sent = np.frombuffer(payload, ">u2")[np.array(reported.aside) // 2].astype(np.int64)
        azimuth = np.where(sent < 2**15, sent, 2**15 - sent)
        elevation, azimuth = elevation * reported.unit, azimuth * reported.unit
    else:
        slots = _layout(model).channels * _layout(model).blocks_in_row
        entry = np.dtype([("sign", "u1"), ("value", ">u2")])
        entries = np.frombuffer(payload, entry, 2 * slots, reported.at)
        degrees = np.where(entries["sign"] == 0, 1, -1) * entries["value"] * reported.unit
        elevation, azimuth = degrees.reshape(2, slots)
        half = slots // 2
        is_empty = (entries["sign"][half:slots] == UNSET).all() or not elevation[half:].any()
        if _layout(model).is_halved and (is_empty or (elevation[half:] == elevation[:half]).all()):
            elevation, azimuth = elevation[:half], azimuth[:half]
    usual = model.elevation_deg or elevation
    odd = (np.abs(elevation) > 90) | (np.abs(elevation - usual) > MOST_APART)
    if odd.any() or len(set(elevation.tolist())) < len(elevation):
        return None
    return Angles(np.radians(elevation), np.radians(azimuth), "the DIFOP packets")


def _layout(model: Model) -> Interpolated:
    assert isinstance(model.layout, Interpolated)
    return model.layout


def _placing(
    model: Model, rows: _Rows, step: Array, share: Array, angles: Angles
) -> Callable[[slice], tuple[Array, Array, Array]]:
    """Give the function from some packets to the coordinates x, y and z of all slots (N, R, S).

    Rows turn by steps (N, R), degrees, until the next; a share of it (S,) is behind as each fires.
    """
    layout = _layout(model)
    channel = np.arange(len(share)) % len(angles.elevation)
    # Few steps differ, so that sines and cosines are those of few angles.
    steps, of_step = np.unique(step, return_inverse=True)
    of_step = of_step.reshape(step.shape)
    on, azimuths = np.deg2rad(np.outer(steps, share)), angles.azimuth[channel]
    beam = np.cos(angles.elevation)[channel] * np.exp(1j * (on + azimuths))
    of_lens = on + np.deg2rad(layout.lens[1]) + layout.has_lens_of_channels * azimuths
    lens, up = layout.lens[0] * np.exp(1j * of_lens), np.sin(angles.elevation)[channel]
    # In the plane, ahead is real and clockwise is imaginary.
    beams, lenses = ((own.real.copy(), own.imag.copy()) for own in (beam, lens))
    turned = np.deg2rad(rows.azimuth)[:, :, None]
    cosines, sines = np.cos(turned), np.sin(turned)

    def place(part: slice) -> tuple[Array, Array, Array]:
        own, cosine, sine = of_step[part], cosines[part], sines[part]
        distance = np.multiply(rows.distance[part], model.distance_m, dtype=np.float64)
        there, aside = (
            np.take(beam, own, axis=0) * distance + np.take(lens, own, axis=0)
            for beam, lens in zip(beams, lenses, strict=True)
        )
        ahead, right = cosine * there - sine * aside, sine * there + cosine * aside
        height = distance * up + layout.lens[2]
        return (ahead, -right, height) if layout.is_x_ahead else (right, ahead, height)

    return place


def _blocks(layout: Interpolated, packets: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The blocks of packets (N, B, bytes)."""
    count, size = layout.count, 4 + 3 * layout.channels
    body = packets[:, layout.start : layout.start + count * size]
    return body.reshape(len(packets), count, size)


def _azimuth(layout: Interpolated, blocks: NDArray[np.uint8]) -> Array:
    return np.multiply(_number(layout, blocks[..., 2:4]) % 36000, 0.01, dtype=np.float64)


def _number(layout: Interpolated, pairs: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Numbers of 2 bytes (...) of bytes (..., 2)."""
    high, low = (0, 1) if layout.is_big_endian else (1, 0)
    number: NDArray[np.uint16] = np.bitwise_or(
        pairs[..., high].astype(np.uint16) << 8, pairs[..., low]
    )
    return number


def _rows(layout: Interpolated, packets: NDArray[np.uint8]) -> _Rows:
    blocks = _blocks(layout, packets)
    shape = len(packets), layout.count // layout.blocks_in_row, -1
    firings = blocks[:, :, 4:].reshape(*shape, 3)
    flags = np.frombuffer(bytes.fromhex(layout.flag), np.uint8)
    begins = (blocks[:, :, : len(flags)] == flags).all(axis=2)
    return _Rows(
        _azimuth(layout, blocks[:, :: layout.blocks_in_row]),
        np.bitwise_and(_number(layout, firings[..., :2]), layout.distance_bits),
        firings[..., 2],
        begins.reshape(shape).all(axis=2),
    )


def _firings(
    layout: Interpolated, rows: _Rows, channels: int, sent: Array
) -> tuple[_Rows, Array, float]:
    """Give rows, when each firing of a row is (S,), and when the next row begins, both seconds.

    If a row has two firings of the channels, and packets come twice as often as these take,
    the second half is the other return of the first one.
    """
    slots = rows.distance.shape[2]
    period, buffered = layout.period_us * 1e-6, max(slots // channels, 1)
    firing = np.repeat(layout.firing_us, layout.together)[: slots // buffered] * 1e-6
    if buffered == 1:
        return rows, firing, period
    gaps = np.diff(sent)
    gaps = gaps[gaps > 0]
    rest = rows.distance.shape[1] * buffered * period
    if layout.is_halved and len(gaps) and np.median(gaps) < 0.75 * rest:
        shape = len(sent), -1, slots // buffered
        parts = rows.distance.reshape(shape), rows.intensity.reshape(shape)
        azimuth = np.repeat(rows.azimuth, buffered, axis=1)
        return _Rows(azimuth, *parts, np.repeat(rows.valid, buffered, axis=1)), firing, period
    starts = np.repeat(np.arange(buffered) * period, slots // buffered)
    return rows, starts + np.tile(firing, buffered), buffered * period


def _is_dual(azimuth: Array) -> bool:
    """Whether each firing is sent twice, from the azimuths of rows (N, R)."""
    every = azimuth.ravel()
    return bool(np.mean(every[1:] == every[:-1]) > MANY) if len(every) > 1 else False


def _kept_of_two(rows: _Rows, unit: float) -> BoolArray:
    """Find the remaining returns (N, R, S), if each firing has two, in rows of one azimuth.

    The rows of a packet may be an odd number: the second return is in the next packet then.
    """
    azimuth = rows.azimuth.ravel()
    same = np.append(azimuth[1:] == azimuth[:-1], False)
    place = np.arange(len(same))
    begins = np.maximum.accumulate(np.where(np.insert(~same[:-1], 0, True), place, 0))
    first = np.flatnonzero(same & ((place - begins) % 2 == 0))
    flat = rows.distance.reshape(len(azimuth), -1)
    kept = np.ones(flat.shape, bool)
    kept[first] = is_other(
        *(np.multiply(flat[k], unit, dtype=np.float64) for k in (first, first + 1))
    )
    return kept.reshape(rows.distance.shape)
