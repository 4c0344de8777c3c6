"""Text on a screen: tables, lines that are broken at its width, nothing that steers a terminal."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from itertools import zip_longest
from typing import Any

import msgspec

from ..base.errors import printable

WIDTH, LINES = 80, 40
"""Columns and lines of a screen. No path and no command is cut: they are copied."""

VALUE_SPACE = re.compile(r"(?<=±) | (?=±)|(?<=\d) (?=(?:mm|cm|m|s|deg|σ|%)(?!\w))")
"""Spaces at which no line is broken: a value stays with its error and its unit."""


def legible(value: Any) -> Any:
    """Write every text of a document so that it steers no terminal and stays on its line."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, msgspec.Struct):
        fields = {name: legible(getattr(value, name)) for name in value.__struct_fields__}
        return msgspec.structs.replace(value, **fields)
    if isinstance(value, dict):
        return {legible(key): legible(each) for key, each in value.items()}
    return type(value)(map(legible, value)) if isinstance(value, list | tuple) else value


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Lay out rows under a header, each column as wide as it needs, numbers to the right.

    A name of the header may have several lines, one for each word where a screen is too narrow.
    """
    cells = [[str(cell) for cell in row] for row in rows]
    longest = [max(len(row[k]) for row in cells) for k in range(len(header))]
    broken = [
        name if len(name) <= most else name.replace(" ", "\n")
        for name, most in zip(header, longest, strict=True)
    ]
    for names in (header, broken):
        heads = zip_longest(*(name.split("\n") for name in names), fillvalue="")
        whole = [*map(list, heads), *cells]
        widths = [max(len(row[k]) for row in whole) for k in range(len(header))]
        if sum(widths) + 2 * len(widths) <= WIDTH:
            break
    lines = []
    for first, *others in whole:
        right = (cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True))
        lines.append("  " + "  ".join([first.ljust(widths[0]), *right]).rstrip())
    return "\n".join(lines)


def wrapped(line: str, indent: str) -> list[str]:
    """Break a line of words at the width of a screen; what follows the first is indented."""
    kept = VALUE_SPACE.sub("\N{NO-BREAK SPACE}", line)
    lines = textwrap.wrap(
        kept, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return [each.replace("\N{NO-BREAK SPACE}", " ") for each in lines]
