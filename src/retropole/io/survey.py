"""Surveyed points as data loggers and total stations export them: columns are known by name.

Half of these programs write north first, so that an order is never guessed.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array
from ..base.errors import LineError, ReadError, naming, quoting
from .arrays import as_utf8
from .fields import IN_BRACKETS, read_whole

UNITS = {"": 1.0, "m": 1.0, "meter": 1.0, "metre": 1.0, "cm": 0.01, "mm": 0.001}
"""Units in the name of a column, metres each; without one, it is in metres."""

IDS = (
    *("name", "pointname", "pointid", "ptid", "pointnumber", "pointno", "point", "punktnummer"),
    *("messpunkt", "id", "p", "pt", "no", "nr"),
)
"""Names as `_plain` gives them, here and below; where a file has several, the first counts."""

AXES = {
    "e": ("e", "east", "easting", "rechtswert", "x"),
    "n": ("n", "north", "northing", "hochwert", "y"),
    "h": (
        *("h", "height", "elevation", "elev", "el", "z", "höhe", "orthometricheight"),
        *("orthoheight", "ellipsoidalheight", "ellipsoidheight"),
    ),
}

SPREADS = ("sigma", "σ", "rms", "sd", "std", "stddev")
"""Names of 1 σ: with the name of a coordinate before or behind, or alone for all three."""

OF_LEVEL, OF_HEIGHT = ("hrms", "horizontalrms"), ("vrms", "verticalrms")
"""Names of 1 σ of east and north, and of height. Where a program means that of both together, each
is smaller by up to √2: it is not stated too small."""

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.I)
"""As a program writes a number: no mark between thousands, no NaN."""

COMMENT = ("#", "//")

MOST_BEFORE, SHOWN = 50, 10
"""Lines before the names of columns, where programs write about the survey; points in an error."""


class SurveyPoint(NamedTuple):
    """A point (3,) east, north, height, and 1 σ of each, (3,), metres; None if not stated."""

    at: Array
    sigma: Array | None


def read_survey(
    path: Path, ids: Iterable[str], columns: str | None = None, *, is_map: bool = False
) -> dict[str, SurveyPoint]:
    """Read the points with these ids from a text with a point in each line.

    Parameters
    ----------
    path
        Values are separated by semicolons, tabs, commas or else blanks. Lines that start with ``#``
        or ``//`` are comments; what is before the names of the columns is skipped.
    ids
        Which points are read. No other has to be whole.
    columns
        Of a file without names of columns, what they are: ``"id, n, e, h"``.
    is_map
        Whether coordinates are east and north of a map. There, columns x and y are refused: in some
        countries x is east, in others north.

    Raises
    ------
    ReadError
        If the meaning of a column is not stated, if a point is missing or given twice, or if a
        value is not a number; names the file, the line, the column and what was expected.
    """
    with naming(path):
        lines = as_utf8(read_whole(path)).decode(errors="replace").splitlines()
        first, names = _named(lines)
        if columns is not None and names:
            raise LineError(first, "names the columns; leave columns out of the site file")
        if columns is not None:
            names = [name.strip() for name in columns.split(",")]
        place = _places(names)
        if is_map and _plain(names[place["e"]]) == "x":
            raise ReadError(
                "has columns x and y: in some countries x is east, in others north; name them east "
                "and north"
            )
        units = [_unit(name) if k in place.values() else 1.0 for k, name in enumerate(names)]
        rows: dict[str, list[tuple[int, list[str]]]] = {}
        plain = [own for own in enumerate(lines, 1) if own[1].strip() and own[0] > first]
        plain = [own for own in plain if not own[1].startswith(COMMENT)]
        mark = _separator(lines[first - 1] if first else plain[0][1] if plain else "")
        for number, text in plain:
            row = [value.strip() for value in _split(text, mark)]
            row += [""] * (len(names) - len(row))
            rows.setdefault(row[place["id"]], []).append((number, row))
        return {name: _point(*_the_one(name, rows), names, place, units) for name in ids}


def _the_one(
    name: str, rows: Mapping[str, Sequence[tuple[int, list[str]]]]
) -> tuple[int, list[str]]:
    found = rows.get(name, [])
    if not found:
        known = ", ".join(list(rows)[:SHOWN])
        raise ReadError(f"has no point {quoting(name)}, expected one of its {quoting(known)}")
    if len(found) > 1:
        where = " and ".join(str(line) for line, _ in found)
        raise ReadError(f"lines {where} have a point {quoting(name)}, expected it once")
    return found[0]


def _point(
    line: int,
    row: Sequence[str],
    names: Sequence[str],
    place: Mapping[str, int],
    units: Sequence[float],
) -> SurveyPoint:
    """Read a line of values."""

    def number(key: str) -> float:
        k = place[key]
        text = row[k].replace(",", ".", 1) if "." not in row[k] else row[k]
        if not NUMBER.fullmatch(text):
            of = f"column {quoting(names[k])}"
            raise LineError(line, f"{of}: {quoting(row[k])!r}, expected a number of metres")
        return float(text) * units[k]

    if any(row[len(names) :]):
        raise LineError(
            line,
            f"{len(row)} values, expected {len(names)}; decimal commas need semicolons between",
        )
    used = "".join(row[place[axis]] for axis in "enh")
    if "," in used and "." in used:
        raise LineError(line, "decimal points and commas, expected one of both")
    keys = [f"σ{axis}" for axis in "enh"]
    is_stated = all(key in place and row[place[key]] for key in keys)
    return SurveyPoint(
        np.array([number(axis) for axis in "enh"]),
        np.array([number(key) for key in keys]) if is_stated else None,
    )


def _named(lines: Sequence[str]) -> tuple[int, list[str]]:
    """Number of the line that names the columns, and the names; 0 and none where none does."""
    for is_comment in (False, True):
        for k, text in enumerate(lines[:MOST_BEFORE], 1):
            if text.startswith(COMMENT) is is_comment:
                text = text.lstrip("#/ ")
                names = [name.strip() for name in _split(text, _separator(text))]
                if {"e", "n"} <= {key for name in names for key, _ in _meanings(name)}:
                    return k, names
                if {"latitude", "longitude"} <= {_plain(name) for name in names}:
                    raise LineError(
                        k,
                        "names latitude and longitude, expected east and north: export it in a "
                        "projected system, and give that system by epsg",
                    )
    return 0, []


def _places(names: Sequence[str]) -> dict[str, int]:
    """Columns of id, e, n and h, and of σe, σn and σh where they are there."""
    if not names:
        raise ReadError(
            "no line has the names of columns, and programs write north first or east first; give "
            'columns = "id, e, n, h" or "id, n, e, h"'
        )
    best: dict[str, tuple[int, int]] = {}
    for k, name in enumerate(names):
        for key, rank in _meanings(name):
            if key in best and best[key][0] == rank:
                raise ReadError(f"has two columns {quoting(name)}, expected one")
            best[key] = min(best.get(key, (rank, k)), (rank, k))
    missing = [key for key in ("id", *AXES) if key not in best]
    if missing:
        listed = quoting(", ".join(names))
        raise ReadError(f"has no column {' and '.join(missing)}; its columns are {listed}")
    return {key: k for key, (_, k) in best.items()}


def _meanings(name: str) -> list[tuple[str, int]]:
    """What a column may be, and how many names come before it."""
    plain = _plain(name)
    if plain in IDS:
        return [("id", IDS.index(plain))]
    if plain in SPREADS:
        return [(f"σ{axis}", 2) for axis in AXES]
    if plain in OF_LEVEL + OF_HEIGHT:
        return [(f"σ{axis}", 1) for axis in ("en" if plain in OF_LEVEL else "h")]
    for axis, own in AXES.items():
        if plain in own:
            return [(axis, own.index(plain))]
        if any(plain in (spread + each, each + spread) for spread in SPREADS for each in own):
            return [(f"σ{axis}", 0)]
    return []


def _plain(name: str) -> str:
    """Keep letters only, in lower case: ``Point Id`` and ``Easting [m]`` as pointid, easting."""
    return re.sub(r"[^a-zöσ]", "", IN_BRACKETS.sub("", name.lower().replace("3d", "")))


def _unit(name: str) -> float:
    bracket = IN_BRACKETS.search(name)
    unit = bracket[1].strip().lower() if bracket else ""
    if unit not in UNITS:
        raise ReadError(f"column {quoting(name)}: expected metres, cm or mm")
    return UNITS[unit]


def _separator(line: str) -> str:
    return next((mark for mark in ";\t," if mark in line), " ")


def _split(line: str, separator: str) -> list[str]:
    return line.split() if separator == " " else next(csv.reader([line], delimiter=separator))
