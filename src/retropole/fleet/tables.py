"""Tables on any file system: Parquet, and lists as Parquet or CSV, rows by the names of columns."""

from __future__ import annotations

import csv
import difflib
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from ..base.errors import MissingExtraError, NewerError, ReadError, is_newer, quoting, said
from .storage import LARGEST_LIST, open_file, read_bytes


def arrow() -> Any:
    """Import pyarrow, with its `parquet`.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtraError("fleet", "a table of a fleet") from None
    return pyarrow


def parquet_of(rows: Iterable[Mapping[str, Any]], schema: Any) -> bytes:
    """Write rows as one Parquet file; the same rows give the same bytes."""
    return parquet_bytes(arrow().Table.from_pylist(list(rows), schema=schema))


def parquet_bytes(table: Any) -> bytes:
    """Write a table of Arrow as one Parquet file; the same table gives the same bytes."""
    pa = arrow()
    sink = pa.BufferOutputStream()
    pa.parquet.write_table(
        table,
        sink,
        compression="zstd",
        write_page_checksum=True,
    )
    data: bytes = sink.getvalue().to_pybytes()
    return data


@contextmanager
def opened(
    place: str, fault: str, most: int = LARGEST_LIST, schema: str = "", remedy: str = ""
) -> Iterator[Any]:
    """Open a Parquet file.

    Parameters
    ----------
    place
        Path or URL.
    fault
        What it is where it cannot be read, with the reason instead of ``{}``.
    most
        Bytes that it may have.
    schema
        Name of the schema that its metadata must have; any without.
    remedy
        What to do about one that cannot be read or has another schema.

    Raises
    ------
    ReadError
        If it cannot be read, or what is read of it meanwhile; a `NewerError` if a newer
        version wrote it.
    MissingExtraError
        As `arrow`.
    """
    pa = arrow()
    with open_file(place, most) as data:
        try:
            file = pa.parquet.ParquetFile(data, page_checksum_verification=True)
            has = (file.schema_arrow.metadata or {}).get(b"schema", b"").decode(errors="replace")
            if schema and is_newer(has, schema):
                raise NewerError(f"{place}: schema {has!r}")
            if schema and has != schema:
                raise ReadError(f"{place}: not of the schema {schema} but {has!r}{remedy}")
            yield file
        # Values that Python cannot hold: times beyond its calendar, text that is not UTF-8.
        except (pa.ArrowException, OSError, ValueError, OverflowError) as error:
            raise ReadError(f"{place}: {fault.format(said(error))}{remedy}") from None


LISTS = (".csv", ".parquet")


LONGEST_NAME = 200
"""Characters of the name of a site, or of a node."""


class Line(NamedTuple):
    """A row of a list: its number from 1 on, its name, and its cells but those that are empty."""

    number: int
    name: str
    cells: Mapping[str, Any]


def lines_of(place: str, columns: Sequence[str], needed: str) -> Iterator[Line]:
    """Read the rows of a list.

    Parameters
    ----------
    place
        Path or URL; ``.csv``, or else Parquet.
    columns
        Every column that it may have.
    needed
        The column that it must have, of names.

    Raises
    ------
    ReadError
        If it cannot be read, has another column or one twice, or a name that is none.
    MissingExtraError
        If the extra ``fleet`` is not installed.
    """
    read = _csv if place.endswith(".csv") else _parquet
    for number, line in enumerate(read(place, columns, needed), 1):
        cells = {name: value for name, value in line.items() if value not in (None, "")}
        name = str(cells.get(needed, ""))
        # That of a site is the name of a folder of reports.
        sound = len(name) <= LONGEST_NAME and name.isprintable() and "\\" not in name
        sound &= isinstance(cells.get(needed), str | int)
        if not sound or any(part.strip() in ("", ".", "..") for part in name.split("/")):
            raise ReadError(
                f"{place}: row {number}, {needed}: {quoting(name)!r}, expected a name of at most "
                f"{LONGEST_NAME} printable characters; parts between / are not empty and no dots"
            )
        yield Line(number, name, cells)


def _check_columns(place: str, names: Sequence[str], columns: Sequence[str], needed: str) -> None:
    """Refuse a column that is not known: it is a slip, and would do nothing."""
    for name in names:
        if name not in columns:
            near = difflib.get_close_matches(str(name), columns, 1)
            guess = f", expected {near[0]}" if near else f", expected some of {', '.join(columns)}"
            raise ReadError(f"{place}: unknown column {str(name)!r}{guess}")
    if needed not in names:
        raise ReadError(f"{place}: no column {needed!r}")
    for name in set(names):
        if list(names).count(name) > 1:
            raise ReadError(f"{place}: the column {name!r} appears twice")


def _csv(place: str, columns: Sequence[str], needed: str) -> Iterator[Mapping[str, Any]]:
    """Read the rows of a CSV list."""
    try:
        text = read_bytes(place).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ReadError(f"{place}: is not UTF-8: {said(error)}") from None
    rows = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    try:
        _check_columns(place, [name.strip() for name in rows.fieldnames or ()], columns, needed)
        for row in rows:
            if None in row or None in row.values():
                raise ReadError(f"{place}: line {rows.line_num} has not as many cells as the first")
            yield {name.strip(): value.strip() for name, value in row.items()}
    except csv.Error as error:
        raise ReadError(f"{place}: line {rows.line_num}: {said(error)}") from None


def _parquet(place: str, columns: Sequence[str], needed: str) -> Iterator[Mapping[str, Any]]:
    """Read the rows of a Parquet list."""
    with opened(place, "is not Parquet that can be read: {}") as file:
        _check_columns(place, file.schema_arrow.names, columns, needed)
        for batch in file.iter_batches():
            yield from _to_microseconds(batch).to_pylist()


def _to_microseconds(batch: Any) -> Any:
    """Round nanoseconds, which other programs write, to times that Python has."""
    pa = arrow()
    schema = batch.schema
    for k, field in enumerate(schema):
        if pa.types.is_timestamp(field.type) and field.type.unit == "ns":
            schema = schema.set(k, field.with_type(pa.timestamp("us", field.type.tz)))
    return batch.cast(schema, safe=False)
