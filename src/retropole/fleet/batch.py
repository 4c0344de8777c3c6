"""Calibrate a fleet: sites in, a dataset out. Nothing that was done is done again."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import chain
from typing import TypeVar

from ..api import quantities
from . import TIME_LIMIT
from .dataset import Row, known_answers, partition_of, read_rows, read_runs, write_partition
from .sites import FleetSite
from .storage import absolute, alone_in, is_url
from .work import Outcome, Task, task_of, unanswered

Key = TypeVar("Key")
Of = TypeVar("Of")
Doing = Callable[[Iterator[Task]], Iterator[Outcome]]


@dataclass(frozen=True)
class FleetSummary:
    """The outcome of a fleet.

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
        If the dataset is damaged.
    OSError
        If it cannot be written, or another run is writing to it.
    """
    out = absolute(out)
    reports = None if reports is None else absolute(reports)
    # At a URL, the dataset's is enough to remove by hand where a run was killed.
    own_reports = reports is not None and reports != out and not is_url(reports)
    with alone_in(out), alone_in(reports) if own_reports and reports else nullcontext():
        known = known_answers(out)
        others = known.keys() - {site.id for site in sites}
        parts: dict[str, list[FleetSite]] = {
            partition_of(each): [] for each in others if drop_others
        }
        for site in sorted(sites, key=lambda site: site.id):
            parts.setdefault(partition_of(site.id), []).append(site)

        # One that is to be tried again has no valid row.
        holds = {each: row.key for each, row in known.items() if not retry or row.status != "error"}
        tasks = (
            task_of(site, time_limit, known=holds.get(site.id), reports=reports)
            for part in sorted(parts)
            for site in parts[part]
            if not site.fault
        )
        done = 0
        statuses: Counter[str] = Counter()
        codes: Counter[str] = Counter()
        empty = {part: dict[str, Outcome]() for part, of_part in parts.items() if not of_part}
        part_of = {site.id: part for part, of_part in parts.items() for site in of_part}
        found = outcomes_of("calibrate", sites, doing(tasks), progress)
        for part, outcomes in chain(empty.items(), whole_groups(found, part_of, {})):
            rows = _write(out, part, outcomes, drop_others)
            statuses.update(rows[site.id].status for site in parts[part])
            codes.update(code for site in parts[part] for code in rows[site.id].codes)
            done += sum(each.row is not None for each in outcomes.values())
        done -= sum(bool(site.fault) for site in sites)
    return FleetSummary(len(sites), done, len(others), dict(statuses), dict(codes))


def outcomes_of(
    step: str,
    sites: Collection[FleetSite],
    done: Iterable[Outcome],
    progress: Callable[[str], None],
) -> Iterator[tuple[str, Outcome]]:
    """Give the outcome of each site by its id: of what is wrong in itself, then as they are done.

    Parameters
    ----------
    step
        What is done, in a word.
    sites
        All sites.
    done
        Outcomes of those without a fault.
    progress
        Called with how many of the sites are done, and when the rest may be.
    """
    faulty = [site for site in sites if site.fault]
    yield from ((site.id, unanswered(site, "usage", site.fault)) for site in faulty)
    start = time.monotonic()
    for over, outcome in enumerate(done, len(faulty) + 1):
        yield outcome.id, outcome
        progress(how_far(step, over, len(sites), time.monotonic() - start))


def whole_groups(
    found: Iterable[tuple[str, Of]], group_of: Mapping[str, Key], waiting: dict[Key, dict[str, Of]]
) -> Iterator[tuple[Key, dict[str, Of]]]:
    """Give each group once the last that belongs to it is found.

    Parameters
    ----------
    found
        By names, in any order.
    group_of
        Of every name.
    waiting
        Takes what was found of groups that are not whole yet.
    """
    missing = Counter(group_of.values())
    for name, each in found:
        group = group_of[name]
        waiting.setdefault(group, {})[name] = each
        missing[group] -= 1
        if not missing[group]:
            yield group, waiting.pop(group)


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
    """Report the progress, in sites or their pairs, and the estimated time for the rest."""
    left = seconds / done * (count - done)
    rest = f", about {quantities.duration(left)} left" if left else ""
    return f"{step}: {done:,} of {count:,}{rest}"
