"""Planned positions of poles, as ``retropole plan`` writes them: a separate JSON document.

Schema ``retropole/plan/1``: metres and radians, in the frame of the scene: its origin on
the ground below the first LiDAR, z up, x where that LiDAR's x axis points.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from ..base.bounded import (
    Count,
    Covariance,
    Direction,
    Name,
    Number,
    Pose,
    Positive,
    Share,
    Sigma,
    Size,
    Text,
    Vector,
)
from ..base.uncertainty import BudgetEntry, ErrorAtRange
from ..base.uncertainty.purpose import Need
from . import ReasonDoc

PLAN_SCHEMA: Literal["retropole/plan/1"] = "retropole/plan/1"

FEWEST_POLES, MOST_POLES, MOST_PLACEMENTS = 2, 6, 8
"""Poles that are set up at once, and how often; a plan advises no more than that either."""

SHORTEST, LONGEST = 0.5, 10.0
"""Of a pole, metres."""


class StationDoc(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """A LiDAR where it is.

    The pose is of the frame of its recordings. `path` and `sha256` are of the one without poles,
    empty if the scene was drawn.
    """

    name: Name
    sensor: Text
    path: Text = ""
    sha256: Text = ""
    T_place_lidar: Pose
    height_m: Size


class SightDoc(msgspec.Struct, frozen=True, kw_only=True):
    """What a LiDAR will have of a pole: returns, rings (None if not known), and its distance."""

    lidar: Text
    returns: Count
    rings: Count | None
    distance_m: Size


class PlannedPoleDoc(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """A planned pole.

    Attributes
    ----------
    name
        A letter.
    foot_m, direction
        (3,) its foot on the ground, and the unit vector up along its axis.
    lean_rad, towards
        How far it leans, and where to, in words: ``away from front, 60° to the left as seen from
        front``; empty if upright.
    words
        Its position, as text.
    seen
        By each LiDAR that sees it.
    """

    name: Name
    foot_m: Vector
    direction: Direction
    lean_rad: Size
    towards: Text
    words: Name
    seen: Annotated[list[SightDoc], Meta(min_length=1)]


class TapeDoc(msgspec.Struct, frozen=True, kw_only=True):
    """A length to measure on the ground, from below a LiDAR or a foot to a foot."""

    start: Text
    end: Text
    metres: Size


def below(lidar: str) -> str:
    """Name the point of the ground below a LiDAR, where a length begins."""
    return f"below {lidar}"


class PlannedPlacementDoc(msgspec.Struct, frozen=True, kw_only=True):
    """Poles of one placement, and how to find their positions with a tape measure."""

    poles: Annotated[list[PlannedPoleDoc], Meta(min_length=1)]
    tape: list[TapeDoc]


class PredictedDoc(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """The error to expect of a LiDAR's pose in the frame of the first.

    Attributes
    ----------
    covariance
        (6, 6) over ``[φ, δ]``, rad and m, axes of the first.
    predicted_error, bounds_m
        1 σ at several ranges, and there the bound that no point exceeds with 95 % probability.
    alone
        1 σ at the same ranges by the poles alone.
    budget
        What it is made of, the largest first.
    """

    lidar: Text
    covariance: Covariance
    predicted_error: list[ErrorAtRange]
    bounds_m: list[Size]
    alone: list[ErrorAtRange]
    budget: list[BudgetEntry]


class MoreDoc(msgspec.Struct, frozen=True, kw_only=True):
    """What one ``pole`` or ``placement`` more would bring: largest 1 σ of all LiDARs at the range,
    the same by the poles alone, the part of the error that it removes, whether that is worth it.
    `status` is the verdict of its rehearsal; None if that of the plan is ok, and none is needed.
    """

    what: Literal["pole", "placement"]
    error_m: Sigma
    alone_m: Sigma
    gain: Number
    is_worth_it: bool
    status: Literal["ok", "warn", "refused"] | None = None


class RehearsalDoc(msgspec.Struct, frozen=True, kw_only=True):
    """The calibration with poles put into the recordings: its verdict."""

    status: Literal["ok", "warn", "refused"]
    reasons: list[ReasonDoc]
    margin: Number | None
    predicted_error: list[ErrorAtRange]


class MovedErrorDoc(msgspec.Struct, frozen=True, kw_only=True):
    """The error to expect of a LiDAR's pose at the plan's range, 1 σ in metres, and that by the
    poles alone, as the page computes them: to 10 %.
    """

    lidar: Text
    sigma_m: Sigma
    alone_m: Sigma


class MovedDoc(msgspec.Struct, frozen=True, kw_only=True):
    """What a person changed on the page of the plan: names of the poles that were moved, and the
    error to expect of each LiDAR but the first where they are now.
    """

    poles: Annotated[list[Name], Meta(min_length=1)]
    errors: Annotated[list[MovedErrorDoc], Meta(min_length=1)]


class PolePlanDoc(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Planned positions of the poles, and what to expect.

    Attributes
    ----------
    length_m, radius_m, range_m
        Of the poles; and the range at which the error was made small.
    need, probability
        How accurate the answer must be, and the least probability of all LiDARs that it is.
    predicted
        Of each LiDAR but the first; none where poles were moved by hand.
    moved
        None unless poles were moved on the page; then nothing is predicted but what it has, and
        nothing was rehearsed.
    words
        The plan in sentences, the most important first.
    """

    schema: Literal["retropole/plan/1"] = PLAN_SCHEMA
    lidars: Annotated[list[StationDoc], Meta(min_length=2)]
    placements: Annotated[list[PlannedPlacementDoc], Meta(min_length=1)]
    length_m: Positive
    radius_m: Positive
    range_m: Positive
    need: Need | None
    probability: Share | None
    predicted: list[PredictedDoc]
    more: list[MoreDoc]
    rehearsal: RehearsalDoc | None
    moved: MovedDoc | None = None
    words: list[Text]
    version: Text
    created: Text
