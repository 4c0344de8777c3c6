"""Lines of numbers, as the text variants of the formats hold them."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ..datatypes import Array
from ..errors import ReadError


def read_table(
    path: Path,
    body: bytes,
    columns: int,
    *,
    line: int,
    mark: str | None = None,
) -> Array:
    """Read the lines of a text as a table of numbers; blank lines and # comments are none.

    Parameters
    ----------
    path
        The file, for messages.
    body
        The text. What is not ASCII becomes a question mark, which is no number.
    columns
        How many values each line must have.
    line
        Number that the first line of `body` has in the file.
    mark
        What parts the values; None is any blank.

    Returns
    -------
    (N, columns) array.

    Raises
    ------
    ReadError
        Naming the first line that does not hold so many numbers.
    """
    text = body.decode("ascii", errors="replace").replace("�", "?")
    # Only these end a line for NumPy and for editors; str.splitlines knows many more.
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if not any(part.split("#", 1)[0].strip() for part in text.split("\n")):
        return np.empty((0, columns))
    try:
        table = np.loadtxt(io.StringIO(text), delimiter=mark, ndmin=2, dtype=np.float64)
    except ValueError:
        bad = _first_bad(text, columns, mark)
        if bad is None:
            raise ReadError(f"{path}: its lines are not {columns} numbers each") from None
        number, content = bad
        raise ReadError(
            f"{path}, line {line + number}: {content[:60]!r}, expected {columns} numbers"
        ) from None
    if table.shape[1] != columns:
        number, content = _first_bad(text, columns, mark) or (0, "")
        raise ReadError(
            f"{path}, line {line + number}: holds {table.shape[1]} values, expected {columns}"
        )
    return table


def is_number(word: str) -> bool:
    """Whether a word reads as a number, nan and inf included."""
    try:
        float(word)
    except ValueError:
        return False
    # Python takes 1_000 for a number, NumPy and everyone else do not.
    return "_" not in word


def _first_bad(text: str, columns: int, mark: str | None) -> tuple[int, str] | None:
    """Find the first line that is not so many numbers: its index and what it holds."""
    for k, content in enumerate(text.split("\n")):
        plain = content.split("#", 1)[0].strip(None if mark is None else " ")
        words = plain.split(mark)
        if plain and (len(words) != columns or not all(is_number(w.strip()) for w in words)):
            return k, content
    return None
