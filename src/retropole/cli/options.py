"""Options of commands, those of a run made of the fields of `RunConfig`: bounds and help are there.

A command takes them by these fields: ``RunConfig(**options)``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import click
from msgspec import inspect

from ..result import DEFAULT_CONFIG
from ..result.options import LARGEST_WHOLE, OPTIONS, UNITS, Frames, frames_named, radius_in_metres

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
    "prior_xyz": "E N H",
    "hypothesis": "LETTER",
    "target_topic": "NAME",
    "source_topic": "NAME",
    "frames": "A:B",
    "intensity": "NAME",
    "intensity_source": "NAME",
    "angles": "FILE",
    "angles_source": "FILE",
}
"""What stands for the values of options in the help, where their type says too little."""

NAMES = {
    **{"need_m": "--need-cm", "at_m": "--at-m", "refine": "--no-refine"},
    "prior_sigma_m": "--prior-sigma-m",
}
"""Options that are not called as their fields without the unit."""

SENSORS = ("sensor_target", "sensor_source", "threshold_target", "threshold_source")
TOPICS = ("target_topic", "source_topic")
WANTED = ("intensity", "intensity_source", "angles", "angles_source")
READING = ("unit", "unit_source", *WANTED)


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
    strict = click.option("--strict", is_flag=True, help="Exit with 1 where the verdict is warn.")
    as_json = click.option(
        "--json", "as_json", is_flag=True, help="Print the result document, and only that."
    )
    verbose = click.option("-v", "--verbose", is_flag=True, help=f"Print {more} as well.")
    quiet = click.option(
        "-q", "--quiet", is_flag=True, help="Print nothing but warnings and errors."
    )
    return lambda command: strict(as_json(verbose(quiet(command))))


def run_option(field: str, name: str | None = None, **changes: Any) -> Callable[[Command], Command]:
    """Make a command's option of a field of `RunConfig`.

    Parameters
    ----------
    field
        Of `RunConfig`; the command gets the value under this name.
    name
        Another name than the field's: ``--sensor``.
    changes
        What is another here, as `click.option` takes it.
    """
    kind, words = OPTIONS[field]
    name = name or NAMES.get(field, f"--{field.removesuffix('_m').replace('_', '-')}")
    default = getattr(DEFAULT_CONFIG, field)
    settings = {"help": words, "metavar": METAVARS.get(field), "default": default}
    if isinstance(kind, inspect.BoolType):
        settings |= {"is_flag": True, "flag_value": not default, "show_default": False}
    else:
        settings["type"] = _type(field, kind)
    if field == "frames":
        settings["callback"] = _frames
    return click.option(name, field, **settings | changes)


def run_options(*fields: str) -> Callable[[Command], Command]:
    """Give a command the options of several fields of `RunConfig`, in this order."""

    def add(command: Command) -> Command:
        for field in reversed(fields):
            command = run_option(field)(command)
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
            return (number,) * 3 if field in ("prior_rpy_deg", "prior_xyz") else number
    return None
