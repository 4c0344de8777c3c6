"""One check of one site, as it is kept: a row of the history.

docs/history.md says what each column holds.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from ...api import Array
from ...base.errors import ReadError
from ...result.decoding import check_covariance
from .model import Observed

SCHEMA = "retropole/history/1"

LONGEST_ID = 200
"""Characters of the name of a site."""

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

UNSETTLED = ("several_minima", "stored_fits_as_well", "scene_denies_stored", "swapped")
"""Codes of checks whose step is not to be trusted, for more than its size."""


@dataclass(frozen=True, eq=False)
class CheckRow:
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
        (6, 6) of it.
    random
        (6, 6) of that the part that each check draws anew.
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
    step: Array | None = None
    covariance: Array | None = None
    random: Array | None = None
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
        failure = ("error", *self.codes) if self.status == "error" else ()
        words = "\n".join((self.id, self.time.astimezone(UTC).isoformat(), *hashes, *failure))
        return hashlib.sha256(words.encode()).hexdigest()

    @property
    def is_usable(self) -> bool:
        """Whether its step says where the site stands: a check too weak to say *same* does."""
        if self.step is None or self.status == "error" or set(self.codes) & set(UNSETTLED):
            return False
        return self.status != "cannot_tell" or "too_weak" in self.codes


def plain(row: CheckRow) -> dict[str, Any]:
    """Give a row as the columns of the table."""
    columns: dict[str, Any] = {"key": row.key}
    for each in fields(row):
        value = getattr(row, each.name)
        columns[each.name] = value.ravel().tolist() if isinstance(value, np.ndarray) else value
    columns["codes"] = list(row.codes)
    return columns


def row_of(columns: dict[str, Any]) -> CheckRow:
    """Read a row back; what is written by others need not be sound.

    Raises
    ------
    ReadError
        Where a step or covariance is none, or the row is not the one that its key names.
    """
    values = {name: columns[name] for name in CHECK_FIELDS}
    values["codes"] = tuple(values["codes"] or ())
    arrays = {"step": (6,), "covariance": (6, 6), "random": (6, 6)}
    there = [name for name in arrays if values[name] is not None]
    for name in there:
        values[name] = array = np.array(values[name], dtype=float).reshape(arrays[name])
        what = f"history, site {values['id']!r}, {name}"
        if name != "step":
            check_covariance(what, array, is_part=name == "random")
        elif not np.isfinite(array).all():
            raise ReadError(f"{what}: a number is not finite")
    if len(there) not in (0, 3):
        raise ReadError(f"history, site {values['id']!r}: a step without its covariances")
    row = CheckRow(**values)
    if row.key != columns["key"]:
        raise ReadError(f"history, site {row.id!r}, {row.time}: the row is not that of its key")
    return row


CHECK_FIELDS = tuple(each.name for each in fields(CheckRow))


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
    # What rounding leaves of a common part must stay a covariance.
    common = row.covariance - row.random
    values, vectors = np.linalg.eigh((common + common.T) / 2.0)
    common = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return Observed(days, row.step, row.random, common, row.used != first)
