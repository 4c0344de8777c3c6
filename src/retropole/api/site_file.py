"""The site file: which LiDARs recorded what, and what was surveyed, as TOML.

It is in `api`, above `site`: clouds of a site are read as `calibrate` reads them.
"""

from __future__ import annotations

import difflib
import os
import re
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from ..base.datatypes import DEFAULT_RADIUS
from ..base.errors import ReadError, RetropoleError, naming, said
from ..base.se3 import FARTHEST
from ..base.sensors import name_from, sensor_or_auto
from ..base.uncertainty.purpose import DEFAULT_AT, LARGEST_NEED
from ..base.uncertainty.purpose import FARTHEST as FARTHEST_NEED
from ..io.fields import Unit, Wanted
from ..io.recordings import MAX_POINTS
from ..result.options import (
    Intensity,
    MastSway,
    MaxPoints,
    Radius,
    RadiusSigma,
    Reading,
    frames_named,
    radius_in_metres,
)

SITE_FILE = "site.toml"
"""What a site file is called in its folder."""

LARGEST_SITE_FILE = 2**18
"""Bytes: a hundred LiDARs with twenty placements take half as many."""

MOST_DOTS = 300
"""Dots on a line. The time that `tomllib` takes for a key grows with the square of its parts: 76 s
for 65,000 dots, a second for a whole file of lines with 300."""

MOST_LIDARS, MOST_PLACEMENTS, MOST_SURVEYED = 100, 100, 1000
"""Of one site."""

LONGEST_PATH = 4096
FARTHEST_SEEN = 1000.0
"""Of a control point from the LiDAR that sees it, metres: none reaches it."""

Name = Annotated[str, Meta(min_length=1, max_length=60)]
Long = Annotated[str, Meta(min_length=1, max_length=1000)]
Coordinate = Annotated[float, Meta(ge=-FARTHEST, le=FARTHEST)]
XYZ = Meta(min_length=3, max_length=3)
Place = Annotated[list[Coordinate], XYZ]
Seen = Annotated[list[Annotated[float, Meta(ge=-FARTHEST_SEEN, le=FARTHEST_SEEN)]], XYZ]
Upwards = Annotated[list[Annotated[float, Meta(ge=-1e3, le=1e3)]], XYZ]
LEAST_SIGMA, LARGEST_SIGMA = 1e-4, 10.0
"""1 σ of a coordinate, metres: no survey is more accurate than 0.1 mm, and a poorer one does not
help."""

Sigma = Annotated[float, Meta(ge=LEAST_SIGMA, le=LARGEST_SIGMA)]
Sigmas = Annotated[list[Sigma], XYZ]


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the site file: what it does not know is a slip."""


class PolesTable(_Table, frozen=True, kw_only=True):
    """What all poles have in common."""

    radius_m: Radius = DEFAULT_RADIUS
    radius_sigma_m: RadiusSigma = 0.0


class ReferenceTable(_Table, frozen=True, kw_only=True):
    """The frame of the site: that of a LiDAR, or the one that coordinates were surveyed in."""

    lidar: Name | None = None
    frame: Literal["local", "enu"] | None = None
    epsg: Annotated[int, Meta(ge=1024, le=32767)] | None = None
    latitude_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] | None = None
    longitude_deg: Annotated[float, Meta(ge=-180.0, le=360.0)] | None = None
    height_m: Annotated[float, Meta(ge=-1e4, le=1e5)] | None = None


class NeedTable(_Table, frozen=True, kw_only=True):
    """How accurate every pose must be."""

    within_cm: Annotated[float, Meta(gt=0.0, le=100 * LARGEST_NEED)]
    at_m: Annotated[float, Meta(gt=0.0, le=FARTHEST_NEED)] = DEFAULT_AT


class LidarTable(_Table, frozen=True, kw_only=True):
    """One LiDAR, and what it recorded in each placement."""

    name: Name
    recordings: Annotated[
        list[Annotated[str, Meta(max_length=LONGEST_PATH)]],
        Meta(min_length=1, max_length=MOST_PLACEMENTS),
    ]
    sensor: Name = "auto"
    serial: Annotated[str, Meta(max_length=100)] = ""
    threshold: Intensity | None = None
    unit: Unit = "m"
    topic: Long | None = None
    frames: Annotated[str, Meta(min_length=1, max_length=60)] | None = None
    intensity: Long | None = None
    angles: Long | None = None
    up: Upwards | None = None
    up_sigma_deg: Annotated[float, Meta(gt=0.0, le=90.0)] | None = None
    mast_sway_deg: MastSway | None = None

    def reading(self, max_points: int) -> Reading:
        """How its recordings are read, with at most this many points of a cloud."""
        frames = None if self.frames is None else frames_named(self.frames)
        how = frames, max_points, self.unit, Wanted(self.intensity, self.angles)
        return Reading(self.sensor, self.threshold, self.topic, *how)


class SurveyedPoleTable(_Table, frozen=True, kw_only=True):
    """A pole of which an end was surveyed, or both: `foot` and `top` name points of the survey."""

    name: Name
    placement: Name
    foot_m: Place | None = None
    top_m: Place | None = None
    foot: Name | None = None
    top: Name | None = None
    sigma_m: Sigma | None = None
    foot_sigma_m: Sigmas | None = None
    top_sigma_m: Sigmas | None = None
    on: Literal["axis", "surface"] = "axis"


class SeenTable(_Table, frozen=True, kw_only=True):
    """Where a LiDAR sees a control point, in the LiDAR's frame."""

    lidar: Name
    at_m: Seen
    sigma_m: Sigma


class ControlPointTable(_Table, frozen=True, kw_only=True):
    """A surveyed point that LiDARs see as a target: `at` names a point of the survey."""

    name: Name
    at_m: Place | None = None
    at: Name | None = None
    sigma_m: Sigma | None = None
    sigmas_m: Sigmas | None = None
    seen: Annotated[list[SeenTable], Meta(min_length=1, max_length=MOST_LIDARS)]


class SiteFile(_Table, frozen=True, kw_only=True):
    """A whole site file, as it is there: degrees and centimetres where the keys say so."""

    name: Name
    placements: Annotated[list[Name], Meta(min_length=1, max_length=MOST_PLACEMENTS)]
    poles: PolesTable = PolesTable()
    reference: ReferenceTable = ReferenceTable()
    need: NeedTable | None = None
    max_points: MaxPoints = MAX_POINTS
    carried: bool = False
    survey: Annotated[str, Meta(min_length=1, max_length=LONGEST_PATH)] | None = None
    columns: Long | None = None
    lidar: Annotated[list[LidarTable], Meta(min_length=2, max_length=MOST_LIDARS)]
    surveyed_pole: Annotated[list[SurveyedPoleTable], Meta(max_length=MOST_SURVEYED)] = []
    control_point: Annotated[list[ControlPointTable], Meta(max_length=MOST_SURVEYED)] = []

    @property
    def surveyed(self) -> bool:
        """Whether coordinates are given that fix the frame."""
        return bool(self.surveyed_pole or self.control_point)


def read_site_file(path: Path) -> SiteFile:
    """Read a site file; no recording is opened.

    Raises
    ------
    ReadError
        If it cannot be read or is not a site file; names the file, the key and what was expected.
    """
    with naming(path):
        with path.open("rb") as file:
            data = file.read(LARGEST_SITE_FILE + 1)
        return decode_site_file(data, path.parent)


def decode_site_file(data: bytes, folder: Path = Path()) -> SiteFile:
    """Read a site file from its bytes; paths in it are relative to its folder.

    Raises
    ------
    ReadError
        If it is none; names the key and what was expected.
    """
    if len(data) > LARGEST_SITE_FILE:
        raise ReadError(f"more than {LARGEST_SITE_FILE} bytes, too long for a site file")
    for k, line in enumerate(data.splitlines(), 1):
        if line.count(b".") > MOST_DOTS:
            raise ReadError(f"line {k} has more than {MOST_DOTS} dots; break it")
    try:
        raw = tomllib.loads(data.decode())
    except (ValueError, RecursionError) as error:
        # Also of text that is not UTF-8, and of integers that Python does not convert.
        raise ReadError(f"is not TOML: {said(error)}") from None
    try:
        site = msgspec.convert(raw, SiteFile)
    except msgspec.ValidationError as error:
        raise ReadError(_in_words(str(error), raw)) from None
    lidars = [
        replace(
            each,
            sensor=name_from(folder, each.sensor),
            angles=None if each.angles is None else os.path.abspath(folder / each.angles),
        )
        for each in site.lidar
    ]
    site = replace(site, lidar=lidars)
    for fault in _faults(site):
        raise ReadError(fault)
    return site


TYPES = {"array": "a list", "object": "a table", "str": "text", "float": "a number"}
TYPES |= {"int": "a whole number", "bool": "true or false", "null": "nothing"}


def _in_words(message: str, raw: dict[str, Any]) -> str:
    """Name the key that is wrong as the file has it, and what was expected there."""
    what, _, where = message.partition(" - at `$")
    what = re.sub(r"`(\w+)`", lambda found: TYPES.get(found[1], found[1]), what)
    what = what.replace("Object missing required field", "missing key")
    steps = re.findall(r"\.(\w+)|\[(\d+)\]", where)
    names: list[str] = []
    at: Any = raw
    for key, number in steps:
        at = at.get(key) if key and isinstance(at, dict) else at
        if key:
            names.append(key)
            continue
        at = at[int(number)] if isinstance(at, list) else at
        names[-1] += f" {int(number) + 1}"
        if isinstance(at, dict) and isinstance(at.get("name"), str):
            names[-1] += f" ({at['name'][:60]})"
    unknown = re.fullmatch(r"Object contains unknown field (.+)", what)
    if unknown:
        near = difflib.get_close_matches(unknown[1].strip("`"), _keys_at(steps), 1)
        what = f"unknown key {unknown[1]}" + (f", expected {near[0]}" if near else "")
    if names == ["poles", "radius_m"] and isinstance(at, int | float):
        what = radius_in_metres(at) or what
    lead = ", ".join(names)
    return f"{lead}: {what[0].lower()}{what[1:]}" if lead else f"{what[0].lower()}{what[1:]}"


TABLES: dict[str, type[_Table]] = {
    "poles": PolesTable,
    "reference": ReferenceTable,
    "need": NeedTable,
    "lidar": LidarTable,
    "surveyed_pole": SurveyedPoleTable,
    "control_point": ControlPointTable,
    "seen": SeenTable,
}


def _keys_at(steps: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """Give the keys that a table of the file may have."""
    keys = [key for key, _ in steps if key]
    return TABLES.get(keys[-1] if keys else "", SiteFile).__struct_fields__


def _faults(site: SiteFile) -> Iterator[str]:
    """Report errors that the types of the keys do not cover."""
    yield from _names(site)
    for lidar in site.lidar:
        yield from _lidar_faults(lidar, len(site.placements))
    yield from _reference_faults(site)
    if site.carried:
        yield from _walk_faults(site)
    names = [lidar.name for lidar in site.lidar]
    if site.columns is not None and site.survey is None:
        yield "columns: expected survey, the file with these columns"
    for pole in site.surveyed_pole:
        of = f"surveyed_pole {pole.name}"
        if pole.placement not in site.placements:
            yield f"{of}, placement: {_no(pole.placement, site.placements)}"
        if not any((pole.foot_m, pole.top_m, pole.foot, pole.top)):
            yield f"{of}: expected foot_m, top_m or both"
        for end in ("foot", "top"):
            yield from _end_faults(site, of, pole, end, f"{end}_m", f"{end}_sigma_m")
        if pole.foot_m is not None and pole.foot_m == pole.top_m:
            yield f"{of}: foot_m and top_m are the same point"
    for point in site.control_point:
        if point.at is None and point.at_m is None:
            yield f"control_point {point.name}: expected at_m, or at"
        yield from _end_faults(site, f"control_point {point.name}", point, "at", "at_m", "sigmas_m")
        seeing = [each.lidar for each in point.seen]
        for name in seeing:
            if name not in names:
                yield f"control_point {point.name}, seen, lidar: {_no(name, names)}"
        yield from _twice(f"control_point {point.name}, seen, lidar", seeing)


def _walk_faults(site: SiteFile) -> Iterator[str]:
    """Report keys that cannot be used with a pole that is carried."""
    if len(site.placements) > 1:
        yield (
            f"carried: a walk is one recording of each LiDAR, expected one placement; there are "
            f"{len(site.placements)}"
        )
    tables = {
        "survey": site.survey is not None,
        "surveyed_pole": bool(site.surveyed_pole),
        "control_point": bool(site.control_point),
        "poles, radius_sigma_m": site.poles.radius_sigma_m > 0,
        "lidar, up": any(lidar.up is not None for lidar in site.lidar),
        "lidar, mast_sway_deg": any(lidar.mast_sway_deg is not None for lidar in site.lidar),
    }
    for key in (key for key, is_there in tables.items() if is_there):
        yield f"{key}: cannot be used with a pole that is carried: leave it out"


def _end_faults(
    site: SiteFile,
    of: str,
    table: SurveyedPoleTable | ControlPointTable,
    by_name: str,
    by_value: str,
    sigmas: str,
) -> Iterator[str]:
    """Report errors of one surveyed place, given by its name or by its coordinates."""
    named, at, own = (getattr(table, key) for key in (by_name, by_value, sigmas))
    if named is not None and at is not None:
        yield f"{of}: expected {by_name} or {by_value}, not both"
    if named is not None and site.survey is None:
        yield f"{of}, {by_name}: expected survey, the file with {named!r}"
    if at is not None and table.sigma_m is None and own is None:
        yield f"{of}: missing key sigma_m"


def _names(site: SiteFile) -> Iterator[str]:
    """Report names that are invalid, or given twice."""
    for what, names in (
        ("name", [site.name]),
        ("placements", site.placements),
        ("lidar, name", [each.name for each in site.lidar]),
        ("surveyed_pole, name", [each.name for each in site.surveyed_pole]),
        ("control_point, name", [each.name for each in site.control_point]),
    ):
        for name in names:
            if name != name.strip() or not name.isprintable():
                yield f"{what}: {name!r} is no name, expected printable text with no space around"
        yield from _twice(what, names)


def _twice(what: str, names: Sequence[str]) -> Iterator[str]:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            yield f"{what}: {name!r} appears twice, expected different names"
        seen.add(name)


def _no(name: str, known: Sequence[str]) -> str:
    return f"{name!r} is unknown, expected one of {', '.join(known)}"


def _lidar_faults(lidar: LidarTable, placements: int) -> Iterator[str]:
    of = f"lidar {lidar.name}"
    if len(lidar.recordings) != placements:
        yield (
            f"{of}, recordings: expected {placements}, one for each placement, "
            f'"" if there is none; there are {len(lidar.recordings)}'
        )
    if not any(lidar.recordings):
        yield f"{of}, recordings: expected at least one"
    for key, paths in (("recordings", lidar.recordings), ("angles", [lidar.angles or ""])):
        if any("\0" in path for path in paths):
            yield f"{of}, {key}: a path cannot contain a null character"
    if lidar.up is not None and not any(abs(value) > 1e-3 for value in lidar.up):
        yield f"{of}, up: expected a direction; this vector has zero length"
    if (lidar.up is None) != (lidar.up_sigma_deg is None):
        yield f"{of}: up and up_sigma_deg must be given together"
    try:
        sensor_or_auto(lidar.sensor)
    except RetropoleError as error:
        yield f"{of}, sensor: {error}"
    if lidar.frames is not None and frames_named(lidar.frames) is None:
        yield f"{of}, frames: {lidar.frames!r}, expected A:B, A:B:STEP or the number of a frame"


def _reference_faults(site: SiteFile) -> Iterator[str]:
    given = site.reference
    lidars = [lidar.name for lidar in site.lidar]
    if given.lidar is not None and given.lidar not in lidars:
        yield f"reference, lidar: {_no(given.lidar, lidars)}"
    frame_given = given.frame is not None or given.epsg is not None
    if given.frame is not None and given.epsg is not None:
        yield "reference: expected frame or epsg, not both"
    if given.lidar is not None and (frame_given or site.surveyed):
        other = "frame or epsg is given" if frame_given else "coordinates are surveyed"
        yield f"reference, lidar: {other}, which fixes the frame; leave lidar out"
    if frame_given and not site.surveyed:
        yield (
            "reference: expected a [[surveyed_pole]] or [[control_point]]: otherwise the site has "
            "no relation to the frame of the survey"
        )
    origin = (given.latitude_deg, given.longitude_deg, given.height_m)
    if any(value is not None for value in origin):
        if given.frame != "enu":
            yield 'reference: latitude_deg, longitude_deg and height_m need frame = "enu"'
        if None in origin:
            yield "reference: latitude_deg, longitude_deg and height_m must be given together"
