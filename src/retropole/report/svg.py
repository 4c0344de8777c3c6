"""Labels of the pictures of a site: none covers another, and long names are shortened."""

from __future__ import annotations

from dataclasses import dataclass, field

from .page import Html, fill

LONGEST_LABEL = 18
"""Characters of a name in a picture; the tables have it whole."""

LETTER = 0.58
"""Width of a letter over the size of the font, on average (measured on sans-serif fonts)."""

FONT = 17.0
"""Size of the labels in a picture's own units, between those of a screen (15) and of a phone (18:
11 px where the picture is 330 px wide)."""

_AROUND: tuple[tuple[float, float, str], ...] = (
    *((1, 0, "start"), (-1, 0, "end"), (0, -1.3, "middle"), (0, 1.3, "middle")),
    *((0.8, -1, "start"), (0.8, 1, "start"), (-0.8, -1, "end"), (-0.8, 1, "end")),
    *((0, -2.4, "middle"), (0, 2.4, "middle"), (1.2, -2, "start"), (1.2, 2, "start")),
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

    def keep_free(self, x: float, y: float, half: float) -> None:
        """Keep a square free of labels."""
        self.taken.append((x - half, y - half, x + half, y + half))

    def place(
        self, text: str, x: float, y: float, away: float, style: str = "", size: float = FONT
    ) -> Html:
        """Write a label beside a mark at x, y, where it covers least."""
        around = (
            (_box(text, x + dx * away, y + dy * away, anchor, size), dx, dy, anchor)
            for dx, dy, anchor in _AROUND
        )
        box, dx, dy, anchor = min(around, key=lambda at: self._cost(at[0]))
        self.taken.append(box)
        x, y = x + dx * away, y + dy * away
        return fill("label", x=x, y=y + 0.35 * size, anchor=anchor, style=style, text=text)

    def _cost(self, box: Box) -> float:
        """Area that a label covers of others, and thrice that outside of the picture."""
        outside = _overlap(box, box) - _overlap(box, (0.0, 0.0, self.width, self.height))
        return sum(_overlap(box, other) for other in self.taken) + 3 * outside


def _box(text: str, x: float, y: float, anchor: str, size: float) -> Box:
    width = LETTER * size * len(text)
    left = x - {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor] * width
    return left, y - 0.6 * size, left + width, y + 0.6 * size


def _overlap(a: Box, b: Box) -> float:
    """Area that two boxes share."""
    wide, high = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    return wide * high if wide > 0 and high > 0 else 0.0
