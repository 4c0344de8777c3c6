"""Places for poles on the ground of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from retropole.base.datatypes import Array
from retropole.simulation.pairs import MIN_POLE_ANGLE, MIN_RINGS, SimulationError
from retropole.simulation.raycast import Cylinder
from retropole.simulation.recorded import RecordedBeams, hits_on
from retropole.simulation.scenes import FOOT_HEIGHT, POLE_SPACING, TAPE

MIN_RETURNS = 8
"""Returns of each LiDAR on each pole. Where rings are known, they lie on `MIN_RINGS` of them: a
pole along a single ring looks like the edge of a plate."""

POLE_DISTANCES = 3.0, 10.0
"""Least and greatest horizontal distance of a pole's foot from each LiDAR, metres."""

POLE_LENGTHS, MAX_LEAN = (2.0, 2.4), float(np.radians(45.0))
"""Least and greatest length, metres; lean from the vertical, rad: what people set up by hand."""

GROUND_RADIUS, GROUND_POINTS, GROUND_QUANTILE = 0.5, 5, 0.1
"""The ground at a foot is this quantile of the heights within so many metres around it, of at least
so many returns."""

GROUND_SPREAD = 0.3
"""It is bare where the heights spread by less, metres: no car, hedge or wall stands there."""

GROUND_STEP, GROUND_AROUND = 0.5, 3.0
"""It is the ground, and not the top of something, where it lies less than this above the lowest
returns within so many metres around."""

CLEARANCE, CLEAR_FROM = 0.3, 0.25
"""Nothing was recorded this close to a pole, from so high above the ground, metres."""

MAX_DRAWS, MAX_SECOND_DRAWS = 20_000, 2_000
"""Draws of single poles before a `SimulationError`, and before earlier poles are drawn again."""


def draw_standing_poles(
    points: Array,
    beams: Sequence[RecordedBeams],
    widths: Sequence[float],
    rng: np.random.Generator,
    count: int,
    radius: float,
    up: Array,
) -> list[Cylinder]:
    """Draw poles that stand free on recorded ground where all LiDARs see them.

    Parameters
    ----------
    points
        (N, 3) all that was recorded, metres, in the target's frame.
    beams
        Of all LiDARs, the target's first, in the same frame.
    widths
        Full angle of their beams, rad.
    rng
        Draws them.
    count, radius
        How many, and how thick, metres.
    up
        (3,) in the same frame.

    Raises
    ------
    SimulationError
        `MAX_DRAWS` draws gave no such poles.
    """
    level = _level(up)
    points = points @ level.T
    origins = [level @ each.origin for each in beams]
    near = np.linalg.norm(points[:, :2] - origins[0][:2], axis=1)
    points = points[near < POLE_DISTANCES[1] + GROUND_AROUND]
    trees = cKDTree(points[:, :2]), cKDTree(points)
    standing: list[Cylinder] = []
    feet: list[Array] = []
    since = 0
    for _ in range(MAX_DRAWS):
        since += 1
        if since > MAX_SECOND_DRAWS:
            standing, feet, since = [], [], 0
        bearing = rng.uniform(0, 2 * np.pi)
        away = np.sqrt(rng.uniform(POLE_DISTANCES[0] ** 2, POLE_DISTANCES[1] ** 2))
        foot = origins[0][:2] + away * np.array([np.cos(bearing), np.sin(bearing)])
        lean, toward = rng.uniform(0, MAX_LEAN), rng.uniform(0, 2 * np.pi)
        length = float(rng.uniform(*POLE_LENGTHS))
        axis = np.r_[np.sin(lean) * np.array([np.cos(toward), np.sin(toward)]), np.cos(lean)]
        others = [float(np.linalg.norm(foot - origin[:2])) for origin in origins[1:]]
        if any(not POLE_DISTANCES[0] <= other <= POLE_DISTANCES[1] for other in others):
            continue
        gaps = [float(np.linalg.norm(foot - other)) for other in feet]
        if any(not POLE_SPACING[0] <= gap <= POLE_SPACING[1] for gap in gaps):
            continue
        cosines = [abs(float(level @ pole.axis @ axis)) for pole in standing]
        if any(cosine > np.cos(MIN_POLE_ANGLE) for cosine in cosines):
            continue
        ground = ground_height(points, trees[0], foot)
        if ground is None:
            continue
        centre = np.r_[foot, ground + FOOT_HEIGHT] + axis * length / 2
        if not _stands_free(points, trees[1], centre, axis, length, ground):
            continue
        pole = Cylinder(level.T @ centre, level.T @ axis, radius, length, TAPE)
        if not _seen(beams, widths, [pole]):
            continue
        standing, since = [*standing, pole], 0
        feet.append(foot)
        if len(standing) == count:
            # One may hide another.
            if _seen(beams, widths, standing):
                return standing
            standing, feet = [], []
    raise SimulationError(
        f"{MAX_DRAWS} draws gave no {count} poles on the ground of the recordings with "
        f"{MIN_RETURNS} returns of each LiDAR"
    )


def _seen(
    beams: Sequence[RecordedBeams], widths: Sequence[float], poles: Sequence[Cylinder]
) -> bool:
    """Whether all LiDARs have `MIN_RETURNS` on each pole, on `MIN_RINGS` where rings are known."""
    for each, width in zip(beams, widths, strict=True):
        hits, met = hits_on(each, poles, width)
        for k in range(len(poles)):
            on_pole = met[hits.surface[met] == k]
            if len(on_pole) < MIN_RETURNS:
                return False
            rings = np.unique(each.rings[on_pole])
            if rings[-1] >= 0 and np.count_nonzero(rings >= 0) < MIN_RINGS:
                return False
    return True


def _level(up: Array) -> Array:
    """(3, 3) rotation from the target's frame to one whose z axis points up."""
    third = up / np.linalg.norm(up)
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(third)))], third)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third])


def ground_height(points: Array, tree: Any, foot: Array) -> float | None:
    """Height of bare ground at a foot (2,), metres; None where there is none.

    Parameters
    ----------
    points
        (N, 3) metres, z up.
    tree
        `cKDTree` of their x and y.
    foot
        (2,) x and y, metres.
    """
    heights = points[tree.query_ball_point(foot, GROUND_RADIUS), 2]
    if len(heights) < GROUND_POINTS:
        return None
    ground, high = np.quantile(heights, [GROUND_QUANTILE, 1 - GROUND_QUANTILE])
    around = points[tree.query_ball_point(foot, GROUND_AROUND), 2]
    if high - ground > GROUND_SPREAD:
        return None
    lowest = np.quantile(around, GROUND_QUANTILE / 2)
    return float(ground) if ground - lowest < GROUND_STEP else None


def _stands_free(
    points: Array, tree: Any, centre: Array, axis: Array, length: float, ground: float
) -> bool:
    """Whether nothing was recorded within `CLEARANCE` of a pole."""
    near = points[tree.query_ball_point(centre, length / 2 + CLEARANCE)] - centre
    along = np.clip(near @ axis, -length / 2, length / 2)
    away = np.linalg.norm(near - along[:, None] * axis, axis=1)
    return not np.any((away < CLEARANCE) & (near[:, 2] + centre[2] > ground + CLEAR_FROM))
