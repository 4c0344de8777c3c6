"""The history of all sites as Parquet files: one folder for each month, appended to, never changed.

``HISTORY/month=2026-11/<hash>.parquet``: each append writes one file for each month in which it has
new rows, named by the keys of its rows and written whole or not at all. Nothing is ever rewritten.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Container, Iterable
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from ...base.errors import ReadError, said
from ...result.decoding import check_covariance
from ..storage import below, replace_bytes
from ..tables import arrow, parquet_of
from .model import Observed

SCHEMA = "retropole/history/1"

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

STATUSES = ("same", "moved", "cannot_tell", "error")

UNSETTLED = ("several_minima", "stored_fits_as_well", "scene_denies_stored", "swapped")
"""Codes of checks whose step is not to be trusted, for more than its size."""


MOST_STEP = 1e6
"""Steps of a pose are below this, rad and m: squares of larger ones leave what a number holds."""

Step = Annotated[list[float], Meta(min_length=6, max_length=6)]
Covariance = Annotated[list[float], Meta(min_length=36, max_length=36)]


class CheckRow(msgspec.Struct, frozen=True):
    """A check of a site at a time.

    Attributes
    ----------
    id
        Name of the site.
    time
        When it was recorded, UTC.
    status
        ``same``, ``moved`` or ``cannot_tell``, as of ``retropole check``; ``error`` where a file
        could not be read.
    used
        What the pose was found by: ``poles``, ``scene``; None where there is none.
    codes
        Reason codes.
    message
        What went wrong, in words; None where nothing did.
    step
        (6,) ``[φ, δ]`` from the stored pose, rad and m, target axes; None where there is none.
    covariance
        6 × 6 of it, row by row.
    random
        6 × 6 of that the part that each check draws anew.
    chi2, power
        As of ``retropole check``.
    stored_sha256, target_sha256, source_sha256
        Hashes of the stored result and of the recordings; empty where they could not be read.
    version
        Of this program.
    """

    id: str
    time: datetime
    status: str
    used: str | None = None
    codes: tuple[str, ...] = ()
    message: str | None = None
    step: Step | None = None
    covariance: Covariance | None = None
    random: Covariance | None = None
    chi2: float | None = None
    power: float | None = None
    stored_sha256: str = ""
    target_sha256: str = ""
    source_sha256: str = ""
    version: str = ""

    @property
    def key(self) -> str:
        """What makes it this check: the same site, time, stored result and recordings.

        A check that ended in an error does not stand for one that succeeds.
        """
        hashes = self.stored_sha256, self.target_sha256, self.source_sha256
        return key_of(self.id, self.time.astimezone(UTC), hashes, self.status, self.codes)

    @property
    def is_usable(self) -> bool:
        """Whether its step says where the site stands: a check too weak to say *same* does."""
        return is_usable(self.step is not None, self.status, self.codes)


def key_of(
    name: str, time: datetime, hashes: Iterable[str], status: str, codes: Iterable[str]
) -> str:
    """Give the key of a check, of the columns that make it this one; the time is UTC."""
    failure = ("error", *codes) if status == "error" else ()
    words = "\n".join((name, time.isoformat(), *hashes, *failure))
    return hashlib.sha256(words.encode()).hexdigest()


def is_usable(has_step: bool, status: str, codes: Collection[str]) -> bool:
    """Whether a check says where its site stands."""
    if not has_step or status == "error" or (codes and not set(codes).isdisjoint(UNSETTLED)):
        return False
    return status != "cannot_tell" or "too_weak" in codes


def flat(value: Any) -> Any:
    """Give an array as a row has it; all else as it is."""
    return value.ravel().tolist() if isinstance(value, np.ndarray) else value


def columns_of(row: CheckRow) -> dict[str, Any]:
    """Give a row as the columns of the table."""
    return {"key": row.key, **msgspec.structs.asdict(row)}


def row_of(columns: dict[str, Any]) -> CheckRow:
    """Read a row back; what is written by others need not be sound.

    Raises
    ------
    ReadError
        Where a status, step or covariance is none, or the row is not the one that its key names.
    """
    site = f"history, site {columns['id']!r}"
    try:
        row = msgspec.convert({**columns, "codes": columns["codes"] or ()}, CheckRow)
        if row.status not in STATUSES:
            raise ReadError(f"{site}: {row.status!r} is no status")
        if row.step is not None and not np.abs(row.step).max() < MOST_STEP:
            raise ReadError(f"{site}, step: no number below {MOST_STEP:g}")
        for name, given in (("covariance", row.covariance), ("random", row.random)):
            if (given is None) != (row.step is None):
                raise ReadError(f"{site}: a step without its covariances")
            if given is not None:
                C = np.reshape(given, (6, 6))
                check_covariance(f"{site}, {name}", C, is_part=name == "random")
    except msgspec.ValidationError as error:
        raise ReadError(f"{site}: {said(error)}") from None
    if row.key != columns["key"]:
        raise ReadError(f"{site}, {row.time}: the row is not that of its key")
    return row


def observed(rows: list[CheckRow]) -> list[tuple[CheckRow, Observed]]:
    """Give what the checks of one site say of its newest stored pose, in the order of time.

    A site that was calibrated anew begins anew: steps from an older pose are left out.
    """
    ordered = sorted(rows, key=lambda row: (row.time, row.key))
    usable = [row for row in ordered if row.is_usable]
    if not usable:
        return []
    newest = [row.stored_sha256 for row in ordered if row.stored_sha256][-1:]
    usable = [row for row in usable if not newest or row.stored_sha256 == newest[0]]
    return [(row, _observed(row, usable[0].used)) for row in usable]


def _observed(row: CheckRow, first: str | None) -> Observed:
    assert row.step is not None
    assert row.covariance is not None
    assert row.random is not None
    days = (row.time - EPOCH) / timedelta(days=1)
    covariance, random = np.reshape([row.covariance, row.random], (2, 6, 6))
    # What rounding leaves of a common part must stay a covariance.
    common = covariance - random
    values, vectors = np.linalg.eigh((common + common.T) / 2.0)
    common = (vectors * np.maximum(values, 0.0)) @ vectors.T
    step, moved = np.array(row.step), row.status == "moved"
    return Observed(days, step, random, common, row.used != first, moved)


def append(folder: str, rows: Iterable[CheckRow], known: Container[str] = ()) -> int:
    """Append checks to a history; those that it has are left out.

    Parameters
    ----------
    folder
        Path or URL of the history.
    rows
        Their order does not matter: the same rows give the same bytes.
    known
        Keys of the checks that the history has of these sites.

    Returns
    -------
    int
        How many were new.

    Raises
    ------
    MissingExtraError
        Without the extra ``fleet``.
    OSError
        Where a file cannot be written; each month is whole or not there.
    """
    months: dict[str, dict[str, CheckRow]] = {}
    for row in rows:
        if row.key not in known:
            months.setdefault(f"month={row.time:%Y-%m}", {})[row.key] = row
    for month, fresh in sorted(months.items()):
        name = hashlib.sha256("\n".join(sorted(fresh)).encode()).hexdigest()[:32]
        place = below(folder, month, f"{name}.parquet")
        replace_bytes(
            place, parquet_of((columns_of(fresh[key]) for key in sorted(fresh)), schema())
        )
    return sum(map(len, months.values()))


def schema() -> Any:
    """Give the schema of the files."""
    pa = arrow()
    text, real, numbers = pa.string(), pa.float64(), pa.list_(pa.float64())
    always = {"key": text, "id": text, "time": pa.timestamp("us", tz="UTC"), "status": text}
    others = {"used": text, "codes": pa.list_(text), "message": text, "step": numbers}
    others |= {"covariance": numbers, "random": numbers, "chi2": real, "power": real}
    hashes = ("stored_sha256", "target_sha256", "source_sha256")
    others |= dict.fromkeys((*hashes, "version"), text)
    columns = [pa.field(name, kind, nullable=False) for name, kind in always.items()]
    return pa.schema([*columns, *others.items()], metadata={"schema": SCHEMA})
