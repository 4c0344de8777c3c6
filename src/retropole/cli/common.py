"""What the commands share: what is reported of readings and refusals, progress."""

from __future__ import annotations

import codecs
import io
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from inspect import cleandoc
from pathlib import Path
from subprocess import list2cmdline
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from msgspec import to_builtins

from ..base.errors import escaped, printable
from ..base.reasons import explain, page, plain

if TYPE_CHECKING:
    from ..api.inputs import Input, Listener
    from ..api.result import CalibrationResult, SiteResult

EXIT_WARNED, EXIT_USAGE, EXIT_REFUSED, EXIT_MOVED = 1, 2, 3, 4
EXIT_INTERRUPTED, EXIT_PIPE = 130, 128 + 13
"""The first is for --strict alone; the last is that of any program whose reader is gone."""

ASCII = {"█": "#", "←": "<-", "σ": "sigma", "±": "+-", "°": " deg", "χ": "chi", "²": "^2"}
ASCII |= {"³": "^3", "–": "-", "…": "...", "×": "x", "≥": ">=", "≤": "<=", "·": "*"}
"""Replacements of our signs where a terminal does not have them."""

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True}


class Group(click.Group):
    """Commands; without the name of one it prints its help on stderr, and that is bad usage.

    What click does then differs from version to version.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the words that follow the group."""
        if not args and not ctx.resilient_parsing:
            click.echo(ctx.get_help(), err=True)
            ctx.exit(EXIT_USAGE)
        return super().parse_args(ctx, args)


def fill_in(command: click.Command, word: str, titles: Mapping[str, str], *, width: int) -> None:
    """List names and titles, a line each, where the help of a command has a word."""
    lines = (f"  {name:<{width}}  {title}" for name, title in titles.items())
    text = cleandoc(command.help or "")
    command.help = text.replace(f"  {word}\n", "\n".join([*lines, ""]))


def json_text(found: Any, indent: int | None = None) -> str:
    """Write what was found as JSON; data classes as objects, and arrays as lists."""
    # NumPy comes with it, which errors and the version do without.
    from ..result import plain as plain_value

    return json.dumps(found, indent=indent, default=partial(to_builtins, enc_hook=plain_value))


def never_fail_to_encode() -> None:
    """Have stdout and stderr write what their encoding lacks in ASCII, rather than fail."""
    codecs.register_error("retropole", _in_ascii)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="retropole")


def _in_ascii(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    signs = error.object[error.start : error.end]
    return "".join(ASCII.get(sign) or escaped(sign) for sign in signs), error.end


def show(text: str | bytes) -> None:
    """Print the output of a command on stdout.

    Raises
    ------
    OSError
        If it cannot be written; names the standard output.
    """
    try:
        click.echo(text, nl=isinstance(text, str) and not text.endswith("\n"))
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OSError(error.errno, error.strerror, "standard output") from None


VERDICT_COLOURS = {"ok": "green", "same": "green", "warn": "yellow", "cannot_tell": "yellow"}
VERDICT_COLOURS |= {"refused": "red", "moved": "red", "pass": "green", "fail": "red"}


def in_colour(text: str, status: str) -> str:
    """Colour the first line, the verdict, where stdout is a terminal that shows colours.

    Not where NO_COLOR is set (https://no-color.org).
    """
    dumb = os.environ.get("TERM") == "dumb"
    if os.environ.get("NO_COLOR") or dumb or not sys.stdout.isatty():
        return text
    verdict, line_end, rest = text.partition("\n")
    return click.style(verdict, fg=VERDICT_COLOURS.get(status), bold=True) + line_end + rest


def say(line: str) -> None:
    """Print a line on stderr; without stderr the exit code is still given."""
    with suppress(OSError):
        click.echo(printable(line), err=True)


class Advice(NamedTuple):
    """How a user keeps more points, names a unit, and has a recording read in it."""

    to_keep: str
    unit: str
    to_read: str


BY_OPTIONS = Advice("--max-points N", "--unit {}", "read them with {}")
BY_SITE_FILE = Advice("max_points = N", 'unit = "{}"', "set {} of its LiDAR in the site file")


@contextmanager
def listening(
    quiet: bool,
    frames: object,
    advice: Advice = BY_OPTIONS,
    *,
    units: bool = True,
    hidden: bool = False,
) -> Iterator[Listener]:
    """Print on stderr the progress of a run, and for each cloud what was left out or is odd.

    Parameters
    ----------
    quiet
        No output.
    frames
        Which were requested; None for none.
    advice
        What to do about it.
    units
        Doubt the unit of the coordinates, as well as the sensor's name.
    hidden
        Does not show the progress.
    """
    from ..api.inputs import Listener

    def report_notes(given: Input) -> None:
        if quiet:
            return
        for line in _left_out(given, frames is not None, advice):
            say(f"retropole: {given.name}: {line}")
        odd = given.oddity if units else None
        if odd is not None:
            named = " or ".join(advice.unit.format(unit) for unit in odd.units)
            remedy = f"; if they are, {advice.to_read.format(named)}" if named else ""
            say(f"retropole: {given.name}: {odd.text}{remedy}")
        elif given.sensor_doubt:
            say(f"retropole: {given.sensor_doubt}")

    with progress_on_terminal(quiet or hidden) as progress:
        yield Listener(progress, report_notes)


def _left_out(given: Input, asked: bool, advice: Advice) -> Iterator[str]:
    """Report damaged parts of a recording, and what was left out without being requested."""
    read, cloud = given.read, given.cloud
    yield from cloud.notes
    if read is not None and read.left_out:
        yield (
            f"read {len(read.numbers)} of {len(read.requested)} frames, one in "
            f"{read.numbers.step // read.requested.step}, since all together have too many points; "
            f"{advice.to_keep} reads more"
        )
    elif read is not None and not asked and not read.is_whole:
        yield (
            f"read {len(read.numbers)} of {read.recording.count} frames, every "
            f"{read.numbers.step}th; --frames A:B reads others"
        )
    if cloud.thinned:
        yield (
            f"downsampled from {len(cloud) + cloud.thinned:,} to {len(cloud):,} points, the "
            f"brightest kept; {advice.to_keep} keeps more"
        )


def echo_refusal(code: str, message: str) -> None:
    """Print on stderr why there is no answer, with advice."""
    say(f"retropole: refused ({code}): {message}")
    explanation = explain(code)
    lead = "what to do: "
    for action in explanation.advice if explanation else ():
        say(lead + plain(action))
        lead = " " * len(lead)
    if explanation:
        say(f"read on: {page(code)}")


def echo_warning(code: str, message: str) -> None:
    """Print on stderr the warnings of an answer."""
    say(f"retropole: warning ({code}): {message}")


def report_result(
    result: CalibrationResult | SiteResult,
    written: Sequence[Path],
    following: Mapping[str, str],
    *,
    as_json: bool,
    verbose: bool,
    quiet: bool,
    strict: bool,
) -> int:
    """Print a result, say on stderr what its verdict rests on, and give the exit code.

    Parameters
    ----------
    result
        Of two LiDARs or of a site.
    written
        Its files.
    following
        Commands to type next, by the words that introduce each.
    as_json, verbose, quiet
        Print the document instead of text, more text, or nothing.
    strict
        Whether a warning is an error.
    """
    from ..report.text import describe_result

    if as_json:
        show(written[0].read_bytes())
    elif not quiet:
        paths = [str(path) for path in written]
        text = describe_result(result.document, paths, following, verbose=verbose)
        show(in_colour(text, result.status))
    refused, unseen = result.status == "refused", quiet or as_json
    for reason in result.reasons:
        if refused and unseen:
            echo_refusal(reason.code, reason.message)
        elif refused and not sys.stdout.isatty():
            # Why is on stdout, wherever that goes: a pipe may end on the same terminal.
            say(f"retropole: refused ({reason.code})")
        elif unseen and not refused:
            echo_warning(reason.code, reason.message)
    if refused:
        return EXIT_REFUSED
    return EXIT_WARNED if strict and result.status == "warn" else 0


def show_written(*places: str | Path) -> None:
    """Print which files were written."""
    show("written: " + ", ".join(printable(str(place)) for place in places))


def command_line(*arguments: str | Path) -> str:
    """Write a command of retropole as it is typed, its words quoted for the shell."""
    typed = ["retropole"]
    # A file whose name begins as an option does is none.
    typed += [f"./{w}" if isinstance(w, Path) and f"{w}"[0] == "-" else f"{w}" for w in arguments]
    return list2cmdline(typed) if os.name == "nt" else shlex.join(typed)


@contextmanager
def progress_on_terminal(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Name the step under way on a terminal; print nothing in a pipe, where nobody waits.

    Long steps name their share of all: ``read drive.bag: frame, 12 of 40``.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda step: None
        return
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status("starting") as status:
        yield lambda step: status.update(escape(printable(step)))
