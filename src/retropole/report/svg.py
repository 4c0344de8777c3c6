"""Pictures of a page: their frame, axes of charts, and labels, of which none covers another."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ..base.datatypes import Array
from ..base.quantities import round_below
from .page import Html, fill, join

WIDTH = 520.0
"""Of a picture, in its units: the page scales it."""

LONGEST_LABEL = 18
"""Characters of a name in a picture; the tables have it whole."""

LETTER = 0.58
"""Width of a letter over the size of the font, on average (measured on sans-serif fonts)."""

FONT = 17.0
"""Size of the labels in the units of a picture, between those of a screen (15) and of a phone (18:
11 px where the picture is 330 px wide)."""

STEP = 11.0
"""Of labels that go further away from their marks than the nearest places, in the same units."""

_AROUND: tuple[tuple[float, float, str], ...] = (
    *((1, 0, "start"), (-1, 0, "end"), (0, -1.3, "middle"), (0, 1.3, "middle")),
    *((0.8, -1, "start"), (0.8, 1, "start"), (-0.8, -1, "end"), (-0.8, 1, "end")),
    *((0, -2.4, "middle"), (0, 2.4, "middle"), (1.2, -2, "start"), (1.2, 2, "start")),
    *((-1.2, -2, "end"), (-1.2, 2, "end"), (2, 0, "start"), (-2, 0, "end")),
    *((0, -3.6, "middle"), (0, 3.6, "middle"), (2, -3, "start"), (2, 3, "start")),
    *((-2, -3, "end"), (-2, 3, "end")),
)
"""Positions of a label around its mark, in units of their distance, and its anchor."""


Box = tuple[float, float, float, float]
"""Left, top, right and bottom, in the units of a picture."""


def picture(name: str, height: float, marks: Iterable[Html], said: object, kind: str = "") -> Html:
    """Frame a picture `WIDTH` wide, and say below it, by an id, what it shows."""
    size = {"width": f"{WIDTH:g}", "height": f"{height:.0f}"}
    return fill("picture", name=name, kind=kind, marks=join(marks), said=said, **size)


@dataclass(frozen=True)
class Chart:
    """A box in a picture; `x` are the numbers at its left and right, `y` at its bottom and top."""

    box: Box
    x: tuple[float, float]
    y: tuple[float, float]

    @classmethod
    def around(cls, middle: Array, scale: float, box: Box) -> Chart:
        """Show what is about a point (2,), at this many units of the picture per number in both
        axes."""
        across, down = (box[2] - box[0]) / scale / 2, (box[3] - box[1]) / scale / 2
        x, y = float(middle[0]), float(middle[1])
        return cls(box, (x - across, x + across), (y - down, y + down))

    def at(self, points: Array) -> Array:
        """Give the places in the picture (N, 2) of points (N, 2 or more): y points down there."""
        (left, top, right, bottom), xy = self.box, np.asarray(points)[:, :2]
        low = np.array([self.x[0], self.y[0]])
        scale = np.array([right - left, top - bottom]) / ([self.x[1], self.y[1]] - low)
        return np.asarray([left, bottom] + (xy - low) * scale)

    def line(self, x: ArrayLike, y: ArrayLike) -> str:
        """Write the corners of a line as those of a path."""
        return "L".join(f"{a:.1f} {b:.1f}" for a, b in self.at(np.transpose([x, y])))

    def axes(
        self, x: dict[float, str], y: dict[float, str], across: str, down: str = ""
    ) -> list[Html]:
        """Draw axes: a tick or a line across at each number, with its text, and what they are."""
        left, top, right, bottom = self.box
        marks = []
        for value, text in y.items():
            at = float(self.at(np.array([[0.0, value]]))[0, 1])
            ends = {"x": left, "y": at, "right": right}
            marks.append(fill("axis-level", **ends, at=left - 8, below=at + 5, value=text))
        for value, text in x.items():
            at = float(self.at(np.array([[value, 0.0]]))[0, 0])
            marks.append(fill("axis-tick", x=at, y=bottom, below=bottom + 22, value=text))
        places = {"left": left, "above": top - 16, "x": (left + right) / 2, "y": bottom + 44}
        return [*marks, fill("axis-names", **places, across=across, down=down)]


def round_step(span: float) -> float:
    """Choose the distance of the lines across a chart: 1, 2, 2.5 or 5, four or five in the span."""
    least = round_below(span / 5)
    return next(k * least for k in (1.0, 2.0, 2.5, 5.0) if k * least >= span / 5 * (1 - 1e-9))


def round_numbers(low: float, high: float, unit: float = 1.0) -> dict[float, str]:
    """Give round numbers from low to high for an axis, with their texts in a unit."""
    step = round_step(high - low)
    numbers = [k * step for k in range(math.ceil(low / step), math.floor(high / step + 1e-9) + 1)]
    return {number: f"{number / unit:g}" for number in numbers}


def short(name: str) -> str:
    """Shorten a name for a picture."""
    return name if len(name) <= LONGEST_LABEL else f"{name[: LONGEST_LABEL - 1]}…"


@dataclass
class Labels:
    """Labels of one picture of this many units across and down; none covers another if it can."""

    width: float
    height: float
    taken: list[Box] = field(default_factory=list)

    def keep_free(self, x: float, y: float, half: float, high: float | None = None) -> None:
        """Keep a box free of labels, of half a width and, where it is another, half a height."""
        high = half if high is None else high
        self.taken.append((x - half, y - high, x + half, y + high))

    def place(
        self,
        text: str,
        x: float,
        y: float,
        away: float,
        style: str = "",
        size: float = FONT,
        away_y: float | None = None,
    ) -> Html:
        """Write a label next to a mark at x, y, where it covers least."""
        away_y = away if away_y is None else away_y
        spots = (
            (x + _beyond(dx, away), y + _beyond(dy, away_y), anchor) for dx, dy, anchor in _AROUND
        )
        x, y, anchor = min(spots, key=lambda at: self._cost(_box(text, at[0], at[1], at[2], size)))
        self.taken.append(_box(text, x, y, anchor, size))
        return fill("label", x=x, y=y + 0.35 * size, anchor=anchor, style=style, text=text)

    def _cost(self, box: Box) -> float:
        """Area that a label covers of others, and thrice that outside of the picture."""
        outside = _overlap(box, box) - _overlap(box, (0.0, 0.0, self.width, self.height))
        return sum(_overlap(box, other) for other in self.taken) + 3 * outside


def _beyond(times: float, away: float) -> float:
    """Go this many times away, the steps beyond the first being short: a mark may be large."""
    steps = max(abs(times) - 1, 0.0)
    return math.copysign(min(abs(times), 1.0) * away + steps * STEP, times)


def _box(text: str, x: float, y: float, anchor: str, size: float) -> Box:
    width = LETTER * size * len(text)
    left = x - {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor] * width
    return left, y - 0.6 * size, left + width, y + 0.6 * size


def _overlap(a: Box, b: Box) -> float:
    """Area that two boxes share."""
    wide, high = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    return wide * high if wide > 0 and high > 0 else 0.0
