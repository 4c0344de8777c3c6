"""One table of the paper with its figure, ready to be written."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Cell = str | int | float | None


@dataclass(frozen=True, eq=False)
class Exhibit:
    """What one experiment shows.

    Attributes
    ----------
    name
        Stem of its files.
    title
        Which table or figure of the paper it is.
    header, rows
        The table; None where there is no figure to give.
    note
        What to know when reading it, in Markdown.
    draw
        Draws the figure; None where there is none.
    size
        Of the figure, inches.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str
    draw: Callable[[Figure], None] | None = None
    size: tuple[float, float] = (10.0, 6.0)

    def markdown(self) -> str:
        """Title, table and note; numbers to four digits."""
        lines = [f"# {self.title}", "", "| " + " | ".join(self.header) + " |"]
        lines.append("| " + " | ".join(["---"] * len(self.header)) + " |")
        lines += ["| " + " | ".join(map(_written, row)) + " |" for row in self.rows]
        return "\n".join([*lines, "", self.note, ""])

    def csv(self) -> str:
        """The table alone; numbers in full."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.header)
        writer.writerows(self.rows)
        return text.getvalue()


def _written(cell: Cell) -> str:
    if cell is None:
        return ""
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)
