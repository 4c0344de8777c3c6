"""Pictures of a fleet: where its sites are, and how large their predicted errors are."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from ..api import quantities
from ..api.pages import EMPTY, Html, fill, join
from .dataset import Status
from .overview import STATUSES, Seen

EARTH = 6_371_009.0
"""Mean radius of the Earth, m (IUGG, Moritz 2000): a map of a city to 0.3 %."""

WIDTH, HEIGHTS = 520, (200.0, 560.0)
"""Of a picture in its own units; the least and the greatest height of the map."""

MARGIN, RIGHT = 44, 84
"""Around what is drawn; to the right of the map is room for degrees of latitude."""

MIDDLE = (WIDTH + MARGIN - RIGHT) / 2

LEAST_SPAN = 200.0
"""A map shows at least so much, m."""

FLAT_BELOW = 500e3
"""So wide a map, m, is to scale everywhere within 1 % or so; a wider one in its middle."""

MOST_NAMED = 20_000
"""So many sites, the worst first, say their names in the map: a page of 2 MB."""

PER_DECADE = (20, 10, 5, 2, 1)
"""Bars of a histogram for each power of ten: as many as stay below `MOST_BARS`."""

MOST_BARS = 40
BARS_HEIGHT = 258


def _shape(status: Status, r: float) -> str:
    """Draw what marks a status beside its colour, from its middle: dot, triangle, square, cross."""
    if status == "ok":
        return "h.01"
    if status == "warn":
        return f"m0{-1.2 * r:.2g}l{1.2 * r:.2g} {2.2 * r:.2g}h{-2.4 * r:.2g}z"
    if status == "refused":
        return f"m{-r:.2g}{-r:.2g}h{2 * r:.2g}v{2 * r:.2g}h{-2 * r:.2g}z"
    return f"m{-r:.2g}{-r:.2g}l{2 * r:.2g} {2 * r:.2g}m0{-2 * r:.2g}l{-2 * r:.2g} {2 * r:.2g}"


def fleet_map(sites: Sequence[Seen], link: Callable[[Seen], str] = lambda site: "") -> Html:
    """Draw where the sites are whose place is known: a figure, or a sentence where none is.

    Those that need action lead to their reports, where there are any.
    """
    placed = [s for s in sites if s.latitude_rad is not None and s.longitude_rad is not None]
    if not placed:
        return fill("fleet-no-map")
    view = _View(placed)
    size = next(r for r, most in ((6.0, 50), (4.0, 1000), (2.5, math.inf)) if len(placed) <= most)
    named, marks, keys = MOST_NAMED, list[Html](), list[Html]()
    # The worst are drawn last, on top, and are the first to be named.
    for status in reversed(STATUSES):
        if of_status := [site for site in placed if site.status == status]:
            marks.append(_marks(status, of_status, view, size, named, link))
            shape, count = _shape(status, 5.0), f"{len(of_status):,}"
            keys.append(fill("fleet-key", status=status, shape=shape, count=count))
            named = max(0, named - len(of_status))
    return fill(
        "fleet-map",
        width=WIDTH,
        height=round(view.height),
        marks=join((view.grid(), *reversed(marks), view.scale_bar())),
        legend=join(reversed(keys)),
        said=_map_said(len(placed), len(sites), view),
    )


class _View:
    """From latitude and longitude to the picture: north is at the top, to scale in the middle."""

    def __init__(self, placed: Sequence[Seen]) -> None:
        longitudes = [site.longitude_rad or 0.0 for site in placed]
        # Longitudes count from their mean direction, so that a fleet may lie across 180°.
        self._from = math.atan2(sum(map(math.sin, longitudes)), sum(map(math.cos, longitudes)))
        x = [self._east(each) for each in longitudes]
        y = [site.latitude_rad or 0.0 for site in placed]
        self._x, self._y = (min(x) + max(x)) / 2, (min(y) + max(y)) / 2
        self._narrow = max(math.cos(self._y), 0.01)
        self.metres = (EARTH * self._narrow * (max(x) - min(x)), EARTH * (max(y) - min(y)))
        spans = [max(each, LEAST_SPAN) for each in self.metres]
        self._scale = min((WIDTH - MARGIN - RIGHT) / spans[0], (HEIGHTS[1] - 2 * MARGIN) / spans[1])
        self.height = min(max(self._scale * spans[1] + 2 * MARGIN, HEIGHTS[0]), HEIGHTS[1])

    def _east(self, longitude: float) -> float:
        return (longitude - self._from + math.pi) % (2 * math.pi) - math.pi

    def place(self, site: Seen) -> tuple[float, float]:
        """Give where a site is in the picture."""
        assert site.latitude_rad is not None
        assert site.longitude_rad is not None
        return self._at(self._east(site.longitude_rad), site.latitude_rad)

    def _at(self, east: float, north: float) -> tuple[float, float]:
        scale = self._scale * EARTH
        return (
            MIDDLE + scale * self._narrow * (east - self._x),
            self.height / 2 - scale * (north - self._y),
        )

    def grid(self) -> Html:
        """Draw round degrees of latitude and longitude."""
        lines = []
        unit = 1 / (self._scale * EARTH)
        wide, high = unit / self._narrow, unit * self.height / 2
        step = quantities.round_below(math.degrees(WIDTH * wide / 3))
        west = self._from + self._x - MIDDLE * wide
        for degrees in _multiples(west, west + (WIDTH - RIGHT) * wide, step):
            x, _ = self._at(math.radians(degrees) - self._from, self._y)
            said = _degrees((degrees + 180) % 360 - 180, step, "E", "W")
            height = round(self.height)
            lines.append(fill("fleet-meridian", x=x, height=height, beside=x + 3, degrees=said))
        step = quantities.round_below(math.degrees(2 * high / 3))
        south, north = max(self._y - high, -math.pi / 2), min(self._y + high, math.pi / 2)
        for degrees in _multiples(south, north, step):
            _, y = self._at(self._x, math.radians(degrees))
            said = _degrees(degrees, step, "N", "S")
            at = {"y": y, "above": y - 4, "width": WIDTH, "end": WIDTH - 4}
            lines.append(fill("fleet-parallel", degrees=said, **at))
        return join(lines)

    def scale_bar(self) -> Html:
        """Draw a round length."""
        metres = quantities.round_below(0.25 * WIDTH / self._scale)
        size, unit = (metres, "m") if metres < 1000 else (metres / 1000, "km")
        said = f"{quantities.large(size)} {unit}"
        y, above, length = self.height - 19, self.height - 24, metres * self._scale
        return fill("fleet-scale", y=y, above=above, length=length, size=said)


def _multiples(low: float, high: float, step: float) -> list[float]:
    """Give the multiples of a step, degrees, between two angles, rad."""
    first, last = (math.degrees(each) / step for each in (low, high))
    return [k * step for k in range(math.ceil(first), math.floor(last) + 1)]


def _degrees(value: float, step: float, positive: str, negative: str) -> str:
    """Write degrees with as many decimals as a step has."""
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    # What rounds to none has no side.
    text = f"{abs(value):.{decimals}f}"
    side = "" if not float(text) else positive if value > 0 else negative
    return f"{text}°{side and ' ' + side}"


def _marks(
    status: Status,
    sites: Sequence[Seen],
    view: _View,
    size: float,
    named: int,
    link: Callable[[Seen], str],
) -> Html:
    """Draw sites of one status; those beyond the named ones only where there is none yet."""
    shape = _shape(status, size)
    drawn = []
    for site in sites[:named]:
        x, y = view.place(site)
        name = f"{site.id}: {status}"
        if site.sigma_30m_m is not None:
            name += f", {quantities.error(site.sigma_30m_m)} at 30 m"
        mark = fill("fleet-named", x=x, y=y, shape=shape, name=name)
        # What is ok is not in the way of who steps from link to link.
        to = "" if status == "ok" else link(site)
        drawn.append(fill("fleet-link", to=to, name=name, mark=mark) if to else mark)
    for at in sorted({(round(x), round(y)) for x, y in map(view.place, sites[named:])}):
        drawn.append(fill("fleet-mark", x=at[0], y=at[1], shape=shape))
    return fill("fleet-marks", status=status, size=round(10 * size), marks=join(drawn))


def _map_said(placed: int, sites: int, view: _View) -> str:
    """Say what the map shows, also for those who do not see it."""
    said = [f"{quantities.counted(placed, 'site')}. North is at the top; the worst lie on top."]
    if max(view.metres) > FLAT_BELOW:
        said.append("The scale holds in the middle.")
    if sites > placed:
        said.append(f"{quantities.counted(sites - placed, 'site')} not drawn: nothing says where.")
    if placed > MOST_NAMED:
        said.append(f"{MOST_NAMED:,} have their names where the pointer rests, the worst first.")
    return " ".join(said)


def histogram(values: Sequence[float]) -> Html:
    """Draw how many sites have which predicted error at 30 m; nothing where none has any.

    Parameters
    ----------
    values
        Metres, from the least on.
    """
    values = [each for each in values if each > 0]
    if not values:
        return EMPTY
    low, high, per = _decades(values)
    edges = [10 ** (k / per) for k in range(low, high + 1)]
    counts = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0].tolist()
    foot, head, right = BARS_HEIGHT - 62, 24, WIDTH - MARGIN
    wide, tall = (right - MARGIN) / len(counts), (foot - head) / max(counts)
    bars = []
    for k, count in enumerate(counts):
        low_error, high_error = quantities.error(edges[k]), quantities.error(edges[k + 1])
        said = f"{low_error} to {high_error}: {quantities.counted(count, 'site')}"
        x, up = MARGIN + k * wide + 0.5, -count * tall
        bar = fill("fleet-bar", x=x, foot=foot, up=up, wide=wide - 1, down=-up, said=said)
        bars.append(bar if count else EMPTY)
    names = {"middle": (MARGIN + right) / 2, "name": BARS_HEIGHT - 10}
    axes = [fill("fleet-foot", left=MARGIN, right=right, foot=foot, **names)]
    for at in _round_values(edges[0], edges[-1]):
        x = MARGIN + (math.log10(at) * per - low) * wide
        said = _plain_length(at)
        axes.append(fill("fleet-length", x=x, foot=foot, below=foot + 22, length=said))
    step = int(quantities.round_below(max(counts) / 2)) if max(counts) > 1 else 1
    for count in range(step, max(counts) + 1, step):
        y = foot - count * tall
        places = {"y": y, "beside": y + 5, "left": MARGIN, "right": right, "end": MARGIN - 6}
        axes.append(fill("fleet-count", count=f"{count:,}", **places))
    said = (
        "Predicted error of a point 30 m away, 1 σ: how many of "
        f"{quantities.counted(len(values), 'site')} with an answer. The scale is logarithmic."
    )
    size = {"width": WIDTH, "height": BARS_HEIGHT}
    return fill("fleet-histogram", axes=join(axes), bars=join(bars), said=said, **size)


def _decades(values: Sequence[float]) -> tuple[int, int, int]:
    """Choose the bars: the first and the last edge, and how many make a power of ten."""
    for per in PER_DECADE:
        low = math.floor(math.log10(values[0]) * per + 1e-9)
        high = max(math.ceil(math.log10(values[-1]) * per - 1e-9), low + 1)
        if high - low <= MOST_BARS:
            break
    return low, high, per


def _round_values(low: float, high: float) -> list[float]:
    """Give 1, 2, 5 times the powers of ten of a range; over many decades only the powers."""
    decades = math.log10(high / low)
    steps = (1, 2, 5) if decades < 2.5 else (1,)
    found = [
        value
        for power in range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        for value in (step * 10.0**power for step in steps)
        if low * (1 - 1e-9) <= value <= high * (1 + 1e-9)
    ]
    every = max(1, math.ceil(len(found) / 8))
    return found[::every] or [low]


def _plain_length(metres: float) -> str:
    """Write a round length without more digits than it has: ``5 mm``, ``0.2 m``."""
    return f"{1000 * metres:.3g} mm" if metres < quantities.MILLIMETRES_BELOW else f"{metres:.3g} m"
