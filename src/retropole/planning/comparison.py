"""The poles as set up against the plan, as one LiDAR sees them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..base import se3
from ..base.datatypes import Array
from ..result import PoleDoc
from ..result.pole_plan import PlannedPoleDoc, PolePlanDoc

FARTHEST = 2.0
"""A pole farther from every planned one is another, metres."""

NEAR, ALIKE = 0.3, float(np.radians(8.0))
"""A pole is as planned where its foot is within this distance, metres, and its axis within, rad: an
arm's length and what an eye can judge."""


LEVEL = 0.3
"""Sine of the elevation of an axis below which the pole lies and has no foot."""


@dataclass(frozen=True, eq=False)
class Deviation:
    """How a pole deviates from its plan.

    Attributes
    ----------
    name
        Of the planned pole.
    offset
        (2,) of its foot from the planned one, metres, place frame; None if it was not found.
    turned
        Angle between both axes, rad.
    text
        The same for a person, and what to do.
    """

    name: str
    offset: Array | None
    turned: float
    text: str

    @property
    def is_as_planned(self) -> bool:
        """Whether it is where it should be."""
        near = self.offset is not None and float(np.linalg.norm(self.offset)) <= NEAR
        return near and self.turned <= ALIKE


@dataclass(frozen=True, eq=False)
class StationView:
    """What one LiDAR sees of a placement.

    Attributes
    ----------
    lidar, placement
        Its name, and the number of the placement, from 0.
    deviations
        Of each pole that the plan wants it to see.
    others
        How many poles are not in the plan.
    """

    lidar: str
    placement: int
    deviations: tuple[Deviation, ...]
    others: int


def against_plan(
    plan: PolePlanDoc,
    poles: Sequence[PoleDoc],
    lidar: str | None = None,
    placement: int | None = None,
) -> StationView:
    """Compare the poles that a LiDAR sees with the plan.

    Parameters
    ----------
    plan
        The plan.
    poles
        That were found, in the frame of the LiDAR's recording.
    lidar, placement
        Which LiDAR and placement it is; None takes those that they fit best.
    """
    tried = []
    for station in plan.lidars:
        if lidar not in (None, station.name):
            continue
        for p, each in enumerate(plan.placements):
            wanted = [
                pole for pole in each.poles if station.name in {seen.lidar for seen in pole.seen}
            ]
            if placement in (None, p):
                deviations, others = _match(wanted, poles, station.T_place_lidar)
                tried.append(StationView(station.name, p, tuple(deviations), others))
    return min(tried, key=_badness)


def _badness(view: StationView) -> float:
    """Sum of how far poles are off; for one that is missing `FARTHEST`."""
    away = [
        FARTHEST if each.offset is None else float(np.linalg.norm(each.offset))
        for each in view.deviations
    ]
    return sum(away) + FARTHEST * view.others


def _match(
    wanted: Sequence[PlannedPoleDoc], poles: Sequence[PoleDoc], T_place_lidar: Array
) -> tuple[list[Deviation], int]:
    """Pair planned poles with those set up, each with the one whose foot is nearest."""
    points = se3.apply(T_place_lidar, np.array([p.point_m for p in poles]).reshape(-1, 3))
    axes = np.array([p.direction for p in poles]).reshape(-1, 3) @ T_place_lidar[:3, :3].T
    offsets = np.zeros((len(wanted), len(poles), 2))
    for k, plan in enumerate(wanted):
        for j, (point, axis) in enumerate(zip(points, axes, strict=True)):
            # Where its axis intersects the ground; of a level one the middle.
            along = (plan.foot_m - point)[2] / axis[2] if abs(axis[2]) > LEVEL else 0.0
            offsets[k, j] = (point + along * axis - plan.foot_m)[:2]
    away = np.linalg.norm(offsets, axis=2)
    planned = np.array([plan.direction for plan in wanted]).reshape(-1, 3)
    turn = np.arccos(np.clip(np.abs(planned @ axes.T), 0.0, 1.0))
    # One that was put where the other should be is identified by how it leans.
    cost = away + NEAR / ALIKE * turn
    pairs = dict(zip(*(each.tolist() for each in linear_sum_assignment(cost)), strict=True))
    found = []
    for k, plan in enumerate(wanted):
        j = pairs.get(k, -1)
        if j < 0 or away[k, j] > FARTHEST:
            found.append(Deviation(plan.name, None, 0.0, _missing(plan)))
            continue
        turned = float(turn[k, j])
        text = _words(plan, offsets[k, j], turned)
        found.append(Deviation(plan.name, offsets[k, j], turned, text))
    matched = sum(each.offset is not None for each in found)
    return found, len(poles) - matched


def _missing(plan: PlannedPoleDoc) -> str:
    return (
        f"pole {plan.name} is not seen within {FARTHEST:g} m of its place: is it set up and "
        f"taped, and is nothing in front of it? ({plan.words.partition(': ')[2]})"
    )


def _words(plan: PlannedPoleDoc, offset: Array, turned: float) -> str:
    """Describe how a pole leans, and where to move it as seen from the first LiDAR."""
    far = float(np.linalg.norm(offset))
    where = f"pole {plan.name} is {far:.2f} m and {np.degrees(turned):.0f}° from its planned pose"
    if far <= NEAR and turned <= ALIKE:
        return f"{where}: good"
    # The origin of the scene is below the first LiDAR.
    out = plan.foot_m[:2] / max(float(np.linalg.norm(plan.foot_m[:2])), 1e-9)
    left = np.array([-out[1], out[0]])
    steps = []
    if far > NEAR:
        for size, plus, minus in (
            (-offset @ out, "farther away", "nearer"),
            (-offset @ left, "to the left", "to the right"),
        ):
            if abs(size) > NEAR / 3:
                steps.append(f"{abs(size):.1f} m {plus if size > 0 else minus}")
    moves = [f"move it {' and '.join(steps)}, as seen from the first LiDAR"] if steps else []
    if turned > ALIKE:
        lean = "upright" if not plan.towards else f"{np.degrees(plan.lean_rad):.0f}° {plan.towards}"
        moves.append(f"lean it {lean}" if plan.towards else f"set it {lean}")
    return f"{where}: {'; '.join(moves)}"
