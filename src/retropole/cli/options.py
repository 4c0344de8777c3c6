"""Options of commands, those of a run made of the fields of `RunConfig`: bounds and help are there.

A command takes them by these fields: ``RunConfig(**options)``. Its --help lists those that many
need, and --help-all all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from inspect import cleandoc
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem
from msgspec import inspect

from ..base.sensors import SENSORS as KNOWN_SENSORS
from ..result import DEFAULT_CONFIG
from ..result.options import (
    LARGEST_WHOLE,
    OPTIONS,
    PAIRS,
    UNITS,
    Frames,
    Pair,
    frames_named,
    radius_in_metres,
)

Command = Callable[..., int]

CLOUD = click.Path(path_type=Path)
FILE = click.Path(path_type=Path, dir_okay=False)
OUT = click.Path(path_type=Path, file_okay=False)


HELP_ALL = "retropole.help-all"
"""Set in a context's `meta` where the whole help is wanted."""


class Option(click.Option):
    """An option; with `more`, --help-all alone lists it."""

    def __init__(self, *names: Any, more: bool = False, **settings: Any) -> None:
        super().__init__(*names, **settings)
        self.more = more

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Give what the help lists, where it does."""
        return None if self.more and HELP_ALL not in ctx.meta else super().get_help_record(ctx)


more_option = partial(click.option, cls=Option, more=True)
"""Make an option that --help-all alone lists."""


class Brief(click.Command):
    """A command whose --help ends at a form feed in its text; --help-all shows the rest as well."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        description = "Show all options and examples, and exit."
        flag: dict[str, Any] = {"is_flag": True, "is_eager": True, "expose_value": False}
        more_option("--help-all", callback=_all, help=description, **flag)(self)

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the text, up to the form feed, or whole."""
        first, _, rest = cleandoc(self.help or "").partition("\f\n")
        formatter.write_paragraph()
        with formatter.indentation():
            formatter.write_text(first + rest if HELP_ALL in ctx.meta else first)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, and how many more there are."""
        super().format_options(ctx, formatter)
        # The option that shows them is not included.
        more = sum(getattr(each, "more", False) for each in self.params) - 1
        if more and HELP_ALL not in ctx.meta:
            formatter.write(f"\n--help-all: {more} more\n")


def _all(context: click.Context, option: click.Parameter, is_wanted: bool) -> None:
    if is_wanted and not context.resilient_parsing:
        context.meta[HELP_ALL] = True
        click.echo(context.get_help())
        context.exit()


class Whole(click.IntRange):
    """A whole number within bounds, which every error names: click does where it is a number."""

    name = "integer"

    def convert(self, value: Any, *of: Any) -> int:
        """Take a number as click does."""
        try:
            int(value)
        except ValueError:
            self.fail(f"{value!r} is no whole number in the range {self._describe_range()}.", *of)
        return int(super().convert(value, *of))


class Number(click.FloatRange):
    """A finite number within bounds: click lets nan through any, and inf where there is none.

    It is typed in one unit and made another inside, as `into` does.
    """

    name = "number"

    def __init__(self, into: Callable[[float], float] = float, **bounds: Any) -> None:
        super().__init__(**bounds)
        self.into = into

    def convert(self, value: Any, *of: Any) -> float:
        """Take a number as click does, but no nan."""
        try:
            is_number = not math.isnan(float(value))
        except ValueError:
            is_number = False
        if not is_number:
            self.fail(f"{value!r} is no number in the range {self._describe_range()}.", *of)
        return self.into(float(super().convert(value, *of)))


class Radius(Number):
    """A radius in metres: who types millimetres gets a hint of what to give."""

    def convert(self, value: Any, *of: Any) -> float:
        """Take a number as `Number` does."""
        with suppress(ValueError):
            if description := radius_in_metres(float(value)):
                self.fail(f"{description}.", *of)
        return super().convert(value, *of)


def metres(centimetres: float) -> float:
    """Give a length in metres."""
    return centimetres / 100


def _frames(context: click.Context, option: click.Parameter, value: str | None) -> Frames | None:
    """Turn ``A:B``, ``A:B:STEP`` or ``N`` into start, stop and step."""
    if value is None:
        return None
    frames = frames_named(value)
    if frames is None:
        raise click.BadParameter(
            f"{value!r}: expected A:B, A:B:STEP or the number of a frame, none "
            f"beyond {LARGEST_WHOLE}"
        )
    return frames.start, frames.stop, frames.step


SEED = Whole(0, LARGEST_WHOLE)

DEGREES = Number(math.radians, min=0, min_open=True, max=180)
"""An angle, which is radians inside."""

METRES = Number(min=0, min_open=True, max=1000)

METAVARS = {
    "prior_rpy_deg": "R P Y",
    "prior_xyz": "E N H",
    "hypothesis": "LETTER",
    "sensor_target": "NAME",
    "target_topic": "NAME",
    "frames": "A:B",
    "intensity": "NAME",
    "angles": "FILE",
}
"""Names of the values of options in the help, where their type is too vague."""

NAMES = {
    "need_m": "--need-cm",
    "at_m": "--at-m",
    "refine": "--no-refine",
    "map_sigma_m": "--map-sigma-m",
    "prior_sigma_m": "--prior-sigma-m",
}
"""Options that are not called as their fields without the unit."""

SENSORS = PAIRS["sensor"], PAIRS["threshold"]
TOPICS = (PAIRS["topic"],)
WANTED = PAIRS["intensity"], PAIRS["angles"]
READING = PAIRS["unit"], *WANTED


class Both(Option):
    """An option of both LiDARs: given once for both, or for TARGET and again for SOURCE.

    It is repeated rather than split at a comma: paths may hold one, ``1,5`` is a number to many,
    and a shell completes each value separately. Options that were of one LiDAR each still work.
    """

    def __init__(self, *names: Any, pair: Pair, **settings: Any) -> None:
        super().__init__(*names, multiple=True, expose_value=False, **settings)
        self.pair = pair

    def add_to_parser(self, parser: Any, ctx: click.Context) -> None:
        """Have it parsed, and the older options."""
        super().add_to_parser(parser, ctx)
        for field in {self.pair.target, self.pair.source} - {self.name}:
            parser.add_option(obj=self, opts=[typed(field)], dest=field)

    def handle_parse_result(
        self, ctx: click.Context, opts: Mapping[str, Any], args: list[str]
    ) -> tuple[Any, list[str]]:
        """Give the command the fields, where either has a value; ``auto`` is none."""
        pair, given = self.pair, list(opts.get(self.pair.name) or ())
        older = [None if pair.target == pair.name else opts.get(pair.target), opts.get(pair.source)]
        if any(each is not None for each in older):
            if len(given) > 1 or (given and older[0] is not None):
                raise click.UsageError(
                    f"{self.opts[0]} can be given twice: for TARGET, then for SOURCE", ctx
                )
            given = [given[0] if given else older[0], older[1]]
        if given and not ctx.resilient_parsing:
            ctx.set_parameter_source(pair.name, ParameterSource.COMMANDLINE)
            values = (None if v in (None, "auto") else self.type(v, self, ctx) for v in given)
            ctx.params |= pair.fields(*values)
        return None, args


def placement_arguments(command: Command) -> Command:
    """Give a command TARGET and SOURCE, and --placement instead for each of several placements."""
    placement = click.option(
        "--placement",
        "placements",
        type=(CLOUD, CLOUD),
        multiple=True,
        metavar="TARGET SOURCE",
        help="Instead of TARGET and SOURCE: one of several placements of the poles; repeat it.",
    )
    target, source = (click.argument(n, type=CLOUD, required=False) for n in ("target", "source"))
    return target(source(placement(command)))


def verdict_options(more: str) -> Callable[[Command], Command]:
    """Give a command --strict, --json, --verbose, which prints more, and --quiet."""
    strict = more_option("--strict", is_flag=True, help="Exit with 1 if the verdict is warn.")
    as_json = click.option(
        "--json", "as_json", is_flag=True, help="Print the result document, and only that."
    )
    verbose = more_option("-v", "--verbose", is_flag=True, help=f"Print {more} as well.")
    quiet = more_option(
        "-q", "--quiet", is_flag=True, help="Print nothing but warnings and errors."
    )
    return lambda command: strict(as_json(verbose(quiet(command))))


def run_option(
    field: str | Pair, name: str | None = None, **changes: Any
) -> Callable[[Command], Command]:
    """Make a command's option of a field of `RunConfig`, or of a pair of fields.

    Parameters
    ----------
    field
        Of `RunConfig`; the command gets the value under this name. Those of a pair it gets where
        either is given.
    name
        Another name than the field's: ``--sensor``.
    changes
        What is another here, as `Option` takes it.
    """
    of = field.target if isinstance(field, Pair) else field
    kind, description, is_rare = OPTIONS[of]
    default = getattr(DEFAULT_CONFIG, of)
    settings: dict[str, Any] = {"cls": Option, "more": is_rare, "metavar": METAVARS.get(of)}
    if isinstance(kind, inspect.BoolType):
        settings |= {"is_flag": True, "flag_value": not default, "show_default": False}
    else:
        settings["type"] = _type(of, kind)
    if of == "frames":
        settings["callback"] = _frames
    if of == "sensor_target":
        settings["shell_complete"] = _sensors
    settings |= {"help": description, "default": default} | changes
    if not isinstance(field, Pair):
        return click.option(name or NAMES.get(field) or typed(field), field, **settings)
    described, mark, default = settings["help"].partition("  [default")
    once = "Once: TARGET's. " if field.name == "angles" else ""
    description = f"{described} {once}Twice: TARGET's, then SOURCE's.{mark}{default}"
    settings |= {"cls": Both, "pair": field, "default": None, "help": description}
    return click.option(f"--{field.name}", field.name, **settings)


def typed(field: str) -> str:
    """Write the name of a field as its option."""
    return f"--{field.removesuffix('_m').replace('_', '-')}"


def run_options(*fields: str | Pair, **changes: Any) -> Callable[[Command], Command]:
    """Give a command the options of several fields of `RunConfig` or pairs, in this order."""

    def add(command: Command) -> Command:
        for field in reversed(fields):
            command = run_option(field, **changes)(command)
        return command

    return add


def _sensors(context: click.Context, option: click.Parameter, incomplete: str) -> list[Any]:
    """Complete the name of a sensor, or of a file that describes one."""
    names = [name for name in KNOWN_SENSORS if name.lower().startswith(incomplete.lower())]
    return names or [CompletionItem(incomplete, type="file")]


def _type(field: str, kind: inspect.Type) -> Any:
    """Give the type of an option on the command line, with the bounds of its field."""
    match kind:
        case inspect.LiteralType():
            return click.Choice(UNITS)
        case inspect.IntType() if field != "frames":
            return Whole(kind.ge, kind.le)
        case inspect.FloatType():
            into, scale = (metres, 100) if field == "need_m" else (float, 1)
            assert kind.le is not None
            least = kind.gt if kind.ge is None else kind.ge
            number = (Radius if field == "radius_m" else Number)(
                into, min=least, min_open=kind.ge is None, max=scale * kind.le
            )
            return (number,) * 3 if field in ("prior_rpy_deg", "prior_xyz") else number
    return click.Path() if field == "angles" else None
