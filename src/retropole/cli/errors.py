"""What ends a command without an answer, in one style: what and where, then what to do.

With --json it is an object on stdout besides.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import click

from ..base.errors import MissingExtraError, NewerError, ReadError, Refusal, RetropoleError, quoting
from ..base.reasons import explain, page, plain
from .common import EXIT_REFUSED, EXIT_USAGE, echo_refusal, json_text, say

ERROR_SCHEMA = "retropole/error/1"


TO_LOOK_AT = {
    "retropole site calibrate": (
        "check the site file, and the recordings that it names",
        "docs/site.md",
    ),
    "retropole site check": (
        "check the result, the site file, and the recordings that it names",
        "docs/check.md",
    ),
    "retropole fleet calibrate": (
        "check SITES and the dataset; errors of a single recording are in its row",
        "docs/fleet.md",
    ),
    "retropole fleet report": (
        "name the folder that 'retropole fleet calibrate --out' wrote to",
        "docs/fleet.md",
    ),
    "retropole": (
        "check the path and the file; 'retropole info FILE' describes a recording",
        "docs/troubleshooting.md",
    ),
}
"""By the command, and for all others: what to do if a file cannot be read, and the page."""


class Failure(NamedTuple):
    """Why there is no answer.

    Attributes
    ----------
    code
        ``usage``, ``unreadable``, ``missing_extra``, ``system``, ``out_of_memory``; or the reason
        code of a refusal.
    message
        What is wrong, and where.
    what_to_do
        One action each.
    read_on
        Page of the documentation, as a clone has it.
    """

    code: str
    message: str
    what_to_do: tuple[str, ...]
    read_on: str | None = None


def failure_of(error: Exception, command: str) -> Failure:
    """Describe an error, with advice.

    Parameters
    ----------
    error
        Any that `run` catches.
    command
        The command that was called, as ``retropole calibrate``.
    """
    options = (f"'{command} --help' lists the arguments and options, with examples",)
    match error:
        case click.MissingParameter():
            # click lists choices a line each.
            return Failure("usage", " ".join(error.format_message().split()), options)
        case click.ClickException():
            return Failure("usage", quoting(error.format_message()), options)
        case Refusal():
            known = explain(error.code)
            actions = () if known is None else tuple(map(plain, known.advice))
            return Failure(error.code, error.message, actions, page(error.code))
        case MissingExtraError():
            install = f"pip install 'retropole[{error.extra}]'"
            return Failure("missing_extra", str(error), (install,), "docs/install.md")
        case NewerError():
            return Failure(
                "unreadable", str(error), ("pip install --upgrade retropole",), "docs/install.md"
            )
        case ReadError():
            look, read_on = TO_LOOK_AT.get(command, TO_LOOK_AT["retropole"])
            return Failure("unreadable", str(error), (look,), read_on)
        case RetropoleError():
            return Failure("usage", str(error), options)
        case MemoryError():
            message = f"there is not enough memory: {quoting(str(error))}"
            less = "read less: fewer --frames A:B, or a smaller --max-points N"
            return Failure("out_of_memory", message, (less,))
        case OSError():
            # Help and tables are printed by click and rich: only they leave out where.
            unnamed = error.errno in (errno.EBADF, errno.ENOSPC, errno.EIO)
            place = error.filename or ("standard output" if unnamed else "")
            message = quoting(f"{place}: {error.strerror}" if place else str(error))
            check = "check that it exists and may be read or written, and that the disk is not full"
            if isinstance(error, BlockingIOError) and error.filename:
                check = "wait until that run has ended, or name another folder with --out"
            return Failure("system", message, (check,))
    raise error


def report_failure(failure: Failure, *, refused: bool, as_json: bool) -> int:
    """Print it on stderr, with --json on stdout too, and give the exit code."""
    if refused:
        echo_refusal(failure.code, failure.message)
    else:
        say(f"retropole: error: {failure.message}")
        for action in failure.what_to_do:
            say(f"what to do: {action}")
    if as_json:
        # Who cannot read it gets the exit code all the same.
        with suppress(OSError):
            status = "refused" if refused else "error"
            about = {"schema": ERROR_SCHEMA, "status": status, "error": failure._asdict()}
            click.echo(json_text(about))
    return EXIT_REFUSED if refused else EXIT_USAGE


def asks_for_json(arguments: Sequence[str]) -> bool:
    """Return whether --json is among words that may make no sense otherwise."""
    options = list(arguments)
    return "--json" in (options[: options.index("--")] if "--" in options else options)
