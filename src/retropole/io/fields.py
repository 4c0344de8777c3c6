"""From named columns to a cloud in metres: meaning of names, units, dropped points."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.errors import ReadError, UsageError, naming
from ..base.systematic import MAP_SIGMA

PARAVIEW = ("points", "points_m_xyz")
IN_BRACKETS = re.compile(r"[\[(]([^\[\]()]{0,20})[\])]$")
"""A unit at the end of a name: ``X (m)``, ``time [s]``."""

COORDINATES = {
    axis: (axis, f"{axis}1", *(f"{name}{mark}{k}" for mark in ":_" for name in PARAVIEW))
    for k, axis in enumerate("xyz")
}
"""Names of x, y and z. Programs based on ParaView name them ``Points:0`` or
``Points_m_XYZ:0``, Ouster's those of the first return ``X1 (m)``."""

INTENSITY = ("intensity", "intensities", "i", "signal", "reflectivity", "reflectance", "remission")
RING = (
    *("ring", "channel", "laser_id", "line", "beam", "laser_number", "laser", "laserid"),
    *("ring_id", "ring_number", "beam_id", "channel_id", "row"),
)
TIME = ("time", "t", "timestamp", "time_stamp", "offset_time", "gps_time", "gpstime")
"""Names of the fields in lower case; if a file has several, the first is used."""

TICKS = {"t": "u4", "time_stamp": "u4", "offset_time": "u4"}
"""Names and types of times in nanoseconds in drivers: Ouster's, Nebula's and Livox'."""

UNIX_NANOSECONDS = 1e18, 1e20
"""Floats of 64 bits in this range are Unix time in nanoseconds, as livox_ros_driver2 writes it."""

SECOND_RETURN = "is_2nd_return"
"""Seyond's name of the mark of the second return of a firing."""

PLAIN_COLUMNS = ("x", "y", "z", "intensity")
"""The columns of a table without names; a fifth could be a colour or a normal."""

IN_SECONDS = ("", "s", "sec", "seconds")
"""Units in the name of a time that mean seconds; most names have none."""

NANOSECONDS = 1e9
"""In a second; the unit of bags and some drivers."""

MAX_PROMISED = 2**62
"""Larger numbers in a header do not fit NumPy's sizes."""

LARGEST = 1e9
"""Of a coordinate, metres, or an intensity: no place on Earth is farther, even in millimetres,
and no sensor has larger intensities. Squares and products of larger numbers overflow."""

SMALLEST = 1e-9
"""Below this distance, metres, the range is zero: the beam origin. Squares of less vanish."""

REAL_KINDS = "fiub"
"""Kinds of NumPy types that hold real numbers."""

Columns = Mapping[str, NDArray[Any]]


class MapPlace(NamedTuple):
    """The region of a map that is read, and 1 σ of positions in the map, both in metres.

    Roughly, in the coordinates of the map; None if not known.
    """

    at: tuple[float, float, float] | None = None
    sigma: float = MAP_SIGMA


class Wanted(NamedTuple):
    """User's statements on how to read points; most files need none.

    Attributes
    ----------
    intensity
        Field of the intensity, in any spelling; None, or empty, uses the first of
        `INTENSITY`.
    angles
        For packets, the file with the angles of the unit; None uses those of the table.
    if_any
        Those of both, by name, that are ignored if they do not apply to a file: they are from
        an older recording, and were not given for this one.
    place
        For a map, the region that is read; None for a recording of one LiDAR.
    """

    intensity: str | None = None
    angles: str | None = None
    if_any: tuple[str, ...] = ()
    place: MapPlace | None = None

    def names(self, fields: Iterable[str]) -> tuple[str, ...]:
        """Find the name of the intensity among the fields of a file.

        Raises
        ------
        ReadError
            If the requested field does not exist; lists the existing ones.
        """
        if not self.intensity:
            return INTENSITY
        named, fields = (self.intensity, self.intensity.lower()), list(fields)
        if _find(fields, named) is not None:
            return named
        if "intensity" in self.if_any:
            return INTENSITY
        have = ", ".join(fields)
        raise ReadError(f"intensity {self.intensity}: no such field; the fields are: {have}")

    def or_known(self, known: Wanted) -> Wanted:
        """Fill in values from an older recording, where they apply."""
        own = self._asdict()
        if_any = tuple(name for name in ("intensity", "angles") if own[name] is None)
        return Wanted(**own | {name: getattr(known, name) for name in if_any} | {"if_any": if_any})

    def refuse_angles(self, fault: str) -> None:
        """Refuse angles for data to which they do not apply; `fault` is the reason."""
        if self.angles is not None and "angles" not in self.if_any:
            raise UsageError(fault)


USUAL = Wanted()
"""Nothing is stated."""


def intensities_of(names: Iterable[str]) -> list[str]:
    """Names that may be those of an intensity, the default one first."""
    own = [name for name in names if _bare(name) in INTENSITY]
    return sorted(own, key=lambda name: INTENSITY.index(_bare(name)))


T = TypeVar("T")


def read_whole(path: Path, expected: str = "points") -> bytes:
    """Read all bytes of a file; for an empty one, raise an error with the expected content."""
    data = path.read_bytes()
    if not data:
        raise ReadError(f"is empty, expected {expected}")
    return data


def noted(cloud: PointCloud, *notes: str) -> PointCloud:
    """Add notes on losses or assumptions to a cloud; empty notes are ignored."""
    return replace(cloud, notes=(*cloud.notes, *filter(None, notes)))


def left_out(promised: int, more: int) -> str:
    """Report that a file has more points than its header promises, which are not read."""
    return f"the header promises {promised:,} points, the {more:,} that follow them are left out"


def _find(columns: Iterable[str], names: tuple[str, ...]) -> str | None:
    """Find the first column with one of the names, in any case; the exact spelling has priority."""
    plain: dict[str, str] = {}
    for spelled in (str, str.lower, _bare):
        for name in columns:
            plain.setdefault(spelled(name), name)
    return next((plain[name] for name in names if name in plain), None)


def _bare(name: str) -> str:
    """Give a name in lower case, without its unit.

    CloudCompare puts ``scalar_`` in front of names that it does not know.
    """
    return IN_BRACKETS.sub("", name.lower().removeprefix("scalar_")).rstrip()


def _unit(name: str) -> str:
    """Give the unit in brackets after a name; empty if there is none."""
    found = IN_BRACKETS.search(name.lower())
    return found[1].strip() if found else ""


def has_coordinates(names: Iterable[str]) -> bool:
    """Whether x, y and z are among names, in any spelling."""
    bare = {_bare(name) for name in names}
    return all(bare.intersection(own) for own in COORDINATES.values())


def has_meaning(name: str, *besides: str) -> bool:
    """Whether a name, in any spelling, is that of an intensity, a ring, a time or one of some
    others."""
    return not {name, _bare(name)}.isdisjoint((*INTENSITY, *RING, *TIME, *besides))


class NoReturnsError(ReadError):
    """None of `points` points is a return; among other frames, this one is empty."""

    def __init__(self, message: str, points: int) -> None:
        super().__init__(message)
        self.points = points


def cloud_from_columns(
    columns: Columns, wanted: Wanted = USUAL, origin: Array | None = None, source: str = ""
) -> PointCloud:
    """Make a cloud of columns (N,), or (N, C) for fields with several values, by their names.

    Of several values of a field (a dual return's intensities), the first is used. An intensity
    that is not finite is treated as 0, or as the lowest if there are lower ones: a return
    without a measured strength cannot be tape. If none is finite, the file has no intensity.
    Colours (rgb) are not an intensity.

    Parameters
    ----------
    columns
        The fields of the file, by name.
    wanted
        Of which the intensity is.
    origin
        (3,) beam origin; None is the origin of the frame.
    source
        The file, or its part.

    Raises
    ------
    ReadError
        Without x, y or z or the requested field, without points, or with none that is finite
        and away from the origin.
    """
    found = {name: _find(columns, names) for name, names in COORDINATES.items()}
    missing = [name for name, own in found.items() if own is None]
    if missing:
        have = ", ".join(columns) or "none"
        raise ReadError(f"field {', '.join(missing)} is missing; the fields are: {have}")
    of_intensity = wanted.names(columns)
    parts = [_numbers(own, columns[own]) for own in found.values() if own is not None]
    if len({len(part) for part in parts}) > 1:
        lengths = ", ".join(str(len(part)) for part in parts)
        raise ReadError(f"x, y and z have {lengths} values, expected one per point")
    start = np.zeros(3) if origin is None else origin
    xyz = np.empty((len(parts[0]), 3))
    for axis, part in enumerate(parts):
        floats(part, xyz[:, axis])
    kept = _is_return(xyz, start)
    both = np.count_nonzero(kept)
    if SECOND_RETURN in columns and len(columns[SECOND_RETURN]) == len(kept):
        kept &= _numbers(SECOND_RETURN, columns[SECOND_RETURN]) == 0
    second = int(both - np.count_nonzero(kept))
    if not kept.any():
        none = _none_of(len(xyz)) if len(xyz) else "has no points, expected at least one"
        raise NoReturnsError(none, len(xyz))

    def optional(names: tuple[str, ...], convert: Callable[[Any], T | None]) -> T | None:
        own = _find(columns, names)
        if own is None or (names is TIME and _unit(own) not in IN_SECONDS):
            return None
        values = _numbers(own, columns[own])
        if names is TIME and values.dtype.str[1:] == TICKS.get(_bare(own)):
            values = values / NANOSECONDS
        if len(values) != len(xyz):
            has = f"{own} has {len(values)} values for {len(xyz)} points"
            raise ReadError(f"{has}, expected one per point")
        return convert(values if kept.all() else values[kept])

    unit = _unit_of_coordinates([own for own in found.values() if own is not None])
    return PointCloud(
        notes=tuple(filter(None, (unit, _left_out_second(second)))),
        xyz=xyz if kept.all() else xyz[kept],
        intensity=optional(of_intensity, _intensity),
        ring=optional(RING, _ring),
        time=optional(TIME, _time),
        origin=start,
        dropped=int(np.count_nonzero(~kept)) - second,
        source=source,
        fields={name: _kind(column) for name, column in columns.items()},
    )


def _left_out_second(count: int) -> str:
    return f"{count:,} second returns ({SECOND_RETURN}) are left out" if count else ""


def _unit_of_coordinates(names: list[str]) -> str:
    """Report the unit other than metres in the names of x, y and z; nothing is converted."""
    units = {_unit(name) or "m" for name in names}
    if len(units) > 1 or not units <= METRES.keys():
        called = f"the coordinates are called {', '.join(names)}"
        raise ReadError(f"{called}, expected one unit of {', '.join(METRES)}")
    (unit,) = units
    return "" if unit == "m" else f"its columns give x, y and z in {unit} (--unit {unit})"


def frame_from_columns(
    where: str, columns: Columns, wanted: Wanted = USUAL, origin: Array | None = None
) -> PointCloud:
    """Make a cloud as `cloud_from_columns` does, and an empty one where no point is a return."""
    with naming(where):
        try:
            return cloud_from_columns(columns, wanted, origin, where)
        except NoReturnsError as error:
            return PointCloud(np.zeros((0, 3)), dropped=error.points, source=where)


def records_of(columns: Columns) -> NDArray[Any]:
    """Make a record of each point (N,), without padding."""
    first, *_ = columns.values()
    records = np.empty(len(first), [(name, own.dtype.str) for name, own in columns.items()])
    for name, own in columns.items():
        records[name] = own
    return records


def _is_return(xyz: Array, origin: Array) -> BoolArray:
    """Find the points that are returns (N,): places, and neither zero nor at the origin."""
    kept = np.empty(len(xyz), bool)
    # Axis by axis, which is several times faster than along the short side of (N, 3), and of so
    # many points at a time that what it takes stays in a processor's cache.
    with np.errstate(invalid="ignore"):
        for start in range(0, len(xyz), 2**14):
            part = xyz[start : start + 2**14]
            size = _largest(part.T)
            off = (column - first for column, first in zip(part.T, origin, strict=True))
            away = _largest(off) if origin.any() else size
            # Of a coordinate that is no number, neither is the largest one.
            kept[start : start + 2**14] = (
                (size >= SMALLEST) & (size <= LARGEST) & (away >= SMALLEST)
            )
    return kept


def _largest(columns: Iterable[Array]) -> Array:
    """Size (N,) of the largest of x, y and z, (N,) each."""
    x, y, z = (np.abs(each) for each in columns)
    return np.maximum(np.maximum(x, y), z)


def only_returns(cloud: PointCloud, name: str = "cloud") -> PointCloud:
    """Give a cloud that was made in memory the properties that readers guarantee.

    Points that are not finite or at zero range are dropped and counted, and an intensity that is
    not finite is treated as 0.

    Parameters
    ----------
    cloud
        Any cloud; returned unchanged if nothing has to change.
    name
        Its name in messages.

    Raises
    ------
    UsageError
        If no point is a return.
    """
    kept = _is_return(cloud.xyz, cloud.origin)
    if not kept.any():
        raise UsageError(f"{name}: {_none_of(len(kept))}")
    intensity = cloud.intensity
    if intensity is not None and not (
        intensity.dtype == np.float64 and np.all(np.abs(intensity) <= LARGEST)
    ):
        intensity = _intensity(intensity)
    if kept.all() and cloud.xyz.dtype == np.float64 and intensity is cloud.intensity:
        return cloud
    xyz = np.ascontiguousarray(cloud.xyz, dtype=np.float64)
    dropped = cloud.dropped + int(np.count_nonzero(~kept))
    return replace(cloud, xyz=xyz, intensity=intensity, dropped=dropped).select(kept)


def _none_of(points: int) -> str:
    return (
        f"none of its {points} points is finite and away from the sensor; expected coordinates in "
        "metres"
    )


def _kind(column: NDArray[Any]) -> str:
    """Name the type of a column, and the number of values per point if it is not one."""
    return column.dtype.name + "".join(f"[{n}]" for n in column.shape[1:])


def _numbers(name: str, column: NDArray[Any]) -> NDArray[Any]:
    """Convert to one number per point, the first of several; refuse text and complex numbers."""
    if column.dtype.kind not in REAL_KINDS or column.ndim not in (1, 2) or column.shape[1:] == (0,):
        kind = f"{column.dtype} {list(column.shape[1:]) or ''}"
        raise ReadError(f"field {name} is {kind}, expected numbers")
    return column if column.ndim == 1 else column[:, 0]


def floats(values: NDArray[Any], out: Array | None = None) -> Array:
    """Give values of a file as float64; values that do not fit become infinite or NaN, without a
    warning."""
    # Casting a signalling NaN or a long double out of range warns; such points are dropped. The sum
    # makes a signalling NaN a quiet one, so that nothing that follows warns either.
    with np.errstate(invalid="ignore", over="ignore"):
        added: Array = np.add(values, 0.0, out, dtype=np.float64, casting="unsafe")
    return added


def _intensity(values: NDArray[Any]) -> Array | None:
    intensity = floats(values)
    measured = np.abs(intensity) <= LARGEST
    if measured.all() and len(measured):
        return intensity
    if not measured.any():
        return None
    lowest = min(0.0, float(intensity[measured].min()))
    return np.where(measured, intensity, lowest)


def _ring(values: NDArray[Any]) -> IntArray | None:
    """Convert ring numbers, which a table stores as floats; None if they are not whole numbers."""
    if values.dtype.kind in "iu" and values.dtype.itemsize <= np.dtype(np.int32).itemsize:
        return values.astype(np.int64)
    numbers = floats(values)
    with np.errstate(invalid="ignore"):
        # Larger numbers, from fields of 8 bytes, are not rings.
        indices = np.all(np.abs(numbers) < 2**31) and np.all(numbers == np.round(numbers))
    return numbers.astype(np.int64) if indices else None


def _time(values: NDArray[Any]) -> Array | None:
    """Convert floats that can be seconds; the length of ticks is given in no file."""
    if values.dtype.kind != "f":
        return None
    seconds = floats(values)
    first, end = UNIX_NANOSECONDS
    # Of a value that is none, neither is a number.
    least, most = seconds.min(initial=np.inf), seconds.max(initial=-np.inf)
    if len(seconds) and least >= first and most < end:
        return seconds / NANOSECONDS
    # Above any time in seconds (year 5138), below any Unix time in milliseconds.
    plausible = not len(seconds) or (least > -1e11 and most < 1e11)
    return seconds if plausible else None


Unit = Literal["m", "cm", "mm", "ft", "in"]

METRES: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
"""Length of each unit, metres; the foot is the international one, 2 ppm from that of US surveys."""

SMALL: tuple[Unit, ...] = ("cm", "mm", "in")
"""Units in which ranges are too large to be mistaken for metres; feet are not."""

NAMES: dict[Unit, str] = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
NAMES |= {"ft": "feet", "in": "inches"}


def unit_named(name: str) -> Unit:
    """Check the name of a unit.

    Raises
    ------
    UsageError
        For any other than ``m``, ``cm``, ``mm``, ``ft`` and ``in``.
    """
    if name not in METRES:
        raise UsageError(f"unit is {name!r}, expected {', '.join(METRES)}")
    return name


def in_metres(cloud: PointCloud, unit: Unit) -> PointCloud:
    """Convert a cloud with coordinates and origin in a unit to metres."""
    if unit == "m":
        return cloud
    return replace(cloud, xyz=cloud.xyz * METRES[unit], origin=cloud.origin * METRES[unit])
