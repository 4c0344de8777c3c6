"""Pages and their pieces: templates filled with text, style and code, which run no other code."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from html import escape
from importlib.resources import files
from string import Template

PIECE = re.compile(r"^<!-- ([\w-]+) -->", re.MULTILINE)
"""What stands before each piece of `pieces.html`: its name."""


class Html(str):
    """Text that is markup. All other text is escaped where a template takes it in."""

    __slots__ = ()


EMPTY = Html("")
"""What a part of a page is that has nothing to say."""


def join(parts: Iterable[Html]) -> Html:
    """Put markup one behind the other."""
    return Html("".join(parts))


def fill(piece: str, /, **places: object) -> Html:
    """Fill the places of a piece in `pieces.html`; what is no `Html` is escaped.

    Numbers that are no integers are places in a picture, and have one digit behind the point.
    """
    return Html(_pieces()[piece].substitute({name: _markup(v) for name, v in places.items()}))


def _markup(value: object) -> str:
    if isinstance(value, Html):
        return value
    return f"{value:.1f}" if isinstance(value, float) else escape(str(value))


def fill_each(piece: str, values: Iterable[object]) -> Html:
    """Fill a piece with each of several values, as its ``$value``."""
    return join(fill(piece, value=value) for value in values)


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


@cache
def _asset(name: str) -> str:
    return (files("retropole.report") / "assets" / name).read_text(encoding="utf-8")


@cache
def _pieces() -> dict[str, Template]:
    _, *parts = PIECE.split(_asset("pieces.html"))
    pieces = zip(parts[::2], parts[1::2], strict=True)
    return {name: Template(markup.strip("\n")) for name, markup in pieces}


def _source_of(text: str) -> str:
    """Name a script or a style by its hash: the page runs these and no others."""
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"
