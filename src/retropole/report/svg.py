"""Labels of the pictures of a site: none covers another, and long names are shortened."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from .page import Html, fill

LONGEST_LABEL = 18
"""Characters of a name in a picture; the tables have it whole."""

LETTER = 0.58
"""Width of a letter over the size of the font, on average (measured on sans-serif fonts)."""

FONT = 17.0
"""Size of the labels in a picture's own units, between those of a screen (15) and of a phone (18:
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
"""Where a label may stand around its mark, in units of their distance, and its anchor."""


Box = tuple[float, float, float, float]
"""Left, top, right and bottom of a label."""


def short(name: str) -> str:
    """Shorten a name for a picture."""
    return name if len(name) <= LONGEST_LABEL else f"{name[: LONGEST_LABEL - 1]}…"


@dataclass
class Labels:
    """Labels of one picture of so many units across and down; none covers another if it can."""

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
        """Write a label beside a mark at x, y, where it covers least."""
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
    """Go so many times away, the steps beyond the first being short: a mark may be large."""
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
