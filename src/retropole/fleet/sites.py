"""What to calibrate: site files and pairs, from folders, globs and lists."""

from __future__ import annotations

import math
import posixpath
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from ..base.errors import ReadError, UsageError, quoting
from ..result import DEFAULT_CONFIG, RunConfig
from .storage import absolute, below, exists, folder_of, found_below, matching
from .tables import LISTS, lines_of

Kind = Literal["pair", "site"]

SITE_FILE = ".toml"
ROLES = ("target", "source")
"""How the recordings of a pair are called in its folder, whatever their suffix."""

MOST_SITES = 1_000_000

OPTIONS = (
    *("radius_m", "radius_sigma_m", "sensor_target", "sensor_source"),
    *("threshold_target", "threshold_source", "target_topic", "source_topic"),
    *("unit", "unit_source", "intensity", "intensity_source"),
    *("max_points", "carried", "poles", "up", "hypothesis"),
    *("trust_poles", "deceiving_share", "need_m", "at_m", "mast_sway_deg"),
)
"""Options of a pair that a list may have as columns: those of `RunConfig`."""

CHECKED = ("result", "time")
"""Columns of a list for ``fleet check``: one list may serve both commands."""

COLUMNS = ("id", *ROLES, "site", "latitude_deg", "longitude_deg", *OPTIONS, *CHECKED)
"""Every column that a list may have."""

EARLIEST, LATEST = datetime(1970, 1, 1, tzinfo=UTC), datetime(2200, 1, 1, tzinfo=UTC)
"""Between which a recording was made."""


class FleetSite(msgspec.Struct, frozen=True, kw_only=True):
    """One site of a fleet: a pair of recordings, or a site file.

    Attributes
    ----------
    id
        What it is called; no other of the fleet is called so.
    kind
        ``pair`` or ``site``.
    target, source
        Places of the recordings of a pair.
    site
        Place of the site file.
    config
        Options of a pair; a site file has separate ones.
    latitude, longitude
        Where it is, rad; None if that is not given.
    result
        Place of the stored result that a check compares it with; a calibration takes none.
    time
        When it was recorded by a list, ISO 8601, UTC; empty if none does.
    fault
        What is wrong with its line of a list; empty if nothing is.
    """

    id: str
    kind: Kind
    target: str = ""
    source: str = ""
    site: str = ""
    config: RunConfig = DEFAULT_CONFIG
    latitude: float | None = None
    longitude: float | None = None
    result: str = ""
    time: str = ""
    fault: str = ""


class _Position(msgspec.Struct):
    """Where a site is, as a list has it."""

    latitude_deg: Annotated[float, Meta(ge=-90.0, le=90.0)] | None = None
    longitude_deg: Annotated[float, Meta(ge=-180.0, le=360.0)] | None = None


def find_sites(given: Iterable[str], config: RunConfig = DEFAULT_CONFIG) -> tuple[FleetSite, ...]:
    """Find the sites of a fleet.

    Parameters
    ----------
    given
        Paths, globs or URLs of site files (``.toml``), of lists (``.csv``, ``.parquet``), and of
        folders. In a folder, at any depth, every ``.toml`` is a site file, and each folder with a
        ``target`` and a ``source``, of any suffix or folders themselves, is a pair.
    config
        Options of pairs, where a list does not say otherwise.

    Returns
    -------
    tuple of FleetSite
        In the order of their ids.

    Raises
    ------
    UsageError
        For a path of another kind.
    ReadError
        Where something is not found or cannot be read, or two sites have the same id.
    MissingExtraError
        If the extra ``fleet`` is not installed.
    """
    sites: dict[str, FleetSite] = {}
    for place in (each for one in given for each in _expanded(one)):
        for site in _sites_of(place, config):
            if site.id in sites:
                raise ReadError(
                    f"{place}: the id {site.id!r} appears twice, expected a different one for "
                    "each site"
                )
            sites[site.id] = site
            if len(sites) > MOST_SITES:
                raise ReadError(f"{place}: more than {MOST_SITES} sites; split the fleet")
    return tuple(sites[each] for each in sorted(sites))


def _expanded(given: str) -> list[str]:
    """Give the places that match a glob; a place without a pattern is unchanged."""
    if exists(given) or not any(sign in given for sign in "*?["):
        return [absolute(given)]
    if found := matching(given):
        return found
    raise ReadError(f"{given}: nothing matches")


def _sites_of(place: str, config: RunConfig) -> Iterator[FleetSite]:
    """Find the sites that a file or a folder lists."""
    if exists(place, as_folder=True):
        yield from _in_folder(place, config)
    elif not exists(place):
        raise ReadError(f"{place}: no such file or folder")
    elif place.endswith(SITE_FILE):
        yield FleetSite(id=_id_of(place, posixpath.basename(place)), kind="site", site=place)
    elif place.endswith(LISTS):
        # Paths in a list count from its folder.
        for _, name, line in lines_of(place, COLUMNS, "id"):
            yield _listed(name, folder_of(place), line, config)
    else:
        expected = ", ".join((SITE_FILE, *LISTS))
        raise UsageError(f"{place}: expected a folder, or a file {expected}")


def _id_of(place: str, inside: str) -> str:
    """Call a site file by its path: ``quay/site.toml`` is quay, ``quay.toml`` as well."""
    folder, _, name = inside.rpartition("/")
    if name != "site.toml":
        return inside.removesuffix(SITE_FILE)
    return folder or posixpath.basename(folder_of(place))


def _in_folder(folder: str, config: RunConfig) -> Iterator[FleetSite]:
    """Find site files and pairs at any depth."""
    pairs: dict[str, dict[str, list[str]]] = {}
    for inside in found_below(folder):
        parent, name = posixpath.split(inside)
        place = below(folder, inside)
        if name.endswith(SITE_FILE):
            yield FleetSite(id=_id_of(place, inside), kind="site", site=place)
        stem, _, suffix = name.partition(".")
        # Next to packets of an Ouster lie their metadata.
        if stem in ROLES and suffix != "json":
            pairs.setdefault(parent, {role: [] for role in ROLES})[stem].append(place)
    for inside, found in pairs.items():
        counts = [len(found[role]) for role in ROLES]
        fault = ""
        if counts != [1, 1]:
            fault = f"there are {counts[0]} named target and {counts[1]} source, expected one each"
        target, source = (next(iter(found[role]), "") for role in ROLES)
        name = inside or posixpath.basename(folder.rstrip("/"))
        pair = FleetSite(id=name, kind="pair", target=target, source=source, config=config)
        yield msgspec.structs.replace(pair, fault=fault)


def _listed(name: str, folder: str, given: Mapping[str, Any], config: RunConfig) -> FleetSite:
    """Make a site of a row; what is wrong with it concerns it alone, and ends nothing."""
    kind: Kind = "site" if "site" in given else "pair"
    files = [key for key in (*ROLES, "site", "result") if key in given]
    names = {key: below(folder, str(given[key])) for key in files}
    expected = {"site"} if kind == "site" else set(ROLES)
    options = {key: value for key, value in given.items() if key in OPTIONS}
    position = _Position()
    time, fault = _time(given.get("time"))
    if names.keys() - {"result"} != expected:
        fault = "expected target and source, or site alone"
    elif kind == "site" and options:
        fault = f"{', '.join(options)}: for a site, these are given in its file"
    try:
        names = {key: absolute(place) for key, place in names.items()}
    except UsageError as error:
        fault = fault or str(error)
    try:
        position = msgspec.convert(given, _Position, strict=False)
        base = msgspec.structs.asdict(config)
        config = msgspec.convert({**base, **options}, RunConfig, strict=False)
    except msgspec.ValidationError as error:
        fault = fault or str(error).replace("`$.", "`")
    latitude, longitude = (
        None if each is None else math.radians(each) for each in msgspec.structs.astuple(position)
    )
    if (latitude is None) != (longitude is None):
        fault = fault or "latitude_deg and longitude_deg must be given together"
    return FleetSite(
        id=name,
        kind=kind,
        config=config,
        latitude=latitude,
        longitude=longitude,
        time=time,
        fault=quoting(fault),
        **names,
    )


def _time(given: object) -> tuple[str, str]:
    """Read a time, UTC where it has no zone; gives it, and what is wrong with it."""
    if given is None:
        return "", ""
    try:
        time = given if isinstance(given, datetime) else datetime.fromisoformat(str(given))
        time = time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
    except (ValueError, OverflowError):
        return "", f"time: {given!r} is not a time (ISO 8601)"
    if not EARLIEST <= time < LATEST:
        return "", f"time: {given!r} is not the time of a recording"
    return time.isoformat(), ""
