"""From packets to sweeps: of recordings, read in ranges, and of packets that come now.

Of a recording, one pass reads where in their turns packets are. Then a sweep is decoded from its
packets alone, so that few are in memory at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...base.datatypes import Array, IntArray
from ..fields import Columns
from . import blocks, interpolated, mirrors, points
from .models import Angles, Blocks, Interpolated, Layout, Mirrors, Model, Points, Returns


class Sweep(NamedTuple):
    """A sweep of a LiDAR.

    Attributes
    ----------
    stamp
        Time of recording, s; None for that of its first point.
    columns
        Function that gives its columns, of which time is in seconds.
    origin
        (3,) of its beams.
    model, notes, nominal_angles
        As `PointCloud` has them.
    """

    stamp: float | None
    columns: Callable[[], Columns]
    origin: Array
    model: str = ""
    notes: tuple[str, ...] = ()
    nominal_angles: str = ""


FAMILIES: dict[type[Layout], ModuleType] = {
    Blocks: blocks,
    Mirrors: mirrors,
    Interpolated: interpolated,
    Points: points,
}
"""By the layout of a model, the module that decodes its packets."""

AT_ONCE = 1024
"""Packets of a bag that are in memory at a time: 1.5 MB."""

PILED = 64
"""Packets that come now are looked at this many at a time: every 5 to 30 ms."""

MOST_KEPT = 2**14
"""Largest number of new packets kept while no sweep is complete: 1.2 s of an OT128."""


def stacked(payloads: Sequence[bytes]) -> NDArray[np.uint8]:
    """Stack packets of one size (N, size)."""
    return np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), -1)


def positions_of(model: Model, stacks: Iterable[NDArray[np.uint8]]) -> Array:
    """Give the positions (N, 2) of packets, which come some together."""
    parts: list[Array] = []
    last = np.zeros((0, 0), np.uint8)
    for stack in stacks:
        found = _on(model, np.concatenate([last, stack]) if len(last) else stack, parts[-1:])
        parts.append(found[len(last) :])
        last = stack[-1:]
    return np.concatenate(parts) if parts else np.zeros((0, 2))


def _on(model: Model, packets: NDArray[np.uint8], before: Sequence[Array]) -> Array:
    """Give positions that go on from others, the last of which is that of the first packet."""
    found: Array = FAMILIES[type(model.layout)].positions(model, packets)
    return found + np.round(before[-1][-1, 0] - found[0, 0]) if before else found


@dataclass(frozen=True, eq=False)
class Index:
    """Which packets hold which sweep.

    Attributes
    ----------
    positions
        (N, 2) of all packets.
    turns
        (S,) number of each sweep, on the scale of the positions, in the order of their packets.
    rows
        Of each sweep, which packets have its parts.
    """

    positions: Array
    turns: IntArray
    rows: list[IntArray]


def index_of(model: Model, positions: Array, angles: Angles | None) -> Index:
    """Find the sweeps of packets.

    Parameters
    ----------
    model, positions, angles
        Of the packets, (N, 2) where in their turns they are, and the angles of the unit.
    """
    if not len(positions):
        return Index(positions, np.zeros(0, np.int64), [])
    margin = _margin(model, angles)
    first, last = (
        np.floor(each).astype(np.int64)
        for each in (positions.min(axis=1) - margin, positions.max(axis=1) + margin)
    )
    row = np.arange(len(positions))
    reach = range(int(min(np.max(last - first), 3)) + 1)
    is_part = [first + k <= last for k in reach]
    turn = np.concatenate([(first + k)[own] for k, own in zip(reach, is_part, strict=True)])
    rows = np.concatenate([row[own] for own in is_part])
    order = np.lexsort((rows, turn))
    # A sweep has a packet that begins in it; slivers of channels that look ahead belong to others.
    turns, begins = np.unique(np.floor(positions[:, 0]).astype(np.int64), return_index=True)
    starts, ends = (np.searchsorted(turn[order], turns, side) for side in ("left", "right"))
    turns_by_row = np.argsort(begins, kind="stable")
    return Index(
        positions,
        turns[turns_by_row],
        [_coherent(rows[order[starts[k] : ends[k]]]) for k in turns_by_row],
    )


def _margin(model: Model, angles: Angles | None) -> float:
    """How far channels look ahead or back, turns."""
    azimuth = (angles or model.angles).azimuth
    # A firing at 0° ends the sweep before.
    return float(np.abs(azimuth).max(initial=0.0) / (2 * np.pi)) + 1e-6


def _coherent(rows: IntArray) -> IntArray:
    """Leave out packets far from the others of a sweep, as a damaged one that names its turn."""
    near = rows[np.abs(rows - np.median(rows)) <= len(rows)]
    return near if len(near) else rows[:1]


def sweeps_of(
    model: Model,
    angles: Angles | None,
    index: Index,
    numbers: range,
    read: Callable[[IntArray], Iterator[NDArray[np.uint8]]],
) -> Iterator[tuple[int, Sweep]]:
    """Decode sweeps, each from its packets.

    Parameters
    ----------
    model, angles, index
        Of the packets.
    numbers
        Ascending, which of the sweeps.
    read
        From ascending rows to these packets, some together.
    """
    needed = np.unique(np.concatenate([index.rows[k] for k in numbers]))
    coming = read(needed)
    # What was read and may be needed still, and how many of those needed came before it.
    buffered: list[NDArray[np.uint8]] = []
    before = 0
    for number in numbers:
        places = np.searchsorted(needed, index.rows[number])
        while buffered and before + len(buffered[0]) <= places[0]:
            before += len(buffered.pop(0))
        end = before + sum(map(len, buffered))
        while end <= places[-1] and (stack := next(coming, None)) is not None:
            buffered.append(stack)
            end += len(stack)
        places = places[(places >= before) & (places < end)]
        if len(places):
            rows = needed[places]
            packets = (buffered[0] if len(buffered) == 1 else np.concatenate(buffered))[
                places - before
            ]
            ends = int(index.turns.min()), int(index.turns.max())
            turn = int(index.turns[number])
            yield number, sweep(model, angles, packets, index.positions[rows], turn, ends)


def sweep(
    model: Model,
    angles: Angles | None,
    packets: NDArray[np.uint8],
    positions: Array,
    turn: int,
    ends: tuple[int, int],
) -> Sweep:
    """Give a sweep that is decoded when its columns are called for.

    Parameters
    ----------
    model, angles, packets, positions
        Of the packets (N, size) that have its parts.
    turn, ends
        Its number; the first and the last of all, to which what lies before and after belongs.
    """
    family = FAMILIES[type(model.layout)]

    def columns() -> Columns:
        types = {axis: "f8" for axis in "xyz"} | {"time": "f8", "ring": "i2", "intensity": "u1"}
        # One piece of memory for all columns is got, and given back, much faster than one for each.
        most = len(packets) * model.layout.slots
        room = np.empty(most * sum(np.dtype(kind).itemsize for kind in types.values()), np.uint8)
        named: dict[str, NDArray[np.generic]] = {}
        at = count = 0
        for name, kind in types.items():
            size = most * np.dtype(kind).itemsize
            named[name], at = room[at : at + size].view(kind), at + size
        found: Returns
        for found in family.decode(model, packets, angles, positions):
            is_own = np.clip(found.turn, *ends) == turn
            own = None if is_own.all() else np.flatnonzero(is_own)
            start, count = count, count + (len(is_own) if own is None else len(own))
            values = dict(zip("xyz", found.xyz.T, strict=True), **found._asdict())
            if found.ring is None:
                named.pop("ring", None)
            for name, column in named.items():
                if own is None:
                    column[start:count] = values[name]
                else:
                    np.take(values[name], own, out=column[start:count], mode="clip")
        return {name: column[:count] for name, column in named.items()}

    used = (angles or model.angles) if model.elevation_deg or angles else None
    notes = (f"angles of {model.title}: {used.found}",) if used else ()
    nominal = model.title if used and angles is None else ""
    return Sweep(None, columns, np.zeros(3), model.sensor or model.title, notes, nominal)


def live(model: Model, angles: Angles | None) -> Callable[[bytes], Sweep | None]:
    """Return a function that receives packets of a model as they arrive, and returns each complete
    sweep.

    The first sweep began before, and is left out. Of several that become whole at once, the newest
    is given.
    """
    margin = _margin(model, angles)
    buffered: list[bytes] = []
    positions = np.zeros((0, 2))
    coming: list[bytes] = []
    following: int | None = None

    def take(payload: bytes) -> Sweep | None:
        nonlocal buffered, positions, coming, following
        if buffered and len(payload) != len(buffered[0]):
            return None
        coming.append(payload)
        if len(coming) < PILED:
            return None
        before = [positions] if len(positions) else []
        carried = buffered[-1:] if before else []
        found = _on(model, stacked([*carried, *coming]), before)[len(carried) :]
        buffered, positions, coming = buffered + coming, np.concatenate([positions, found]), []
        direction = 1 if positions[-1, 0] >= positions[0, 0] else -1
        if following is None:
            following = int(np.floor(positions[0, 0])) + direction
        # Whole are those before the one that the last packet is in, and whose channels all passed.
        whole = int(np.floor(positions[-1].min() - margin)) - 1
        if direction < 0:
            whole = int(np.floor(positions[-1].max() + margin)) + 1
        done = None
        if (whole - following) * direction >= 0:
            rows = _rows_of(positions, whole, margin)
            packets = stacked([buffered[row] for row in rows.tolist()])
            done = sweep(model, angles, packets, positions[rows], whole, (whole - 9, whole + 9))
            following = whole + direction
        start = 0
        if done is not None:
            kept = _rows_of(positions, following, margin)
            start = int(kept[0]) if len(kept) else len(buffered) - 1
        start = max(start, len(buffered) - MOST_KEPT)
        buffered, positions = buffered[start:], positions[start:]
        return done

    return take


def _rows_of(positions: Array, turn: int, margin: float) -> IntArray:
    """Find the packets that hold parts of a sweep."""
    is_part = (positions.min(axis=1) - margin <= turn + 1) & (
        positions.max(axis=1) + margin >= turn
    )
    return np.flatnonzero(is_part)
