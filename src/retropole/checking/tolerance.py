"""The movement that matters: what a check must detect, and its command line offers as a default."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from math import radians

from ..base.quantities import at_most


@dataclass(frozen=True)
class Tolerance:
    """The movement that matters: of the rotation, rad, and of the translation, m."""

    rotation: float
    translation: float

    def or_wider(self, other: Tolerance) -> Tolerance:
        """Give the wider of both in each part."""
        return Tolerance(*map(max, astuple(self), astuple(other)))

    def or_narrower(self, other: Tolerance) -> Tolerance:
        """Give the narrower of both in each part."""
        return Tolerance(*map(min, astuple(self), astuple(other)))

    def is_within(self, other: Tolerance) -> bool:
        """Whether it is no wider than another in either part."""
        return self.or_wider(other) == other

    @property
    def rotation_in_words(self) -> str:
        """The rotation, rounded up: ``0.30°``."""
        return at_most(self.rotation, "rad")

    @property
    def translation_in_words(self) -> str:
        """The translation, rounded up: ``30 mm``."""
        return at_most(self.translation)

    @property
    def in_words(self) -> str:
        """Both parts."""
        return f"{self.rotation_in_words} and {self.translation_in_words}"


DEFAULT_TOLERANCE = Tolerance(radians(0.3), 0.03)

WIDEST_TOLERANCE = Tolerance(radians(1.0), 0.1)
"""The widest that is confirmed where none was requested, and by the scene alone whatever was
requested: 1 σ of where `by_scene` searches it about the stored pose. What no surface constrains
stays as uncertain as that, and is not within it with `CONFIDENCE`."""


@dataclass(frozen=True)
class RequestedTolerance:
    """The tolerance that a user requested, rad and m; None for a part that is left to the data.

    What was requested is kept. A part that was not is the default, or else the least beyond it
    that the data resolve, up to the widest.
    """

    rotation: float | None = None
    translation: float | None = None

    @property
    def least(self) -> Tolerance:
        """What is to be confirmed where the data can."""
        return self._or(DEFAULT_TOLERANCE)

    @property
    def widest(self) -> Tolerance:
        """What is to be confirmed at least."""
        return self._or(WIDEST_TOLERANCE)

    def _or(self, other: Tolerance) -> Tolerance:
        return Tolerance(
            other.rotation if self.rotation is None else self.rotation,
            other.translation if self.translation is None else self.translation,
        )


NO_REQUEST = RequestedTolerance()
"""All is left to the data."""
