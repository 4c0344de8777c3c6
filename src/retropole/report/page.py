"""A page of its own: a template filled with text, style and code, which runs no other code."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from string import Template


def fill_page(
    template: str,
    styles: Sequence[str],
    scripts: Sequence[str],
    parts: Mapping[str, str],
    style: str = "",
) -> str:
    """Fill a template of the assets, the body of a page.

    Parameters
    ----------
    template, styles, scripts
        Names of files of the assets; style and code go into the page in this order.
    parts
        HTML, by the names of the template's places; `title` is also that of the page, and `status`,
        where there is one, an attribute of its root.
    style
        More style, behind that of the files.
    """
    sheet = "".join(map(_asset, styles)) + style
    code = [_asset(name) for name in scripts]
    return Template(_asset("page.html")).substitute(
        attributes=f' data-status="{parts["status"]}"' if "status" in parts else "",
        title=parts["title"],
        body=Template(_asset(template)).substitute(parts),
        style=sheet,
        style_hash=_source_of(sheet),
        scripts="\n".join(f"<script>{text}</script>" for text in code),
        script_hashes=" ".join(map(_source_of, code)),
    )


def _asset(name: str) -> str:
    return (files("retropole.report") / "assets" / name).read_text(encoding="utf-8")


def _source_of(text: str) -> str:
    """Name a script or a style by its hash: the page runs these and no others."""
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"
