"""Many small files of a month that is over, merged into few: the same rows, read sooner.

A merged file is written whole before those it replaces are removed, so that whatever ends this on
the way loses nothing: a row that is there twice counts once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from typing import Any

from ...base.errors import ReadError
from ..storage import below, exists, folder_of, remove, replace_bytes
from ..tables import arrow, parquet_bytes
from .reading import Contents, files_of, tables_of
from .store import schema

MERGED_ROWS = 4_000
"""Rows of a merged file, at most: a month of daily checks of 100 sites, which are read together."""


def merge(folder: str, held: Contents, month: str) -> int:
    """Merge files of the months before one; gives how many were replaced.

    Parameters
    ----------
    folder
        Path or URL of the history.
    held
        What `reading.contents` found there: what was appended since is left for the next time.
    month
        ``month=2026-11``, say: it, and all after it, may still grow.

    Raises
    ------
    OSError
        Where a file cannot be written or removed.
    """
    replaced = 0
    for own in files_of(folder, lambda own: own < month):
        known = [place for place in own if place in held.files]
        for places in _bins(known, held):
            replaced += _merge(places)
    return replaced


def _bins(places: Sequence[str], held: Contents) -> Iterator[list[str]]:
    """Put files together whose sites are the same, or next in order; of one file there is none."""
    some: list[str] = []
    rows = 0
    for place in sorted(places, key=lambda place: (held.files[place].first, place)):
        file = held.files[place]
        differs = bool(some) and file.first != held.files[some[-1]].first
        if some and (rows + file.count > MERGED_ROWS or (differs and rows > MERGED_ROWS / 2)):
            if len(some) > 1:
                yield some
            some, rows = [], 0
        some.append(place)
        rows += file.count
    if len(some) > 1:
        yield some


def _merge(places: Sequence[str]) -> int:
    """Write one file in the place of some, unless one of them is damaged or gone."""
    faults: list[ReadError] = []
    tables = [table for _, table in tables_of(places, faults.append)]
    if faults or len(tables) < len(places):
        return 0
    data = parquet_bytes(_whole(tables))
    # Named by all that is in it: another run that merges the same files writes the same one.
    name = hashlib.sha256(data).hexdigest()[:32]
    merged = below(folder_of(places[0]), f"{name}.parquet")
    replace_bytes(merged, data)
    old = [place for place in places if place != merged]
    for place in old:
        try:
            remove(place)
        except OSError:
            # Another run may have removed it meanwhile.
            if exists(place):
                raise
    return len(old)


def _whole(tables: Sequence[Any]) -> Any:
    """Give all rows, by site, time and key; of those that are the same in all, one."""
    pa = arrow()
    table = pa.concat_tables(tables)
    order = [(name, "ascending") for name in ("id", "time", "key")]
    table = table.sort_by(order).combine_chunks()
    keys = table["key"].to_pylist()
    again = {k for k in range(1, len(keys)) if keys[k] == keys[k - 1]}
    twice = {k for k in again if table.slice(k, 1).equals(table.slice(k - 1, 1))}
    kept = [k for k in range(len(keys)) if k not in twice]
    return (table.take(kept) if twice else table).cast(schema())
