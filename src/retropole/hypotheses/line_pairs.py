"""Two poles as two skew lines: what no motion changes of them, and the ways of laying two on two.

A line has no direction and two poles have no names, so a pair of poles fits another in 2 × 4 ways
(Xue et al. 2019, Fig. 4). Each way has a start in closed form: the bisectors and the common
perpendicular of two skew lines make a frame, the middle of the common perpendicular its origin,
and frame is laid on frame. Of the eight, four are exact: the lines' own symmetry group is the
identity and the half turns about the common perpendicular and about the two bisectors (the Klein
four-group). The other four pair an angle with its supplement, so they are exact only where the
poles are perpendicular and cross.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base import se3
from ..base.datatypes import Array, Pole
from ..base.errors import Refusal


@dataclass(frozen=True, eq=False)
class LinePair:
    """The geometry of two skew lines that no rigid motion changes, and the frame that one moves.

    Attributes
    ----------
    angle
        Between the lines, in (0, π/2], radians.
    distance
        Along the common perpendicular, metres.
    handedness
        Sign of the screw from one line to the other, times `distance`: no proper motion changes it.
    frame
        (4, 4) bisector, other bisector, common perpendicular; origin midway between the lines.
    """

    angle: float
    distance: float
    handedness: float
    frame: Array


def line_pair(p1: Array, n1: Array, p2: Array, n2: Array) -> LinePair:
    """Measure two lines, with ``n1`` and ``n2`` taken as directed the way they are given.

    Parameters
    ----------
    p1, n1, p2, n2
        (3,) a point and the unit direction of each line.

    Raises
    ------
    Refusal
        ``parallel_poles`` where the lines have no common perpendicular of their own.
    """
    cross = np.cross(n1, n2)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-6:
        raise Refusal(
            "parallel_poles",
            "two poles are parallel; lean one by 15° or more against the other",
            {"angle_deg": float(np.degrees(np.arcsin(sine)))},
        )
    e1 = (n1 + n2) / np.linalg.norm(n1 + n2)
    e3 = cross / sine
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2] = e1, np.cross(e3, e1), e3
    # Feet of the common perpendicular: solve p1 + a n1 + h e3 = p2 + b n2.
    a, b, h = np.linalg.solve(np.stack([n1, -n2, e3], axis=1), p2 - p1)
    frame[:3, 3] = (p1 + a * n1 + p2 + b * n2) / 2
    cosine = float(n1 @ n2)
    angle = float(np.arctan2(sine, abs(cosine)))
    return LinePair(angle, abs(float(h)), float(h) * (1.0 if cosine >= 0 else -1.0), frame)


def pair_starts(
    target: tuple[Pole, Pole], source: tuple[Pole, Pole]
) -> list[tuple[Array, tuple[int, int]]]:
    """Lay one pair of poles on another in the paper's eight ways, in closed form.

    Returns
    -------
    list of (T_target_source, order)
        ``order`` tells which source pole (0 or 1) goes to the first and to the second target pole.
    """
    frame = line_pair(
        target[0].point, target[0].direction, target[1].point, target[1].direction
    ).frame
    return [(frame @ way, order) for way, order in pair_ways(source)]


def pair_ways(pair: tuple[Pole, Pole]) -> list[tuple[Array, tuple[int, int]]]:
    """Express points in the frame of a pair of poles, in the eight ways of naming and directing it.

    Returns
    -------
    list of (T_frame_lidar, order)
        (4, 4), and which pole (0 or 1) is the first and which the second.
    """
    ways = []
    for order in ((0, 1), (1, 0)):
        first, second = pair[order[0]], pair[order[1]]
        for s1 in (1.0, -1.0):
            for s2 in (1.0, -1.0):
                frame = line_pair(
                    first.point, s1 * first.direction, second.point, s2 * second.direction
                ).frame
                ways.append((se3.inverse(frame), order))
    return ways


def direction_sigma(pole: Pole) -> float:
    """Roughly how well the points of a pole fix its direction, 1 σ in radians."""
    return float(pole.rms * np.sqrt(12.0 / len(pole.xyz)) / max(pole.length, 1e-3))
