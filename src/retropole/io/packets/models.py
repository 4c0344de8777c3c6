"""Models of LiDARs by their packets: each is a table of its maker's file, none is code.

A table states how packets of a model are recognized, the layout of their fields, and the angles and
times at which each channel fires. What packets of one shape have in common is a family: a layout
here, and a module with ``positions`` and ``decode``.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from typing import Any, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from ...base.datatypes import Array, BoolArray, IntArray
from ...base.quantities import counted

T = TypeVar("T", np.int64, np.float64)

MAKERS = ("hesai", "robosense", "leishen", "livox")
"""Files of tables, one for each maker."""


class Returns(NamedTuple):
    """What packets hold.

    Attributes
    ----------
    xyz
        (M, 3) m, in the sensor's frame, with axes as its manual has them.
    intensity
        (M,) as sent, 0 to 255.
    ring
        (M,) rank of the elevation from below; None for a model without rings.
    time
        (M,) s, when each fired: the time of the packet, and what block and channel add.
    turn
        (M,) the sweep, on the scale of the positions of the packets.
    packet
        (M,) row of the packet.
    """

    xyz: Array
    intensity: NDArray[np.uint8]
    ring: NDArray[np.int16] | None
    time: Array
    turn: IntArray
    packet: IntArray


IN_CACHE = 2**13
"""Returns that are decoded at a time: what that takes stays in a processor's cache, and no array
has the 128 kB from which on glibc asks the system for new pages each time, which is slow."""


def parts_in_cache(packets: int, slots: int) -> Iterator[slice]:
    """Divide packets of this many returns each into those that are decoded at a time."""
    step = max(IN_CACHE // slots, 1)
    return (slice(k, min(k + step, packets)) for k in range(0, packets, step))


def taking(kept: BoolArray) -> Callable[..., NDArray[Any]]:
    """Give what takes those that are kept of each of some values (K, M), one row for each.

    Values are of the shape of `kept`, or broadcast to it.
    """
    places = None if kept.all() else np.flatnonzero(kept)
    count = kept.size if places is None else len(places)

    def take(*values: NDArray[Any]) -> NDArray[Any]:
        found = np.empty((len(values), count), values[0].dtype)
        for own, each in zip(found, values, strict=True):
            if places is None:
                own.reshape(kept.shape)[...] = each
            else:
                # To take by indices is several times faster than by what is true; the mode leaves
                # out a buffer.
                every = np.broadcast_to(each, kept.shape).reshape(-1)
                np.take(every, places, out=own, mode="clip")
        return found

    return take


def wrapped(differences: NDArray[T], circle: int) -> NDArray[T]:
    """Bring differences of azimuths to within half a circle, its lower end included."""
    found: NDArray[T] = (differences + circle // 2) % circle - circle // 2
    return found


@dataclass(frozen=True, eq=False)
class Angles:
    """Where the channels of a unit look.

    Attributes
    ----------
    elevation, azimuth
        (C,) rad: above the horizon, and what is added to the azimuth of a firing.
    found
        In words: ``the table of the model``, ``angles.csv``, ``the DIFOP of the capture``.
    starts, adjusted
        Of mirrors: (K,) where the field of each starts, and (2, C, 180) what is added to azimuth
        and elevation at each 2°, rad; None if the file has none.
    """

    elevation: Array
    azimuth: Array
    found: str = "the table of the model"
    starts: Array | None = None
    adjusted: Array | None = None

    @cached_property
    def ring(self) -> NDArray[np.int16]:
        """Rank of each channel (C,) by its elevation, from below."""
        return rings_of(self.elevation).astype(np.int16)

    def looks_as(self, other: Angles | None) -> bool:
        """Whether its channels look where those of another do."""
        return other is not None and all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("elevation", "azimuth")
        )

    @cached_property
    def ways(self) -> tuple[Array, Array, Array]:
        """Where channels look at azimuth 0, each (C,): ahead, to the right and up."""
        level = np.cos(self.elevation)
        return level * np.cos(self.azimuth), level * np.sin(self.azimuth), np.sin(self.elevation)


class Layout(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What packets of a family hold where; offsets count bytes from the first of the packet."""


class Blocks(Layout, frozen=True, tag_field="family", tag="blocks", kw_only=True):
    """Of Hesai: blocks of channels, each with one azimuth, to which each channel adds an offset.

    Attributes
    ----------
    count, channels
        Blocks of a packet, channels of a block.
    start, block, channel
        Bytes before the first block, of a block, and of a channel.
    azimuth, distance
        Where in a block the azimuth is (16 bits, 0.01°), and the first channel: distance (16 bits)
        and intensity (8 bits).
    returns, date, microseconds
        Offsets of the return mode, of the date (6 bytes) and of the microseconds (32 bits).
    block_us, step_us, is_counted_back
        When the first or, where counted back, the last group of blocks with one azimuth fires,
        µs after the packet's time, and from group to group.
    firing_us
        When each channel fires after its block, µs; several where the packet selects one.
    states, state
        How one of them is selected, and the offset of what selects it: ``loops`` by a flag, of
        which sets of channels take turns; ``bits`` by two bits for each block.
    """

    count: int
    channels: int
    start: int
    block: int
    channel: int
    azimuth: int
    distance: int
    returns: int
    date: int
    microseconds: int
    block_us: float
    step_us: float
    firing_us: tuple[tuple[float, ...], ...]
    is_counted_back: bool = True
    states: Literal["", "loops", "bits"] = ""
    state: int = 0

    @property
    def slots(self) -> int:
        """Most returns of a packet."""
        return self.count * self.channels


class Mirrors(Blocks, frozen=True, tag="mirrors", kw_only=True):
    """Of Hesai's AT128: a block has a finer azimuth, and mirrors pass one after the other.

    Attributes
    ----------
    fine
        Where in a block the 1/256 of the azimuth are (8 bits).
    starts_deg
        Azimuth at which the field of each mirror starts.
    """

    fine: int
    starts_deg: tuple[float, ...]


class Interpolated(Layout, frozen=True, tag_field="family", tag="interpolated", kw_only=True):
    """Of spinning LiDARs of RoboSense and Leishen: azimuths lie between those of blocks.

    Attributes
    ----------
    count, channels, start
        Blocks of a packet, channels of a block (3 bytes each, after 4 for flag and azimuth), and
        bytes before the first block.
    flag
        What each block begins with (hexadecimal).
    clock, stamp
        How the packet's time is written, as `clocks` names it, and where.
    is_big_endian, is_x_ahead
        Order of bytes; whether x is at azimuth 0 and y to the left, or y at 0 and x to the right.
    blocks_in_row
        Blocks that are one firing of all channels.
    is_halved
        Whether the two halves of a block may be the returns of one firing of half as many channels.
    is_stamped_last
        Whether the packet's time is that of the end of its last firing, not of the first.
    period_us, firing_us, together
        From one firing of all channels to the next, µs; when in it each group of `together`
        channels fires.
    lens
        Where beams start: distance from the axis, m, degrees clockwise from the azimuth, height, m.
    has_lens_of_channels
        Whether this is the azimuth with what each channel adds.
    distance_bits
        Of a distance, those that are one.
    difop
        Where the angles of the unit are in its DIFOP packet.
    """

    count: int
    channels: int
    start: int
    flag: str
    clock: str
    stamp: int
    period_us: float
    firing_us: tuple[float, ...]
    lens: tuple[float, float, float]
    has_lens_of_channels: bool = False
    is_big_endian: bool = True
    is_x_ahead: bool = True
    blocks_in_row: int = 1
    is_halved: bool = False
    is_stamped_last: bool = False
    together: int = 1
    distance_bits: int = 0xFFFF
    difop: Difop | None = None

    @property
    def slots(self) -> int:
        """Most returns of a packet."""
        return self.count * self.channels


class Difop(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where a LiDAR sends its angles: elevations from byte `at`, and azimuths after them.

    Each is a sign and 16 bits, in units of `unit` degrees. Where the first `below` channels look
    down, there are no azimuths, and elevations have 24 bits. Where channels have an `order`, an
    elevation has 16 bits, and `aside` says where the azimuth of each channel is.
    """

    at: int
    unit: float
    below: int = 0
    order: tuple[int, ...] = ()
    aside: tuple[int, ...] = ()


class Points(Layout, frozen=True, tag_field="family", tag="points", kw_only=True):
    """Of RoboSense's M1 and E1, and of Livox: where each point is.

    Attributes
    ----------
    count, points, start
        Blocks of a packet, points of a block, and bytes before the first block.
    block, point
        Names and types (NumPy's) of what a block begins with and a point has. Of a block, ``late``
        is µs after the packet's time and ``number`` which of two returns, 1 or 2.
    form
        ``coordinates``; ``vector`` (of length 2¹⁵) and distance; ``elevation`` or ``zenith``, 0.01°
        above `zero`.
    clock, stamp
        As `Interpolated` has them.
    counter
        Offset of the packet's number in its frame (16 bits); None if frames are `sweep_s` long.
    span, gap_us
        Offset of the time from the first to the last point (16 bits, 0.1 µs); else, from block to
        block, µs.
    is_dual
        Whether the two points of a block are returns of one firing.
    """

    count: int
    start: int
    clock: str
    stamp: int
    point: tuple[tuple[str, str], ...]
    form: Literal["coordinates", "vector", "elevation", "zenith"]
    points: int = 1
    block: tuple[tuple[str, str], ...] = ()
    zero: int = 0
    counter: int | None = None
    sweep_s: float = 0.1
    span: int | None = None
    gap_us: float = 0.0
    is_dual: bool = False

    @property
    def slots(self) -> int:
        """Most returns of a packet."""
        return self.count * self.points


AnyLayout = Blocks | Mirrors | Interpolated | Points


class Model(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, dict=True):
    """How packets of a model are recognized and read.

    Attributes
    ----------
    name, maker, port, port_told
        Of the model; the UDP ports are those to which it sends returns, and packets that describe
        the LiDAR, unless it was configured otherwise; 0 if it does not send its angles.
    sizes
        Bytes that its packets may have, without IP and UDP.
    marks
        What it is recognized by: bytes (hexadecimal) from an offset on, or the lowest and the
        highest that they may be.
    distance_m, range_m
        Metres of a unit of distance; nearest and farthest return kept, m.
    elevation_deg, azimuth_deg
        Of each channel: above the horizon, and what is added to the azimuth of a firing.
    layout
        Of its family.
    source, tried
        Where the figures come from; on which real packets it was tried, empty for none.
    sensor
        Its name in ``sensors.toml``; empty if there is none.
    """

    name: str
    maker: str
    port: int
    sizes: tuple[int, ...]
    marks: tuple[tuple[int | str, ...], ...]
    distance_m: float
    range_m: tuple[float, float]
    layout: AnyLayout
    source: str
    port_told: int = 0
    elevation_deg: tuple[float, ...] = ()
    azimuth_deg: tuple[float, ...] = ()
    tried: str = ""
    sensor: str = ""

    @property
    def title(self) -> str:
        """Maker and name."""
        return f"{self.maker} {self.name}"

    @cached_property
    def angles(self) -> Angles:
        """Those of the table, for units whose angles are not known."""
        azimuth = self.azimuth_deg or (0.0,) * len(self.elevation_deg)
        return Angles(np.radians(self.elevation_deg), np.radians(azimuth))

    @cached_property
    def firing_s(self) -> Array:
        """When channels fire after their block, s, as the layout of blocks has it."""
        return np.array(getattr(self.layout, "firing_us", ())) / 1e6

    @cached_property
    def signature(self) -> tuple[tuple[slice, bytes, bytes], ...]:
        """The marks as bytes: where they are, the lowest and the highest."""
        found = []
        for at, lowest, *highest in self.marks:
            low, high = (bytes.fromhex(str(each)) for each in (lowest, *(highest or [lowest])))
            found.append((slice(int(at), int(at) + len(low)), low, high))
        return tuple(found)


def _tables() -> Iterator[Model]:
    """Read the tables of all makers; one that is ``like`` another inherits what it does not
    state."""
    for maker in MAKERS:
        file = files("retropole.io.packets").joinpath(f"{maker}.toml")
        tables: dict[str, dict[str, Any]] = tomllib.loads(file.read_text(encoding="utf-8"))
        for name, own in tables.items():
            other = tables.get(own.pop("like", ""), {})
            layout = {**other.get("layout", {}), **own.get("layout", {})}
            merged = {"name": name, **other, **own, "layout": layout}
            tables[name] = merged
            yield msgspec.convert(merged, Model)


MODELS: tuple[Model, ...] = tuple(_tables())
"""All that are known; a variant of a model with packets of another size has the same name."""

_BY_SIZE: dict[int, list[Model]] = {
    size: [model for model in MODELS if size in model.sizes]
    for size in sorted({size for model in MODELS for size in model.sizes})
}


def recognized(payload: bytes) -> Model | None:
    """Find the model that sent a packet of returns, by its size and marks; None if none did."""
    for model in _BY_SIZE.get(len(payload), ()):
        for where, low, high in model.signature:
            if not low <= payload[where] <= high:
                break
        else:
            return model
    return None


NEAR_TWIN = 0.1
"""Two returns of a firing that are nearer to each other, m, are one; drivers leave one out."""


def is_other(first: Array, second: Array) -> BoolArray:
    """Whether the first of two returns of each firing is another than the second, by distances, m.

    The second is kept in any case.
    """
    difference = np.abs(first.astype(np.float32) - second.astype(np.float32))
    return difference >= np.float32(NEAR_TWIN)


def rings_of(elevation: Array) -> IntArray:
    """Rank each channel (C,) by its elevation, from below."""
    return np.argsort(np.argsort(elevation, kind="stable"), kind="stable")


def unknown(sizes: dict[int, int]) -> str:
    """Report packets that no model sends, with the number of each size."""
    most = sorted(sizes.items(), key=lambda each: -each[1])[:3]
    came = ", ".join(f"{size} bytes ({counted(count, 'packet')})" for size, count in most)
    return f"packets of no known model: {came or 'none'}"
