"""Lines of numbers, as the text variants of the formats hold them."""

from __future__ import annotations

import io

import numpy as np

from ..base.datatypes import Array
from ..base.errors import ReadError
from .failures import LineError


def read_table(body: bytes, columns: int, *, line: int, separator: str | None = None) -> Array:
    """Read the lines of a text as a table of numbers, without blank lines and # comments.

    Parameters
    ----------
    body
        The text. Bytes that are not ASCII become question marks, which are not numbers.
    columns
        How many values each line must have.
    line
        Number that the first line of `body` has in the file.
    separator
        What separates the values; None is any number of blanks.

    Returns
    -------
    (N, columns) array.

    Raises
    ------
    ReadError
        Naming the first line that does not have `columns` numbers.
    """
    # Only these end a line for NumPy and for editors; str.splitlines knows many others.
    if b"\r" in body:
        body = body.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if not any(part.split(b"#", 1)[0].strip() for part in io.BytesIO(body)):
        return np.empty((0, columns))
    # Line by line: the whole as a string takes several times the memory of the file.
    lines = io.TextIOWrapper(io.BytesIO(body), "ascii", errors="replace", newline="\n")
    try:
        table = np.loadtxt(lines, delimiter=separator, ndmin=2, dtype=np.float64)
    except ValueError:
        bad = _first_bad(body, columns, separator)
        if bad is None:
            raise ReadError(f"its lines are not {columns} numbers each") from None
        number, content = bad
        words = f"{content[:60]!r}, expected {columns} numbers"
        raise LineError(line + number, words) from None
    if table.shape[1] != columns:
        number, _ = _first_bad(body, columns, separator) or (0, "")
        raise LineError(line + number, f"holds {table.shape[1]} values, expected {columns}")
    return table


def is_number(word: str) -> bool:
    """Whether a word reads as a number, nan and inf included."""
    try:
        float(word)
    except ValueError:
        return False
    # Python reads 1_000 as a number, NumPy and all others do not.
    return "_" not in word


def _first_bad(body: bytes, columns: int, separator: str | None) -> tuple[int, str] | None:
    """Find the first line without `columns` numbers: its index, and what it contains."""
    for k, line in enumerate(io.BytesIO(body)):
        content = line.rstrip(b"\n").decode("ascii", errors="replace").replace("�", "?")
        plain = content.split("#", 1)[0].strip(None if separator is None else " ")
        words = plain.split(separator)
        if plain and (len(words) != columns or not all(is_number(w.strip()) for w in words)):
            return k, content
    return None
