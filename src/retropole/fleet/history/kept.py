"""Where the replay of a site stood after its checks, kept beside the history to go on from there.

``HISTORY/state/<hash of the id>``. It counts only where all checks that went into it are still
those that the history begins with, number by number, and the program is the same; otherwise all is
replayed. So it changes nothing but time, and may be removed at any moment.
"""

from __future__ import annotations

import errno
import hashlib
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import msgspec
import numpy as np

from ...api import Array
from ...base.errors import ReadError
from ...base.version import __version__
from ..storage import below, is_url, read_bytes, replace_bytes
from .events import Event, EventKind, Watched
from .model import PLAIN, SIZE, Observed
from .runs import Runs, begin
from .watch import Stand, watch_from

SCHEMA = "retropole/state/1"

AFTER = 7
"""New checks of a site after which it is kept anew: 0.1 MB a site. The more there are, the likelier
one of them needs what all filters made of older checks, which is not kept."""

LARGEST = 2**24
"""Bytes of a file: of a site of which much was told."""

READERS = 8
"""Files that are read or written at once: of an object store most of the time is waiting."""

SHA = hashlib.sha256().digest_size

Kept = bytes | None
"""A file as it is there; None where there is none."""


class _Told(msgspec.Struct, frozen=True, array_like=True):
    """An event as it is kept."""

    kind: EventKind
    onset: int
    found: int
    size: bytes | None
    covariance: bytes | None
    statistic: float
    lead: float


class _Document(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is kept of a site: arrays of `Runs` one after the other, N of the state of each kind."""

    schema: str
    version: str
    checks: bytes
    count: int
    kinds: int
    runs: bytes
    events: list[_Told]
    waiting: dict[int, float]


def replayed(some: Sequence[tuple[Observed, Kept]]) -> list[tuple[Watched, Kept]]:
    """Replay the checks of sites from where they stood; gives what is to be kept, or None."""
    stands = [None if kept is None else decoded(kept, checks) for checks, kept in some]
    found = watch_from([checks for checks, _ in some], stands)
    return [
        (watched, encoded(now, checks) if then is None or now.count - then.count >= AFTER else None)
        for (checks, _), then, (watched, now) in zip(some, stands, found, strict=True)
    ]


def encoded(stand: Stand, checks: Observed) -> bytes:
    """Write down where the replay of a site stands, whose checks these are."""
    document = _Document(
        SCHEMA,
        __version__,
        _digest(checks, stand.count),
        stand.count,
        stand.runs.state.mean.shape[-1],
        b"".join(_bytes(values) for values in _arrays(stand.runs)),
        [_told(event) for event in stand.events],
        dict(stand.waiting),
    )
    data = msgspec.msgpack.encode(document)
    return hashlib.sha256(data).digest() + data


def decoded(kept: bytes, checks: Observed) -> Stand | None:
    """Read where the replay of a site stood; None unless it is of these checks, and sound."""
    data = kept[SHA:]
    if hashlib.sha256(data).digest() != kept[:SHA]:
        return None
    try:
        one = msgspec.msgpack.decode(data, type=_Document)
        is_ours = (one.schema, one.version) == (SCHEMA, __version__) and one.kinds in (PLAIN, SIZE)
        if not is_ours or not 0 < one.count <= len(checks.step):
            return None
        if one.checks != _digest(checks, one.count):
            return None
        blank = begin(checks[:1])
        runs = _filled(blank if one.kinds == PLAIN else blank.whole(), np.frombuffer(one.runs))
        return Stand(one.count, runs, tuple(map(_event, one.events)), one.waiting)
    # Too few numbers, for one.
    except (msgspec.MsgspecError, ValueError):
        return None


def _digest(checks: Observed, count: int) -> bytes:
    """Hash the first checks, with all that is replayed of them."""
    found = hashlib.sha256()
    for values in vars(checks[:count]).values():
        found.update(_bytes(values))
    return found.digest()


def _bytes(values: Array) -> bytes:
    return np.asarray(values, float).tobytes()


def _arrays(runs: Runs) -> Iterator[Array]:
    own = (runs.likelihood, runs.total, runs.weight, runs.telling)
    yield from (*own, *vars(runs.state).values(), *vars(runs.changes).values())


def _filled(blank: Runs, numbers: Array) -> Runs:
    """Put numbers into the arrays of the runs of a site, in place."""
    first = 0
    for values in _arrays(blank):
        values[...] = numbers[first : first + values.size].reshape(values.shape)
        first += values.size
    return blank


def _told(event: Event) -> _Told:
    size, covariance = (
        None if values is None else _bytes(values) for values in (event.size, event.covariance)
    )
    numbers = size, covariance, float(event.statistic), float(event.lead)
    return _Told(event.kind, event.onset, event.found, *numbers)


def _event(one: _Told) -> Event:
    size = None if one.size is None else np.frombuffer(one.size)
    covariance = None if one.covariance is None else np.frombuffer(one.covariance).reshape(6, 6)
    return Event(one.kind, one.onset, one.found, size, covariance, one.statistic, one.lead)


def read(folder: str, ids: Iterable[str]) -> list[Kept]:
    """Read what is kept of sites of a history; what cannot be read is not there."""

    def one(name: str) -> Kept:
        try:
            return read_bytes(_place(folder, name), LARGEST)
        except ReadError:
            return None

    with ThreadPoolExecutor(READERS) as readers:
        return list(readers.map(one, ids))


def write(folder: str, kept: Iterable[tuple[str, bytes]]) -> None:
    """Keep where the replay of sites stands.

    Raises
    ------
    OSError
        Where a file cannot be written; each is whole or as before.
    """

    def one(name: str, data: bytes) -> None:
        try:
            replace_bytes(_place(folder, name), data)
        except OSError as error:
            # Another run keeps the same meanwhile.
            if error.errno != errno.EAGAIN:
                raise

    # On the local system one at a time has its folder.
    with ThreadPoolExecutor(READERS if is_url(folder) else 1) as writers:
        list(writers.map(lambda each: one(*each), kept))


def _place(folder: str, name: str) -> str:
    return below(folder, "state", hashlib.sha256(name.encode()).hexdigest()[:32])
