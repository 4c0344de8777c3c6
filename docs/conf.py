"""Sphinx: python -m sphinx -W docs docs/_build. Reads nothing from the network."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util.inspect import TypeAliasForwardRef

import retropole

project = "retropole"
author = "The retropole authors"
project_copyright = author
version = release = retropole.__version__

# Pages that only include a file from above this folder: in a clone that file itself is read.
source_suffix = {".rst": "restructuredtext", ".md": "markdown", ".inc": "markdown"}
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


def outside(app: Sphinx, page: str, source: list[str]) -> None:
    """Turn links to files above this folder to the pages that include them."""
    source[0] = re.sub(
        r"\]\((?:\.\./)+(CHANGELOG|CONTRIBUTING|SECURITY)\.md",
        lambda found: f"](/{found[1].lower()}.inc",
        source[0],
    )


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
    """Register the way equations are written."""
    app.add_html_math_renderer("mathml", (equation("inline"), None), (equation("block"), None))
    app.connect("source-read", outside)
    app.connect("autodoc-process-signature", no_made_up_arguments)
    return {"parallel_read_safe": True}
