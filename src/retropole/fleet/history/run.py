"""All sites checked once, their history appended to, and what changed at each."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import chain, groupby
from typing import Any

import msgspec
import numpy as np

from ...api import Array, quantities
from ...base.errors import ReadError, UsageError
from .. import TIME_LIMIT
from ..batch import Doing, outcomes_of, whole_groups
from ..dataset import partition_of, partitions_in, read_rows
from ..sites import FleetSite
from ..storage import absolute
from ..work import Check, Outcome, Task, task_of
from . import store
from .check import WatchedPair, unanswered_check, watched_pairs
from .store import CheckRow
from .watch import Event, Watched, watch

FLUSH = 100
"""Sites whose rows are appended together: an interrupt loses no more than these."""


@dataclass(frozen=True, eq=False)
class SiteChange:
    """The history of one site.

    Attributes
    ----------
    times
        Of its checks that gave a step from the newest stored pose, in order: what the numbers in
        `watched` count.
    watched
        What was found in them.
    newest
        The result of its check in this run; of one that the history had, the last that had no
        error.
    """

    id: str
    times: Sequence[datetime]
    watched: Watched
    newest: CheckRow

    @property
    def changes(self) -> tuple[Event, ...]:
        """What somebody should look at, since the site was calibrated."""
        return self.watched.alarms

    @property
    def is_decided(self) -> bool:
        """Whether the newest check gave a step at all."""
        return self.newest.is_usable

    def is_new(self, event: Event) -> bool:
        """Whether the newest check found it."""
        return self.is_decided and event.found == len(self.times) - 1

    def describe(self, event: Event) -> str:
        """Describe the change, its onset and its size."""
        since = f"{self.times[event.onset]:%Y-%m-%d}"
        new = ", new" if self.is_new(event) else ""
        if event.size is None or event.covariance is None:
            return f"checks that do not agree since {since}{new}"
        parts = slice(0, 3), slice(3, 6)
        turned, pushed = (_length(event.size[p], event.covariance[p, p]) for p in parts)
        rotation = quantities.value_and_error(*turned, "rad")
        translation = quantities.value_and_error(*pushed)
        size = f"rotation {rotation}, translation {translation}"
        if event.kind == "moved":
            return f"moved since {since}: now {size} (1 σ{new})"
        per = " a year" if event.kind == "trend" else ""
        unclear = "" if event.is_clear else ", or a trend instead of a step or the reverse"
        return f"{event.kind} since {since}: {size}{per} (1 σ{unclear}{new})"


def _length(vector: Array, covariance: Array) -> tuple[float, float]:
    """Give the length of a vector (3,), and 1 σ of it along its direction."""
    length = float(np.linalg.norm(vector))
    unit = vector / max(length, 1e-12)
    return length, float(np.sqrt(unit @ covariance @ unit))


@dataclass(frozen=True, eq=False)
class FleetCheck:
    """What a run did: how many checks were new to the history, and its summary of each site.

    What of the history is damaged, and was left out, is named in `damaged`.
    """

    appended: int
    sites: tuple[SiteChange, ...]
    damaged: tuple[str, ...] = ()


Replayed = tuple[list[SiteChange], list[str]]
"""What changed at some sites, and what of their history is damaged."""

Replaying = Callable[[Callable[[Any], Replayed], Iterator[Any]], Iterable[Replayed]]


def check_fleet(
    sites: Sequence[FleetSite],
    history: str,
    doing: Doing,
    *,
    answers: str | None = None,
    tolerance: tuple[float | None, float | None] = (None, None),
    time_limit: float = TIME_LIMIT,
    now: datetime | None = None,
    progress: Callable[[str], None] = lambda step: None,
    replaying: Replaying = map,
) -> FleetCheck:
    """Check sites, append to their history, and report what changed.

    Parameters
    ----------
    sites
        As `fleet.sites.find_sites` gives them; their order does not matter.
    history
        Path or URL of the history; made where there is none.
    doing
        What does the tasks: `engine.outcomes` with its client.
    answers
        Path or URL of a dataset of `batch.calibrate_fleet` with the stored results; None
        if each site names its results, or has it next to the target.
    tolerance
        Movement that matters, rad and m; None for the least that the data show.
    time_limit
        Of one site, seconds.
    now
        When the run begins: the time of sites whose files cannot be read. None takes the clock.
    progress
        Receives how many of the sites are checked, and when the rest may be.
    replaying
        What replays the history of sites: `engine.mapped` with its client, or `map` here.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    UsageError
        If `answers` is not a dataset, or a site names another stored result.
    ReadError
        If the dataset is damaged.
    OSError
        If the history cannot be written.
    """
    history = absolute(history)
    if answers is not None:
        answers = absolute(answers)
        _check_answers(answers, sites)
    tried = (now or datetime.now(UTC)).replace(microsecond=0)
    pairs: list[WatchedPair] = []
    # So that no more than a partition of the answers is in memory.
    by_part = sorted(sites, key=lambda site: (partition_of(site.id), site.id))
    for part, of_part in groupby(by_part, lambda site: partition_of(site.id)):
        stored = None if answers is None else read_rows(answers, part)
        pairs += (pair for site in of_part for pair in watched_pairs(site, stored))
    by_id = {pair.site.id: pair.site for pair in pairs}
    if len(by_id) < len(pairs):
        raise UsageError("a pair of a site has the name of another site: rename that site")
    damaged: list[ReadError] = []
    files, keys = store.contents(history, damaged.append)

    def keys_of(name: str) -> set[str]:
        return {*keys.get(name, b"").decode().split()}

    blank = Check(tolerance=tolerance, tried=tried)

    def tasks() -> Iterator[Task]:
        for part, of_part in groupby(pairs, lambda pair: partition_of(pair.origin)):
            stored = {} if answers is None else read_rows(answers, part)
            for pair in of_part:
                if pair.site.fault:
                    continue
                check = msgspec.structs.replace(
                    blank,
                    document=stored[pair.origin].document if stored else None,
                    lidars=pair.lidars,
                    known=sorted(keys_of(pair.site.id)),
                )
                yield task_of(pair.site, time_limit, check=check)

    newest: dict[str, CheckRow] = {}

    def append(outcomes: Iterable[Outcome]) -> int:
        # Of what the history has there is neither.
        new = []
        for one in outcomes:
            if one.check is not None:
                new.append(one.check)
            elif one.row is not None:
                new.append(unanswered_check(by_id[one.id], blank, one.row))
        newest.update((row.id, row) for row in new)
        return store.append(history, new, set().union(*(keys_of(row.id) for row in new)))

    # Rows come in any order: those of the same sites are appended together, so that the files of
    # the history are the same whatever the workers.
    appended = 0
    waiting: dict[int, dict[str, Outcome]] = {}
    chunk_of = {name: k // FLUSH for k, name in enumerate(by_id)}
    found = outcomes_of("check", by_id.values(), doing(tasks()), progress)
    try:
        for _, outcomes in whole_groups(found, chunk_of, waiting):
            appended += append(outcomes.values())
    finally:
        # Also what was checked before an interrupt.
        append(chain.from_iterable(outcomes.values() for outcomes in waiting.values()))
    progress("look at the history")
    changes, faults = replay(history, by_id, replaying, newest, files)
    return FleetCheck(appended, tuple(changes), (*dict.fromkeys([*map(str, damaged), *faults]),))


def replay(
    history: str,
    ids: Collection[str] | None = None,
    replaying: Replaying = map,
    newest: Mapping[str, CheckRow] | None = None,
    known: store.Sites | None = None,
) -> Replayed:
    """Report changes at sites, in the order of their ids, and damaged parts of the history.

    Without ids, at all that the history has.
    `newest` has the result of each site of a run, by its id, and `known` the files that existed.
    """
    damaged: list[ReadError] = []
    changes: list[SiteChange] = []
    faults: list[str] = []
    for found, damaged_too in replaying(
        _replayed, store.tables(history, ids, damaged.append, known)
    ):
        changes += found
        faults += damaged_too
    own = newest or {}
    changes = [replace(site, newest=own.get(site.id, site.newest)) for site in changes]
    return sorted(changes, key=lambda site: site.id), [*map(str, damaged), *faults]


def _replayed(table: Any) -> Replayed:
    faults: list[ReadError] = []
    changes = [changes_of(rows) for _, rows in store.rows_of(table, faults.append)]
    return changes, [*map(str, faults)]


def changes_of(rows: Sequence[CheckRow], newest: CheckRow | None = None) -> SiteChange:
    """Report changes at one site, from all of its checks; `newest` is that of this run."""
    usable = store.observed(rows)
    newest = newest or max(rows, key=lambda row: (row.status != "error", row.time, row.key))
    times, watched = [row.time for row, _ in usable], watch([one for _, one in usable])
    return SiteChange(rows[0].id, times, watched, newest)


def _check_answers(answers: str, sites: Sequence[FleetSite]) -> None:
    """Find out now what would make an error of every site."""
    if not partitions_in(answers):
        raise UsageError(f"{answers}: is not a dataset of 'retropole fleet calibrate'")
    named = next((site for site in sites if site.result), None)
    if named is not None:
        raise UsageError(
            f"site {named.id!r}: a stored result is given in its list, {named.result}, and in "
            "the answers; remove the column result, or leave out --answers"
        )
