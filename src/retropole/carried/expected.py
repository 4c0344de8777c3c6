"""Which bright clusters of a sweep are searched for the pole: those that it may have come to.

A person walks no faster than `FASTEST`, so that from where a pole was found the next sweeps show it
nearby. What was found at all in the last `AGAIN` sweeps is looked for there in every sweep, and so
are two poles once both were seen. The rest of a sweep is searched where nothing is found so, where
all that was found is static, and in every tenth sweep: signs and posts of the surroundings would
take most of the time.
"""

from __future__ import annotations

from collections import Counter
from math import dist, floor, hypot
from typing import NamedTuple

from ..base.datatypes import Array
from ..extraction.acceptance_shape import MIN_LENGTH

FASTEST = 2.5
"""No person carries a pole faster, m/s (chosen: a person who runs)."""

JUMP = 0.4
"""The middle of the returns of a pole at rest moves by this amount from sweep to sweep, metres, as
rings enter and leave."""

BARREN, AGAIN, CELL = 5, 10, 0.2
"""What shines within the same box, its ends in the same cells of this size, metres, and was no pole
this many times in a row, is searched in every tenth sweep only. Ten recordings of tuning seeds 700
to 704 give the same tracks without it (benchmarks/carried.py, 20 s, five pairs of sensors)."""

STATIC = 10
"""What was found more often than this with its ends in the same cells is static."""

Ends = tuple[int, ...]
"""Cells of both ends of a box, three each."""


class Box(NamedTuple):
    """Least and largest coordinates, metres, of returns at a time, s."""

    low: list[float]
    high: list[float]
    time: float

    @classmethod
    def of(cls, xyz: Array, times: Array) -> Box:
        """Box of returns (N, 3) at times (N,)."""
        return cls(xyz.min(axis=0).tolist(), xyz.max(axis=0).tolist(), float(times.mean()))

    @property
    def ends(self) -> Ends:
        """Where it is."""
        return tuple(floor(each / CELL) for each in (*self.low, *self.high))

    def is_reached_from(self, other: Box) -> bool:
        """Whether a pole that was in another box may be in this one."""
        gaps = zip(self.low, self.high, other.low, other.high, strict=True)
        gap = hypot(*(max(low - top, bottom - high, 0.0) for low, high, bottom, top in gaps))
        return gap < FASTEST * abs(self.time - other.time) + JUMP


class Expected:
    """Where poles were in the last sweeps, and what was none."""

    def __init__(self) -> None:
        self._places: list[tuple[int, Box]] = []
        self._found, self._barren = Counter[Ends](), Counter[Ends]()

    def in_order(self, sweep: int, boxes: list[Box]) -> list[list[int]]:
        """Which of the clusters of a sweep are searched first, and which if these are no pole."""
        self._places = [each for each in self._places if each[0] >= sweep - AGAIN]
        is_again = sweep % AGAIN == 0
        sought = [
            k
            for k, box in enumerate(boxes)
            # What is shorter than any pole is none; its extent along a line is no longer.
            if dist(box.low, box.high) >= MIN_LENGTH
            and (is_again or self._barren[box.ends] < BARREN)
        ]
        if is_again or all(self._found[place.ends] > STATIC for _, place in self._places):
            return [sought]
        near = [k for k in sought if any(boxes[k].is_reached_from(own) for _, own in self._places)]
        return [near, [k for k in sought if k not in near]]

    def add(self, sweep: int, box: Box, poles: list[Box]) -> None:
        """Note what was found in a cluster."""
        self._barren[box.ends] = 0 if poles else self._barren[box.ends] + 1
        self._found.update(pole.ends for pole in poles)
        # Where one was before, it is no longer.
        self._places = [
            (at, place)
            for at, place in self._places
            if at == sweep or not any(pole.is_reached_from(place) for pole in poles)
        ]
        self._places += [(sweep, pole) for pole in poles]
