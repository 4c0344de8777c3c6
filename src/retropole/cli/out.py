"""The folder that a command writes to: one run at a time, and no result of a run before."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import wraps
from pathlib import Path
from typing import Any

import click

from ..base.errors import printable
from ..base.files import leaving, run_alone, set_aside, without_older
from .common import say
from .options import OUT, Command

DEFAULT_OUT = Path("retropole-out")
"""Where a calibration writes to unless another folder is named."""


def out_folder(
    help_text: str, *files: str, default: Path | None = DEFAULT_OUT, keeping: str = "nothing"
) -> Callable[[Command], Command]:
    """Give a command --out, a folder that no other run may write to until it ends.

    Parameters
    ----------
    help_text
        Help of the option.
    files
        What it writes there. Those of a run before are renamed at its start, since they would be
        taken for those of this run however it ends; it reports those that it does not replace.
    default
        The folder unless another is named; None for none.
    keeping
        Name of an option with which it writes none of these files.
    """

    def add(command: Command) -> Command:
        @wraps(command)
        def alone(*given: Any, out: Path | None, **options: Any) -> int:
            if out is None:
                return command(*given, out=out, **options)
            names = () if options.get(keeping) is not None else files
            with run_alone(out, _command_path()), _without_older(out, names):
                return command(*given, out=out, **options)

        option = click.option("--out", type=OUT, default=default, help=help_text)
        added = option(alone)
        WRITES[added] = files, default, keeping
        return added

    return add


WRITES: dict[Any, tuple[tuple[str, ...], Path | None, str]] = {}
"""Of commands with such a folder: files, default and keeping, as `out_folder` takes them."""


@contextmanager
def locked_folder(file: Path) -> Iterator[None]:
    """Keep other runs from the folder of a result that a command writes to, where there is one."""
    with run_alone(file.parent, _command_path()) if file.exists() else nullcontext():
        yield


def _command_path() -> str:
    context = click.get_current_context(silent=True)
    return context.command_path if context else ""


@contextmanager
def _without_older(folder: Path, names: Sequence[str]) -> Iterator[None]:
    """Rename the files of a run before, and report those that this one does not replace."""
    files = [folder / name for name in names]
    are_there = any(map(Path.is_file, files))

    def report_at_once() -> None:
        message = _moved_in_words([path.with_name(f"older-{path.name}") for path in files])
        os.write(2, f"{message}\n".encode(errors="backslashreplace"))

    if are_there:
        leaving.append(report_at_once)
    left: list[Path] = []
    try:
        with without_older(files) as left:
            yield
    finally:
        if are_there:
            leaving.remove(report_at_once)
        if left:
            say(_moved_in_words(left))


def _moved_in_words(moved: Sequence[Path]) -> str:
    there = [path for path in moved if path.exists()]
    kind = there[0].stem.removeprefix("older-").replace("-", " ") if there else ""
    now = " and ".join(printable(str(path)) for path in there)
    return f"retropole: no {kind} of this run; the previous one is now {now}" if there else ""


def set_older_aside(command: click.Command, arguments: Sequence[str]) -> None:
    """Rename what a command would have replaced, if its arguments are wrong.

    Not where another run is writing to the folder: it does so itself.
    """
    files, default, keeping = WRITES.get(command.callback, ((), None, ""))
    out = _out_of(arguments, default)
    keeps = next((each for each in command.params if each.name == keeping), None)
    if keeps is not None and any(word.partition("=")[0] in keeps.opts for word in arguments):
        return
    if out is None or not out.is_dir():
        return
    with suppress(OSError), run_alone(out):
        moved = set_aside([out / name for name in files])
        if moved:
            say(_moved_in_words(moved))


def _out_of(arguments: Sequence[str], default: Path | None) -> Path | None:
    """Find --out among words that may make no sense otherwise."""
    out, options = default, list(arguments)
    if "--" in options:
        options = options[: options.index("--")]
    for word, following in zip(options, [*options, ""][1:], strict=True):
        if word == "--out" and following:
            out = Path(following)
        elif word.startswith("--out="):
            out = Path(word.removeprefix("--out="))
    return out
