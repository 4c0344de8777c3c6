"""The scene recorded without poles: its ground, and possible positions of poles on it.

All is in the frame of the scene, whose z axis points up from the ground. For each possible pole
it is known which beams of each LiDAR hit it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.errors import Refusal
from ..base.sensors import Sensor
from ..ground.surface import cells_of
from ..simulation.raycast import Cylinder
from ..simulation.recorded import RecordedBeams, in_frame
from ..simulation.scenes import FOOT_HEIGHT, TAPE

CELL = 0.25
"""Side of a cell of the ground, metres."""

FOOT, FOOT_POINTS = 0.5, 3
"""The ground at a foot is formed by the returns within this many metres, of which there must be at
least this many."""

SPREAD = 0.25
"""Ground is bare and flat if its cells within `FOOT` differ in height by no more than this,
metres: this includes the foot of a pole, and a slope of 14°."""

STEP, AROUND = 0.4, 3.0
"""Ground is no higher than this above the lowest within this many metres: otherwise it is the top
of an object, such as a car."""

FARTHEST = 15.0
"""Ground farther from every LiDAR is not considered, metres: hardly any beam hits a pole there."""

ABOVE = 0.3
"""Returns this high above the ground are of an object, metres."""

CLEARANCE = 0.6
"""Distance of a pole from objects, metres (docs/poles.md)."""

LIDAR_CLEARANCE = 1.0
"""Distance of poles from a LiDAR, metres."""

MIN_FEET = 4
"""With fewer positions for a foot the ground has no room for poles."""


@dataclass(frozen=True, eq=False)
class Station:
    """A LiDAR at its pose, and its recording there without poles.

    Attributes
    ----------
    name
        What it is called.
    cloud
        In its frame, with the beam origin at (0, 0, 0).
    sensor
        What recorded it; None if not known.
    beams
        In the same frame.
    T
        (4, 4) its pose in the frame of the scene.
    origin
        (3,) beam origin in the frame of its recording, metres.
    is_refined
        Whether the pose was refined by the recordings, or drawn; else it is as given.
    """

    name: str
    cloud: PointCloud
    sensor: Sensor | None
    beams: RecordedBeams
    T: Array
    origin: Array
    is_refined: bool = True

    @property
    def T_place_recording(self) -> Array:
        """(4, 4) from the frame of its recording."""
        return self.T @ se3.from_rt(np.eye(3), -self.origin)

    @property
    def at(self) -> Array:
        """(3,) its position in the frame of the scene."""
        return np.asarray(self.T[:3, 3])

    def seen_from_place(self) -> RecordedBeams:
        """Its beams in the frame of the scene."""
        return in_frame(self.beams, self.T)


@dataclass(frozen=True, eq=False)
class Area:
    """A rectangle of the ground, metres, that is allowed or not: its sides along x and y."""

    low: Array
    high: Array

    def contains(self, at: Array) -> BoolArray:
        """Which points (N, 2) lie in it."""
        return np.asarray(np.all((at > self.low) & (at < self.high), axis=1))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The ground, and the objects on it.

    Attributes
    ----------
    feet
        (F, 3) possible feet, the middle of each cell on the ground.
    objects
        Points recorded above the ground, from which poles keep a distance.
    """

    feet: Array
    objects: cKDTree

    def are_free(self, foot: Array, axis: Array, length: float) -> BoolArray:
        """Which poles (K,) with feet (K, 3) and axes (K, 3) keep `CLEARANCE` from all around."""
        steps = np.linspace(0.0, length, int(np.ceil(length / (CLEARANCE / 2))) + 1)
        along = foot[:, None] + steps[:, None] * axis[:, None]
        away = self.objects.query(along.reshape(-1, 3), distance_upper_bound=CLEARANCE)[0]
        return np.asarray(np.isinf(away).reshape(len(foot), len(steps)).all(axis=1))


def survey(
    stations: Sequence[Station], allowed: Sequence[Area] = (), forbidden: Sequence[Area] = ()
) -> Surroundings:
    """Find the ground for poles.

    Parameters
    ----------
    stations
        All LiDARs, in the frame of the scene.
    allowed, forbidden
        Where poles are allowed, anywhere if empty; and where they are not.

    Raises
    ------
    Refusal
        ``no_ground`` if there is none that is bare and flat.
    """
    points = np.concatenate([se3.apply(each.T, each.cloud.xyz) for each in stations])
    lidars = np.stack([each.at for each in stations])
    near = np.full(len(points), np.inf)
    for at in lidars:
        near = np.minimum(near, np.linalg.norm(points[:, :2] - at[:2], axis=1))
    if not (near < FARTHEST).any():
        raise Refusal(
            "no_ground",
            f"no LiDAR recorded anything within {FARTHEST:g} m, the nearest return is "
            f"{near.min(initial=np.inf):.1f} m away: a pole cannot be set up where it would be "
            "seen",
            {"nearest_m": float(near.min(initial=np.inf)), "farthest_m": FARTHEST},
        )
    points = points[near < FARTHEST]
    low, high, count, corner = cells_of(points, CELL)
    disc = _disc(FOOT)
    bottom = ndimage.minimum_filter(low, footprint=disc, mode="constant", cval=np.inf)
    top = ndimage.maximum_filter(high, footprint=disc, mode="constant", cval=-np.inf)
    around = ndimage.minimum_filter(low, footprint=_disc(AROUND), mode="constant", cval=np.inf)
    enough = ndimage.convolve(count, disc.astype(count.dtype), mode="constant") >= FOOT_POINTS
    # The space between the returns around a box may be its inside.
    enough &= ndimage.maximum_filter(count, size=3, mode="constant") > 0
    flat = enough & (top < bottom + SPREAD) & (bottom < around + STEP)
    x, y = np.nonzero(flat)
    feet = np.c_[corner + (np.c_[x, y] + 0.5) * CELL, (bottom[x, y] + top[x, y]) / 2]
    kept = np.all(
        np.linalg.norm(feet[:, None, :2] - lidars[:, :2], axis=2) > LIDAR_CLEARANCE, axis=1
    )
    if allowed:
        kept &= np.any([area.contains(feet[:, :2]) for area in allowed], axis=0)
    for area in forbidden:
        kept &= ~area.contains(feet[:, :2])
    if np.count_nonzero(kept) < MIN_FEET:
        where = " in the areas that are allowed" if allowed or forbidden else ""
        raise Refusal(
            "no_ground",
            f"the recordings show {np.count_nonzero(flat)} squares of {CELL:g} m on bare, flat "
            f"ground within {FARTHEST:g} m, {np.count_nonzero(kept)} of them{where}: a pole "
            "cannot be set up",
            {"places": int(np.count_nonzero(flat)), "allowed": int(np.count_nonzero(kept))},
        )
    # If nothing low is near, the recorded points are on an object.
    floors = np.where(bottom < around + STEP, bottom, around)
    floor = floors[tuple(((points[:, :2] - corner) / CELL).astype(np.intp).T)]
    return Surroundings(feet[kept], cKDTree(points[points[:, 2] > floor + ABOVE]))


def _disc(radius: float) -> BoolArray:
    """Cells within a radius, metres, of the one in the middle."""
    steps = np.arange(-int(radius / CELL), int(radius / CELL) + 1) * CELL
    return np.asarray(np.hypot(steps[:, None], steps) <= radius)


LEANS = (np.radians(20.0), np.radians(35.0))
"""Leans that are tried in addition to upright, rad (docs/poles.md)."""

DIRECTIONS = 4
"""Directions that a pole is tried to lean in, evenly over the turn."""

MOST_FEET = 40
"""Number of positions that are tried first: it determines their spacing."""

FEET_OF_TWO = 8
"""With several LiDARs, the number for every two that see them: with fewer, far ones had none."""

SPACINGS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
"""Spacings that are tried for them, metres."""

MIN_RETURNS, MIN_RINGS = 14, 4
"""Returns that a LiDAR must have on a pole, and the number of rings if these are
known: 1.5 times the minimum for detection, since real tape and ground differ from the model."""

MIN_CORE = 10
"""… and those of infinitely thin beams: in the simulator a pole with 8 on 3 rings is treated as
seen."""

FAR = 600.0
"""A LiDAR sees a pole up to a distance of this many times its radius: one of 4 cm diameter up to
12 m. With poles 10 m from masts nearly all runs are answered, with 15 m a fifth is not
(masts.py)."""

IN_VIEW = 0.7
"""Share of the beams toward a pole that must reach it: with less, the pole is hidden."""


IN_FIELD = 0.95
"""Share of a recording's returns that are in the field of view of its sensor, in its frame."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Isolated poles on the ground, in the frame of the scene.

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


class Hits(NamedTuple):
    """The beams of one LiDAR that hit a pole, and their ranges (M,); the number that pointed at
    it."""

    beam: IntArray
    ranges: Array
    toward: int


def beams_hit(pole: Cylinder, beams: RecordedBeams, divergence: float) -> Hits:
    """Find the beams that hit a pole before any other object."""
    toward = pole.centre - beams.origin
    away = float(np.linalg.norm(toward))
    if away <= pole.bounding_radius:
        return Hits(np.zeros(0, dtype=np.int64), np.zeros(0), 0)
    cone = np.sqrt(1 - (pole.bounding_radius / away) ** 2)
    index = np.flatnonzero(beams.directions @ (toward / away) >= cone)
    ranges = pole.intersect(beams.origin, beams.directions[index], divergence).ranges
    aimed, is_hit = np.isfinite(ranges), ranges < beams.ranges[index]
    return Hits(index[is_hit], ranges[is_hit], int(np.count_nonzero(aimed)))


def is_seen(met: Hits, beams: RecordedBeams) -> bool:
    """Whether a LiDAR sees enough of a pole, and nothing hides it."""
    rings = np.unique(beams.rings[met.beam])
    known = len(rings) == 0 or rings[0] >= 0
    return (
        len(met.beam) >= max(MIN_RETURNS, IN_VIEW * met.toward)
        and (len(rings) if known else MIN_RINGS) >= MIN_RINGS
    )


def sees_core(pole: Cylinder, met: IntArray, beams: RecordedBeams) -> bool:
    """Whether enough of the beams that hit a pole do so with their middle, not only an edge."""
    ranges = pole.intersect(beams.origin, beams.directions[met], 0.0).ranges
    rings = beams.rings[met[ranges < beams.ranges[met]]]
    return len(rings) >= MIN_CORE and (rings.min() < 0 or len(np.unique(rings)) >= MIN_RINGS)


def who_sees(
    candidates: Candidates, stations: Sequence[Station], divergences: Sequence[float]
) -> BoolArray:
    """Find which LiDAR sees which pole, (C, L), each pole separately."""
    seen = np.zeros((len(candidates), len(stations)), dtype=bool)
    for i, (station, divergence) in enumerate(zip(stations, divergences, strict=True)):
        beams = station.seen_from_place()
        field = field_of(station)
        for k in range(len(candidates)):
            pole = candidates.pole(k)
            if np.linalg.norm(pole.centre - station.at) > FAR * pole.radius:
                continue
            if field is not None and not is_in_view(pole, station, field):
                continue
            is_hit = beams_hit(pole, beams, divergence)
            seen[k, i] = is_seen(is_hit, beams) and sees_core(pole, is_hit.beam, beams)
    return seen


def field_of(station: Station) -> Sensor | None:
    """Give the sensor of a LiDAR with a limited field of view, if it was recorded in its frame.

    None for any other: the limits of the field of view are not known for a rotated recording.
    """
    sensor = station.sensor
    if sensor is None or sensor.sees_all_around:
        return None
    return sensor if np.mean(sensor.has_in_view(station.cloud.xyz)) >= IN_FIELD else None


def is_in_view(pole: Cylinder, station: Station, sensor: Sensor) -> bool:
    """Whether a pole is in a LiDAR's field of view, and would be if it leaned further to a side."""
    ends = pole.centre + np.array([[-0.5], [0.5]]) * pole.length * pole.axis
    rays = se3.apply(se3.inverse(station.T), ends)
    away = np.hypot(rays[:, 0], rays[:, 1])
    margin = np.arctan2(pole.length * np.sin(LEANS[0]), away)
    return bool(sensor.has_in_view(rays, margin).all())


def candidate_poles(
    place: Surroundings,
    stations: Sequence[Station],
    divergences: Sequence[float],
    length: float,
    radius: float,
) -> tuple[Candidates, BoolArray]:
    """Place poles on the ground, upright and leaning, where at least two LiDARs see them.

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
    feet = shared_feet(upright.foot, seen)
    found = leaning(feet, LEANS, DIRECTIONS, length, radius)
    found = found.select(place.are_free(found.foot, found.axis, length))
    seen = who_sees(found, stations, divergences)
    kept = seen.sum(axis=1) >= 2
    return found.select(kept), seen[kept]


def shared_feet(feet: Array, seen: BoolArray) -> Array:
    """Keep feet (F, 3) for every two LiDARs that see poles there, evenly over their common
    ground."""
    shared = [feet[seen[:, i] & seen[:, j]] for i, j in combinations(range(seen.shape[1]), 2)]
    count = MOST_FEET if len(shared) == 1 else FEET_OF_TWO
    kept = np.concatenate([at_most(own, count) for own in shared])
    return np.unique(kept, axis=0) if len(shared) > 1 else kept


def leaning(
    feet: Array, leans: Sequence[float], directions: int, length: float, radius: float
) -> Candidates:
    """Place a pole on each foot (F, 3) upright, and for each lean, rad, in this many directions."""
    axes = [np.array([0.0, 0.0, 1.0])]
    for lean in leans:
        for toward in 2 * np.pi * np.arange(directions) / directions:
            level = np.sin(lean) * np.array([np.cos(toward), np.sin(toward)])
            axes.append(np.r_[level, np.cos(lean)])
    return Candidates(
        np.repeat(feet, len(axes), axis=0), np.tile(axes, (len(feet), 1)), length, radius
    )


def at_most(feet: Array, count: int) -> Array:
    """Keep at most this many feet (F, 3), as near to each other as that allows."""
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
