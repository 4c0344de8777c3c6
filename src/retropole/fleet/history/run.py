"""All sites checked once, their history appended to, and what changed at each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from ...monitoring.tolerance import DEFAULT_TOLERANCE, Tolerance
from . import store
from .check import WatchedSite, check_site
from .events import Event, Watched
from .rows import CheckRow, observed
from .watch import watch

FLUSH = 100
"""Rows after which they are appended: an interrupt loses no more than these."""


@dataclass(frozen=True, eq=False)
class SiteChange:
    """What the history says of one site.

    Attributes
    ----------
    rows
        Its checks that gave a step from the newest stored pose, in the order of time: what the
        numbers in `watched` count.
    watched
        What was found in them.
    newest
        Its newest check, whatever came of it.
    """

    id: str
    rows: Sequence[CheckRow]
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
        return self.is_told and event.found == len(self.rows) - 1


@dataclass(frozen=True, eq=False)
class FleetCheck:
    """What a run did: how many checks were new to the history, and what it says of each site."""

    appended: int
    sites: tuple[SiteChange, ...]


def check_fleet(
    sites: Sequence[WatchedSite],
    history: Path,
    *,
    tolerance: Tolerance = DEFAULT_TOLERANCE,
    processes: int = 1,
    progress: Callable[[str], None] = lambda step: None,
) -> FleetCheck:
    """Check sites, append to their history, and tell what changed.

    Parameters
    ----------
    sites
        From `check.find_sites`.
    history
        Folder of the history; made where there is none.
    tolerance
        Of the check of each.
    processes
        How many sites are checked at a time; more than one are spawned.
    progress
        Is told which of how many is under way.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    ReadError
        Where the history is damaged.
    OSError
        Where it cannot be written.
    """
    store.arrow()
    appended, waiting = 0, list[CheckRow]()
    with _mapping(processes) as mapped:
        try:
            job = partial(check_site, tolerance=tolerance, history=history)
            for done, row in enumerate(mapped(job, sites), start=1):
                progress(f"check, {done} of {len(sites)}")
                if row is not None:
                    waiting.append(row)
                if len(waiting) >= FLUSH:
                    appended, waiting = appended + store.append(history, waiting), []
        finally:
            # Also what was checked before an interrupt.
            appended += store.append(history, waiting)
        progress("history")
        rows = store.read(history, {site.id for site in sites})
        there = [rows[site.id] for site in sites if site.id in rows]
        return FleetCheck(appended, tuple(mapped(changes_of, there)))


def changes_of(rows: Sequence[CheckRow]) -> SiteChange:
    """Tell what changed at one site, from all of its checks."""
    usable = observed(list(rows))
    return SiteChange(
        rows[0].id,
        [row for row, _ in usable],
        watch([one for _, one in usable]),
        max(rows, key=lambda row: (row.time, row.key)),
    )


@contextmanager
def _mapping(processes: int) -> Iterator[Callable[..., Iterable[Any]]]:
    if processes == 1:
        yield map
        return
    # small_gicp hangs after a fork.
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        try:
            yield pool.map
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
