"""Options of commands, those of a run made of the fields of `RunConfig`: bounds and help are there.

A command takes them by these fields: ``RunConfig(**options)``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import click
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
from .brief import Option, more_option

Command = Callable[..., int]

CLOUD = click.Path(path_type=Path)
FILE = click.Path(path_type=Path, dir_okay=False)
OUT = click.Path(path_type=Path, file_okay=False)


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
    """A radius in metres: who types millimetres is told what to give."""

    def convert(self, value: Any, *of: Any) -> float:
        """Take a number as `Number` does."""
        with suppress(ValueError):
            if words := radius_in_metres(float(value)):
                self.fail(f"{words}.", *of)
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
    "hypothesis": "LETTER",
    "sensor_target": "NAME",
    "target_topic": "NAME",
    "frames": "A:B",
    "intensity": "NAME",
    "angles": "FILE",
}
"""What stands for the values of options in the help, where their type says too little."""

NAMES = {"need_m": "--need-cm", "at_m": "--at-m", "refine": "--no-refine"}
"""Options that are not called as their fields without the unit."""

SENSORS = PAIRS["sensor"], PAIRS["threshold"]
TOPICS = (PAIRS["topic"],)
WANTED = PAIRS["intensity"], PAIRS["angles"]
READING = PAIRS["unit"], *WANTED

AUTO = "auto"
"""Stands for a LiDAR of a `Both` that has no value of its own."""


class Both(Option):
    """An option of both LiDARs: given once for both, or for TARGET and again for SOURCE.

    It is repeated rather than split at a comma: paths may hold one, ``1,5`` is a number to many,
    and a shell completes each value on its own. Options that were of one LiDAR each still work.
    """

    def __init__(self, *names: Any, pair: Pair, **settings: Any) -> None:
        super().__init__(*names, multiple=True, expose_value=False, callback=_to_fields, **settings)
        self.pair = pair

    def add_to_parser(self, parser: Any, ctx: click.Context) -> None:
        """Have it parsed, and the older options."""
        super().add_to_parser(parser, ctx)
        for field in {self.pair.target, self.pair.source} - {self.name}:
            parser.add_option(obj=self, opts=[_typed(field)], dest=field)

    def handle_parse_result(
        self, ctx: click.Context, opts: Mapping[str, Any], args: list[str]
    ) -> tuple[Any, list[str]]:
        """Put what older options say to the values."""
        given, pair = list(opts.get(self.name or "") or ()), self.pair
        first = None if pair.target == self.name else opts.get(pair.target)
        second = opts.get(pair.source)
        if first is not None or second is not None:
            if len(given) > 1 or (given and first is not None):
                raise click.UsageError(f"{self.opts[0]} is for TARGET and again for SOURCE", ctx)
            opts = {**opts, self.name or "": [*[*given, first][:1], second]}
        return super().handle_parse_result(ctx, opts, args)

    def type_cast_value(self, ctx: click.Context, value: Any) -> Any:
        """Take one value or two; None for what has none of its own."""
        return tuple(
            None if each in (None, AUTO) else self.type(each, self, ctx) for each in value or ()
        )


def _to_fields(context: click.Context, option: click.Parameter, values: tuple[Any, ...]) -> None:
    assert isinstance(option, Both)
    if values:
        context.params |= option.pair.fields(*values)


def placement_arguments(command: Command) -> Command:
    """Give a command TARGET and SOURCE, and --placement instead for each of several placements."""
    placement = click.option(
        "--placement",
        "placements",
        type=(CLOUD, CLOUD),
        multiple=True,
        metavar="TARGET SOURCE",
        help="Instead of TARGET and SOURCE: one placement of the poles of several; repeat it.",
    )
    target, source = (click.argument(n, type=CLOUD, required=False) for n in ("target", "source"))
    return target(source(placement(command)))


def verdict_options(more: str) -> Callable[[Command], Command]:
    """Give a command --strict, --json, --verbose, which prints more, and --quiet."""
    strict = more_option("--strict", is_flag=True, help="Exit with 1 where the verdict is warn.")
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
    """Make a command's option of a field of `RunConfig`, or of a pair of them.

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
    if isinstance(field, Pair):
        return _both(field, changes)
    name = name or NAMES.get(field, _typed(field.removesuffix("_m")))
    return click.option(name, field, **_settings(field) | changes)


def _both(pair: Pair, changes: dict[str, Any]) -> Callable[[Command], Command]:
    """Make an option of both LiDARs."""
    name = next(name for name, each in PAIRS.items() if each == pair)
    settings = _settings(pair.target) | {"cls": Both, "pair": pair, "default": None} | changes
    words, mark, default = settings["help"].partition("  [default")
    once = "" if name != "angles" else "Once: TARGET's. "
    settings["help"] = f"{words} {once}Twice: TARGET's, then SOURCE's.{mark}{default}"
    return click.option(_typed(name), name, **settings)


def _typed(field: str) -> str:
    return f"--{field.replace('_', '-')}"


def _settings(field: str) -> dict[str, Any]:
    """Say what the option of a field of `RunConfig` is, as `Option` takes it."""
    kind, words, is_rare = OPTIONS[field]
    default = getattr(DEFAULT_CONFIG, field)
    settings = {"cls": Option, "more": is_rare, "help": words, "default": default}
    settings["metavar"] = METAVARS.get(field)
    if isinstance(kind, inspect.BoolType):
        return settings | {"is_flag": True, "flag_value": not default, "show_default": False}
    if field == "frames":
        settings["callback"] = _frames
    if field == "sensor_target":
        settings["shell_complete"] = _sensors
    return settings | {"type": _type(field, kind)}


def _sensors(context: click.Context, option: click.Parameter, incomplete: str) -> list[Any]:
    """Complete the name of a sensor, or of a file that describes one."""
    names = [name for name in KNOWN_SENSORS if name.lower().startswith(incomplete.lower())]
    return names or [CompletionItem(incomplete, type="file")]


def run_options(*fields: str | Pair, **changes: Any) -> Callable[[Command], Command]:
    """Give a command the options of several fields of `RunConfig` or pairs, in this order."""

    def add(command: Command) -> Command:
        for field in reversed(fields):
            command = run_option(field, **changes)(command)
        return command

    return add


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
            return (number,) * 3 if field == "prior_rpy_deg" else number
    return click.Path() if field == "angles" else None
