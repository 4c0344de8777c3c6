"""Poles that could stand, and what each LiDAR's beams meet of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array, BoolArray, IntArray
from ..simulation.raycast import Cylinder
from ..simulation.recorded import RecordedBeams
from ..simulation.scenes import FOOT_HEIGHT, TAPE
from .place import Place, Station

LEANS = (np.radians(20.0), np.radians(35.0))
"""Leans that are tried beside upright, rad (docs/placing.md)."""

DIRECTIONS = 4
"""Directions that a pole is tried to lean in, evenly over the turn."""

MOST_FEET = 40
"""Places that are looked at first: they are as far apart as that takes."""

FEET_OF_TWO = 8
"""Of several LiDARs, those that every two see together: with less, far ones had none."""

SPACINGS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
"""How far apart that may be, metres."""

MIN_RETURNS, MIN_RINGS = 14, 4
"""Returns that a LiDAR must have on a pole, and on how many rings where these are known: half as
many again as the least that is detected, since real tape and real ground are not as drawn."""

MIN_CORE = 10
"""… and those of infinitely thin beams: 8 on 3 rings are what the simulator takes for seen."""

FAR = 600.0
"""A LiDAR sees a pole as far away as so many times its radius: one of 4 cm up to 12 m. With poles
10 m from masts nearly all runs are answered, 15 m from them a fifth is not (masts.py)."""

IN_VIEW = 0.7
"""Share of the beams toward a pole that must reach it: less, and something hides it."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poles that stand free on the ground, in the frame of the place.

    Attributes
    ----------
    foot, axis
        (C, 3) of each, metres, and unit vector upwards.
    length, radius
        Of all, metres.
    """

    foot: Array
    axis: Array
    length: float
    radius: float

    def __len__(self) -> int:  # noqa: D105
        return len(self.foot)

    @property
    def centre(self) -> Array:
        """(C, 3) the middle of each."""
        return np.asarray(self.foot + (FOOT_HEIGHT + self.length / 2) * self.axis)

    def select(self, index: IntArray | BoolArray) -> Candidates:
        """Keep some."""
        return Candidates(self.foot[index], self.axis[index], self.length, self.radius)

    def pole(self, k: int) -> Cylinder:
        """One of them as a body."""
        return Cylinder(self.centre[k], self.axis[k], self.radius, self.length, TAPE)


class Met(NamedTuple):
    """The beams of one LiDAR that meet a pole, and their ranges (M,); how many pointed at it."""

    beam: IntArray
    ranges: Array
    toward: int


def beams_met(pole: Cylinder, beams: RecordedBeams, divergence: float) -> Met:
    """Find the beams that meet a pole before anything else."""
    toward = pole.centre - beams.origin
    away = float(np.linalg.norm(toward))
    if away <= pole.bounding_radius:
        return Met(np.zeros(0, dtype=np.int64), np.zeros(0), 0)
    cone = np.sqrt(1 - (pole.bounding_radius / away) ** 2)
    index = np.flatnonzero(beams.directions @ (toward / away) >= cone)
    ranges = pole.intersect(beams.origin, beams.directions[index], divergence).ranges
    aimed, met = np.isfinite(ranges), ranges < beams.ranges[index]
    return Met(index[met], ranges[met], int(np.count_nonzero(aimed)))


def is_seen(met: Met, beams: RecordedBeams) -> bool:
    """Whether a LiDAR sees enough of a pole, and nothing hides it."""
    rings = np.unique(beams.rings[met.beam])
    known = len(rings) == 0 or rings[0] >= 0
    return (
        len(met.beam) >= max(MIN_RETURNS, IN_VIEW * met.toward)
        and (len(rings) if known else MIN_RINGS) >= MIN_RINGS
    )


def sees_core(met: Met, beams: RecordedBeams) -> bool:
    """Whether enough beams meet a pole with their middle, and do not only touch it."""
    rings = np.unique(beams.rings[met.beam])
    return len(met.beam) >= MIN_CORE and (rings[0] < 0 or len(rings) >= MIN_RINGS)


def who_sees(
    candidates: Candidates, stations: Sequence[Station], divergences: Sequence[float]
) -> BoolArray:
    """Tell which LiDAR sees which pole, (C, L), each pole by itself."""
    seen = np.zeros((len(candidates), len(stations)), dtype=bool)
    for i, (station, divergence) in enumerate(zip(stations, divergences, strict=True)):
        beams = station.seen_from_place()
        for k in range(len(candidates)):
            pole = candidates.pole(k)
            if np.linalg.norm(pole.centre - station.at) > FAR * pole.radius:
                continue
            seen[k, i] = is_seen(beams_met(pole, beams, divergence), beams)
            seen[k, i] &= sees_core(beams_met(pole, beams, 0.0), beams)
    return seen


def candidate_poles(
    place: Place,
    stations: Sequence[Station],
    divergences: Sequence[float],
    length: float,
    radius: float,
) -> tuple[Candidates, BoolArray]:
    """Stand poles on the ground, upright and leaning, where two LiDARs or more see them.

    Returns
    -------
    Candidates
        Those that are free.
    (C, L) bool
        Which LiDAR sees which.
    """
    feet = at_most(place.feet, 4 * MOST_FEET * (len(stations) - 1))
    upright = Candidates(feet, np.tile([0.0, 0.0, 1.0], (len(feet), 1)), length, radius)
    upright = upright.select(place.are_free(upright.foot, upright.axis, length))
    seen = who_sees(upright, stations, divergences)
    feet = seen_together(upright.foot, seen)
    found = leaning(feet, LEANS, DIRECTIONS, length, radius)
    found = found.select(place.are_free(found.foot, found.axis, length))
    seen = who_sees(found, stations, divergences)
    kept = seen.sum(axis=1) >= 2
    return found.select(kept), seen[kept]


def seen_together(feet: Array, seen: BoolArray) -> Array:
    """Keep feet (F, 3) of each two LiDARs that see poles there, evenly over what they share."""
    shared = [feet[seen[:, i] & seen[:, j]] for i, j in combinations(range(seen.shape[1]), 2)]
    count = MOST_FEET if len(shared) == 1 else FEET_OF_TWO
    kept = np.concatenate([at_most(own, count) for own in shared])
    return np.unique(kept, axis=0) if len(shared) > 1 else kept


def leaning(
    feet: Array, leans: Sequence[float], directions: int, length: float, radius: float
) -> Candidates:
    """Stand a pole on each foot (F, 3) upright, and for each lean, rad, in so many directions."""
    axes = [np.array([0.0, 0.0, 1.0])]
    for lean in leans:
        for toward in 2 * np.pi * np.arange(directions) / directions:
            level = np.sin(lean) * np.array([np.cos(toward), np.sin(toward)])
            axes.append(np.r_[level, np.cos(lean)])
    return Candidates(
        np.repeat(feet, len(axes), axis=0), np.tile(axes, (len(feet), 1)), length, radius
    )


def at_most(feet: Array, count: int) -> Array:
    """Keep so many feet (F, 3) at most, as near to each other as that allows."""
    kept = feet
    for spacing in SPACINGS:
        if len(kept) <= count:
            break
        kept = thinned(feet, spacing)
    return kept


def thinned(feet: Array, spacing: float) -> Array:
    """Keep one foot (F, 3) of each square of a side, metres."""
    square = np.floor(feet[:, :2] / spacing).astype(np.int64)
    middle = (square + 0.5) * spacing
    # Of each square the one nearest to its middle.
    order = np.argsort(np.linalg.norm(feet[:, :2] - middle, axis=1), kind="stable")
    _, first = np.unique(square[order], axis=0, return_index=True)
    return np.asarray(feet[np.sort(order[first])])


def leans_of(axis: Array) -> Array:
    """Angles (N,) of axes (N, 3) from upright, rad."""
    return np.asarray(np.arccos(np.clip(np.abs(axis[..., 2]), 0.0, 1.0)))
