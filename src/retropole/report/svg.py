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

_AROUND = (
    *((1, 0, "start"), (-1, 0, "end"), (0, -1.3, "middle"), (0, 1.3, "middle")),
    *((0.8, -1, "start"), (0.8, 1, "start"), (-0.8, -1, "end"), (-0.8, 1, "end")),
    *((0, -2.4, "middle"), (0, 2.4, "middle"), (1.2, -2, "start"), (1.2, 2, "start")),
)
"""Where a label may stand around its mark, in units of their distance, and its anchor."""


def short(name: str) -> str:
    """Shorten a name for a picture."""
    return name if len(name) <= LONGEST_LABEL else f"{name[: LONGEST_LABEL - 1]}…"


@dataclass
class Labels:
    """Labels of one picture of so many units across and down; none covers another if it can."""

    width: float
    height: float
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)

    def keep_free(self, x: float, y: float, half: float) -> None:
        """Keep a square free of labels."""
        self.taken.append((x - half, y - half, x + half, y + half))

    def place(
        self, text: str, x: float, y: float, away: float, style: str = "", size: float = FONT
    ) -> Html:
        """Write a label beside a mark at x, y, where it covers least."""
        best, least = None, math.inf
        for dx, dy, anchor in _AROUND:
            box = self._box(text, x + dx * away, y + dy * away, anchor, size)
            cost = sum(_overlap(box, other) for other in self.taken)
            cost += 3 * self._outside(box)
            if cost < least:
                best, least = (x + dx * away, y + dy * away, anchor, box), cost
            if cost == 0:
                break
        assert best is not None
        self.taken.append(best[3])
        return fill(
            "label", x=best[0], y=best[1] + 0.35 * size, anchor=best[2], style=style, text=text
        )

    def _box(
        self, text: str, x: float, y: float, anchor: str, size: float
    ) -> tuple[float, float, float, float]:
        width = LETTER * size * len(text)
        left = x - {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor] * width
        return left, y - 0.6 * size, left + width, y + 0.6 * size

    def _outside(self, box: tuple[float, float, float, float]) -> float:
        inside = max(0.0, min(box[2], self.width) - max(box[0], 0.0)) * max(
            0.0, min(box[3], self.height) - max(box[1], 0.0)
        )
        return (box[2] - box[0]) * (box[3] - box[1]) - inside


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> float:
    """Area that two boxes share."""
    wide, high = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    return wide * high if wide > 0 and high > 0 else 0.0
