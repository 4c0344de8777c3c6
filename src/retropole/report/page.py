"""Pages and their pieces: templates filled with text, style and code, which run no other code.

Whatever the pieces are given is escaped.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache
from html import escape
from importlib.resources import files
from string import Template

from ..base.errors import visible
from ..base.quantities import UNKNOWN, error
from ..base.reasons import unlinked
from .listings import Listing

PIECE = re.compile(r"^<!-- ([\w-]+) -->", re.MULTILINE)
"""What is before each piece of `pieces.html`: its name."""


NO_BREAK = "\u00a0"

CODE = re.compile(r"`([^`]+)`")
EMPHASIS = re.compile(r"\*([^*\s][^*]*)\*")

SHOWN = 12
"""Number of rows of a long table that are shown at once, the worst first; the page unfolds the
others."""


class Html(str):
    """Text that is markup. All other text is escaped where a template takes it in."""

    __slots__ = ()


EMPTY = Html("")
"""What a part of a page is that has nothing to say."""


def join(parts: Iterable[Html]) -> Html:
    """Concatenate markup."""
    return Html("".join(parts))


def fill(piece: str, /, **places: object) -> Html:
    """Fill the places of a piece in `pieces.html`; what is no `Html` is escaped, and visible.

    Numbers that are not integers are places in a picture, and have one digit behind the point.
    """
    return Html(_pieces()[piece].substitute({name: _markup(v) for name, v in places.items()}))


def _markup(value: object) -> str:
    if isinstance(value, Html):
        return value
    return f"{value:.1f}" if isinstance(value, float) else escape(visible(str(value)))


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
    sheet = "".join(map(asset, styles)) + style
    code = [asset(name) for name in scripts]
    return Template(asset("page.html")).substitute(
        attributes=f' data-status="{parts["status"]}"' if "status" in parts else "",
        title=parts["title"],
        body=Template(asset(template)).substitute(parts),
        style=sheet,
        style_hash=source_of(sheet),
        scripts="\n".join(f"<script>{text}</script>" for text in code),
        script_hashes=" ".join(map(source_of, code)),
    )


@cache
def asset(name: str) -> str:
    """Read a file of the assets."""
    return (files("retropole.report") / "assets" / name).read_text(encoding="utf-8")


@cache
def _pieces() -> dict[str, Template]:
    _, *parts = PIECE.split(asset("pieces.html"))
    pieces = zip(parts[::2], parts[1::2], strict=True)
    return {name: Template(markup.strip("\n")) for name, markup in pieces}


def source_of(text: str) -> str:
    """Name a script or a style by its hash: the page runs these and no others."""
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def plus_minus(sigma_m: float | None) -> str:
    """Write a 1 σ as ``± 8.4 mm``, which no line break parts; a dash where there is none."""
    text = error(sigma_m)
    return text if text == UNKNOWN else f"± {text}".replace(" ", NO_BREAK)


def share_styles() -> str:
    """Style the bars of every length, in percent: the page allows no style of a single element."""
    return "\n".join(f"td.share-{percent} {{ --share: {percent}%; }}" for percent in range(101))


def table(
    caption: str,
    header: Sequence[str],
    rows: Sequence[Sequence[object]],
    text: Collection[int] = (),
    bars: Sequence[tuple[str, float]] = (),
    links: Sequence[str] = (),
) -> Html:
    """Arrange a table that scrolls sideways on narrow screens.

    Parameters
    ----------
    caption, header, rows
        Every cell is escaped; the first of each row is its heading.
    text
        Columns of words, aligned left; all others but the first are numbers.
    bars
        Of each row, the class and the length, 0 to 1, of a bar behind its last cell.
    links
        Of each row, the target of its heading's link; empty for none.
    """
    kinds = [Html(' class="text"') if k in text else EMPTY for k in range(len(header))]
    head = (fill("th", kind=kind, text=name) for kind, name in zip(kinds, header, strict=True))
    lengths = [(name, round(100 * min(max(share, 0), 1))) for name, share in bars]
    ends = [fill("share", name=name, length=length) for name, length in lengths]
    body = [
        fill(
            "tr",
            heading=fill("a", to=link, text=row[0]) if link else row[0],
            cells=join(
                fill("td", kind=kind, text=cell)
                for kind, cell in zip([*kinds[1:-1], end], row[1:], strict=True)
            ),
        )
        for row, end, link in zip(
            rows, ends or [kinds[-1]] * len(rows), links or [""] * len(rows), strict=True
        )
    ]
    return fill("table", caption=caption, head=join(head), body=join(body))


def listed(listing: Listing) -> Html:
    """Arrange a table; of a long one the first `SHOWN` rows, the rest folded away."""
    caption, header, rows, text_columns = listing
    if len(rows) <= SHOWN:
        return table(caption, header, rows, text_columns) if rows else EMPTY
    rest = table(f"{caption}: the rest", header, rows[SHOWN:], text_columns)
    more = folded(f"{len(rows) - SHOWN} more", rest)
    return fill("stack", body=join((table(caption, header, rows[:SHOWN], text_columns), more)))


def folded(summary: str, body: Html, *, is_open: bool = False) -> Html:
    """Fold markup away under a summary; nothing if there is none."""
    opened = Html(" open" if is_open else "")
    return fill("details", opened=opened, summary=summary, body=body) if body else body


def inline(markdown: str) -> Html:
    """Turn a line of Markdown into HTML: code and emphasis, links by their words."""
    # Escaped first: nothing in the text but these marks can become markup.
    text = escape(visible(unlinked(markdown)))
    # The odd parts are code, in which an asterisk is an asterisk.
    parts = CODE.split(text)
    return Html(
        "".join(
            f"<code>{part}</code>" if k % 2 else EMPHASIS.sub(r"<em>\1</em>", part)
            for k, part in enumerate(parts)
        )
    )
