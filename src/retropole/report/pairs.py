"""Graph and table of the pairs of LiDARs: who decides by himself, and how well they agree."""

from __future__ import annotations

import numpy as np

from ..adjustment.blunders import POOR
from ..result.site import SiteDoc
from . import listings
from .certainty import number
from .page import EMPTY, Html, fill, join, listed
from .subject import colour_class
from .svg import FONT, Labels, short

DOUBT_W = 1.96
"""A sound observation is beyond this once in twenty times; beyond `POOR` the verdict says so."""

WIDTH, HEIGHT = 520.0, 420.0
"""Of the picture, in its own units."""

RADIUS = 145.0
"""Of the circle that the LiDARs stand on in the picture."""

LABELLED_PAIRS = 10
"""Up to so many lines all bear their w; of more only those beyond `DOUBT_W`."""

LEVELS = (
    ("calm", f"|w| up to {DOUBT_W:g}"),
    ("doubt", f"{DOUBT_W:g} to {POOR:g}"),
    ("blunder", f"above {POOR:g}"),
    ("untested", "not tested"),
)
"""How a line is drawn by the size of its w, and what the legend says of it."""


def level_of(w: float | None) -> str:
    """Name the class of a line by its w."""
    if w is None:
        return "untested"
    return "calm" if abs(w) <= DOUBT_W else "doubt" if abs(w) <= POOR else "blunder"


def pairs(site: SiteDoc) -> Html:
    """Draw the pairs as a graph, and list them."""
    if not site.pairs:
        return EMPTY
    decided = "" if site.status == "refused" else " and others decide"
    table = listed(listings.pairs(site))
    return fill("pairs", decided=decided, figure=_figure(site), table=table)


def _figure(site: SiteDoc) -> Html:
    count = len(site.lidars)
    angle = np.pi / 2 - 2 * np.pi * np.arange(count) / count
    if count == 2:
        angle += np.pi / 2
    x, y = WIDTH / 2 + RADIUS * np.cos(angle), HEIGHT / 2 - RADIUS * np.sin(angle)
    labels = Labels(WIDTH, HEIGHT)
    lines, figures, nodes = [], [], []
    for k, lidar in enumerate(site.lidars):
        labels.keep_free(x[k], y[k], 9.0)
        cosine, colour = float(np.cos(angle[k])), colour_class(k)
        anchor = "middle" if abs(cosine) < 0.3 else "start" if cosine > 0 else "end"
        place = {"x": x[k] + 16 * cosine, "y": y[k] - 20 * np.sin(angle[k]) + 0.35 * FONT}
        nodes.append(fill("place", colour=colour, x=x[k], y=y[k], r=8))
        nodes.append(
            fill("label", **place, anchor=anchor, style=f"name {colour}", text=short(lidar.name))
        )
    # The largest w is drawn last: it lies on top of all others.
    for pair in sorted(site.pairs, key=lambda each: abs(each.w or 0.0)):
        a, b = pair.lidars
        kind = f"{level_of(pair.w)} {'solid' if pair.standing == 1 else 'dashed'}"
        lines.append(fill("pair", kind=kind, x1=x[a], y1=y[a], x2=x[b], y2=y[b]))
        labelled = len(site.pairs) <= LABELLED_PAIRS or level_of(pair.w) != "calm"
        if pair.w is not None and labelled:
            middle = ((x[a] + x[b]) / 2, (y[a] + y[b]) / 2)
            figures.append(labels.place(number(abs(pair.w), 1), *middle, 9.0, "halo", FONT - 1))
    return fill(
        "graph",
        width=f"{WIDTH:g}",
        height=f"{HEIGHT:g}",
        marks=join((*lines, *nodes, *figures)),
        legend=join(fill("level", level=level, words=words) for level, words in LEVELS),
    )
