"""The history of all sites as Parquet files: one folder for each month, appended to, never changed.

``HISTORY/month=2026-11/<hash>.parquet``: each append writes one file for each month in which it has
new rows, named by the keys of its rows and written whole or not at all. Nothing is ever rewritten.
"""

from __future__ import annotations

import hashlib
import re
from bisect import bisect_right
from collections.abc import Collection, Container, Iterable, Iterator
from typing import Any

from ...base.errors import ReadError
from ..parquet import arrow, opened, parquet_of
from ..storage import below, names_in, write_bytes
from .rows import SCHEMA, CheckRow, plain, row_of

MONTH = re.compile(r"month=\d{4}-\d{2}")

LARGEST_FILE = 2**31
"""Bytes of a file: 10,000 sites make 10 MB in an append."""


def append(folder: str, rows: Iterable[CheckRow], known: Container[str] | None = None) -> int:
    """Append checks to a history; those that it has are left out.

    Parameters
    ----------
    folder
        Path or URL of the history.
    rows
        Their order does not matter: the same rows give the same bytes.
    known
        Keys of the checks that the history has of these sites; None has them read.

    Returns
    -------
    int
        How many were new.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    ReadError
        Where a file of the history cannot be read.
    OSError
        Where one cannot be written; each month is whole or not there.
    """
    months: dict[str, dict[str, CheckRow]] = {}
    for row in rows:
        months.setdefault(f"month={row.time:%Y-%m}", {})[row.key] = row
    count = 0
    for month, own in sorted(months.items()):
        there = keys(folder, months=[month]).values() if known is None else ()
        kept = set().union(*there) if known is None else known
        fresh = {key: row for key, row in sorted(own.items()) if key not in kept}
        if fresh:
            name = hashlib.sha256("\n".join(fresh).encode()).hexdigest()[:32]
            place = below(below(folder, month), f"{name}.parquet")
            write_bytes(place, parquet_of(map(plain, fresh.values()), schema()))
        count += len(fresh)
    return count


def keys(
    folder: str, ids: Collection[str] | None = None, months: Collection[str] | None = None
) -> dict[str, set[str]]:
    """Give the keys of the checks of each site of a history, or of some of its months."""
    found: dict[str, set[str]] = {}
    for place in _files(folder, months):
        for row in _table(place, ["id", "key"]).to_pylist():
            if ids is None or row["id"] in ids:
                found.setdefault(row["id"], set()).add(row["key"])
    return found


def read(folder: str, ids: Collection[str] | None = None) -> Iterator[tuple[str, list[CheckRow]]]:
    """Read a history: the checks of each site in the order of time, sites in the order of ids.

    Parameters
    ----------
    folder
        Path or URL of the history; where there is none, it is empty.
    ids
        Sites to read; None reads all.

    Yields
    ------
    tuple of str and list of CheckRow
        One site at a time: of a large history the rows of all would not fit into memory.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    ReadError
        Where a file of it is damaged, or not of this schema.
    """
    pa, _ = arrow()
    from pyarrow import compute

    tables = [schema().empty_table()]
    for place in _files(folder):
        table = _table(place)
        some = None if ids is None else compute.field("id").isin(sorted(ids))
        tables.append(table if some is None else table.filter(some))
    whole = pa.concat_tables(tables)
    whole = whole.sort_by([(name, "ascending") for name in ("id", "time", "key")])
    names = whole.column("id").to_pylist()
    start = 0
    while start < len(names):
        end = bisect_right(names, names[start], start)
        rows = {row["key"]: row for row in whole.slice(start, end - start).to_pylist()}
        yield names[start], [row_of(row) for row in rows.values()]
        start = end


def schema() -> Any:
    """Give the schema of the files."""
    pa, _ = arrow()
    text, double = pa.string(), pa.float64()
    always = {"key": text, "id": text, "time": pa.timestamp("us", tz="UTC"), "status": text}
    columns = {
        **{"used": text, "codes": pa.list_(text), "message": text},
        **dict.fromkeys(("step", "covariance", "random"), pa.list_(double)),
        **dict.fromkeys(("chi2", "power"), double),
        **dict.fromkeys(("stored_sha256", "target_sha256", "source_sha256", "version"), text),
    }
    needed = [pa.field(name, kind, nullable=False) for name, kind in always.items()]
    return pa.schema([*needed, *columns.items()], metadata={"schema": SCHEMA})


def _files(folder: str, months: Collection[str] | None = None) -> Iterator[str]:
    for month in names_in(folder):
        if MONTH.fullmatch(month) and (months is None or month in months):
            for name in names_in(below(folder, month)):
                if name.endswith(".parquet"):
                    yield below(below(folder, month), name)


def _table(place: str, columns: list[str] | None = None) -> Any:
    with opened(place, "no history: {}", LARGEST_FILE) as file:
        metadata = file.schema_arrow.metadata or {}
        if metadata.get(b"schema") != SCHEMA.encode() or not file.schema_arrow.equals(schema()):
            raise ReadError(f"{place}: not of the schema {SCHEMA}")
        return file.read(columns)
