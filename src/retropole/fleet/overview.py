"""The outcome of a fleet, taken from its dataset: little of each site, so that thousands fit."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import msgspec

from ..base.errors import ReadError, shortened
from .dataset import (
    ANSWERS,
    RUNS,
    Latitude,
    Length,
    Longitude,
    Seconds,
    Status,
    partitions_in,
    read_as,
)
from .sites import Kind
from .storage import absolute

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
    """

    place: str
    sites: tuple[Seen, ...]
    made_by: Mapping[str, int]
    seconds: Sequence[float]
    first: datetime | None
    last: datetime | None
    hosts: Mapping[str, int]

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


def overview_of(out: str) -> Overview:
    """Read the outcome of a fleet, one partition after the other.

    Parameters
    ----------
    out
        Path or URL of the dataset.

    Raises
    ------
    ReadError
        Where there is none, or a partition is damaged.
    """
    out = absolute(out)
    if not (partitions := partitions_in(out)):
        raise ReadError(f"{out}: is no dataset of a fleet: it has no {ANSWERS}/part-….parquet")
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
        raise ReadError(f"{out}/{RUNS}: there is no such time ({error})") from None
    return Overview(
        place=out,
        sites=tuple(sorted(sites, key=lambda site: site.id)),
        made_by=made_by,
        seconds=[run.seconds for run in runs],
        first=min(starts, default=None),
        last=max(ends, default=None),
        hosts=Counter(run.host for run in runs),
    )


def _slim(row: Seen) -> Seen:
    """Leave out what no part of the page shows, thousands of times."""
    messages = tuple(map(shortened, row.messages)) if row.status in ("refused", "error") else ()
    return msgspec.structs.replace(row, messages=messages, version="", libraries="")
