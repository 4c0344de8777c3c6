"""Write what pages take from the program: reasons, commands, options, modules, sensors, packets.

python docs/make_pages.py
python docs/make_pages.py --check

Each stands in its page between ``<!-- NAME -->`` and ``<!-- end of NAME -->``, so that a clone
shows it as the built pages do. A test compares what is there with what this writes.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import numpy as np

import retropole
from retropole.base.reasons import Explanation, tables
from retropole.base.sensors import SENSORS, Sensor
from retropole.cli import cli
from retropole.cli.options import HELP_ALL, NAMES, typed
from retropole.io.packets.models import MODELS
from retropole.result import DEFAULT_CONFIG
from retropole.result.options import OPTIONS, PAIRS

DOCS = Path(__file__).parent
HELP_WIDTH = 92
"""Of the help of commands, characters."""

SHARED = 3
"""Commands that have an option, from which on the page lists it once."""


def table(head: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> str:
    """A table of Markdown."""
    return "".join(f"| {' | '.join(row)} |\n" for row in (head, ("---",) * len(head), *rows))


def reason_entries() -> str:
    """Every reason code with its explanation."""

    def entry(code: str, text: Explanation) -> str:
        actions = "".join(f"- {action}\n" for action in text.advice)
        return f"### {code}\n\n{text.title}. {text.help}\n\n{actions}\n"

    parts = []
    for group in tables().groups.values():
        entries = [entry(code, text) for code, text in group.reasons.items()]
        if group.title == "Check":
            entries += [entry(f"{prefix}_", text) for prefix, text in tables().prefixes.items()]
        parts += [f"## {group.title}\n\n{group.introduction}\n\n", *entries]
    return "".join(parts)


def command_entries() -> str:
    """Every command's whole help, but options of several commands once."""
    top = click.Context(cli, info_name="retropole", **cli.context_settings)
    commands: list[tuple[str, click.Context]] = []
    for name, command in sorted(cli.commands.items()):
        context = click.Context(command, parent=top, info_name=name, show_default=True)
        commands.append((name, context))
        inner = command.commands if isinstance(command, click.Group) else {}
        for sub in sorted(inner):
            below = click.Context(inner[sub], parent=context, info_name=sub, show_default=True)
            commands.append((f"{name} {sub}", below))
    for _, context in commands:
        context.terminal_width = HELP_WIDTH
        context.meta[HELP_ALL] = True

    def record(context: click.Context, option: click.Parameter) -> tuple[str, str] | None:
        return option.get_help_record(context) if isinstance(option, click.Option) else None

    found = Counter(record(context, each) for _, context in commands for each in options(context))
    shared: dict[str, tuple[str, str]] = {}
    for one, n in found.most_common():
        if one and n >= SHARED:
            shared.setdefault(one[0], one)
    parts = []
    for name, context in commands:
        left_out = [
            each
            for each in options(context)
            if (one := record(context, each)) and one in shared.values()
        ]
        names = ", ".join(f"`{each.opts[-1]}`" for each in left_out if "help" not in each.name)
        also = f"Common options: {names}.\n\n" if names else ""
        for each in left_out:
            each.hidden = True
        text = context.command.get_help(context)
        for each in left_out:
            each.hidden = False
        parts.append(f"## {name}\n\n```text\n{text}\n```\n\n{also}")
    form = click.HelpFormatter(width=HELP_WIDTH)
    form.write_dl(sorted(shared.values()))
    return f"## Common options\n\n```text\n{form.getvalue()}```\n\n{''.join(parts)}"


def options(context: click.Context) -> list[click.Option]:
    """Options of a command, with that of its help."""
    every = context.command.get_params(context)
    return [each for each in every if isinstance(each, click.Option)]


def option_rows() -> str:
    """Every field of the options of a run, with the option."""
    both = {field: f"--{pair.name}" for pair in PAIRS.values() for field in pair[1:3]}

    def rows() -> Iterator[tuple[str, ...]]:
        for field in OPTIONS:
            name = both.get(field) or NAMES.get(field) or typed(field)
            default = f"`{getattr(DEFAULT_CONFIG, field)!r}`"
            yield f"`{field}`", default, f"`{name}`"

    return table(("field", "default", "option"), rows())


def first_line(path: Path) -> str:
    """First sentence of a module's docstring, in one line."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(text.partition("\n\n")[0].split()).replace("|", "\\|").replace("``", "`")


def module_rows() -> str:
    """Every page of the reference, and what it has: the module of its name, or its first."""
    package = Path(retropole.__file__).parent
    pages = re.findall(r"^(\w+)$", (DOCS / "api" / "index.md").read_text(encoding="utf-8"), re.M)

    def rows() -> Iterator[tuple[str, ...]]:
        for page in pages:
            text = (DOCS / "api" / f"{page}.rst").read_text(encoding="utf-8")
            found = re.findall(r"^\.\. automodule:: retropole\.(\S+)", text, flags=re.M)
            name = page if page in found else found[0]
            path = package.joinpath(*name.split("."))
            path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
            yield f"[{page}]({page}.rst)", first_line(path)

    return table(("page", "has"), rows())


def sensor_rows() -> str:
    """The table of sensors."""

    def rows() -> Iterator[tuple[str, ...]]:
        for sensor in SENSORS.values():
            low, high = np.degrees(sensor.elevation_span)
            yield (
                sensor.name,
                scan_lines(sensor),
                f"{low:+.1f}° to {high:+.1f}°",
                "all" if sensor.sees_all_around else f"{np.degrees(sensor.turn):.0f}°",
                f"{np.degrees(sensor.azimuth_step):.2f}°" if sensor.azimuth_step else "none",
                f"{1000 * sensor.range_noise:g}",
                f"{sensor.seconds:g}" if sensor.sweeps > 1 else "a sweep",
                f"{sensor.threshold:g}",
                sensor.threshold_source,
                sensor.source,
            )

    names = "sensor", "rings", "elevation", "azimuth", "step", "noise mm", "record s", "threshold"
    return table((*names, "its source", "source"), rows())


def scan_lines(sensor: Sensor) -> str:
    """How many scan lines a sensor has, and whether they are rings."""
    if sensor.pattern == "rosette":
        return "rosette"
    return f"{len(sensor.elevations)}{'' if sensor.is_numbered else ', not numbered'}"


def model_rows() -> str:
    """The table of models whose packets are read."""

    def rows() -> Iterator[tuple[str, ...]]:
        for model in MODELS:
            yield (
                model.title,
                str(len(model.elevation_deg) or "–"),
                str(model.port),
                ", ".join(map(str, model.sizes)),
                f"{model.range_m[0]:g} to {model.range_m[1]:g} m",
                model.tried or "–",
            )

    names = "model", "channels", "UDP port", "bytes of a packet", "range kept", "real packets tried"
    return table(names, rows())


PARTS: dict[str, tuple[str, Callable[[], str]]] = {
    "reasons": ("reasons.md", reason_entries),
    "commands": ("commands.md", command_entries),
    "options": ("commands.md", option_rows),
    "modules": ("api/index.md", module_rows),
    "sensors": ("sensors.md", sensor_rows),
    "models": ("formats.md", model_rows),
}
"""By the name in its comments: the page, and what writes the part."""


def fresh(name: str) -> str:
    """A page with its part as the program says it now."""
    page, write = PARTS[name]
    text = (DOCS / page).read_text(encoding="utf-8")
    head, _, rest = text.partition(f"<!-- {name} -->\n")
    _, end, tail = rest.partition(f"<!-- end of {name} -->")
    if not end:
        raise SystemExit(f"{page} has no place for {name}")
    return f"{head}<!-- {name} -->\n{write().strip()}\n{end}{tail}"


def main() -> None:
    """Write the parts, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; say what is stale")
    is_check = parser.parse_args().check
    stale = 0
    for name, (page, _) in PARTS.items():
        path, text = DOCS / page, fresh(name)
        is_fresh = path.read_text(encoding="utf-8") == text
        stale += not is_fresh
        print(f"{page}: {name} {'fresh' if is_fresh else 'stale' if is_check else 'written'}")
        if not is_fresh and not is_check:
            path.write_text(text, encoding="utf-8")
    raise SystemExit(int(bool(stale) and is_check))


if __name__ == "__main__":
    main()
