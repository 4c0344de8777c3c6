"""The history of all sites as Parquet files: one folder for each month, appended to, never changed.

``HISTORY/month=2026-11/<hash>.parquet``: each append writes one file for each month in which it has
new rows, named by the keys of its rows and written whole or not at all. Nothing is ever rewritten.
It is read a few sites at a time; what is damaged is reported and left out.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from functools import partial
from itertools import groupby
from operator import itemgetter
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from ...base.errors import NewerError, ReadError, said
from ...result.decoding import check_covariance
from ..storage import below, names_in, replace_bytes
from ..tables import arrow, opened, parquet_of
from .watch import Observed

SCHEMA = "retropole/history/1"

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

STATUSES = ("same", "moved", "cannot_tell", "error")

UNSETTLED = ("several_minima", "stored_fits_as_well", "scene_denies_stored", "swapped")
"""Codes of checks whose step is not to be trusted, for more than its size."""

MOST_STEP = 1e6
"""Steps of a pose are below this, rad and m: squares of larger ones overflow."""

PLACE = "place"
"""Column of the file that a row was read of; no file has it."""

LARGEST_FILE = 2**31
"""Bytes of a file: 10,000 sites make 10 MB in an append."""

READERS = 8
"""Files that are read at once: of an object store most of the time is waiting. Not tuned."""

SITES_PER_BATCH = 20
"""Sites that are read, and replayed, together: 7 MB in a year of daily checks."""

Step = Annotated[list[float], Meta(min_length=6, max_length=6)]
Covariance = Annotated[list[float], Meta(min_length=36, max_length=36)]


def _raise(error: ReadError) -> None:
    raise error


Report = Callable[[ReadError], None]
"""Receives what is damaged, which is then left out; or raises it."""

Sites = dict[str, tuple[str, ...]]
"""Files of a history, and the sites that each has."""


class CheckRow(msgspec.Struct, frozen=True):
    """A check of a site at a time.

    Attributes
    ----------
    id
        Name of the site.
    time
        When it was recorded, UTC.
    status
        ``same``, ``moved`` or ``cannot_tell``, as of ``retropole check``; ``error`` where a file
        could not be read.
    used
        What the pose was found by: ``poles``, ``scene``; None if there is none.
    codes
        Reason codes.
    message
        What went wrong, in words; None if nothing did.
    step
        (6,) ``[φ, δ]`` from the stored pose, rad and m, target axes; None if there is none.
    covariance
        Covariance of the pose, 6 × 6, row by row.
    random
        6 × 6 of that the part that each check draws anew.
    chi2, power
        As of ``retropole check``.
    stored_sha256, target_sha256, source_sha256
        Hashes of the stored result and of the recordings; empty if they could not be read.
    version
        Of this program.
    """

    id: str
    time: datetime
    status: str
    used: str | None = None
    codes: tuple[str, ...] = ()
    message: str | None = None
    step: Step | None = None
    covariance: Covariance | None = None
    random: Covariance | None = None
    chi2: float | None = None
    power: float | None = None
    stored_sha256: str = ""
    target_sha256: str = ""
    source_sha256: str = ""
    version: str = ""

    @property
    def key(self) -> str:
        """What makes it this check: the same site, time, stored result and recordings.

        A check that ended in an error does not replace one that succeeds.
        """
        hashes = self.stored_sha256, self.target_sha256, self.source_sha256
        return key_of(self.id, self.time.astimezone(UTC), hashes, self.status, self.codes)

    @property
    def is_usable(self) -> bool:
        """Whether its step gives the pose of the site: a check too weak to say *same* does."""
        return is_usable(self.step is not None, self.status, self.codes)


def key_of(
    name: str, time: datetime, hashes: Iterable[str], status: str, codes: Iterable[str]
) -> str:
    """Give the key of a check, of the columns that make it this one; the time is UTC."""
    failure = ("error", *codes) if status == "error" else ()
    text = "\n".join((name, time.isoformat(), *hashes, *failure))
    return hashlib.sha256(text.encode()).hexdigest()


def is_usable(has_step: bool, status: str, codes: Collection[str]) -> bool:
    """Whether a check gives the pose of its site."""
    if not has_step or status == "error" or (codes and not set(codes).isdisjoint(UNSETTLED)):
        return False
    return status != "cannot_tell" or "too_weak" in codes


def flat(value: Any) -> Any:
    """Give an array as a row has it; all else as it is."""
    return value.ravel().tolist() if isinstance(value, np.ndarray) else value


def columns_of(row: CheckRow) -> dict[str, Any]:
    """Give a row as the columns of the table."""
    return {"key": row.key, **msgspec.structs.asdict(row)}


def row_of(columns: Mapping[str, Any]) -> CheckRow:
    """Read a row, whose time may be in µs since 1970: what is written by others need not be sound.

    Raises
    ------
    ReadError
        If a status, step or covariance is none, or the row is not the one that its key names.
    """
    site = f"history, site {columns['id']!r}"
    try:
        time = columns["time"]
        if isinstance(time, int):
            time = EPOCH + timedelta(microseconds=time)
        codes = columns["codes"] or ()
        row = msgspec.convert({**columns, "codes": codes, "time": time}, CheckRow)
        if row.status not in STATUSES:
            raise ReadError(f"{site}: {row.status!r} is no status")
        if row.step is not None and not np.abs(row.step).max() < MOST_STEP:
            raise ReadError(f"{site}, step: no number below {MOST_STEP:g}")
        for name, given in (("covariance", row.covariance), ("random", row.random)):
            if (given is None) != (row.step is None):
                raise ReadError(f"{site}: a step without its covariances")
            if given is not None:
                C = np.reshape(given, (6, 6))
                check_covariance(f"{site}, {name}", C, is_part=name == "random")
    # A time beyond the calendar, for one.
    except (msgspec.ValidationError, OverflowError) as error:
        raise ReadError(f"{site}: {said(error)}") from None
    if row.key != columns["key"]:
        raise ReadError(f"{site}, {row.time}: the row is not that of its key")
    return row


def observed(rows: Iterable[CheckRow]) -> list[tuple[CheckRow, Observed]]:
    """Give the checks of one site against its newest stored pose, in the order of time.

    A site that was calibrated anew begins anew: steps from an older pose are left out.
    """
    ordered = sorted(rows, key=lambda row: (row.time, row.key))
    newest = [row.stored_sha256 for row in ordered if row.stored_sha256][-1:]
    usable = [r for r in ordered if r.is_usable and (not newest or r.stored_sha256 == newest[0])]
    if not usable:
        return []
    covariance, random = np.reshape(
        [[row.covariance, row.random] for row in usable], (-1, 2, 6, 6)
    ).swapaxes(0, 1)
    # What rounding leaves of a common part must stay a covariance.
    common = covariance - random
    values, vectors = np.linalg.eigh((common + common.swapaxes(1, 2)) / 2.0)
    common = (vectors * np.maximum(values, 0.0)[:, None]) @ vectors.swapaxes(1, 2)
    return [
        (
            row,
            Observed(
                (row.time - EPOCH) / timedelta(days=1),
                np.array(row.step),
                random[k],
                common[k],
                row.used != usable[0].used,
                row.status == "moved",
            ),
        )
        for k, row in enumerate(usable)
    ]


def append(folder: str, rows: Iterable[CheckRow], known: Container[str] = ()) -> int:
    """Append checks to a history; those that it has are left out.

    Parameters
    ----------
    folder
        Path or URL of the history.
    rows
        Their order does not matter: the same rows give the same bytes.
    known
        Keys of the checks that the history has of these sites.

    Returns
    -------
    int
        How many were new.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    OSError
        If a file cannot be written; each month is whole or not there.
    """
    months: dict[str, dict[str, CheckRow]] = {}
    for row in rows:
        if row.key not in known:
            months.setdefault(f"month={row.time:%Y-%m}", {})[row.key] = row
    for month, fresh in sorted(months.items()):
        name = hashlib.sha256("\n".join(sorted(fresh)).encode()).hexdigest()[:32]
        place = below(folder, month, f"{name}.parquet")
        replace_bytes(
            place, parquet_of((columns_of(fresh[key]) for key in sorted(fresh)), schema())
        )
    return sum(map(len, months.values()))


def schema() -> Any:
    """Give the schema of the files."""
    pa = arrow()
    text, real, numbers = pa.string(), pa.float64(), pa.list_(pa.float64())
    always = {"key": text, "id": text, "time": pa.timestamp("us", tz="UTC"), "status": text}
    others = {"used": text, "codes": pa.list_(text), "message": text, "step": numbers}
    others |= {"covariance": numbers, "random": numbers, "chi2": real, "power": real}
    hashes = ("stored_sha256", "target_sha256", "source_sha256")
    others |= dict.fromkeys((*hashes, "version"), text)
    columns = [pa.field(name, kind, nullable=False) for name, kind in always.items()]
    return pa.schema([*columns, *others.items()], metadata={"schema": SCHEMA})


def contents(
    folder: str, report: Report = _raise, known: Collection[str] = ()
) -> tuple[Sites, dict[str, bytearray]]:
    """Look what a history has, but in files that are `known`: the files, and the keys of each site.

    Of millions of checks the keys are kept as lines of text: sets would need four times the memory.
    """
    sites: Sites = {}
    names_of: dict[tuple[str, ...], tuple[str, ...]] = {}
    keys: dict[str, bytearray] = {}
    months = filter(re.compile(r"month=\d{4}-\d{2}").fullmatch, names_in(folder))
    files = (
        below(folder, month, name) for month in months for name in names_in(below(folder, month))
    )
    places = [place for place in files if place.endswith(".parquet") and place not in known]
    for place, table in _tables(places, report, ["id", "key"]):
        names = table["id"].to_pylist()
        # Files that were appended one after the other have the same sites.
        own = (*sorted(set(names)),)
        sites[place] = names_of.setdefault(own, own)
        for name, key in zip(names, table["key"].to_pylist(), strict=True):
            keys.setdefault(name, bytearray()).extend(f"{key}\n".encode())
    return sites, keys


def tables(
    folder: str, ids: Collection[str] | None, report: Report, known: Sites | None = None
) -> Iterator[Any]:
    """Read a history as tables of a few sites each, with all rows of these and the `PLACE` of each.

    Parameters
    ----------
    folder
        Path or URL of the history; where there is none, it is empty.
    ids
        Sites to read; None reads all.
    report
        Receives each file that is damaged or not of this schema.
    known
        What `contents` gave; what was appended since is found.
    """
    pa = arrow()
    from pyarrow import compute

    known = known or {}
    files: dict[str, list[str]] = {}
    for place, names in (known | contents(folder, report, known)[0]).items():
        for name in names:
            files.setdefault(name, []).append(place)
    wanted = files.keys() if ids is None else files.keys() & {*ids}
    order = sorted(wanted, key=lambda name: (files[name][-1], name))

    def of(table: Any, names: list[str]) -> Any:
        return table.filter(compute.is_in(table["id"], value_set=pa.array(names)))

    # Sites that were appended together are in the same files, of which the last is one.
    for _, group in groupby(order, lambda name: files[name][-1]):
        for some in _parts([*group], 5 * SITES_PER_BATCH):
            places = sorted({place for name in some for place in files[name]})
            found = [
                own.append_column(PLACE, pa.array([place] * len(own), pa.string()))
                for place, table in _tables(places, report)
                if len(own := of(table, some))
            ]
            if found:
                table = pa.concat_tables(found)
                yield from (of(table, few) for few in _parts(some, SITES_PER_BATCH))


def _parts(names: list[str], most: int) -> Iterator[list[str]]:
    return (names[k : k + most] for k in range(0, len(names), most))


def rows_of(table: Any, report: Report = _raise) -> Iterator[tuple[str, list[CheckRow]]]:
    """Give the checks of each site of a table in the order of time; report invalid rows."""
    micros = table.set_column(
        table.schema.get_field_index("time"), "time", table["time"].cast("int64")
    )
    order = [(name, "ascending") for name in ("id", "time", "key")]
    for name, own in groupby(micros.sort_by(order).to_pylist(), itemgetter("id")):
        sound = {}
        for columns in own:
            place = columns.pop(PLACE)
            try:
                # The same check may be there twice.
                sound[columns["key"]] = row_of(columns)
            except ReadError as error:
                report(ReadError(f"{place}: {error}"))
        if sound:
            yield name, [*sound.values()]


def read(
    folder: str, ids: Collection[str] | None = None, report: Report = _raise
) -> Iterator[tuple[str, list[CheckRow]]]:
    """Read a history: the checks of each site in the order of time, a site at a time.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    ReadError
        Of what is damaged, without `report`.
    """
    for table in tables(folder, ids, report):
        yield from rows_of(table, report)


def _tables(
    places: Iterable[str], report: Report, columns: list[str] | None = None
) -> Iterator[tuple[str, Any]]:
    """Read files, but those that are damaged; a few at once."""
    with ThreadPoolExecutor(READERS) as readers:
        for place, found in zip(places, readers.map(partial(_table, columns), places), strict=True):
            if isinstance(found, NewerError):
                # Its checks are not lost, and what would be written has its name.
                raise found
            if isinstance(found, ReadError):
                report(found)
            else:
                yield place, found


def _table(columns: list[str] | None, place: str) -> Any:
    try:
        with opened(place, "no history: {}", LARGEST_FILE, SCHEMA) as file:
            if not file.schema_arrow.equals(schema()):
                raise ReadError(f"{place}: its columns are not of the schema {SCHEMA}")
            # Others are read meanwhile.
            found = file.read(columns, use_threads=False)
            # Text that is not UTF-8, for example.
            found.validate(full=True)
    except ReadError as error:
        return error
    return found
