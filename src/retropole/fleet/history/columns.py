"""The checks of many sites as columns: what they say is taken from Arrow's arrays as it is there.

What is plainly sound is not looked at row by row; any other row is read as `store.row_of` does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import groupby
from typing import Any

import numpy as np

from ...api import Array, BoolArray
from ...base.errors import ReadError, said
from .model import Observed
from .store import EPOCH, MOST_STEP, STATUSES, CheckRow, is_usable, key_of, row_of

PLACE = "place"
"""Column of the file that a row was read of; no file has it."""

ROUNDED = 1e-12
"""Share of its largest number by which a symmetric matrix may be uneven."""

SURELY = 1e-9
"""Least pivot of correlations from which a matrix is positive, whatever was rounded."""


@dataclass(frozen=True, eq=False)
class History:
    """What the history has of one site.

    Attributes
    ----------
    newest
        The last of its checks that was no error, or the last.
    times
        Of those that gave a step from the newest stored pose, in order.
    checks
        These, their number in front; None where there is none.
    """

    id: str
    newest: CheckRow
    times: tuple[datetime, ...]
    checks: Observed | None


@dataclass(frozen=True, eq=False)
class _Columns:
    """Rows as arrays and lists of n."""

    rows: Any
    ids: list[str]
    keys: list[str]
    times: list[datetime]
    statuses: list[str]
    codes: list[tuple[str, ...]]
    used: list[str | None]
    stored: list[str]
    has_step: BoolArray
    step: Array
    covariance: Array
    random: Array


def histories(table: Any, tell: Callable[[ReadError], None]) -> Iterator[History]:
    """Give what `reading.tables` read of each site, in the order of ids; what is no row is told."""
    columns, is_sound = _columns(table)
    for k in np.flatnonzero(~is_sound).tolist():
        fault = _fault(table, k)
        if fault is None:
            is_sound[k] = True
        else:
            tell(fault)
    ids, times, keys = columns.ids, columns.times, columns.keys
    order = sorted(np.flatnonzero(is_sound).tolist(), key=lambda k: (ids[k], times[k], keys[k]))
    for _, own in groupby(order, lambda k: ids[k]):
        # The same check may be there twice.
        yield _history(columns, [*{keys[k]: k for k in own}.values()])


def _fault(table: Any, k: int) -> ReadError | None:
    """Tell why a row is none; None if it is one."""
    try:
        ((columns),) = table.slice(k, 1).to_pylist()
        place = columns.pop(PLACE)
    # A time beyond the calendar.
    except (ValueError, OverflowError) as error:
        place = table[PLACE][k].as_py()
        return ReadError(f"{place}: history, site {table['id'][k].as_py()!r}: {said(error)}")
    try:
        row_of(columns)
    except ReadError as error:
        return ReadError(f"{place}: {error}")
    return None


def _columns(table: Any) -> tuple[_Columns, BoolArray]:
    """Take the columns out; gives too which rows are plainly sound."""
    count = len(table)
    whole = ("key", "id", "time", "status", "stored_sha256", "target_sha256", "source_sha256")
    is_sound = np.ones(count, dtype=bool)
    for name in (*whole, "version"):
        is_sound &= _there(table[name])
    text = {name: table[name].to_pylist() for name in (*whole, "used") if name != "time"}
    micros = table["time"].cast("int64").to_numpy().tolist()
    is_sound &= np.array([status in STATUSES for status in text["status"]], dtype=bool)
    codes, whole_codes = _codes(table["codes"])
    has_step = _there(table["step"])
    step, steps = _numbers(table["step"], 6)
    arrays = [step]
    is_sound &= whole_codes & steps & (np.abs(step).max(axis=1, initial=0.0) < MOST_STEP)
    for name in ("covariance", "random"):
        values, there = _numbers(table[name], 36)
        C = values.reshape(-1, 6, 6)
        is_sound &= there & (_there(table[name]) == has_step)
        uneven = np.abs(C - C.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0)
        is_even = uneven <= ROUNDED * np.abs(C).max(axis=(1, 2), initial=0.0)
        is_sound &= ~has_step | (is_positive(C) & is_even)
        arrays.append(C)
    times = []
    for k, since in enumerate(micros):
        try:
            times.append(EPOCH + timedelta(microseconds=since or 0))
        except OverflowError:
            is_sound[k] = False
            times.append(EPOCH)
    hashes = zip(text["stored_sha256"], text["target_sha256"], text["source_sha256"], strict=True)
    rows = zip(text["id"], times, hashes, text["status"], codes, strict=True)
    for k, (name, time, files, status, own) in enumerate(rows):
        if is_sound[k] and key_of(name, time, files, status, own) != text["key"][k]:
            is_sound[k] = False
    columns = _Columns(
        table,
        text["id"],
        text["key"],
        times,
        text["status"],
        codes,
        text["used"],
        text["stored_sha256"],
        has_step,
        *arrays,
    )
    return columns, is_sound


def _there(column: Any) -> BoolArray:
    return np.asarray(column.is_valid().to_numpy(zero_copy_only=False), dtype=bool)


def _codes(column: Any) -> tuple[list[tuple[str, ...]], BoolArray]:
    """Give the codes of each row, and whether they are text; most rows have none."""
    codes: list[tuple[str, ...]] = [()] * len(column)
    is_sound = np.ones(len(column), dtype=bool)
    lengths = np.asarray(column.combine_chunks().value_lengths().fill_null(0))
    some = np.flatnonzero(lengths)
    for k, own in zip(some.tolist(), column.take(some).to_pylist(), strict=True):
        codes[k] = tuple(own)
        is_sound[k] = None not in own
    return codes, is_sound


def _numbers(column: Any, count: int) -> tuple[Array, BoolArray]:
    """(n, count) lists of so many numbers, zero where there is none; and whether each is one."""
    lengths = np.asarray(column.combine_chunks().value_lengths().fill_null(-1))
    found = np.zeros((len(column), count))
    rows = np.flatnonzero(lengths == count)
    own = column if len(rows) == len(column) else column.take(rows)
    found[rows] = own.combine_chunks().flatten().to_numpy(zero_copy_only=False).reshape(-1, count)
    return found, np.isin(lengths, (-1, count)) & np.isfinite(found).all(axis=1)


def is_positive(C: Array) -> BoolArray:
    """Whether symmetric matrices (n, 6, 6) are surely positive definite."""
    variances = np.einsum("nii->ni", C)
    is_one = (variances > 0.0).all(axis=1) & np.isfinite(variances).all(axis=1)
    scale = np.sqrt(np.where(is_one[:, None], variances, 1.0))
    A = np.ascontiguousarray((C / (scale[:, :, None] * scale[:, None])).transpose(1, 2, 0))
    for k in range(6):
        is_one &= A[k, k] > SURELY
        pivot = np.where(is_one, A[k, k], 1.0)
        A[k + 1 :, k + 1 :] -= (A[k, k + 1 :] / pivot)[:, None] * A[k, k + 1 :]
    return np.asarray(is_one)


def common_of(covariance: Array, random: Array) -> Array:
    """(n, 6, 6) what checks share of their covariances: what rounding leaves must stay one."""
    common = covariance - random
    common = (common + common.swapaxes(1, 2)) / 2.0
    rest = ~is_positive(common)
    values, vectors = np.linalg.eigh(common[rest])
    common[rest] = (vectors * np.maximum(values, 0.0)[:, None]) @ vectors.swapaxes(1, 2)
    return np.asarray(common)


def _history(columns: _Columns, rows: Sequence[int]) -> History:
    """Put together what the rows of one site say, which are in the order of time."""
    times, keys, statuses = columns.times, columns.keys, columns.statuses
    last = max(rows, key=lambda k: (statuses[k] != "error", times[k], keys[k]))
    (newest,) = columns.rows.slice(last, 1).drop_columns([PLACE]).to_pylist()
    stored = [columns.stored[k] for k in rows if columns.stored[k]][-1:]
    usable = [
        k
        for k in rows
        if is_usable(bool(columns.has_step[k]), columns.statuses[k], columns.codes[k])
        and (not stored or columns.stored[k] == stored[0])
    ]
    own = tuple(times[k] for k in usable)
    checks = None
    if usable:
        days = np.array([(time - EPOCH) / timedelta(days=1) for time in own])
        other = [columns.used[k] != columns.used[usable[0]] for k in usable]
        moved = [columns.statuses[k] == "moved" for k in usable]
        random = columns.random[usable]
        common = common_of(columns.covariance[usable], random)
        step = columns.step[usable]
        checks = Observed(days, step, random, common, np.array(other), np.array(moved))
    return History(columns.ids[last], row_of(newest), own, checks)
