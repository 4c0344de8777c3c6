"""Hold the tables of figures in the documents against fresh runs of the commands that print them.

Each such table stands between two comments. The first names the command, the day on which it was
run, and the commit:

    <!-- figures: python benchmarks/units.py --seeds 1000:1036 · 2026-11-24 · 8a0265f -->
    | ... |
    <!-- end of figures -->

Where several commands make the rows of a table, each has a comment of its own, and is held against
the rows that it prints. Words after the commit say why a table is not compared, but for three:

- `slow`: no part of a day has it;
- `times`: nor this. Its times are named only where a fresh one is more than three times as long or
  less than a third, of a largest only where it is longer: they are of another machine;
- `whole`: nor this. A share of its runs would say nothing, so all are run, and every cell must have
  the same digits. So it is without the word where a command has no seeds.

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
import shlex
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
from figures_compare import Cell, compare
from figures_marks import Stated, rewrite, stated
from figures_run import ROOT, drawn, draws

WHOLE, TIMES = "whole", "times"
COMPARED = ("slow", TIMES, WHOLE)
"""Words for which a table is compared, but on no day of its own."""

SECONDS = 45.0
"""After so long no further draw of a command is begun."""


def wanted(
    found: Sequence[Stated], only: str, data: Path | None, slow: bool
) -> dict[str, list[Stated]]:
    """The tables that can be compared, by their commands; without data not those of recordings."""
    chosen: dict[str, list[Stated]] = {}
    for one in found:
        able = not one.why or (slow and one.why in COMPARED)
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
    """List the commands and their tables."""
    for one in found:
        print(f"{one.page}:{one.line}  {one.command}  ({one.day}, {one.commit})")
        if one.why:
            print(f"    {one.why}" if one.why in COMPARED else f"    not compared: {one.why}")
    every = {(one.page, one.first) for one in found}
    compared = {(one.page, one.first) for one in found if one.why in ("", *COMPARED)}
    print(f"{len(found)} marks, {len(every)} tables, {len(compared)} of them compared")


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
    whole = {command for command, own in chosen.items() if any(o.why == WHOLE for o in own)}
    run = partial(drawn, share=share, seconds=seconds, data=data, whole=whole)
    for (command, own), (texts, took) in zip(
        chosen.items(), two_at_a_time(run, chosen), strict=True
    ):
        print(f"{command}: {len(texts)} draws, {took:.0f} s", flush=True)
        for one in own:
            runs = 0 if command in whole else draws(command)
            cells = compare(one.table, texts, runs, is_shared=one.is_shared, times=one.why == TIMES)
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
