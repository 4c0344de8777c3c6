"""Graph and table of the pairs of LiDARs: who decides by himself, and how well they agree."""

from __future__ import annotations

from html import escape

import numpy as np

from ...base.quantities import counted
from ...result.site import PairDoc, SiteDoc
from ..markup import MISSING, number, table
from .svg import FONT, Labels, colour_class, short

LIMIT_W = 3.29
"""A sound observation is beyond this once in a thousand times (Baarda 1968)."""

DOUBT_W = 1.96
"""… and beyond this once in twenty."""

WIDTH, HEIGHT = 520.0, 420.0
"""Of the picture, in its own units."""

RADIUS = 145.0
"""Of the circle that the LiDARs stand on in the picture."""

LABELLED_PAIRS = 10
"""Up to so many lines all bear their w; of more only those beyond `DOUBT_W`."""

SHOWN_PAIRS = 12
"""So many pairs are listed at once; the page unfolds the others."""

LEVELS = (
    ("calm", f"|w| up to {DOUBT_W:g}"),
    ("doubt", f"{DOUBT_W:g} to {LIMIT_W:g}"),
    ("blunder", f"above {LIMIT_W:g}"),
    ("untested", "not tested"),
)
"""How a line is drawn by the size of its w, and what the legend says of it."""


def level_of(w: float | None) -> str:
    """Name the class of a line by its w."""
    if w is None:
        return "untested"
    return "calm" if abs(w) <= DOUBT_W else "doubt" if abs(w) <= LIMIT_W else "blunder"


def pair_words(pair: PairDoc, refused: bool) -> str:
    """Say what a pair alone has to say of its pose."""
    if pair.standing == 1:
        return "decides by itself"
    if pair.standing > 1:
        ways = counted(pair.standing, "way")
        return f"leaves {ways}" if refused else f"leaves {ways}, others decide"
    return "no answer of its own" if refused else "linked through others"


def pairs(document: SiteDoc) -> str:
    """Draw the pairs as a graph, and list them, those with the largest w first."""
    if not document.pairs:
        return ""
    decided = "" if document.status == "refused" else " and others decide"
    return (
        '<section aria-labelledby="pairs"><h2 id="pairs">Pairs</h2>'
        "<p>Every line is a pair of LiDARs: solid where the pair decides its pose by itself, "
        f"dashed where it leaves several ways or has none{decided}. Its colour and width "
        "say how well both agree: <i>w</i> is the largest normalised residual of what they share."
        f'</p><div class="columns">{_figure(document)}{_table(document)}</div></section>'
    )


def _figure(document: SiteDoc) -> str:
    count = len(document.lidars)
    angle = np.pi / 2 - 2 * np.pi * np.arange(count) / count
    if count == 2:
        angle += np.pi / 2
    x, y = WIDTH / 2 + RADIUS * np.cos(angle), HEIGHT / 2 - RADIUS * np.sin(angle)
    labels = Labels(WIDTH, HEIGHT)
    nodes = []
    for k, lidar in enumerate(document.lidars):
        labels.keep_free(x[k], y[k], 9.0)
        cosine = float(np.cos(angle[k]))
        anchor = "middle" if abs(cosine) < 0.3 else "start" if cosine > 0 else "end"
        at = x[k] + 16 * cosine, y[k] - 20 * np.sin(angle[k]) + 0.35 * FONT
        nodes.append(
            f'<circle class="place {colour_class(k)}" cx="{x[k]:.1f}" cy="{y[k]:.1f}" r="8"/>'
            f'<text class="name {colour_class(k)}" x="{at[0]:.1f}" y="{at[1]:.1f}" '
            f'text-anchor="{anchor}">{escape(short(lidar.name))}</text>'
        )
    lines, figures = [], []
    # The largest w is drawn last: it lies on top of all others.
    for pair in sorted(document.pairs, key=lambda each: abs(each.w or 0.0)):
        a, b = pair.lidars
        solid = "solid" if pair.standing == 1 else "dashed"
        level = level_of(pair.w)
        lines.append(
            f'<path class="pair {level} {solid}" d="M{x[a]:.1f} {y[a]:.1f}L{x[b]:.1f} {y[b]:.1f}"/>'
        )
        if pair.w is not None and (len(document.pairs) <= LABELLED_PAIRS or level != "calm"):
            middle = ((x[a] + x[b]) / 2, (y[a] + y[b]) / 2)
            figures.append(labels.place(number(abs(pair.w), 1), *middle, 9.0, "halo", FONT - 1))
    legend = "".join(
        f'<li><svg viewBox="0 0 30 10" aria-hidden="true"><path class="pair {level} solid" '
        f'd="M2 5h26"/></svg>{escape(words)}</li>'
        for level, words in LEVELS
    )
    return (
        f'<figure class="picture"><svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" '
        f'aria-label="Graph of the pairs; the table says the same">{"".join(lines)}'
        f"{''.join(nodes)}{''.join(figures)}</svg>"
        f'<figcaption><ul class="legend">{legend}</ul></figcaption></figure>'
    )


def _table(document: SiteDoc) -> str:
    refused = document.status == "refused"
    ordered = sorted(document.pairs, key=lambda each: (-abs(each.w or 0.0), each.lidars))
    rows: list[tuple[object, ...]] = [
        (
            " – ".join(document.lidars[k].name for k in pair.lidars),
            number(None if pair.w is None else abs(pair.w), 1)
            + (" stands out" if level_of(pair.w) == "blunder" else ""),
            pair.shared_poles,
            pair.patches or MISSING,
            pair_words(pair, refused)
            + ("" if pair.refusal is None else f": {pair.refusal.message}"),
        )
        for pair in ordered
    ]
    header = ("pair", "|w|", "shared poles", "patches", "the pair alone")
    listed = table(
        "Pairs" if refused else "Pairs, the largest |w| first", header, rows[:SHOWN_PAIRS], (4,)
    )
    rest = rows[SHOWN_PAIRS:]
    if not rest:
        return listed
    others = table("The other pairs", header, rest, (4,))
    folded = f"<details><summary>{len(rest)} more</summary>{others}</details>"
    return f'<div class="stack">{listed}{folded}</div>'
