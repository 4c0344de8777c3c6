"""The movement that matters: what a check must find, and its command line offers as a default."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians


@dataclass(frozen=True)
class Tolerance:
    """The movement that matters: of the rotation, rad, and of the translation, m."""

    rotation: float = radians(0.3)
    translation: float = 0.03


DEFAULT_TOLERANCE = Tolerance()
