"""Compare a table of a page with what fresh runs of its command print.

Each fresh run prints the table for one draw (one seed): a count is then 0 or 1, and a median or a
quantile is the value of that draw. So nothing but the printed tables is needed, and no law of
errors is assumed:

- a count of n, or a share of n runs: Fisher's exact test against the count of the fresh runs;
- a median, a 95 % quantile, the largest or the least of n values: how many fresh values lie below
  it is beta-binomial, whatever the values' distribution;
- a table without seeds: the same digits;
- a time, where it is asked for: within a factor of three.

What is none of these (a mean, a range, words) is not compared.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import NamedTuple

from scipy.stats import betabinom, fisher_exact

OF = re.compile(r"(\d+)(?: of |/)(\d+)\b")
SHARE = re.compile(r"(\d+(?:\.\d+)?) ?%(?! of \d)")
"""That of several things of one run is no count of runs: they hang together."""
FIGURE = re.compile(r"\d+(?:\.\d+)?")
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?: [a-zµ°]+)?$|inf$")
CODES = re.compile(r"([A-Za-z_][^,]*) (\d+)(?:, |$)")
RUNS = re.compile(
    r"(?:.*: )?(?:runs|draws|scenes|pairs|recordings|clouds|sites|tested|answers|"
    r"poles (?:to be )?seen)$"
)
"""A column that says how many runs a row has."""

TIME = re.compile(r"CPU|wall|peak|\bseconds\b|time|killed")
"""A column of what depends on the machine."""

UNCOMPARED = re.compile(
    r"mean|ratio|share of|score|predicted|, %|σ of a check|memory|answers with it"
)
"""Columns of what is neither count nor quantile."""

FACTOR = 3.0
"""A time that differs by more is named."""

QUANTILES = {
    "median": 0.5,
    "90 %": 0.9,
    "95 %": 0.95,
    "99 %": 0.99,
    "largest": 1.0,
    "most": 1.0,
    "least": 0.0,
}
"""What the head of a column calls a quantile; the first that it has counts."""


class Table(NamedTuple):
    """A Markdown table: the names of its columns, and the cells of its rows."""

    head: tuple[str, ...]
    rows: list[tuple[str, ...]]


@dataclass(frozen=True)
class Cell:
    """A cell that was compared; the probability is that of a difference as large by chance.

    It is impossible where the same runs cannot have been counted so, as one wrong of five where a
    page says none of 500: some run ends otherwise today, which chance may explain all the same.
    """

    row: str
    column: str
    said: str
    measured: str
    probability: float
    impossible: bool = False


def tables(text: str, kept: bool = False) -> list[Table]:
    """Find the Markdown tables in a text, with the emphasis of their cells or without."""
    blocks = re.findall(r"(?:^\|.*\n?)+", text, flags=re.MULTILINE)
    found = []
    for block in blocks:
        head, _, *rows = [cells(line, kept) for line in block.splitlines()] + [()]
        # A row may be printed short where nothing was answered.
        filled = [(row + ("",) * len(head))[: len(head)] for row in rows if row]
        found.append(Table(head, filled))
    return found


def cells(line: str, kept: bool) -> tuple[str, ...]:
    """Split a row of a table, and leave out emphasis if it is not kept."""
    plain = line if kept else re.sub(r"\*\*|`", "", line)
    return tuple(cell.strip() for cell in plain.strip().strip("|").split("|"))


def places(head: Sequence[str], printed: Sequence[str]) -> list[int] | None:
    """Where the columns of a page stand in a printed table, in order; None if not all do."""
    found, start = [], 0
    for name in head:
        if name not in printed[start:]:
            return None
        found.append(printed.index(name, start))
        start = found[-1] + 1
    return found


def keys(table: Table) -> dict[tuple[str, ...], tuple[str, ...]]:
    """Name each row by as many of its first cells as tell all rows apart."""
    for count in range(1, len(table.head) + 1):
        named = {row[:count]: row for row in table.rows}
        if len(named) == len(table.rows):
            break
    return named


def fresh_cells(
    said: Table, text: str, kept: bool = False
) -> dict[tuple[str, ...], tuple[str, ...]] | None:
    """Rows of a printed table, by the keys and with the columns of a page; None if not printed."""
    count = len(next(iter(keys(said))))
    for plain, shown in zip(tables(text), tables(text, kept), strict=True):
        at = places(said.head, plain.head)
        if at is not None:
            rows = zip(plain.rows, shown.rows, strict=True)
            return {tuple(a[i] for i in at[:count]): tuple(b[i] for i in at) for a, b in rows}
    return None


def compare(
    said: Table,
    texts: Sequence[str],
    runs: int,
    *,
    is_shared: bool = False,
    times: bool = False,
) -> list[Cell] | None:
    """Compare the cells of a page's table with fresh runs.

    Parameters
    ----------
    said
        The table of the page.
    texts
        What the command printed for one draw each; for all that the page states if `runs` is 0.
    runs
        How many draws the page's command has; 0 for a command without seeds.
    is_shared
        Whether another command prints the rows that this does not.
    times
        Whether times are compared as well.

    Returns
    -------
    list of Cell
        The cells that could be compared; None where a text has no such table, or all other rows.
    """
    found: list[Cell] = []
    fresh = [rows for text in texts if (rows := fresh_cells(said, text)) is not None]
    printed = set().union(*fresh)
    # A table without rows is one of which these draws have nothing.
    if len(fresh) < len(texts) or (printed and printed.isdisjoint(keys(said))):
        return None
    for key, row in keys(said).items():
        drawn = [rows[key] for rows in fresh if key in rows]
        if times and drawn:
            found += by_time(said.head, key, row, drawn)
        if runs == 0 and (drawn or not is_shared):
            found += exactly(said.head, key, row, drawn)
        # A row that sums up others says nothing that they do not.
        elif drawn and not key[0].startswith("all"):
            found += by_chance(said.head, key, row, drawn, runs)
    return found


def exactly(
    head: Sequence[str], key: Sequence[str], row: Sequence[str], drawn: Sequence[Sequence[str]]
) -> Iterator[Cell]:
    """Hold each cell against the same digits."""
    fresh = drawn[0] if drawn else ("no such row",) * len(row)
    for column, said, measured in list(zip(head, row, fresh, strict=True))[len(key) :]:
        if not TIME.search(column):
            yield Cell(", ".join(key), column, said, measured, float(said == measured))


def by_time(
    head: Sequence[str], key: Sequence[str], row: Sequence[str], drawn: Sequence[Sequence[str]]
) -> Iterator[Cell]:
    """Hold the times of a row against the median of those of single draws."""
    for i in range(len(key), len(head)):
        if not TIME.search(head[i]):
            continue
        # The largest of few is less than that of many.
        least = 0.0 if quantile_of(head[i], None) == 1.0 else 1.0 / FACTOR
        fresh = [float(found[0]) for other in drawn if (found := FIGURE.match(other[i]))]
        if fresh and (stated := FIGURE.match(row[i])):
            ratio = median(fresh) / float(stated[0])
            shown = f"{median(fresh):g}"
            alike = float(least <= ratio <= FACTOR)
            yield Cell(", ".join(key), head[i], row[i], shown, alike)


def by_chance(
    head: Sequence[str],
    key: Sequence[str],
    row: Sequence[str],
    drawn: Sequence[Sequence[str]],
    runs: int,
) -> Iterator[Cell]:
    """Hold each cell of a row against that of single draws."""
    counted = [i for i, name in enumerate(head) if RUNS.match(name)]
    quantile = quantile_of(", ".join(key), None)
    for i in range(len(key), len(head)):
        quantile = quantile_of(head[i], quantile)
        if i in counted or TIME.search(head[i]) or UNCOMPARED.search(head[i]):
            continue
        before = [k for k in counted if k < i] or [k for k in range(i) if OF.match(row[k])]
        # Without a column that says of how many runs a row is, it is of all.
        total = size(row[before[-1]]) if before else runs
        each = [size(other[before[-1]]) if before else 1 for other in drawn]
        parts = parted(head[i], quantile, row[i], [other[i] for other in drawn])
        for part, share, said, column in parts:
            for found in tested(said, column, share, total, each):
                named = ", ".join(filter(None, (part, found.column)))
                yield replace(found, row=", ".join(key), column=named)


def parted(
    name: str, quantile: float | None, said: str, column: Sequence[str]
) -> Iterator[tuple[str, float | None, str, list[str]]]:
    """Take apart cells that hold several quantiles, as in "moved: median, 90 %, most"."""
    first, _, names = name.partition(": ")
    parts = [part for part in names.split(", ") if part in QUANTILES]
    if len(parts) < 2 or said.count(", ") + 1 != len(parts):
        yield name, quantile, said, list(column)
        return
    empty = ", ".join([""] * len(parts))
    split = [(c if c.count(", ") == said.count(", ") else empty).split(", ") for c in column]
    for k, (part, text) in enumerate(zip(parts, said.split(", "), strict=True)):
        yield f"{first}: {part}", QUANTILES[part], text, [cell[k] for cell in split]


def size(text: str) -> int:
    """Of how many runs a cell is: of "a of b" b, else the number that it is."""
    match = OF.match(text)
    return int(match[2] if match else text) if match or text.isdigit() else 0


def quantile_of(name: str, left: float | None) -> float | None:
    """Which quantile a column holds: as its head says, else that of the column to its left."""
    return next((share for word, share in QUANTILES.items() if word in name), left)


def tested(
    said: str, column: Sequence[str], quantile: float | None, runs: int, each: Sequence[int]
) -> Iterator[Cell]:
    """Compare a cell; its column is the code that is counted, of a list of these."""
    of_each = list(zip(column, each, strict=True))
    if match := OF.match(said):
        ofs = [m for cell in column if (m := OF.match(cell))]
        pair = sum(int(m[1]) for m in ofs), sum(int(m[2]) for m in ofs)
        yield from counts("", said, (int(match[1]), int(match[2])), pair)
    elif match := SHARE.match(said):
        shares = [(float(m[1]) / 100, n) for cell, n in of_each if (m := SHARE.match(cell))]
        right = sum(share * n for share, n in shares)
        if abs(right - round(right)) < 0.02 * len(shares):
            pair = round(right), sum(n for _, n in shares)
            yield from counts("", said, (round(runs * float(match[1]) / 100), runs), pair)
    elif said.isdigit():
        numbers = [(int(cell), n) for cell, n in of_each if cell.isdigit()]
        pair = sum(k for k, _ in numbers), sum(n for _, n in numbers)
        yield from counts("", said, (int(said), runs), pair)
    elif NUMBER.match(said) and quantile is not None:
        # A row of several runs in each draw states a median of few, not the value of one.
        values = [float(c.split()[0]) for c, n in of_each if n == 1 and NUMBER.match(c)]
        if values:
            below = position(float(said.split()[0]), values, quantile, runs)
            shown = ", ".join(f"{value:g}" for value in sorted(values))
            yield Cell("", "", said, shown, below)
    elif CODES.match(said):
        stated = {code: int(n) for code, n in CODES.findall(said)}
        drawn = [(code, int(n)) for cell in column for code, n in CODES.findall(cell)]
        for code in sorted(stated.keys() | {code for code, _ in drawn}):
            met = sum(n for other, n in drawn if other == code)
            yield from counts(code, said, (stated.get(code, 0), runs), (met, sum(each)))


def counts(
    code: str, said: str, stated: tuple[int, int], measured: tuple[int, int]
) -> Iterator[Cell]:
    """Fisher's exact test of two counts, each of so many."""
    if stated[0] <= stated[1] and measured[0] <= measured[1] and stated[1] and measured[1]:
        rows = [[k, n - k] for k, n in (stated, measured)]
        impossible = any(few < more for few, more in zip(*rows, strict=True))
        probability = float(fisher_exact(rows).pvalue)
        yield Cell("", code, said, f"{measured[0]} of {measured[1]}", probability, impossible)


def position(said: float, values: Sequence[float], quantile: float, runs: int) -> float:
    """Two-sided probability of so many values on one side of a quantile that `runs` others state.

    Of the k-th smallest of N values, the number of n further ones below it is beta-binomial with
    k and N + 1 - k, for any continuous distribution. Values equal to it as printed count for it.
    """
    a, b = 1 + quantile * (runs - 1), 1 + (1 - quantile) * (runs - 1)
    number = betabinom(len(values), a, b)
    most, least = sum(v <= said for v in values), sum(v < said for v in values)
    return min(1.0, 2.0 * min(float(number.cdf(most)), float(number.sf(least - 1))))
