"""All sites checked once, their history appended to, and what changed at each."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain, groupby

import msgspec

from ...base.errors import UsageError
from .. import TIME_LIMIT
from ..batch import Doing, how_far, whole_groups
from ..dataset import Row, partition_of, partitions_in, read_rows
from ..sites import FleetSite
from ..storage import absolute
from ..work import Outcome, Task, environment, lost
from . import store
from .check import lost_check
from .events import Event, Watched
from .rows import CheckRow, observed, row_of
from .site_pairs import watched_pairs
from .task import Check
from .watch import watch

FLUSH = 100
"""Sites whose rows are appended together: an interrupt loses no more than these."""


@dataclass(frozen=True, eq=False)
class SiteChange:
    """What the history says of one site.

    Attributes
    ----------
    times
        Of its checks that gave a step from the newest stored pose, in order: what the numbers in
        `watched` count.
    watched
        What was found in them.
    newest
        What came of its check in this run; of one that the history had, the last that had no error.
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
    def is_told(self) -> bool:
        """Whether the newest check gave a step at all."""
        return self.newest.is_usable

    def is_new(self, event: Event) -> bool:
        """Whether the newest check found it."""
        return self.is_told and event.found == len(self.times) - 1


@dataclass(frozen=True, eq=False)
class FleetCheck:
    """What a run did: how many checks were new to the history, and what it says of each site."""

    appended: int
    sites: tuple[SiteChange, ...]


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
) -> FleetCheck:
    """Check sites, append to their history, and tell what changed.

    Parameters
    ----------
    sites
        As `fleet.sites.find_sites` gives them; their order does not matter.
    history
        Path or URL of the history; made where there is none.
    doing
        What does the tasks: `engine.outcomes` with its client.
    answers
        Path or URL of a dataset of `batch.calibrate_fleet` that holds the stored results; None
        where each site names its own, or has it beside the target.
    tolerance
        Movement that matters, rad and m; None for as little as the data tell.
    time_limit
        Of one site, seconds.
    now
        When the run begins: the time of sites whose files cannot be read. None takes the clock.
    progress
        Is told how many of the sites are checked, and when the rest may be.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    UsageError
        Where `answers` is no dataset, or a site names another stored result.
    ReadError
        Where the history or the dataset is damaged.
    OSError
        Where the history cannot be written.
    """
    history = absolute(history)
    if answers is not None:
        answers = absolute(answers)
        _check_answers(answers, sites)
    tried = (now or datetime.now(UTC)).replace(microsecond=0)
    # So that each partition of the answers is read once.
    ordered = [
        pair
        for site in sorted(sites, key=lambda site: (partition_of(site.id), site.id))
        for pair in watched_pairs(site, answers)
    ]
    by_id = {pair.site.id: pair.site for pair in ordered}
    if len(by_id) < len(ordered):
        raise UsageError("a pair of a site is called as another site is: call that one otherwise")
    known = store.keys(history, by_id)
    blank = Check(tolerance=tolerance, tried=tried)
    faulty: list[Outcome] = []

    def tasks() -> Iterator[Task]:
        for part, of_part in groupby(ordered, lambda pair: partition_of(pair.origin)):
            stored = {} if answers is None else read_rows(answers, part)
            for pair in of_part:
                site, own = pair.site, stored.get(pair.origin)
                fault = site.fault or ("" if answers is None else _unanswered(own, pair.lidars))
                if fault:
                    faulty.append(lost(site, "usage", fault))
                    continue
                check = msgspec.structs.replace(
                    blank,
                    document=None if own is None else own.document,
                    lidars=pair.lidars,
                    known=sorted(known.get(site.id, ())),
                )
                yield Task(site=site, check=check, time_limit=time_limit, environment=environment())

    newest: dict[str, CheckRow] = {}

    def outcomes() -> Iterator[Outcome]:
        # Which are faulty is known as tasks are taken, and of the last after all outcomes.
        for outcome in chain(doing(tasks()), (None,)):
            if outcome is not None:
                yield outcome
            while faulty:
                yield faulty.pop()

    def found() -> Iterator[tuple[str, CheckRow | None]]:
        start = time.monotonic()
        for over, outcome in enumerate(outcomes(), 1):
            yield outcome.id, _row(outcome, by_id[outcome.id], blank)
            progress(how_far("check", over, len(ordered), time.monotonic() - start))

    def append(rows: Iterable[CheckRow | None]) -> int:
        new = [row for row in rows if row is not None]
        newest.update((row.id, row) for row in new)
        return store.append(history, new, set().union(*(known.get(row.id, ()) for row in new)))

    # Rows come in any order: those of the same sites are appended together, so that the files of
    # the history are the same whatever the workers.
    appended = 0
    waiting: dict[int, dict[str, CheckRow | None]] = {}
    chunk_of = {name: k // FLUSH for k, name in enumerate(by_id)}
    try:
        for _, rows in whole_groups(found(), chunk_of, waiting):
            appended += append(rows.values())
    finally:
        # Also what was checked before an interrupt.
        rest = chain.from_iterable(rows.values() for rows in waiting.values())
        append([*rest, *(_row(each, by_id[each.id], blank) for each in faulty)])
    progress("look at the history")
    changes = (changes_of(own, newest.get(name)) for name, own in store.read(history, by_id))
    return FleetCheck(appended, tuple(changes))


def changes_of(rows: Sequence[CheckRow], newest: CheckRow | None = None) -> SiteChange:
    """Tell what changed at one site, from all of its checks; `newest` is that of this run."""
    usable = observed(list(rows))
    newest = newest or max(rows, key=lambda row: (row.status != "error", row.time, row.key))
    return SiteChange(
        rows[0].id,
        [row.time for row, _ in usable],
        watch([one for _, one in usable]),
        newest,
    )


def _check_answers(answers: str, sites: Sequence[FleetSite]) -> None:
    """Find out now what would make an error of every site."""
    if not partitions_in(answers):
        raise UsageError(f"{answers}: is no dataset of 'retropole fleet calibrate'")
    named = next((site for site in sites if site.result), None)
    if named is not None:
        raise UsageError(
            f"site {named.id!r}: its list names a stored result, {named.result}, and so do the "
            "answers; take the column result out, or do without --answers"
        )


def _unanswered(stored: Row | None, lidars: tuple[str, str] | None) -> str:
    """Say why a pair has no stored result among the answers; empty where it has one."""
    if stored is None:
        return "the answers have no site of this id; calibrate it"
    if lidars is None and stored.kind == "site":
        return "the answers have a site of many LiDARs of this id: give a site file"
    if stored.document is None:
        return f"it was not calibrated: {', '.join(stored.codes)}"
    return ""


def _row(outcome: Outcome, site: FleetSite, check: Check) -> CheckRow | None:
    """Take the row of a check; None where the history has it."""
    if outcome.check is not None:
        return row_of(outcome.check)
    return None if outcome.row is None else lost_check(site, check, outcome.row)
