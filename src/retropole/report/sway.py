"""How each LiDAR swayed while it recorded, drawn over time."""

from __future__ import annotations

import math
from collections.abc import Iterator

from ..base.quantities import round_below
from ..base.sway import Sway
from ..result import SwayDoc
from .page import EMPTY, Html, fill, join
from .subject import Subject

WIDTH, HEIGHT = 520.0, 220.0
"""Of the picture, in its own units."""

LEFT, RIGHT, TOP, BOTTOM = 66.0, 500.0, 34.0, 166.0
"""Edges of what is plotted."""


def sways(subject: Subject) -> Html:
    """Draw what was seen of each recording, name what was stated; nothing where all stood."""
    if not subject.site.sways:
        return EMPTY
    several = len(subject.site.placements) > 1
    figures = [_figure(subject, each, several=several) for each in subject.site.sways]
    return fill("sways", figures=join(figures))


def _figure(subject: Subject, found: SwayDoc, *, several: bool) -> Html:
    name = subject.called(found.lidar)
    name = f"{name[0].upper()}{name[1:]}"
    if several:
        name += f", placement {subject.placement(found.placement)}"
    said = f"{name}: {found.sway.words}."
    if len(found.sway.times_s) < 2:
        return fill("sway-stated", said=said)
    return fill(
        "sway-figure",
        id=f"sway-{found.lidar}-{found.placement}",
        width=f"{WIDTH:g}",
        height=f"{HEIGHT:g}",
        marks=join(_marks(found.sway)),
        said=said,
    )


def _marks(sway: Sway) -> Iterator[Html]:
    """Draw the angle over time, between three lines."""
    angles = [math.degrees(each) for each in sway.angles_rad]
    top = max(*map(abs, angles), 1e-3)
    level = round_below(top)
    top, last = 1.1 * top, sway.times_s[-1]
    middle, scale = (TOP + BOTTOM) / 2, (BOTTOM - TOP) / 2 / top

    def x_of(time: float) -> float:
        return LEFT + (RIGHT - LEFT) * time / last

    for k in (-1, 0, 1):
        y = middle - k * level * scale
        value = f"{k * level:.2g}"
        yield fill("curve-level", x=LEFT, y=y, right=RIGHT, at=LEFT - 8, below=y + 5, value=value)
    for k in range(5):
        time = k * last / 4
        x = x_of(time)
        yield fill("curve-distance", x=x, y=BOTTOM, below=BOTTOM + 22, value=f"{time:.2g}")
    yield fill("sway-names", left=LEFT, above=TOP - 14, x=(LEFT + RIGHT) / 2, y=HEIGHT - 10)
    corners = zip(sway.times_s, angles, strict=True)
    path = "L".join(f"{x_of(time):.1f} {middle - scale * angle:.1f}" for time, angle in corners)
    yield fill("sway-line", path=path)
