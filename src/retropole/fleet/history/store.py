"""The history of all sites as Parquet files: one folder for each month, appended to, never changed.

``HISTORY/month=2026-11/<hash>.parquet``: each append writes one file for each month in which it has
new rows, named by the keys of its rows and written whole or not at all. Nothing is ever rewritten.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

from ...errors import MissingExtraError, ReadError
from ...files import write_atomically
from .rows import SCHEMA, CheckRow, plain, row_of

MONTH = re.compile(r"month=\d{4}-\d{2}")

LARGEST_FILE = 2**31
"""Bytes of a file: 10,000 sites make 10 MB in an append."""


def append(folder: Path, rows: Iterable[CheckRow]) -> int:
    """Append checks to a history; those that it has are left out.

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
    pa, pq = arrow()
    months: dict[str, dict[str, CheckRow]] = {}
    for row in rows:
        months.setdefault(f"month={row.time:%Y-%m}", {})[row.key] = row
    count = 0
    for month, own in sorted(months.items()):
        known = keys(folder, [month])
        fresh = {key: row for key, row in sorted(own.items()) if key not in known}
        if not fresh:
            continue
        name = hashlib.sha256("\n".join(fresh).encode()).hexdigest()[:32]
        table = pa.Table.from_pylist([plain(row) for row in fresh.values()], schema=schema())
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink, compression="zstd")
        write_atomically(folder / month / f"{name}.parquet", sink.getvalue().to_pybytes())
        count += len(fresh)
    return count


def keys(folder: Path, months: Collection[str] | None = None) -> set[str]:
    """Give the keys of all checks of a history, or of some of its months."""
    return {
        key
        for path in _files(folder, months)
        for key in _table(path, ["key"]).column("key").to_pylist()
    }


def read(folder: Path, ids: Collection[str] | None = None) -> dict[str, list[CheckRow]]:
    """Read a history: the checks of each site, in the order of time.

    Parameters
    ----------
    folder
        The history; where there is none, it is empty.
    ids
        Sites to read; None reads all.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    ReadError
        Where a file of it is damaged, or not of this schema.
    """
    found: dict[str, CheckRow] = {}
    for path in _files(folder):
        for columns in _table(path).to_pylist():
            if ids is None or columns["id"] in ids:
                found[columns["key"]] = row_of(columns)
    sites: dict[str, list[CheckRow]] = {}
    for row in sorted(found.values(), key=lambda row: (row.id, row.time, row.key)):
        sites.setdefault(row.id, []).append(row)
    return sites


def schema() -> Any:
    """Give the schema of the files."""
    pa, _ = arrow()
    double = pa.float64()
    text = pa.string()
    return pa.schema(
        [
            pa.field("key", text, nullable=False),
            pa.field("id", text, nullable=False),
            pa.field("time", pa.timestamp("us", tz="UTC"), nullable=False),
            pa.field("status", text, nullable=False),
            ("used", text),
            ("codes", pa.list_(text)),
            ("message", text),
            ("step", pa.list_(double)),
            ("covariance", pa.list_(double)),
            ("random", pa.list_(double)),
            ("chi2", double),
            ("power", double),
            ("stored_sha256", text),
            ("target_sha256", text),
            ("source_sha256", text),
            ("version", text),
        ],
        metadata={"schema": SCHEMA},
    )


def _files(folder: Path, months: Collection[str] | None = None) -> Iterator[Path]:
    if not folder.is_dir():
        return
    for month in sorted(folder.iterdir()):
        if MONTH.fullmatch(month.name) and (months is None or month.name in months):
            yield from sorted(month.glob("*.parquet"))


def _table(path: Path, columns: list[str] | None = None) -> Any:
    pa, pq = arrow()
    if path.stat().st_size > LARGEST_FILE:
        raise ReadError(f"{path}: more than {LARGEST_FILE} bytes, no history is so long")
    try:
        with path.open("rb") as file:
            parquet = pq.ParquetFile(file)
            metadata = parquet.schema_arrow.metadata or {}
            if metadata.get(b"schema") != SCHEMA.encode() or not parquet.schema_arrow.equals(
                schema()
            ):
                raise ReadError(f"{path}: not of the schema {SCHEMA}")
            return parquet.read(columns)
    except (pa.ArrowException, OSError) as error:
        raise ReadError(f"{path}: no history: {error}") from None


def arrow() -> tuple[Any, Any]:
    """Import pyarrow and its Parquet.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("fleet", "a history of checks") from None
    return pyarrow, pyarrow.parquet
