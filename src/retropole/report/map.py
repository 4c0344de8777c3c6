"""Pictures of a site: from above, with the uncertainty of its LiDARs; and the graph of its
pairs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..adjustment.snooping import POOR
from ..base.datatypes import Array
from ..base.quantities import large, round_below
from ..result.site import SiteDoc
from . import listings
from .listings import number
from .page import EMPTY, Html, fill, folded, join, listed, table
from .plan import Plan
from .subject import Subject, colour_class, pole_labels
from .svg import FONT, WIDTH, Chart, Labels, picture, short

HEIGHTS = 260.0, 560.0
"""Least and greatest height of the picture."""

MARGIN = 60.0
"""Around all that is there: room for names."""

LEAST_SPAN = 2.0
"""A site is drawn as at least so wide, metres."""

SEEN_ELLIPSE = 34.0
"""Longest half axis in the picture."""

DOUBT_W = 1.96
"""A sound observation is beyond this once in twenty times; beyond `POOR` the verdict says so."""

GRAPH_HEIGHT = 420.0
"""Of the graph of the pairs."""

RADIUS = 145.0
"""Of the circle of the LiDARs in the picture."""

LABELLED_PAIRS = 10
"""Up to this many lines all bear their w; of more only those beyond `DOUBT_W`."""

LEVELS = (
    ("calm", f"|w| up to {DOUBT_W:g}"),
    ("doubt", f"{DOUBT_W:g} to {POOR:g}"),
    ("blunder", f"above {POOR:g}"),
    ("untested", "not tested"),
)
"""How a line is drawn by the size of its w, and its text in the legend."""


def site_map(subject: Subject, plan: Plan) -> Html:
    """Draw a site from above and list the positions of its LiDARs; nothing of two, or where
    refused."""
    site = subject.site
    if subject.pair is not None or not subject.answered:
        return EMPTY
    return fill("map", figure=_figure(site, plan), poles=_poles(site))


def _figure(site: SiteDoc, plan: Plan) -> Html:
    R = plan.R_plan_site
    lidars = np.array([np.array(each.T_site_lidar)[:3, 3] for each in site.lidars]) @ R.T
    ends = [[p.point + s * p.length * p.direction for s in (-0.5, 0.5)] for p in site.poles]
    poles = np.array(ends).reshape(-1, 2, 3) @ R.T
    points = np.array([each.at for each in site.control_points]).reshape(-1, 3) @ R.T
    scale, height, chart = fit(np.concatenate([lidars, *poles, points])[:, :2])
    labels = Labels(WIDTH, height)
    for x, y in [*chart.at(lidars), *chart.at(points), *chart.at(poles.mean(axis=1))]:
        labels.keep_free(x, y, 6.0)
    # The corners of the scale bar and of north.
    labels.keep_free(40.0, height - 10.0, 40.0)
    labels.keep_free(WIDTH - 35.0, 30.0, 35.0)
    factor, ellipses, sizes = _ellipses(site, R, chart.at(lidars), scale)
    for (x, y), (wide, high) in zip(chart.at(lidars), sizes, strict=True):
        labels.keep_free(x, y, wide, high)
    metres = round_below(0.3 * (WIDTH - 2 * MARGIN) / scale)
    # The names of the LiDARs choose their places first, and are drawn last.
    named = []
    for k, ((x, y), (wide, high)) in enumerate(zip(chart.at(lidars), sizes, strict=True)):
        named.append(fill("place", colour=colour_class(k), x=x, y=y, r=6))
        name, style = short(site.lidars[k].name), f"name {colour_class(k)}"
        offsets = {"away": max(11.0, wide + 4.0), "away_y": max(14.0, high + 8.0)}
        named.append(labels.place(name, x, y, style=style, **offsets))
    marks = [*ellipses, *_pole_marks(pole_labels(site), chart, poles, labels)]
    for point, (x, y) in zip(site.control_points, chart.at(points), strict=True):
        marks.append(fill("control", x=x, y=y - 6))
        marks.append(labels.place(short(point.name), x, y, 10.0, "soft", FONT - 2))
    marks += named
    scale_bar = {"length": metres * scale, "m": large(metres)}
    marks.append(fill("scale", y=height - 14.0, above=height - 24.0, **scale_bar))
    marks.append(_direction(plan))
    return picture("map-said", height, marks, _caption(site, plan, factor), "map")


def fit(points: Array) -> tuple[float, float, Chart]:
    """Choose units per metre and the height of the picture so that all points are in it."""
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.maximum(high - low, LEAST_SPAN)
    scale = float(min((WIDTH - 2 * MARGIN) / span[0], (HEIGHTS[1] - 2 * MARGIN) / span[1]))
    height = float(np.clip(scale * span[1] + 2 * MARGIN, *HEIGHTS))
    return scale, height, Chart.around((low + high) / 2, scale, (0.0, 0.0, WIDTH, height))


def _ellipses(
    site: SiteDoc, R: Array, places: Array, scale: float
) -> tuple[float | None, list[Html], Array]:
    """Draw 1 σ of each LiDAR's position, enlarged; give how many times, and half of each size."""
    spreads = [(R @ np.array(each.covariance)[3:, 3:] @ R.T)[:2, :2] for each in site.lidars]
    values, vectors = np.linalg.eigh(np.array(spreads))
    half_axes = np.sqrt(np.maximum(values, 0.0))
    if half_axes.max() <= 0:
        return None, [], np.zeros((len(spreads), 2))
    factor = round_below(SEEN_ELLIPSE / (scale * half_axes.max()))
    turns = -np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    drawn = [
        fill("ellipse", colour=colour_class(k), x=x, y=y, rx=long, ry=wide, turn=turns[k])
        for k, ((x, y), (wide, long)) in enumerate(
            zip(places, factor * scale * half_axes, strict=True)
        )
        if long
    ]
    extents = np.sqrt(np.maximum(np.diagonal(spreads, axis1=1, axis2=2), 0.0))
    return factor, drawn, factor * scale * extents


def _pole_marks(names: Sequence[str], chart: Chart, ends: Array, labels: Labels) -> list[Html]:
    """Draw each pole as the line that it covers from above, and a ring in its middle."""
    marks = []
    for name, pole in zip(names, ends, strict=True):
        (x1, y1), (x2, y2) = chart.at(pole)
        x, y = (x1 + x2) / 2, (y1 + y2) / 2
        marks.append(fill("pole", x1=x1, y1=y1, x2=x2, y2=y2, x=x, y=y))
        marks.append(labels.place(name, x, y, 8.0, "soft", FONT - 2))
    return marks


def _direction(plan: Plan) -> Html:
    """Draw where north is, or else the level axes of the frame."""
    x = WIDTH - 40.0
    if plan.north is not None:
        return fill("north", x=x)
    ends = [(plan.R_plan_site @ axis)[:2] * [24, -24] for axis in np.eye(3)[:2]]
    return join(
        fill("axis", x=x - 6, dx=a, dy=b, at_x=x - 6 + 1.4 * a, at_y=55 + 1.4 * b, name=name)
        for name, (a, b) in zip("xy", ends, strict=True)
    )


def _caption(site: SiteDoc, plan: Plan, factor: float | None) -> str:
    """Describe the picture, also for those who do not see it."""
    text = [f"Seen from above; up is {plan.up}."]
    if plan.north:
        text.append(f"{plan.north.capitalize()} is at the top.")
    fixed = [each.name for each in site.lidars if not np.any(each.covariance)]
    if factor is None:
        text.append("No LiDAR has an ellipse: its position is without error.")
    else:
        text.append(f"Ellipses: 1 σ of the position of each LiDAR, enlarged {large(factor)} times.")
        text += [f"{name} has none: its frame is the site's." for name in fixed[:1]]
    if site.poles:
        text.append(
            "Rings: poles, 2.1 being the first of placement 2, with the direction in which each "
            "leans."
        )
    if site.control_points:
        text.append("Triangles: control points.")
    return " ".join(text)


def _poles(site: SiteDoc) -> Html:
    rows = [
        (
            label,
            pole.name,
            *(number(v, 3) for v in pole.point + site.frame.offset),
            number(pole.length, 2),
            ", ".join(site.lidars[k].name for k in pole.seen_by),
        )
        for label, pole in zip(pole_labels(site), site.poles, strict=True)
    ]
    header = ("pole", "name", "x, m", "y, m", "z, m", "length, m", "seen by")
    listed = table("Poles, the middle of the tape", header, rows, (1, 6))
    return folded(f"Poles: {len(rows)}", listed) if rows else EMPTY


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
    listing = listed(listings.pairs(site))
    return fill("pairs", decided=decided, figure=_graph(site), table=listing)


def _graph(site: SiteDoc) -> Html:
    count = len(site.lidars)
    angle = np.pi / 2 - 2 * np.pi * np.arange(count) / count
    if count == 2:
        angle += np.pi / 2
    x, y = WIDTH / 2 + RADIUS * np.cos(angle), GRAPH_HEIGHT / 2 - RADIUS * np.sin(angle)
    labels = Labels(WIDTH, GRAPH_HEIGHT)
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
        height=f"{GRAPH_HEIGHT:g}",
        marks=join((*lines, *nodes, *figures)),
        legend=join(fill("level", level=level, text=text) for level, text in LEVELS),
    )
