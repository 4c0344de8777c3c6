"""Sweeps of both LiDARs that are kept while the poles stand still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..io import Frame
from .seeing import Tracked, away_from, present

SWEEPS = 15
"""Of each LiDAR that are kept of a placement."""

LEAST_SECONDS = 3.0
"""They take no less, s: of sweeps that come faster more are kept, and a sway shows."""

MOST_SWEEPS = 150
"""More are not kept, 15 s at 10 Hz: 1.5 GB of two LiDARs with 100,000 points."""

ELSEWHERE = 0.3
"""A pole that stands so far from where it was, metres, or one more, is another placement."""


@dataclass(frozen=True, eq=False)
class Capture:
    """What is kept of one placement.

    Attributes
    ----------
    frames
        Of each LiDAR.
    start
        When it began, s.
    seconds
        How long it has to take.
    poles
        That each LiDAR saw at its start.
    """

    frames: tuple[tuple[Frame, ...], ...]
    start: float
    poles: tuple[tuple[Tracked, ...], ...]
    seconds: float = LEAST_SECONDS

    @property
    def count(self) -> int:
        """How many sweeps are kept of the LiDAR that has the fewest."""
        return min(len(own) for own in self.frames)

    def with_frame(self, lidar: int, frame: Frame) -> Capture:
        """Keep one sweep more; none beyond `MOST_SWEEPS`."""
        own = self.frames[lidar]
        if len(own) >= MOST_SWEEPS:
            return self
        frames = (*self.frames[:lidar], (*own, frame), *self.frames[lidar + 1 :])
        return replace(self, frames=frames)

    def is_full(self, wanted: int, now: float) -> bool:
        """Whether there are enough sweeps, over time enough."""
        enough = self.count >= wanted and now - self.start >= self.seconds
        return enough or self.count >= MOST_SWEEPS


def begun(tracks: Sequence[Sequence[Tracked]], now: float) -> Capture:
    """Begin to keep sweeps of poles that stand so."""
    return Capture(tuple(() for _ in tracks), now, tuple(present(own, now) for own in tracks))


def is_elsewhere(capture: Capture, tracks: Sequence[Sequence[Tracked]], now: float) -> bool:
    """Whether the poles stand otherwise than when a placement was kept."""
    for was, own in zip(capture.poles, tracks, strict=True):
        for each in present(own, now):
            gaps = [max(away_from(each.pole, old.pole), _along(each, old)) for old in was]
            if min(gaps, default=np.inf) > ELSEWHERE:
                return True
    return False


def _along(new: Tracked, old: Tracked) -> float:
    """How far the middle lies beyond the returns of before, metres."""
    gap = abs(float((new.pole.point - old.pole.point) @ old.pole.direction))
    return max(gap - old.pole.length / 2, 0.0)
