"""Packets of Hesai's AT128: three mirrors pass one after the other, each is a sweep of 120°.

The azimuth of a block is that of the mirrors; a beam turns twice as far. How each channel leaves a
mirror is in a correction file of the unit.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...base.datatypes import Array, IntArray
from ...base.errors import ReadError
from .blocks import CIRCLE, azimuths, fired, of_blocks, unwrapped
from .models import Angles, Mirrors, Model, Returns, wrapped

FINE = 256 * CIRCLE
"""Units of an azimuth with its finer part in a whole turn."""

MIRRORS = 3
"""Sweeps of a turn. They are cut at multiples of 120°, where no mirror looks out: fields start
between 12.8° and 23.4° after (in the maker's and Tier IV's files), and are 60° wide from 15° on."""


def positions(model: Model, packets: NDArray[np.uint8]) -> Array:
    """Give the sweeps, whole and part, at the first and the last block of each packet (N, 2)."""
    azimuth = _azimuths(_layout(model), packets)[:, [0, -1]].reshape(-1)
    return MIRRORS * unwrapped(azimuth, FINE).reshape(-1, 2) / FINE


def decode(
    model: Model, packets: NDArray[np.uint8], angles: Angles | None, positions: Array
) -> Iterator[Returns]:
    """Decode packets of a few sweeps, as `blocks.decode` does."""
    angles = angles or model.angles
    azimuth = _azimuths(_layout(model), packets)
    starts = np.radians(_layout(model).starts_deg) if angles.starts is None else angles.starts
    mirror = azimuth * (2 * np.pi / FINE)
    order = np.argsort(starts)
    # Before the first start, the last field goes on.
    field = order[np.searchsorted(starts[order], mirror, side="right") - 1]
    beams = 2 * ((mirror - starts[field]) % (2 * np.pi))
    # Steps of 2° around the mirrors; the last goes on to the first.
    at = mirror / np.radians(2)
    low, share = at.astype(np.int64) % 180, (at - np.floor(at))[..., None]
    start = np.round(positions[:, :1] * (FINE // MIRRORS)).astype(np.int64)
    whole = start + wrapped(azimuth - azimuth[:, :1], FINE)
    turn = (whole // (FINE // MIRRORS))[..., None]
    adjusted = [
        (each.T.copy(), np.roll(each.T, -1, axis=0) - each.T)
        for each in (() if angles.adjusted is None else angles.adjusted)
    ]
    for own in fired(model, packets):
        if angles.adjusted is None:
            ahead, aside, up = angles.ways
            sine, cosine = (f(beams[own.part])[..., None] for f in (np.sin, np.cos))
            x, y = sine * ahead + cosine * aside, cosine * ahead - sine * aside
        else:
            here, part = low[own.part], share[own.part]
            # Between two steps, of which each has a row of (180, C).
            added, more = (
                np.take(each, here, axis=0) + part * np.take(step, here, axis=0)
                for each, step in adjusted
            )
            sine, cosine = _sine_and_cosine(beams[own.part][..., None] + angles.azimuth + added)
            up, level = _sine_and_cosine(angles.elevation + more)
            x, y = level * sine, level * cosine
        distance = own.distance
        xyz = own.take(distance * x, distance * y, distance * up)
        ring, turns = own.take(angles.ring)[0], own.take(turn[own.part])[0]
        yield Returns(xyz.T, own.intensity, ring, own.time, turns, own.packet)


def _sine_and_cosine(angle: Array) -> tuple[Array, Array]:
    """Give both by the tangent of the half, which NumPy works out several times faster."""
    tangent = np.tan(angle / 2)
    more = 2 / (1 + tangent * tangent)
    return tangent * more, more - 1


def _layout(model: Model) -> Mirrors:
    assert isinstance(model.layout, Mirrors)
    return model.layout


def _azimuths(layout: Mirrors, packets: NDArray[np.uint8]) -> IntArray:
    return azimuths(layout, packets) * 256 + of_blocks(layout, packets, layout.fine, "u1")


def read_corrections(path: Path) -> Angles:
    """Read a correction file of a unit, .dat, of version 1.5.

    Raises
    ------
    ReadError
        If it is none, or is cut short.
    """
    data = path.read_bytes()[: 2**20]
    start = data.find(b"\xee\xff")
    head = data[start : start + 16]
    if start < 0 or len(head) < 16 or head[2:4] != b"\x01\x05":
        raise ReadError("is not a correction file of an AT128 (version 1.5)")
    channels, mirrors, unit = head[4], head[5], np.radians(head[15] / 100)
    kinds = [("starts", "<u4", mirrors), ("ends", "<u4", mirrors), ("azimuth", "<i4", channels)]
    kinds += [("elevation", "<i4", channels), ("adjusted", "i1", 2 * channels * 180)]
    layout = np.dtype([(name, kind, (count,)) for name, kind, count in kinds])
    if len(data) < start + 16 + layout.itemsize or not channels or not mirrors:
        raise ReadError(f"has {len(data)} bytes, expected {start + 16 + layout.itemsize}")
    (found,) = np.frombuffer(data, layout, 1, start + 16)
    return Angles(
        elevation=found["elevation"] * unit / 256,
        azimuth=-found["azimuth"] * unit / 256,
        found=path.name,
        starts=found["starts"] * unit / 256,
        adjusted=found["adjusted"].reshape(2, channels, 180) * unit,
    )
