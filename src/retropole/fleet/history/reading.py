"""The history of sites read: filtered by Arrow, packed for workers, what is damaged left out."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby, pairwise
from operator import itemgetter
from typing import Any

import numpy as np

from ...base.errors import ReadError
from ..storage import below, names_in
from ..tables import arrow, opened
from .columns import PLACE
from .store import SCHEMA, CheckRow, row_of, schema

MONTH = re.compile(r"month=\d{4}-\d{2}")

LARGEST_FILE = 2**31
"""Bytes of a file: 10,000 sites make 10 MB in an append."""

READERS = 8
"""Files that are read at once: of an object store most of the time is waiting. Not tuned."""

TOGETHER = 20
"""Sites that are packed together: 5 MB at 365 checks each."""

def _raise(error: ReadError) -> None:
    raise error


Tell = Callable[[ReadError], None]
"""Is told what is damaged, which is then left out; or raises it."""


def keys(folder: str, ids: Collection[str], tell: Tell = _raise) -> dict[str, set[str]]:
    """Give the keys of the checks of some sites of a history."""
    found: dict[str, set[str]] = {}
    for table in _tables(folder, ids, tell, ["id", "key"]):
        for name, key in zip(*(table[each].to_pylist() for each in ("id", "key")), strict=True):
            found.setdefault(name, set()).add(key)
    return found


def read(
    folder: str, ids: Collection[str] | None = None, tell: Tell = _raise
) -> Iterator[tuple[str, list[CheckRow]]]:
    """Read a history: the checks of each site in the order of time, sites in the order of ids.

    Parameters
    ----------
    folder
        Path or URL of the history; where there is none, it is empty.
    ids
        Sites to read; None reads all.
    tell
        Is told of each file that is damaged or not of this schema, and each row that is none.

    Yields
    ------
    tuple of str and list of CheckRow
        One site at a time: of a large history the rows of all would not fit into memory.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    ReadError
        Of what is damaged, without `tell`.
    """
    for _, data in read_packed(folder, ids, tell):
        yield from unpacked(data, tell)


def read_packed(
    folder: str, ids: Collection[str] | None = None, tell: Tell = _raise
) -> Iterator[tuple[list[str], bytes]]:
    """Read a history as `read` does, `TOGETHER` sites at a time, for another process to unpack."""
    pa = arrow()
    place = pa.field(PLACE, pa.dictionary(pa.int32(), pa.string()))
    tables = _tables(folder, ids, tell)
    whole = pa.concat_tables([schema().append(place).empty_table(), *tables]).unify_dictionaries()
    whole = whole.sort_by([(name, "ascending") for name in ("id", "time", "key")])
    counts = whole["id"].value_counts()
    names = counts.field("values").to_pylist()
    ends = np.cumsum([0, *counts.field("counts").to_pylist()]).tolist()
    ends = [*ends[:-1:TOGETHER], ends[-1]]
    for k, (start, end) in enumerate(pairwise(ends)):
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, whole.schema) as stream:
            stream.write_table(whole.slice(start, end - start))
        data: bytes = sink.getvalue().to_pybytes()
        yield names[TOGETHER * k : TOGETHER * (k + 1)], data


def unpacked(data: bytes, tell: Tell = _raise) -> Iterator[tuple[str, list[CheckRow]]]:
    """Give the checks of each site that was packed."""
    rows = arrow().ipc.open_stream(data).read_all().to_pylist()
    for name, own in groupby(rows, itemgetter("id")):
        sound = {}
        for columns in own:
            place = columns.pop(PLACE)
            try:
                sound[columns["key"]] = row_of(columns)
            except ReadError as error:
                tell(ReadError(f"{place}: {error}"))
        if sound:
            yield name, [*sound.values()]


def _files(folder: str) -> Iterator[str]:
    for month in filter(MONTH.fullmatch, names_in(folder)):
        names = (name for name in names_in(below(folder, month)) if name.endswith(".parquet"))
        yield from (below(folder, month, name) for name in names)


def _tables(
    folder: str, ids: Collection[str] | None, tell: Tell, columns: list[str] | None = None
) -> Iterator[Any]:
    """Give what the files say of some sites, with the place of each."""
    pa = arrow()
    from pyarrow import compute

    some = compute.scalar(True) if ids is None else compute.field("id").isin(sorted(ids))

    def table(place: str) -> Any:
        try:
            with opened(place, "no history: {}", LARGEST_FILE, SCHEMA) as file:
                if not file.schema_arrow.equals(schema()):
                    raise ReadError(f"{place}: its columns are not of the schema {SCHEMA}")
                found = file.read(columns)
                # Text that is no UTF-8, for one.
                found.validate(full=True)
                found = found.filter(some)
        except ReadError as error:
            return error
        places = pa.DictionaryArray.from_arrays(np.zeros(len(found), np.int32), [place])
        return found.append_column(PLACE, places)

    with ThreadPoolExecutor(READERS) as readers:
        for found in readers.map(table, _files(folder)):
            if isinstance(found, ReadError):
                tell(found)
            else:
                yield found
