"""The tables of the documents that are marked: what printed each, and when; and their rewriting."""

from __future__ import annotations

import re
import shlex
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from figures_compare import Table, fresh_cells, keys, tables
from figures_run import printed

MARK = re.compile(
    r"<!-- figures: (?P<command>.+?) · (?P<day>\d{4}-\d\d-\d\d) · (?P<commit>\w+)"
    r"(?: · (?P<why>.+?))? -->\n"
)
MARKED = re.compile(
    r"(?P<marks>(?:<!-- figures: .+ -->\n)+)(?P<table>(?:\|.*\n)+)<!-- end of figures -->"
)


@dataclass(frozen=True)
class Stated:
    """What a command printed of a table: where it is said, when; why it is not compared.

    Attributes
    ----------
    page, line
        Where the comment stands.
    command, day, commit, why
        As the comment has them.
    table
        All of it.
    first
        Line of the first comment of the table.
    is_shared
        Whether other commands print rows of the same table.
    """

    page: str
    line: int
    command: str
    day: str
    commit: str
    why: str
    table: Table
    first: int
    is_shared: bool


def stated(root: Path) -> list[Stated]:
    """All marks of the documents, in their order."""
    found = []
    for path in (root / "README.md", *sorted((root / "docs").rglob("*.md"))):
        text = path.read_text(encoding="utf-8")
        for match in MARKED.finditer(text):
            (table,) = tables(match["table"])
            first = text.count("\n", 0, match.start()) + 1
            marks = list(MARK.finditer(match["marks"]))
            for k, mark in enumerate(marks):
                said = mark["command"], mark["day"], mark["commit"], mark["why"] or ""
                page = str(path.relative_to(root))
                found.append(Stated(page, first + k, *said, table, first, len(marks) > 1))
    return found


def rewrite(root: Path, chosen: dict[str, list[Stated]], data: Path | None) -> None:
    """Run whole commands, and put what they print in the place of the tables.

    A page keeps its columns and its rows; what it does not show is left out.
    """
    git = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, cwd=root, capture_output=True, text=True, check=True).stdout
    for command, own in chosen.items():
        text = printed(shlex.split(command), data)
        for one in own:
            fresh = fresh_cells(one.table, text, kept=True)
            if fresh is None:
                raise SystemExit(f"{command} prints no such table as {one.page}:{one.line}")
            path = root / one.page
            page = "".join(replaced(path.read_text(encoding="utf-8"), one, fresh, commit.strip()))
            path.write_text(page, encoding="utf-8")
            print(f"{one.page}:{one.line}: written")


def replaced(
    text: str, one: Stated, fresh: dict[tuple[str, ...], tuple[str, ...]], commit: str
) -> Iterator[str]:
    """A page with the fresh rows in the place of those of a table."""
    match = next(
        m for m in MARKED.finditer(text) if text.count("\n", 0, m.start()) + 1 == one.first
    )
    marks = match["marks"].splitlines(keepends=True)
    why = f" · {one.why}" if one.why else ""
    new = f"<!-- figures: {one.command} · {date.today()} · {commit}{why} -->\n"
    marks[one.line - one.first] = new
    lines = match["table"].splitlines(keepends=True)
    yield text[: match.start()]
    yield from (*marks, *lines[:2])
    for key, line in zip(keys(one.table), lines[2:], strict=True):
        if key in fresh:
            # The cells that name a row keep their emphasis.
            kept = line.strip().strip("|").split("|")[: len(key)]
            yield "| " + " | ".join([*map(str.strip, kept), *fresh[key][len(key) :]]) + " |\n"
        elif one.is_shared:
            yield line
        else:
            raise SystemExit(f"{one.command} prints no row {', '.join(key)}")
    yield "<!-- end of figures -->"
    yield text[match.end() :]
