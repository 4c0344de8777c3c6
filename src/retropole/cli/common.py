"""What the commands share: options, reading, refusals, progress."""

from __future__ import annotations

import codecs
import io
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import list2cmdline
from typing import TYPE_CHECKING, Any, get_args

import click

from ..base.datatypes import MAX_RADIUS, MIN_RADIUS
from ..base.errors import escaped, printable
from ..base.reasons import explain, page, plain
from ..base.sensors import SENSORS
from ..io.recordings import frames_named
from ..io.thinning import LEAST_POINTS
from ..io.units import Unit
from ..result import DEFAULT_CONFIG

if TYPE_CHECKING:
    from ..api.inputs import Input

EXIT_WARNED, EXIT_USAGE, EXIT_REFUSED, EXIT_INTERRUPTED, EXIT_PIPE = 1, 2, 3, 130, 141
"""The first is for --strict alone; the last is 128 + SIGPIPE, as of any program whose reader is
gone."""

ASCII = {"█": "#", "←": "<-", "σ": "sigma", "±": "+-", "°": " deg", "χ": "chi", "²": "^2"}
ASCII |= {"³": "^3", "–": "-", "…": "...", "×": "x", "≥": ">=", "≤": "<=", "·": "*"}
"""What stands for our own signs where a terminal has them not."""

CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}

CLOUD = click.Path(path_type=Path)
OUT = click.Path(path_type=Path, file_okay=False)
SENSOR_HELP = f"Sensor's name ({', '.join(SENSORS)}), or auto."
TOPIC_HELP = "Topic of the bag; needed where it has several of point clouds."
SAME_FOR_SOURCE = "The same for SOURCE."


class Number(click.FloatRange):
    """A finite number within bounds: click lets nan through any, and inf where there is none."""

    name = "number"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Take a number as click does, but no nan."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is no number.", param, ctx)
        return number


DEGREES = Number(min=0, min_open=True, max=180)
METRES = Number(min=0, min_open=True, max=1000)
ANGLE = Number(min=-360, max=360)
INTENSITY = Number(min=0, min_open=True, max=1e9)

radius_option = click.option(
    "--radius",
    type=Number(min=MIN_RADIUS, max=MAX_RADIUS),
    default=DEFAULT_CONFIG.radius_m,
    show_default=True,
    help="Radius of the poles, m: half their thickness, tape included.",
)

topic_option = click.option("--topic", metavar="NAME", help=TOPIC_HELP)


def sensor_options(command: Callable[..., int]) -> Callable[..., int]:
    """Give a command --sensor-* and --threshold-*, each for the target and the source."""
    for option in (
        click.option("--threshold-source", type=INTENSITY, help=SAME_FOR_SOURCE),
        click.option(
            "--threshold-target",
            type=INTENSITY,
            help="Intensity from which a return is retro-reflective, on the file's own scale.  "
            "[default: from the sensor or the cloud]",
        ),
        click.option(
            "--sensor-source",
            default=DEFAULT_CONFIG.sensor_source,
            show_default=True,
            help=SAME_FOR_SOURCE,
        ),
        click.option(
            "--sensor-target",
            default=DEFAULT_CONFIG.sensor_target,
            show_default=True,
            help=SENSOR_HELP,
        ),
    ):
        command = option(command)
    return command


def topic_options(command: Callable[..., int]) -> Callable[..., int]:
    """Give a command --target-topic and --source-topic."""
    of_target = click.option("--target-topic", metavar="NAME", help=TOPIC_HELP)
    of_source = click.option("--source-topic", metavar="NAME", help=SAME_FOR_SOURCE)
    return of_target(of_source(command))


def _slice(context: click.Context, option: click.Parameter, value: str | None) -> slice | None:
    """Turn ``A:B``, ``A:B:STEP`` or ``N`` into a slice."""
    if value is None:
        return None
    frames = frames_named(value)
    if frames is None:
        raise click.BadParameter(f"{value!r}: expected A:B, A:B:STEP or the number of a frame")
    return frames


frames_option = click.option(
    "--frames",
    callback=_slice,
    metavar="A:B",
    help="Frames of a recording to read, as Python slices: 0:20, -50:, ::10, 7.  "
    "[default: evenly spread, about a million points]",
)


max_points_option = click.option(
    "--max-points",
    type=click.IntRange(min=LEAST_POINTS),
    default=DEFAULT_CONFIG.max_points,
    show_default=True,
    help="Of a cloud with more points, read so many: fewer frames, or the brightest points and "
    "the others evenly.",
)


unit_option = click.option(
    "--unit",
    type=click.Choice(get_args(Unit)),
    default=DEFAULT_CONFIG.unit,
    show_default=True,
    help="Unit of the coordinates, where they are not metres; 'retropole info' tells.",
)


def unit_options(command: Callable[..., int]) -> Callable[..., int]:
    """Give a command --unit and --unit-source."""
    of_source = click.option(
        "--unit-source",
        type=click.Choice(get_args(Unit)),
        help="The same for SOURCE, where it is another.  [default: that of --unit]",
    )
    return unit_option(of_source(command))


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


def show(words: str | bytes) -> None:
    """Print what a command was asked for on stdout.

    Raises
    ------
    OSError
        Where it cannot be written; names the standard output.
    """
    try:
        click.echo(words, nl=isinstance(words, str) and not words.endswith("\n"))
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OSError(error.errno, error.strerror, "standard output") from None


VERDICT_COLOURS = {"ok": "green", "same": "green", "warn": "yellow", "cannot_tell": "yellow"}
VERDICT_COLOURS |= {"refused": "red", "moved": "red", "pass": "green", "fail": "red"}


def in_colour(words: str, status: str) -> str:
    """Colour the first line, the verdict, where stdout is a terminal that shows colours.

    Not where NO_COLOR is set (https://no-color.org).
    """
    dumb = os.environ.get("TERM") == "dumb"
    if os.environ.get("NO_COLOR") or dumb or not sys.stdout.isatty():
        return words
    verdict, line_end, rest = words.partition("\n")
    return click.style(verdict, fg=VERDICT_COLOURS.get(status), bold=True) + line_end + rest


def say(line: str) -> None:
    """Say something on stderr as one line; who cannot hear it gets the exit code all the same."""
    with suppress(OSError):
        click.echo(printable(line), err=True)


def read_input(
    path: Path,
    sensor_name: str,
    threshold: float | None,
    *,
    topic: str | None = None,
    frames: slice | None = None,
    max_points: int = DEFAULT_CONFIG.max_points,
    unit: Unit = DEFAULT_CONFIG.unit,
    quiet: bool = False,
    progress: Callable[[str], None] = lambda step: None,
) -> Input:
    """Read a cloud and look up its sensor; say on stderr what was left out unasked."""
    from ..api.inputs import read_input as read

    given = read(
        path,
        sensor=sensor_name,
        threshold=threshold,
        topic=topic,
        frames=frames,
        max_points=max_points,
        unit=unit,
        progress=progress,
    )
    if not quiet:
        echo_left_out(given, frames)
        echo_doubts(given)
    return given


def echo_doubts(given: Input) -> None:
    """Say on stderr what cannot be right: the unit of the coordinates, or the sensor's name."""
    from ..io.coordinates import oddity_of

    odd = oddity_of(given.cloud)
    if odd is not None:
        options = " or ".join(f"--unit {unit}" for unit in odd.units)
        advice = f"; if they are, read them with {options}" if options else ""
        say(f"retropole: {given.name}: {odd.words}{advice}")
    else:
        echo_sensor_doubt(given)


def echo_sensor_doubt(given: Input) -> None:
    """Say on stderr where a cloud is hardly of the sensor that was named."""
    from ..extraction.sensor_pattern import sensor_doubt
    from ..io.beam_origin import with_beam_origin
    from ..io.rings import with_trusted_rings

    if given.sensor is None:
        return
    doubt = sensor_doubt(with_beam_origin(with_trusted_rings(given.cloud)), given.sensor)
    if doubt:
        say(f"retropole: {doubt}")


def echo_left_out(
    given: Input,
    frames: slice | None,
    *,
    to_keep: str = "--max-points N",
    to_choose: str = "--frames A:B",
) -> None:
    """Say on stderr what of a recording is damaged, and what was left out unasked.

    Parameters
    ----------
    given, frames
        What was read, and which frames were asked for; None for none.
    to_keep, to_choose
        What a user gives to keep more points, and to read other frames.
    """
    read = given.read
    lines = list(given.cloud.notes)
    if read is not None and read.left_out:
        lines.append(
            f"read {len(read.numbers)} of {len(read.asked)} frames, one in "
            f"{read.numbers.step // read.asked.step}, since all have too many points; "
            f"{to_keep} reads more"
        )
    elif read is not None and frames is None and not read.is_whole:
        lines.append(
            f"read {len(read.numbers)} of {read.recording.count} frames, every "
            f"{read.numbers.step}th; {to_choose} reads others"
        )
    if given.cloud.thinned:
        lines.append(
            f"thinned from {len(given.cloud) + given.cloud.thinned:,} points to "
            f"{len(given.cloud):,}, the brightest kept; {to_keep} keeps more"
        )
    for line in lines:
        say(f"retropole: {given.name}: {line}")


def echo_refusal(code: str, message: str, *, advise: bool = True) -> None:
    """Say on stderr why there is no answer and, unless stdout does, what to do about it."""
    say(f"retropole: refused ({code}): {message}")
    explanation = explain(code) if advise else None
    lead = "what to do: "
    for action in explanation.advice if explanation else ():
        say(lead + plain(action))
        lead = " " * len(lead)
    if explanation:
        say(f"read on: documentation, {page(code)}")


def echo_warning(code: str, message: str) -> None:
    """Say on stderr what an answer warns of."""
    say(f"retropole: warning ({code}): {message}")


def command_line(*words: str | Path) -> str:
    """Write a command of retropole as it is typed, its words quoted for the shell."""
    typed = ["retropole"]
    # A file whose name begins as an option does is none.
    typed += [f"./{w}" if isinstance(w, Path) and f"{w}"[0] == "-" else f"{w}" for w in words]
    return list2cmdline(typed) if os.name == "nt" else shlex.join(typed)


@contextmanager
def progress_on_terminal(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Name the step under way on a terminal; say nothing in a pipe, where nobody waits.

    Long steps name their share of all: ``read drive.bag: frame, 12 of 40``.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda step: None
        return
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status("starting") as status:
        yield lambda step: status.update(escape(printable(step)))
