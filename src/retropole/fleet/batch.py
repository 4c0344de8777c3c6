"""Calibrate a fleet: sites in, a dataset out. Nothing that was done is done again."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from ..api import quantities
from . import TIME_LIMIT
from .dataset import Known, Row, known_in, partition_of, read_rows, read_runs, write_partition
from .sites import FleetSite
from .storage import absolute
from .work import Outcome, Task, environment, lost

Doing = Callable[[Iterator[Task]], Iterator[Outcome]]


@dataclass(frozen=True)
class FleetSummary:
    """What became of a fleet.

    Attributes
    ----------
    sites
        How many there are.
    done
        How many were calibrated now; of the others the rows that were there hold.
    others
        Rows of the dataset that are of no site of this fleet.
    statuses, codes
        How many sites ended so, and how many have each code.
    """

    sites: int
    done: int
    others: int
    statuses: dict[str, int]
    codes: dict[str, int]


def calibrate_fleet(
    sites: Sequence[FleetSite],
    out: str,
    doing: Doing,
    *,
    retry: bool = False,
    drop_others: bool = False,
    reports: str | None = None,
    time_limit: float = TIME_LIMIT,
    progress: Callable[[str], None] = lambda step: None,
) -> FleetSummary:
    """Calibrate every site, and write a row of each.

    Parameters
    ----------
    sites
        As `sites.find_sites` gives them; their order does not matter.
    out
        Path or URL of the dataset; one that is there goes on.
    doing
        What does the tasks: `engine.outcomes` with its client.
    retry
        Whether sites that ended in an error are tried again, though their inputs are the same.
    drop_others
        Whether rows of sites that are not of this fleet are removed.
    reports
        Path or URL of a folder for the result and the report of each site; None for none.
    time_limit
        Of one site, seconds.
    progress
        Called with how many of the sites are done, and when the rest may be.

    Raises
    ------
    ReadError
        Where the dataset is damaged.
    OSError
        Where it cannot be written.
    """
    out = absolute(out)
    reports = None if reports is None else absolute(reports)
    known = known_in(out)
    parts: dict[str, list[FleetSite]] = {}
    for site in sorted(sites, key=lambda site: site.id):
        parts.setdefault(partition_of(site.id), []).append(site)
    named = {site.id for site in sites}
    others = [each for each in known if each not in named]
    if drop_others:
        for each in others:
            parts.setdefault(partition_of(each), [])

    def tasks() -> Iterator[Task]:
        for part in sorted(parts):
            for site in parts[part]:
                if not site.fault:
                    yield _task(site, known.get(site.id), retry, reports, time_limit)

    part_of = {site.id: part for part, of_part in parts.items() for site in of_part}
    missing = {part: {site.id for site in of_part} for part, of_part in parts.items()}
    found: dict[str, dict[str, Outcome]] = {part: {} for part in parts}
    statuses: Counter[str] = Counter()
    codes: Counter[str] = Counter()

    def note(outcome: Outcome) -> None:
        part = part_of[outcome.id]
        found[part][outcome.id] = outcome
        missing[part].discard(outcome.id)

    def write_whole(part: str) -> None:
        if missing[part]:
            return
        rows = _write(out, part, found.pop(part), drop_others)
        statuses.update(rows[site.id].status for site in parts[part])
        codes.update(code for site in parts[part] for code in rows[site.id].codes)

    for site in sites:
        if site.fault:
            note(lost(site, "usage", site.fault))
    for part in sorted(parts):
        write_whole(part)
    done, over, start = 0, sum(bool(site.fault) for site in sites), time.monotonic()
    for outcome in doing(tasks()):
        note(outcome)
        write_whole(part_of[outcome.id])
        done, over = done + (outcome.row is not None), over + 1
        progress(how_far("calibrate", over, len(sites), time.monotonic() - start))
    return FleetSummary(len(sites), done, len(others), dict(statuses), dict(codes))


def _task(
    site: FleetSite, known: Known | None, retry: bool, reports: str | None, time_limit: float
) -> Task:
    """Say what a worker is to do; a site that is to be tried again has no row that holds."""
    holds = known is not None and not (retry and known.status == "error")
    return Task(
        site=site,
        known=known.key if known is not None and holds else None,
        reports=reports,
        time_limit=time_limit,
        environment=environment(),
    )


def _write(out: str, part: str, outcomes: dict[str, Outcome], drop_others: bool) -> dict[str, Row]:
    """Write a partition where it changes, and give its rows."""
    before, runs = read_rows(out, part), read_runs(out, part)
    kept = {each for each in before if each in outcomes or not drop_others}
    rows = {each: before[each] for each in kept}
    rows |= {each.id: each.row for each in outcomes.values() if each.row is not None}
    if rows != before:
        runs |= {each.id: each.run for each in outcomes.values() if each.run is not None}
        write_partition(out, part, rows.values(), (runs[each] for each in rows if each in runs))
    return rows


def how_far(step: str, done: int, count: int, seconds: float) -> str:
    """Say how far it is, and how long the rest takes if it goes on so."""
    left = seconds / done * (count - done)
    rest = f", about {quantities.duration(left)} left" if left else ""
    return f"{step}: {done} of {quantities.counted(count, 'site')}{rest}"
