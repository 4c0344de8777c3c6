"""The place as it was recorded without poles: its ground, and where a pole can stand on it.

All is in the frame of the place, whose z axis points up from the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.errors import Refusal
from ..base.sensors import Sensor
from ..simulation.recorded import RecordedBeams, in_frame

CELL = 0.25
"""Side of a cell of the ground, metres."""

FOOT, FOOT_POINTS = 0.5, 3
"""The ground at a foot is what lies within so many metres of it, of at least so many returns."""

LOW, HIGH = 0.1, 0.9
"""Quantiles of the heights in a cell that count as its bottom and its top: single returns err."""

SPREAD = 0.25
"""Ground is bare and flat where its cells within `FOOT` reach no higher above each other, metres:
a pole's foot stands on it, and on a slope of 14°."""

STEP, AROUND = 0.4, 3.0
"""Ground lies no higher than this above the lowest within so many metres: else it is the top of
something, such as a car."""

FARTHEST = 15.0
"""Ground farther from every LiDAR is not looked at, metres: hardly a beam meets a pole there."""

ABOVE = 0.3
"""Returns so high above the ground are of something that stands there, metres."""

CLEARANCE = 0.6
"""So far a pole keeps from it, metres (docs/placing.md)."""

OWN = 1.0
"""Poles keep so far from a LiDAR, metres."""

MIN_FEET = 4
"""Fewer places for a foot are no ground to stand poles on."""


@dataclass(frozen=True, eq=False)
class Station:
    """A LiDAR where it stands, and what it recorded there without poles.

    Attributes
    ----------
    name
        What it is called.
    cloud
        In its own frame, the beams starting at its origin (0, 0, 0).
    sensor
        What recorded it; None where not known.
    beams
        In the same frame.
    T
        (4, 4) its pose in the frame of the place.
    origin
        (3,) where its beams start in the frame of its recording, metres.
    is_settled
        Whether what was recorded, or drawn, says so; else it is as it was given.
    """

    name: str
    cloud: PointCloud
    sensor: Sensor | None
    beams: RecordedBeams
    T: Array
    origin: Array
    is_settled: bool = True

    @property
    def T_place_recording(self) -> Array:
        """(4, 4) from the frame of its recording."""
        return self.T @ se3.from_rt(np.eye(3), -self.origin)

    @property
    def at(self) -> Array:
        """(3,) where it is in the place."""
        return np.asarray(self.T[:3, 3])

    def seen_from_place(self) -> RecordedBeams:
        """Its beams in the frame of the place."""
        return in_frame(self.beams, self.T)


@dataclass(frozen=True, eq=False)
class Area:
    """A rectangle of the ground, metres, that is allowed or not: its sides along x and y."""

    low: Array
    high: Array

    def holds(self, at: Array) -> BoolArray:
        """Which points (N, 2) lie in it."""
        return np.asarray(np.all((at > self.low) & (at < self.high), axis=1))


@dataclass(frozen=True, eq=False)
class Place:
    """What is known of the ground, and what stands on it.

    Attributes
    ----------
    feet
        (F, 3) where a foot can stand, the middle of each cell on the ground.
    standing
        What was recorded above the ground, to keep away from.
    """

    feet: Array
    standing: cKDTree

    def are_free(self, foot: Array, axis: Array, length: float) -> BoolArray:
        """Which poles (K,) with feet (K, 3) and axes (K, 3) keep `CLEARANCE` from all around."""
        steps = np.linspace(0.0, length, int(np.ceil(length / (CLEARANCE / 2))) + 1)
        along = foot[:, None] + steps[:, None] * axis[:, None]
        away = self.standing.query(along.reshape(-1, 3), distance_upper_bound=CLEARANCE)[0]
        return np.asarray(np.isinf(away).reshape(len(foot), len(steps)).all(axis=1))


def survey(
    stations: Sequence[Station], allowed: Sequence[Area] = (), forbidden: Sequence[Area] = ()
) -> Place:
    """Find the ground on which a pole can stand.

    Parameters
    ----------
    stations
        All LiDARs, in the frame of the place.
    allowed, forbidden
        Where poles may stand, anywhere if empty; and where they may not.

    Raises
    ------
    Refusal
        ``no_ground`` where there is none that is bare and flat.
    """
    points = np.concatenate([se3.apply(each.T, each.cloud.xyz) for each in stations])
    lidars = np.stack([each.at for each in stations])
    near = np.full(len(points), np.inf)
    for at in lidars:
        near = np.minimum(near, np.linalg.norm(points[:, :2] - at[:2], axis=1))
    if not (near < FARTHEST).any():
        raise Refusal(
            "no_ground",
            f"no LiDAR recorded anything within {FARTHEST:g} m beside it, the nearest return is "
            f"{near.min(initial=np.inf):.1f} m away: no pole can stand where it would be seen",
            {"nearest_m": float(near.min(initial=np.inf)), "farthest_m": FARTHEST},
        )
    points = points[near < FARTHEST]
    low, high, count, corner = _cells(points)
    disc = _disc(FOOT)
    bottom = ndimage.minimum_filter(low, footprint=disc, mode="constant", cval=np.inf)
    top = ndimage.maximum_filter(high, footprint=disc, mode="constant", cval=-np.inf)
    around = ndimage.minimum_filter(low, footprint=_disc(AROUND), mode="constant", cval=np.inf)
    enough = ndimage.convolve(count, disc.astype(count.dtype), mode="constant") >= FOOT_POINTS
    # What lies between the returns around a box may be its inside.
    enough &= ndimage.maximum_filter(count, size=3, mode="constant") > 0
    flat = enough & (top < bottom + SPREAD) & (bottom < around + STEP)
    x, y = np.nonzero(flat)
    feet = np.c_[corner + (np.c_[x, y] + 0.5) * CELL, (bottom[x, y] + top[x, y]) / 2]
    kept = np.all(np.linalg.norm(feet[:, None, :2] - lidars[:, :2], axis=2) > OWN, axis=1)
    if allowed:
        kept &= np.any([area.holds(feet[:, :2]) for area in allowed], axis=0)
    for area in forbidden:
        kept &= ~area.holds(feet[:, :2])
    if np.count_nonzero(kept) < MIN_FEET:
        where = " in the areas that are allowed" if allowed or forbidden else ""
        raise Refusal(
            "no_ground",
            f"the recordings show {np.count_nonzero(flat)} squares of {CELL:g} m on bare, flat "
            f"ground within {FARTHEST:g} m, {np.count_nonzero(kept)} of them{where}: no pole can "
            "stand",
            {"places": int(np.count_nonzero(flat)), "allowed": int(np.count_nonzero(kept))},
        )
    # Where nothing low is near, what was recorded stands on something.
    floors = np.where(bottom < around + STEP, bottom, around)
    floor = floors[tuple(((points[:, :2] - corner) / CELL).astype(np.intp).T)]
    return Place(feet[kept], cKDTree(points[points[:, 2] > floor + ABOVE]))


def _cells(points: Array) -> tuple[Array, Array, IntArray, Array]:
    """Bottom and top of what was recorded in each cell, how much, and the corner (2,) of all."""
    corner = np.floor(points[:, :2].min(axis=0) / CELL) * CELL
    at = ((points[:, :2] - corner) / CELL).astype(np.int64)
    shape = tuple(at.max(axis=0) + 1)
    cell = np.ravel_multi_index((at[:, 0], at[:, 1]), shape)
    order = np.lexsort((points[:, 2], cell))
    found, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    heights = points[order, 2]
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    low.flat[found] = heights[first + (LOW * (count - 1)).astype(np.int64)]
    high.flat[found] = heights[first + np.ceil(HIGH * (count - 1)).astype(np.int64)]
    counts = np.zeros(shape, dtype=np.int64)
    counts.flat[found] = count
    return low, high, counts, corner


def _disc(radius: float) -> BoolArray:
    """Cells within a radius, metres, of the one in the middle."""
    steps = np.arange(-int(radius / CELL), int(radius / CELL) + 1) * CELL
    return np.asarray(np.hypot(steps[:, None], steps) <= radius)
