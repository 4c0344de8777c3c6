"""The history of sites read, a few sites at a time; what is damaged is told and left out."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np

from ...base.errors import NewerError, ReadError
from ..storage import below, exists, names_in
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
    """What is in a file.

    Attributes
    ----------
    ids
        Sites that are to be read.
    rows
        How many it has of each.
    has_others
        Whether it has rows of other sites.
    first
        The first of all sites in order.
    count
        Of all rows.
    """

    ids: frozenset[str]
    rows: float
    has_others: bool
    first: str
    count: int


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
    gone: set[str] = set()
    before, columns = -1, ["id", "key"] if keys else ["id"]
    while len(gone) > before:
        before = len(gone)
        places = (place for place in _files(folder) if place not in found.files)
        for place, table in tables_of(places, tell, columns, gone):
            _add(found, place, table, some, alike)


def _add(
    found: Contents,
    place: str,
    table: Any,
    some: set[str] | None,
    alike: dict[frozenset[str], frozenset[str]],
) -> None:
    """Add a file, of which the ids were read and the keys or not."""
    names = table["id"].to_pylist()
    each = set(names)
    own = frozenset(each if some is None else some & each)
    # Files that were appended one after the other have the same sites.
    own = alike.setdefault(own, own)
    first, rows = min(names, default=""), len(names) / max(len(each), 1)
    found.files[place] = Held(own, rows, len(each) > len(own), first, len(names))
    if "key" in table.column_names:
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
    for names in [*_groups(holding, found.files)]:
        places = {place for name in names for place in holding[name]}

        def later(names: frozenset[str] = names) -> set[str]:
            _look(found, folder, ids, tell, keys=False)
            return {place for place, held in found.files.items() if names & held.ids}

        yield _of_some(places, names, found.files, tell, later)


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
    places: set[str],
    names: frozenset[str],
    files: Mapping[str, Held],
    tell: Tell,
    later: Callable[[], set[str]],
) -> Any:
    """Read the rows of some sites of all files that hold them, with the place of each.

    `later` looks again, where another run has merged some of the files meanwhile.
    """
    pa = arrow()
    from pyarrow import compute

    parts = [schema().append(pa.field(PLACE, pa.dictionary(pa.int32(), pa.string()))).empty_table()]
    wanted = pa.array(sorted(names))
    tried: set[str] = set()
    while places:
        gone: set[str] = set()
        for place, table in tables_of(sorted(places), tell, None, gone):
            if files[place].has_others or not files[place].ids <= names:
                table = table.filter(compute.is_in(table["id"], value_set=wanted))
            own = pa.DictionaryArray.from_arrays(np.zeros(len(table), np.int32), [place])
            parts.append(table.append_column(PLACE, own))
        tried |= places
        places = later() - tried if gone else set()
    return pa.concat_tables(parts).unify_dictionaries().combine_chunks()


def files_of(
    folder: str, wanted: Callable[[str], bool] = lambda month: True
) -> Iterator[list[str]]:
    """Give the files of each month, ``month=2026-11`` say, that is wanted."""
    for month in filter(MONTH.fullmatch, names_in(folder)):
        if wanted(month):
            names = (name for name in names_in(below(folder, month)) if name.endswith(".parquet"))
            yield [below(folder, month, name) for name in names]


def _files(folder: str) -> Iterator[str]:
    for places in files_of(folder):
        yield from places


def tables_of(
    places: Iterable[str],
    tell: Tell,
    columns: list[str] | None = None,
    gone: set[str] | None = None,
) -> Iterator[tuple[str, Any]]:
    """Read files, but those that are damaged; a few at once.

    A file that is not there any more is put into `gone`, where it is given: it may have been
    merged. If it was in there already, it is damaged.
    """

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
        if isinstance(found, NewerError):
            # Its checks are not lost, and what would be written has its name.
            raise found
        if isinstance(found, ReadError):
            if gone is None or place in gone or _is_there(place):
                tell(found)
            else:
                gone.add(place)
        else:
            yield place, found

    with ThreadPoolExecutor(READERS) as readers:
        for place in places:
            waiting.append((place, readers.submit(table, place)))
            if len(waiting) > 2 * READERS:
                yield from first()
        while waiting:
            yield from first()


def _is_there(place: str) -> bool:
    try:
        return exists(place)
    except ReadError:
        return True
