"""Sphinx: python -m sphinx -W docs docs/_build. Reads nothing from the network."""

from __future__ import annotations

from typing import Any

import click
import numpy as np
from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.inspect import TypeAliasForwardRef

import retropole
from retropole.base.reasons import Explanation, tables
from retropole.base.sensors import SENSORS, Sensor
from retropole.cli import cli
from retropole.io.packets.models import MODELS

project = "retropole"
author = "The retropole authors"
project_copyright = author
version = release = retropole.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "README.md"]
default_role = "py:obj"

napoleon_google_docstring = False
napoleon_use_ivar = True
# Attributes of several classes have one name, and napoleon refers to each by that alone.
suppress_warnings = ["ref.python"]
autodoc_member_order = "bysource"
autodoc_type_aliases = {name: name for name in ("Array", "IntArray", "BoolArray")}
# Inside other types, as in a union, an alias is written by its repr.
TypeAliasForwardRef.__repr__ = lambda self: self.name
python_use_unqualified_type_names = True
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = "retropole"
html_static_path = ["_static"]
html_css_files = ["retropole.css"]
html_copy_source = False
html_show_sphinx = False
html_math_renderer = "mathml"


class Commands(SphinxDirective):
    """Every command's own help, as the installed command line prints it."""

    def run(self) -> list[nodes.Node]:
        """Make one section per command."""
        sections: list[nodes.Node] = []
        commands: list[tuple[str, click.Command]] = []
        for name, command in sorted(cli.commands.items()):
            inner = command.commands if isinstance(command, click.Group) else {}
            commands += [(name, command), *((f"{name} {sub}", inner[sub]) for sub in sorted(inner))]
        for name, command in commands:
            context = click.Context(command, info_name=f"retropole {name}", show_default=True)
            context.max_content_width = 92
            section = nodes.section(ids=[name.replace(" ", "-")], names=[name])
            section += nodes.title(text=name)
            block = nodes.literal_block(text=command.get_help(context))
            block["language"] = "text"
            section += block
            sections.append(section)
        return sections


def reason_entries() -> str:
    """Write every reason code with its explanation, from the program's own table."""

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


def sensor_rows() -> str:
    """Write the table of sensors, from the program's own."""
    names = "sensor", "rings", "elevation", "azimuth", "step", "noise mm", "record s", "threshold"
    names += "its source", "source"
    lines = [" | ".join(names), " | ".join(["---"] * len(names))]
    for sensor in SENSORS.values():
        low, high = np.degrees(sensor.elevation_span)
        cells = (
            sensor.name,
            _lines(sensor),
            f"{low:+.1f}° to {high:+.1f}°",
            "all" if sensor.sees_all_around else f"{np.degrees(sensor.turn):.0f}°",
            f"{np.degrees(sensor.azimuth_step):.2f}°" if sensor.azimuth_step else "none",
            f"{1000 * sensor.range_noise:g}",
            f"{sensor.seconds:g}" if sensor.sweeps > 1 else "a sweep",
            f"{sensor.threshold:g}",
            sensor.threshold_source,
            sensor.source,
        )
        lines.append(" | ".join(cells))
    return "".join(f"| {line} |\n" for line in lines)


def _lines(sensor: Sensor) -> str:
    """How many scan lines a sensor has, and whether they are rings."""
    if sensor.pattern == "rosette":
        return "rosette"
    return f"{len(sensor.elevations)}{'' if sensor.is_numbered else ', not numbered'}"


def model_rows() -> str:
    """Write the table of models whose packets are read, from the program's own."""
    names = "model", "channels", "UDP port", "bytes of a packet", "range kept", "tried on", "source"
    lines = [" | ".join(names), " | ".join(["---"] * len(names))]
    for model in MODELS:
        cells = (
            model.title,
            str(len(model.elevation_deg) or "–"),
            str(model.port),
            ", ".join(map(str, model.sizes)),
            f"{model.range_m[0]:g} to {model.range_m[1]:g} m",
            model.tried or "no real packets",
            model.source,
        )
        lines.append(" | ".join(cells))
    return "".join(f"| {line} |\n" for line in lines)


TABLES = {
    "<!-- reasons -->": reason_entries,
    "<!-- sensors -->": sensor_rows,
    "<!-- models -->": model_rows,
}
"""What stands in a page for a table of the program, and what writes it."""


def with_tables(app: Sphinx, page: str, source: list[str]) -> None:
    """Put the program's tables into a page before it is parsed."""
    for mark, write in TABLES.items():
        if mark in source[0]:
            source[0] = source[0].replace(mark, write())


def equation(display: str) -> Any:
    """Make a visitor that writes an equation as MathML, which browsers set without any script."""

    def visit(translator: Any, node: nodes.Element) -> None:
        written = convert(node.astext(), display=display)
        if display == "block":
            written = f'<div class="math">{written}</div>'
        translator.body.append(written)
        raise nodes.SkipNode

    return visit


def no_made_up_arguments(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, given: str | None, back: str | None
) -> tuple[str | None, str | None] | None:
    """Show protocols without the arguments that Python makes up for them: none is ever made."""
    return (None, None) if what == "class" and given == "(*args, **kwargs)" else None


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive and the way equations are written."""
    app.add_directive("commands", Commands)
    app.add_html_math_renderer("mathml", (equation("inline"), None), (equation("block"), None))
    app.connect("autodoc-process-signature", no_made_up_arguments)
    app.connect("source-read", with_tables)
    return {"parallel_read_safe": True}
