"""Hold the tables of figures in the documents against fresh runs of the commands that print them.

Each such table stands between two comments. The first names the command, the day on which it was
run, and the commit:

    <!-- figures: python benchmarks/units.py --seeds 1000:1036 · 2026-11-24 · 8a0265f -->
    | ... |
    <!-- end of figures -->

Words after the commit say why a table is not compared; `slow`, that no part of a day has it.
Without options this lists the tables.

    python benchmarks/figures.py
    python benchmarks/figures.py --share 0.05
    python benchmarks/figures.py --share 0.05 --only units.py
    python benchmarks/figures.py --part 25
    python benchmarks/figures.py --only repeats.py --write

`--share` runs every command again for a share of its seeds, drawn at random but always the same,
one seed at a time: each prints a table of one draw. Every cell that differs by more than chance is
named, and the exit code is then 1. If all tables still hold, the chance that any cell at all is
named is below 1 % (`--alarm`), however many are compared: a cell is named where its probability is
below that, divided by their number. The seeds being those of the page, it is far less as long as
the code is the same. What a share finds is gross: 34 of 34 that are now 0 of 5, or a median beyond
which all of 20 draws lie. Give one command more of its draws to see more: `--share 0.3 --only fit`.

Counts that the same runs cannot have given are named as well, without an exit code: then single
runs end otherwise than on that day, and the page is of another version, or another machine.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import random
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date
from functools import partial
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
from figures_compare import Cell, Table, compare, fresh_cells, keys, tables

ROOT = Path(__file__).resolve().parents[1]

MARKED = re.compile(
    r"<!-- figures: (?P<command>.+?) · (?P<day>\d{4}-\d\d-\d\d) · (?P<commit>\w+)"
    r"(?: · (?P<why>.+?))? -->\n(?P<table>(?:\|.*\n)+)<!-- end of figures -->"
)
COUNTS = (
    *("--seeds", "--runs", "--draws", "--sites", "--setups", "--scenes"),
    *("--easy", "--hard", "--wrong", "--right"),
)
"""Options that say how many seeds a command draws, where they are followed by a number."""

SLOW = "slow"
"""Why a table is compared, but on no day of its own."""

LEAST = 5
"""Draws of each command: fewer hardly tell anything."""

SECONDS = 45.0
"""After so long no further draw of a command is begun: all take ten minutes on two cores."""


@dataclass(frozen=True)
class Stated:
    """A table of a page: where it stands, what printed it and when; why it is not compared."""

    page: str
    line: int
    command: str
    day: str
    commit: str
    why: str
    table: Table


def stated(root: Path) -> list[Stated]:
    """All marked tables of the documents, in their order."""
    found = []
    for path in (root / "README.md", *sorted((root / "docs").glob("*.md"))):
        text = path.read_text(encoding="utf-8")
        for match in MARKED.finditer(text):
            found.append(
                Stated(
                    str(path.relative_to(root)),
                    text.count("\n", 0, match.start()) + 1,
                    match["command"],
                    match["day"],
                    match["commit"],
                    match["why"] or "",
                    tables(match["table"])[0],
                )
            )
    return found


def draws(command: str) -> int:
    """How many draws of each kind a command makes, at the least; 0 where it has no seeds."""
    words = shlex.split(command)
    numbers = []
    for option, value in pairwise(words):
        if option in COUNTS and value.isdigit():
            numbers.append(int(value))
        elif option == "--seeds":
            numbers.append(len(range(*map(int, value.split(":")))))
    return min(numbers, default=0)


def one_draw(command: str, number: int) -> list[str]:
    """Words of the same command for one of its draws alone."""
    words = shlex.split(command)
    for i, (option, value) in enumerate(pairwise(words), start=1):
        if option in COUNTS and value.isdigit():
            words[i] = "1"
        elif option == "--seeds":
            first, _, *step = map(int, value.split(":"))
            seed = first + number * (step[0] if step else 1)
            words[i] = f"{seed}:{seed + 1}"
        elif option == "--first":
            words[i] = str(int(value) + number)
        elif option in ("--processes", "--jobs"):
            words[i] = "1"
        elif option == "--hopeless":
            words[i] = "0"
    return words


def printed(words: Sequence[str], data: Path | None = None) -> str:
    """What a command prints, run in this process."""
    _, script, *rest = words
    if data is not None:
        rest = [str(data) if word == "data" else word for word in rest]
    module = importlib.import_module(Path(script).stem)
    # A pool of processes would start anew for every draw.
    if hasattr(module, "ProcessPoolExecutor"):
        module.ProcessPoolExecutor = lambda *_, **__: ThreadPoolExecutor(1)
    before, out = sys.argv, io.StringIO()
    sys.argv = [script, *rest]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
            module.main()
    finally:
        sys.argv = before
    return out.getvalue()


def drawn(
    command: str, share: float, seconds: float, data: Path | None = None
) -> tuple[list[str], float]:
    """What a share of the draws of a command print, one by one, and the seconds that it took."""
    start = time.perf_counter()
    runs = draws(command)
    if runs == 0:
        texts = [printed(shlex.split(command), data)]
    else:
        count = min(runs, max(LEAST, round(share * runs)))
        texts = []
        for number in random.Random(command).sample(range(runs), count):
            texts.append(printed(one_draw(command, number), data))
            if time.perf_counter() - start > seconds:
                break
    return texts, time.perf_counter() - start


def wanted(
    found: Sequence[Stated], only: str, data: Path | None, slow: bool
) -> dict[str, list[Stated]]:
    """The tables that can be compared, by their commands; without data not those of recordings."""
    chosen: dict[str, list[Stated]] = {}
    for one in found:
        able = not one.why or (slow and one.why == SLOW)
        able = able and (data is not None or "data" not in shlex.split(one.command))
        if able and (only in one.page or only in one.command):
            chosen.setdefault(one.command, []).append(one)
    return chosen


def of_day(chosen: dict[str, list[Stated]], day: int) -> dict[str, list[Stated]]:
    """The commands of a day of the month: every command has one."""
    return {c: own for k, (c, own) in enumerate(sorted(chosen.items())) if k % 31 + 1 == day}


def differences(
    compared: Sequence[tuple[Stated, Sequence[Cell]]], alarm: float
) -> list[tuple[Stated, Cell]]:
    """The cells that differ by more than chance; by chance any does with a probability of `alarm`.

    Bonferroni's bound, over all cells that were compared by chance. Cells without chance differ or
    do not.
    """
    every = [(one, cell) for one, own in compared for cell in own]
    return [(one, cell) for one, cell in every if cell.probability < alarm / len(every)]


def say(found: Sequence[Stated]) -> None:
    """List the tables and their commands."""
    for one in found:
        print(f"{one.page}:{one.line}  {one.command}  ({one.day}, {one.commit})")
        if one.why:
            print(f"    {one.why}" if one.why == SLOW else f"    not compared: {one.why}")
    left = sum(one.why not in ("", SLOW) for one in found)
    print(f"{len(found)} tables, {len(found) - left} of them compared")


def two_at_a_time(
    run: Callable[[str], tuple[list[str], float]], commands: Collection[str]
) -> Iterator[tuple[list[str], float]]:
    """Run commands in two processes; a single one in this, which nothing outlives."""
    if len(commands) == 1:
        yield from map(run, commands)
    else:
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            yield from pool.map(run, commands)


def check(
    chosen: dict[str, list[Stated]], share: float, seconds: float, alarm: float, data: Path | None
) -> int:
    """Run the commands again, and print what differs; return the exit code."""
    compared, broken = [], 0
    run = partial(drawn, share=share, seconds=seconds, data=data)
    for (command, own), (texts, took) in zip(
        chosen.items(), two_at_a_time(run, chosen), strict=True
    ):
        print(f"{command}: {len(texts)} draws, {took:.0f} s", flush=True)
        for one in own:
            cells = compare(one.table, texts, draws(command))
            if cells is None:
                broken += 1
                print(f"    {one.page}:{one.line}: no such table is printed")
            else:
                compared.append((one, cells))
                print(f"    {one.page}:{one.line}: {len(cells)} figures compared")
    differ = differences(compared, alarm)
    others = [(one, cell) for one, own in compared for cell in own if cell.impossible]
    for words, some in (("", differ), ("not on the same seeds: ", others)):
        for one, cell in some:
            print(
                f"{words}{one.page}:{one.line}, row {cell.row!r}, column {cell.column!r}: said "
                f"{cell.said}, measured {cell.measured} (probability {cell.probability:.1g})"
            )
    print(f"{sum(len(cells) for _, cells in compared)} figures, {len(differ)} differ")
    return int(bool(differ) or bool(broken))


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
    match = next(m for m in MARKED.finditer(text) if text.count("\n", 0, m.start()) + 1 == one.line)
    lines = match["table"].splitlines(keepends=True)
    yield text[: match.start()]
    why = f" · {one.why}" if one.why else ""
    yield f"<!-- figures: {one.command} · {date.today()} · {commit}{why} -->\n"
    yield from lines[:2]
    for key, line in zip(keys(one.table), lines[2:], strict=True):
        if key not in fresh:
            raise SystemExit(f"{one.command} prints no row {', '.join(key)}")
        # The cells that name a row keep their emphasis.
        kept = line.strip().strip("|").split("|")[: len(key)]
        yield "| " + " | ".join([*map(str.strip, kept), *fresh[key][len(key) :]]) + " |\n"
    yield "<!-- end of figures -->"
    yield text[match.end() :]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--share", type=float, help="run so much of each command again, as 0.05")
    parser.add_argument("--part", type=int, help="only what has this day of the month, 1 to 31")
    parser.add_argument("--only", default="", help="pages or commands that have this in them")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="for each command")
    parser.add_argument("--alarm", type=float, default=0.01, help="probability of a false alarm")
    parser.add_argument("--data", type=Path, help="folder with the recordings")
    parser.add_argument("--root", type=Path, default=ROOT, help="folder of docs/ and README.md")
    parser.add_argument("--write", action="store_true", help="run all of it, and write the tables")
    given = parser.parse_args()
    found = stated(given.root.resolve())
    chosen = wanted(found, given.only, given.data, slow=given.part is None)
    if given.part is not None:
        chosen = of_day(chosen, given.part)
    if not given.write and given.share is None and given.part is None:
        say([one for one in found if given.only in one.page or given.only in one.command])
    elif not chosen:
        print("no table is compared")
    elif given.write:
        rewrite(given.root.resolve(), chosen, given.data)
    else:
        raise SystemExit(check(chosen, given.share or 0.05, given.seconds, given.alarm, given.data))


if __name__ == "__main__":
    main()
