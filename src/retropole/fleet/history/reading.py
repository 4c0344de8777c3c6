"""The history of sites read, a few sites at a time; what is damaged is told and left out."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import groupby
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

MOST_ROWS = 40_000
"""Rows that are read together, of some sites: 40 MB. 100 sites that are appended together have as
many in a year of daily checks."""


def _raise(error: ReadError) -> None:
    raise error


Tell = Callable[[ReadError], None]
"""Is told what is damaged, which is then left out; or raises it."""


@dataclass(frozen=True)
class Contents:
    """What a history has of some sites: keys of the checks of each, and which files have which.

    Of millions of checks the keys are kept as text: as sets they would need four times the memory.
    """

    keys: dict[str, bytearray] = field(default_factory=dict)
    files: dict[str, Held] = field(default_factory=dict)

    def keys_of(self, name: str) -> set[str]:
        """Give the keys of the checks of a site."""
        return set(self.keys.get(name, b"").decode().split("\n")) - {""}


@dataclass(frozen=True)
class Held:
    """Sites of a file that are to be read, how many rows it has of each, and whether of others."""

    ids: frozenset[str]
    rows: float
    has_others: bool


def contents(
    folder: str, ids: Collection[str] | None = None, tell: Tell = _raise, *, keys: bool = True
) -> Contents:
    """Look what a history has of some sites; without `keys`, which need memory, of the files."""
    found = Contents()
    _look(found, folder, ids, tell, keys)
    return found


def _look(
    found: Contents, folder: str, ids: Collection[str] | None, tell: Tell, keys: bool
) -> None:
    """Add the files that are not known."""
    some = None if ids is None else set(ids)
    alike: dict[frozenset[str], frozenset[str]] = {}
    places = (place for place in _files(folder) if place not in found.files)
    for place, table in _tables(places, tell, ["id", "key"] if keys else ["id"]):
        names = table["id"].to_pylist()
        own = frozenset(names) if some is None else some.intersection(names)
        # Files that were appended one after the other have the same sites.
        own = alike.setdefault(frozenset(own), frozenset(own))
        each, others = len(names) / max(len(set(names)), 1), len(set(names)) > len(own)
        found.files[place] = Held(own, each, others)
        if keys:
            for name, key in zip(names, table["key"].to_pylist(), strict=True):
                if name in own:
                    found.keys.setdefault(name, bytearray()).extend(f"{key}\n".encode())


def read(
    folder: str, ids: Collection[str] | None = None, tell: Tell = _raise
) -> Iterator[tuple[str, list[CheckRow]]]:
    """Read a history: the checks of each site in the order of time.

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
        One site at a time: of a large history the rows of all would not fit into memory. Sites come
        in the order of ids, but those first whose checks lie in files together.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    ReadError
        Of what is damaged, without `tell`.
    """
    for table in tables(folder, ids, tell):
        rows = table.sort_by([(name, "ascending") for name in ("id", "time", "key")]).to_pylist()
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


def tables(
    folder: str,
    ids: Collection[str] | None = None,
    tell: Tell = _raise,
    known: Contents | None = None,
) -> Iterator[Any]:
    """Read a history as tables of a few sites each, all rows of these, in any order.

    `known` is what `contents` gave; what was appended since is found.
    """
    found = Contents({}, {} if known is None else dict(known.files))
    _look(found, folder, ids, tell, keys=False)
    holding: dict[str, list[str]] = {}
    for place, held in found.files.items():
        for name in held.ids:
            holding.setdefault(name, []).append(place)
    for names in _groups(holding, found.files):
        places = sorted({place for name in names for place in holding[name]})
        yield _of_some(places, names, found.files, tell)


def _groups(
    holding: Mapping[str, list[str]], files: Mapping[str, Held]
) -> Iterator[frozenset[str]]:
    """Split sites into groups of at most so many rows, or one; sites that share files first."""
    group: set[str] = set()
    rows, last = 0.0, ""
    for name in sorted(holding, key=lambda name: (holding[name][-1], name)):
        own = sum(files[place].rows for place in holding[name])
        # Files that hold sites of two groups are read twice.
        ends = holding[name][-1] != last and rows > MOST_ROWS / 2
        if group and (ends or rows + own > MOST_ROWS):
            yield frozenset(group)
            group, rows = set(), 0.0
        group.add(name)
        rows, last = rows + own, holding[name][-1]
    if group:
        yield frozenset(group)


def _of_some(
    places: Sequence[str], names: frozenset[str], files: Mapping[str, Held], tell: Tell
) -> Any:
    """Read the rows of some sites of all files that hold them, with the place of each."""
    pa = arrow()
    from pyarrow import compute

    parts = [schema().append(pa.field(PLACE, pa.dictionary(pa.int32(), pa.string()))).empty_table()]
    wanted = pa.array(sorted(names))
    for place, table in _tables(places, tell):
        if files[place].has_others or not files[place].ids <= names:
            table = table.filter(compute.is_in(table["id"], value_set=wanted))
        own = pa.DictionaryArray.from_arrays(np.zeros(len(table), np.int32), [place])
        parts.append(table.append_column(PLACE, own))
    return pa.concat_tables(parts).unify_dictionaries().combine_chunks()


def _files(folder: str) -> Iterator[str]:
    for month in filter(MONTH.fullmatch, names_in(folder)):
        names = (name for name in names_in(below(folder, month)) if name.endswith(".parquet"))
        yield from (below(folder, month, name) for name in names)


def _tables(
    places: Iterable[str], tell: Tell, columns: list[str] | None = None
) -> Iterator[tuple[str, Any]]:
    """Read files, but those that are damaged; a few at once."""

    def table(place: str) -> Any:
        try:
            with opened(place, "no history: {}", LARGEST_FILE, SCHEMA) as file:
                if not file.schema_arrow.equals(schema()):
                    raise ReadError(f"{place}: its columns are not of the schema {SCHEMA}")
                # Others are read meanwhile.
                found = file.read(columns, use_threads=False)
                # Text that is no UTF-8, for one.
                found.validate(full=True)
        except ReadError as error:
            return error
        return found

    waiting: deque[tuple[str, Future[Any]]] = deque()

    def first() -> Iterator[tuple[str, Any]]:
        place, future = waiting.popleft()
        found = future.result()
        if isinstance(found, ReadError):
            tell(found)
        else:
            yield place, found

    with ThreadPoolExecutor(READERS) as readers:
        for place in places:
            waiting.append((place, readers.submit(table, place)))
            if len(waiting) > 2 * READERS:
                yield from first()
        while waiting:
            yield from first()
