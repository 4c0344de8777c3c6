"""The outcome of a fleet, taken from its dataset: little of each site, so that thousands fit."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import msgspec

from ..base.errors import ReadError, said, shortened
from .dataset import (
    ANSWERS,
    RUNS,
    Latitude,
    Length,
    Longitude,
    Row,
    Seconds,
    Status,
    partition_of,
    partitions_in,
    read_as,
    read_rows,
)
from .history.run import SiteChange, replay
from .sites import Kind
from .storage import absolute, below, exists

HISTORY = "history"
"""Folder of a dataset where the history of its checks may be."""

STATUSES: tuple[Status, ...] = ("ok", "warn", "refused", "error")
"""From the best to the worst."""


class Seen(msgspec.Struct, frozen=True):
    """What is taken of each row; the fields are columns of the dataset."""

    id: str
    kind: Kind
    status: Status
    codes: tuple[str, ...]
    messages: tuple[str, ...]
    latitude_rad: Latitude | None
    longitude_rad: Longitude | None
    sigma_30m_m: Length | None
    version: str
    libraries: str


class _Took(msgspec.Struct, frozen=True):
    """What is taken of each run."""

    started: datetime
    seconds: Seconds
    host: str


@dataclass(frozen=True, eq=False)
class Changed:
    """A site that changed since it was calibrated.

    Attributes
    ----------
    site
        Of the dataset; of many LiDARs, `change` is of a pair of LiDARs.
    change
        The history.
    is_current
        Whether it was checked against the answer that is in the dataset.
    """

    site: Seen
    change: SiteChange
    is_current: bool


@dataclass(frozen=True)
class Overview:
    """The outcome of a fleet.

    Attributes
    ----------
    place
        Path or URL of the dataset.
    sites
        Every site, in the order of the ids; messages only of those without an answer.
    made_by
        How many rows each version, with the libraries that compute, has made.
    seconds
        How long each site took, in no order.
    first, last
        When the first site was begun, and the last done, UTC; None without runs.
    hosts
        How many sites were done on each machine.
    changed
        What changed since it was calibrated; empty without a history.
    damaged
        What of the history was left out.
    """

    place: str
    sites: tuple[Seen, ...]
    made_by: Mapping[str, int]
    seconds: Sequence[float]
    first: datetime | None
    last: datetime | None
    hosts: Mapping[str, int]
    changed: tuple[Changed, ...] = ()
    damaged: tuple[str, ...] = ()

    @property
    def statuses(self) -> dict[Status, int]:
        """How many sites ended so, from the best to the worst; those that none did are left out."""
        counts = Counter(site.status for site in self.sites)
        return {status: counts[status] for status in STATUSES if counts[status]}

    @property
    def errors_at_range(self) -> list[float]:
        """Predicted errors at 30 m, 1 σ, metres, from the least on; of sites with an answer."""
        found = (site.sigma_30m_m for site in self.sites)
        return sorted(each for each in found if each is not None and math.isfinite(each))

    def worst(self, count: int) -> list[Seen]:
        """Give the sites with the largest predicted errors, the largest first."""
        stated = [site for site in self.sites if site.sigma_30m_m is not None]
        return sorted(stated, key=lambda site: (-(site.sigma_30m_m or 0.0), site.id))[:count]


def overview_of(out: str, history: str | None = None) -> Overview:
    """Read the outcome of a fleet, one partition after the other.

    Parameters
    ----------
    out
        Path or URL of the dataset.
    history
        Path or URL of the history of its checks; None for ``history`` in the dataset, where there
        is one.

    Raises
    ------
    ReadError
        If there is none, or a partition is damaged.
    """
    out = absolute(out)
    if not (partitions := partitions_in(out)):
        raise ReadError(f"{out}: is not a dataset of a fleet: it has no {ANSWERS}/part-….parquet")
    sites: list[Seen] = []
    made_by: Counter[str] = Counter()
    for name in partitions:
        rows = read_as(out, ANSWERS, name, Seen)
        sites += map(_slim, rows.values())
        made_by.update(f"retropole {row.version}: {row.libraries}" for row in rows.values())
    runs = [
        run for name in partitions_in(out, RUNS) for run in read_as(out, RUNS, name, _Took).values()
    ]
    try:
        starts = [run.started.astimezone(UTC) for run in runs]
        ends = [start + timedelta(0, run.seconds) for start, run in zip(starts, runs, strict=True)]
    except OverflowError as error:
        raise ReadError(f"{out}/{RUNS}: there is no such time ({said(error)})") from None
    changed, damaged = _changed(out, sites, history)
    return Overview(
        place=out,
        sites=tuple(sorted(sites, key=lambda site: site.id)),
        made_by=made_by,
        seconds=[run.seconds for run in runs],
        first=min(starts, default=None),
        last=max(ends, default=None),
        hosts=Counter(run.host for run in runs),
        changed=changed,
        damaged=damaged,
    )


def _changed(
    out: str, sites: Iterable[Seen], history: str | None
) -> tuple[tuple[Changed, ...], tuple[str, ...]]:
    """Report sites that changed since they were calibrated, and damaged parts of the history."""
    place = below(out, HISTORY) if history is None else absolute(history)
    if not exists(place, as_folder=True):
        if history is not None:
            raise ReadError(f"{place}: is not a history of 'retropole fleet check'")
        return (), ()
    by_id = {site.id: site for site in sites}
    changes, damaged = replay(place)
    changed = []
    for change in changes:
        # Of many LiDARs, a pair is called by the site and both its LiDARs.
        parts = change.id.split("/")
        names = ("/".join(parts[:k]) for k in range(len(parts), 0, -1))
        site = next((by_id[name] for name in names if name in by_id), None)
        if site is not None and change.changes:
            changed.append((site, change))
    answers: dict[str, Row] = {}
    for part in {partition_of(site.id) for site, _ in changed}:
        answers |= read_rows(out, part)
    return (
        tuple(
            Changed(site, change, change.newest.stored_sha256 == _sha256(answers[site.id]))
            for site, change in changed
        ),
        tuple(dict.fromkeys(map(str, damaged))),
    )


def _sha256(answer: Row) -> str:
    """Hash a stored result, as a check that takes it from the dataset does."""
    return hashlib.sha256((answer.document or "").encode()).hexdigest()


def _slim(row: Seen) -> Seen:
    """Leave out what no part of the page shows, thousands of times."""
    messages = tuple(map(shortened, row.messages)) if row.status in ("refused", "error") else ()
    return msgspec.structs.replace(row, messages=messages, version="", libraries="")
