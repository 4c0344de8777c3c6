"""The walk with one pole, from above, and the clocks of the LiDARs in each part."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..base.carried import SiteWalk
from ..base.datatypes import Array
from ..base.quantities import large, round_below
from ..result.site import input_names
from .listings import Listing, carried_words, clock_words, walk_names
from .map import MARGIN, fit
from .page import EMPTY, Html, fill, join, listed
from .plan import turning
from .subject import Subject, colour_class
from .svg import WIDTH, Chart, Labels, picture, round_numbers, short

SHADES = 6
"""Colours of the way, from its begin to its end."""


def walk(subject: Subject) -> Html:
    """Show the walk; nothing of fixed poles."""
    found = subject.site.walk
    if found is None or not subject.answered:
        return EMPTY
    others = (k for k in range(len(found.lidars)) if k != subject.site.reference)
    return fill(
        "walk",
        above=_from_above(subject, found),
        clocks=join(_clocks(subject, found, k) for k in others),
        figures=listed(_figures(subject, found)),
    )


def _from_above(subject: Subject, found: SiteWalk) -> Html:
    R = turning(np.array(found.up))
    times, path = np.split(np.array(found.path).reshape(-1, 4), [1], axis=1)
    way = path @ R.T
    lidars = np.array([np.array(each.T_site_lidar)[:3, 3] for each in subject.site.lidars]) @ R.T
    scale, height, chart = fit(np.concatenate([lidars, way])[:, :2])
    labels = Labels(WIDTH, height)
    labels.keep_free(40.0, height - 10.0, 40.0)
    for x, y in [*chart.at(lidars), *chart.at(way[:: max(1, len(way) // 60)])]:
        labels.keep_free(x, y, 6.0)
    marks = [*_way(chart, way)]
    for name, at in ((f"{times[0, 0]:.0f} s", way[0]), (f"{times[-1, 0]:.0f} s", way[-1])):
        x, y = chart.at(at[None])[0]
        marks.append(fill("walk-end", x=x, y=y))
        marks.append(labels.place(name, x, y, 9.0, "soft"))
    recorded = input_names(subject.pair) if subject.pair else []
    names = recorded or walk_names(subject)
    for k, ((x, y), name) in enumerate(zip(chart.at(lidars), names, strict=False)):
        marks.append(fill("place", colour=colour_class(k), x=x, y=y, r=6))
        marks.append(labels.place(short(name), x, y, 11.0, f"name {colour_class(k)}"))
    metres = round_below(0.3 * (WIDTH - 2 * MARGIN) / scale)
    bar = {"length": metres * scale, "m": large(metres)}
    marks.append(fill("scale", y=height - 14.0, above=height - 24.0, **bar))
    said = (
        f"Seen from above; up is the mean direction of the pole. The line is its path, "
        f"from blue at the start to orange at the end: {carried_words(found)}."
    )
    return picture("walk-said", height, marks, said, "map")


def _way(chart: Chart, way: Array) -> list[Html]:
    """Draw the way in parts, each with the colour of its time."""
    ends = np.linspace(0, len(way) - 1, 4 * SHADES + 1).round().astype(int)
    return [
        fill("line", kind=f"when-{k // 4}", path=chart.line(*way[first : last + 1, :2].T))
        for k, (first, last) in enumerate(pairwise(ends))
        if last > first
    ]


def _clocks(subject: Subject, found: SiteWalk, lidar: int) -> Html:
    """Draw the offset of a clock in each window relative to that of the walk, with 1 σ."""
    own = found.lidars[lidar]
    if len(own.clock_windows) < 2:
        return EMPTY
    middle, offset, sigma = np.array(own.clock_windows).T
    at, offset, sigma = middle - found.begin_s, 1e3 * offset, 1e3 * sigma
    most = 1.1 * float(np.max(np.abs(offset) + sigma))
    chart = Chart((70.0, 34.0, 500.0, 196.0), (0.0, found.seconds), (-most, most))
    marks = chart.axes(
        round_numbers(0.0, found.seconds), round_numbers(-most, most), "time, s", "offset, ms"
    )
    for x, value, error in zip(at, offset, sigma, strict=True):
        if 0 <= x <= found.seconds:
            low, high = chart.at(np.array([[x, value - error], [x, value + error]]))
            y = chart.at(np.array([[x, value]]))[0, 1]
            marks.append(fill("clock-window", x=low[0], low=low[1], high=high[1], y=y))
    said = (
        f"{clock_words(subject, lidar)}. The chart has windows of 5 s, relative to the whole walk, "
        "1 σ. Clocks with a constant rate stay near zero."
    )
    name = "clocks-said" if subject.pair else f"clocks-said-{lidar}"
    return picture(name, 250.0, marks, said, "curve")


def _figures(subject: Subject, found: SiteWalk) -> Listing:
    seen = found.lidars
    rows = [
        ["sweeps in which the pole was found", *(f"{x.found} of {x.sweeps}" for x in seen)],
        ["scatter of ranges, relative to the stated", *(f"{x.range_scale:.2f}" for x in seen)],
        [
            "jitter of the edges of the pole, mrad",
            *(f"{1e3 * x.edge_jitter_rad:.2f}" for x in seen),
        ],
    ]
    caption = "Seen by both" if len(seen) == 2 else "Seen by each"
    return Listing(caption, ["", *walk_names(subject)], rows)
