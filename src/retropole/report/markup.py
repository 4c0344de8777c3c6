"""Pieces of HTML that every part of the page is made of; whatever they are given is escaped."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from html import escape

from ..base.quantities import UNKNOWN, error
from ..base.reasons import unlinked

MISSING = UNKNOWN

NO_BREAK = "\u00a0"

CODE = re.compile(r"`([^`]+)`")
EMPHASIS = re.compile(r"\*([^*\s][^*]*)\*")


def number(value: float | None, digits: int, scale: float = 1.0, unit: str = "") -> str:
    """Write a number with fixed digits, or a dash where there is none."""
    if value is None or not math.isfinite(value):
        return MISSING
    return f"{value * scale:.{digits}f}{unit}"


def plus_minus(sigma_m: float | None) -> str:
    """Write a 1 σ as ``± 8.4 mm``, which no line break parts; a dash where there is none."""
    text = error(sigma_m)
    return text if text == MISSING else f"± {text}".replace(" ", NO_BREAK)


def share_styles() -> str:
    """Style the bars of every length, in percent: the page allows no style of an element's own."""
    return "\n".join(f"td.share-{percent} {{ --share: {percent}%; }}" for percent in range(101))


def table(
    caption: str,
    header: Sequence[str],
    rows: Sequence[Sequence[object]],
    text: Collection[int] = (),
    bars: Sequence[tuple[str, float]] = (),
    links: Sequence[str] = (),
) -> str:
    """Lay out a table that scrolls sideways on narrow screens.

    Parameters
    ----------
    caption, header, rows
        Every cell is escaped; the first of each row is its heading.
    text
        Columns of words, aligned left; all others but the first are numbers.
    bars
        Of each row, the class and the length, 0 to 1, of a bar behind its last cell.
    links
        Of each row, where its heading leads; empty for nowhere.
    """
    kind = ["" if k not in text else ' class="text"' for k in range(len(header))]
    head = "".join(
        f'<th scope="col"{c}>{escape(name)}</th>' for c, name in zip(kind, header, strict=True)
    )
    ends = [
        f' class="share share-{round(100 * min(max(share, 0), 1))} {escape(name)}"'
        for name, share in bars
    ] or [kind[-1]] * len(rows)
    headings = [escape(str(row[0])) for row in rows]
    if links:
        headings = [
            f'<a href="{escape(link)}">{name}</a>' if link else name
            for name, link in zip(headings, links, strict=True)
        ]
    body = "".join(
        f'<tr><th scope="row">{heading}</th>'
        + "".join(
            f"<td{c}>{escape(str(cell))}</td>"
            for c, cell in zip([*kind[1:-1], end], row[1:], strict=True)
        )
        + "</tr>"
        for heading, row, end in zip(headings, rows, ends, strict=True)
    )
    name = escape(caption)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{name}"><table>'
        f"<caption>{name}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody>"
        "</table></div>"
    )


def inline(markdown: str) -> str:
    """Turn a line of Markdown into HTML: code and emphasis, links by their words."""
    # Escaped first: nothing in the text but these marks can become markup.
    text = escape(unlinked(markdown))
    # The odd parts are code, in which an asterisk is an asterisk.
    parts = CODE.split(text)
    return "".join(
        f"<code>{part}</code>" if k % 2 else EMPHASIS.sub(r"<em>\1</em>", part)
        for k, part in enumerate(parts)
    )
