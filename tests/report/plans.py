"""Plans of poles that are made up: a yard, what the poles would tell, and the document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.base.uncertainty import RANGES, BudgetEntry, predicted_error
from retropole.base.uncertainty.purpose import Need, displacement_bounds
from retropole.report.pole_plan_picture import PlanPicture
from retropole.result import ReasonDoc
from retropole.result.pole_plan import (
    MoreDoc,
    PlannedPlacementDoc,
    PlannedPoleDoc,
    PolePlanDoc,
    PredictedDoc,
    RehearsalDoc,
    SightDoc,
    StationDoc,
    TapeDoc,
)

LENGTH = 2.0
LEAN = np.radians(20.0)


@dataclass(frozen=True, eq=False)
class Yard(PlanPicture):
    """A place with feet of poles: their axes, where each is, and those of each placement."""

    axis: Array
    words: Sequence[str]
    chosen: Sequence[Sequence[int]]


def made_picture(placements: int = 1, lidars: int = 2) -> Yard:
    """A yard of 12 m with a wall, and a grid of feet, each upright or leaning to two sides."""
    rng = np.random.default_rng(0)
    grid = [(x, y) for x in (2.0, 3.5, 5.0, 6.5, 8.0) for y in (-3.0, -1.5, 0.0, 1.5, 3.0)]
    feet = np.array([(x, y, 0.0) for x, y in grid])
    low, high = np.sin(LEAN), np.cos(LEAN)
    axes = np.array([[0.0, 0.0, 1.0], [low, 0.0, high], [0.0, low, high]])
    foot = np.repeat(feet, 3, axis=0)
    axis = np.tile(axes, (len(feet), 1))
    ground = np.c_[rng.uniform(-2, 12, 4000), rng.uniform(-6, 6, 4000), np.zeros(4000)]
    wall = np.c_[np.full(500, 10.0), rng.uniform(-6, 6, 500), rng.uniform(0.4, 3, 500)]
    T = [se3.from_rt(np.eye(3), np.array([0.0, 4.0 * k, 1.5])) for k in range(lidars)]
    towards = ("", "away from front", "to the left as seen from front")
    lean = ("upright", *(f"lean 20° {way}" for way in towards[1:]))
    words = [f"{np.hypot(x, y):.1f} m from front; {way}" for x, y in grid for way in lean]
    return Yard(
        np.stack(T),
        [ground, wall],
        foot,
        axis,
        words,
        # One upright and one that leans.
        [(33 + 3 * p, 46 + 3 * p) for p in range(placements)],
    )


def made_plan(
    picture: Yard, name: str = "rear", status: str = "ok", need: Need | None = None
) -> PolePlanDoc:
    names = ["front", name, *(f"side {k}" for k in range(2, len(picture.lidars)))]
    lidars = [
        StationDoc(name=n, sensor="XT32", path=f"{n}.pcd", T_place_lidar=T, height_m=1.5)
        for n, T in zip(names, picture.lidars, strict=True)
    ]
    placements, letters = [], iter("ABCDEFGH")
    for own in picture.chosen:
        poles = []
        for k in own:
            letter = next(letters)
            seen = [SightDoc(lidar=n, returns=80, rings=12, distance_m=5.0) for n in names]
            lean = float(np.arccos(picture.axis[k, 2]))
            pole = PlannedPoleDoc(
                name=letter,
                foot_m=picture.feet[k],
                direction=picture.axis[k],
                lean_rad=lean,
                towards="",
                words=f"pole {letter}: {picture.words[k]}",
                seen=seen,
            )
            poles.append(pole)
        placements.append(PlannedPlacementDoc(poles=poles, tape=tape_of(poles, lidars)))
    covariance = np.diag([1e-4**2] * 3 + [2e-3**2] * 3)
    predicted = [
        PredictedDoc(
            lidar=each.name,
            covariance=covariance,
            predicted_error=list(predicted_error(covariance)),
            bounds_m=displacement_bounds(covariance, RANGES).tolist(),
            alone=list(predicted_error(25 * covariance)),
            budget=[BudgetEntry(f"kind {k}", "source", 1e-3, "m", None, 0.2) for k in range(5)],
        )
        for each in lidars[1:]
    ]
    reasons = [] if status == "ok" else [ReasonDoc("few_points", f"{name} has few", {})]
    return PolePlanDoc(
        lidars=lidars,
        placements=placements,
        length_m=LENGTH,
        radius_m=0.02,
        range_m=20.0,
        need=need,
        probability=None if need is None else 0.3,
        predicted=predicted,
        more=[MoreDoc(what="pole", error_m=4e-3, alone_m=9e-3, gain=0.2, is_worth_it=True)],
        rehearsal=RehearsalDoc(
            status=status,  # type: ignore[arg-type]
            reasons=reasons,
            margin=None,
            predicted_error=[],
        ),
        words=["The error to expect at 20 m is 3.2 mm.", f"Poles for {name}."],
        version="1",
        created="2026-01-02T03:04:05+00:00",
    )


def tape_of(poles: list[PlannedPoleDoc], lidars: list[StationDoc]) -> list[TapeDoc]:
    found = []
    for k, pole in enumerate(poles):
        lengths = [
            (float(np.linalg.norm((pole.foot_m - each.T_place_lidar[:3, 3])[:2])), each.name)
            for each in lidars
        ]
        for metres, name in sorted(lengths)[:2]:
            found.append(TapeDoc(start=f"below {name}", end=pole.name, metres=metres))
        for other in poles[:k]:
            metres = float(np.linalg.norm(pole.foot_m - other.foot_m))
            found.append(TapeDoc(start=other.name, end=pole.name, metres=metres))
    return found
