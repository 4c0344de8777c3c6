"""What is known in addition to the returns on poles.

Surveyed ends of poles and control points, up directions, and poses from the surroundings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ..base import se3
from ..base.datatypes import Array, IntArray
from .posterior import JointState
from .unknowns import POSE


@dataclass(frozen=True, eq=False)
class SurveyedEnd:
    """A surveyed end of a pole: a point (3,) on an axis, in the frame of the site; 1 σ, metres.

    Attributes
    ----------
    sigma
        Of each coordinate: one for all, or (3,).
    spread
        1 σ that is added in each direction across the axis, metres: of a point on the surface, of
        which nobody knows on which side it is.
    side
        Index of the known point that is the offset of all surfaces' points; None on the axis.
    """

    name: str
    axis: int
    at: Array
    sigma: float | Array
    spread: float = 0.0
    side: int | None = None


@dataclass(frozen=True, eq=False)
class ControlPoint:
    """A control point: (3,) in the frame of the site, and 1 σ of each coordinate, metres.

    With `is_side` it is none, but by how much (3,) points on surfaces are off the axes together.
    """

    name: str
    at: Array
    sigma: float | Array
    is_side: bool = False


@dataclass(frozen=True, eq=False)
class SeenPoint:
    """A control point as a LiDAR sees it: (3,) about its beam origin, and 1 σ, metres."""

    name: str
    lidar: int
    point: int
    at: Array
    sigma: float


@dataclass(frozen=True, eq=False)
class MeasuredUp:
    """Up direction (3,) in the frame of a LiDAR, and 1 σ, rad."""

    name: str
    lidar: int
    direction: Array
    sigma: float


@dataclass(frozen=True, eq=False)
class PriorPose:
    """A pose (4, 4) of a LiDAR, and 1 σ (6,) of ``[φ, δ]``, rad and metres."""

    name: str
    lidar: int
    T: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class Surveyed:
    """All that is known of a site in addition to the returns on its poles."""

    ends: tuple[SurveyedEnd, ...] = ()
    known: tuple[ControlPoint, ...] = ()
    seen: tuple[SeenPoint, ...] = ()
    up: tuple[MeasuredUp, ...] = ()
    poses: tuple[PriorPose, ...] = ()


NOTHING_SURVEYED = Surveyed()


@dataclass(frozen=True, eq=False)
class SurveyTerm:
    """One observation: residual (M,), its derivative (M, P) by parameters at `place`, 1 σ (M,).

    Attributes
    ----------
    kind, name
        As in `answer.Test`; what was observed, in words.
    lidar
        Whose observation it is; None if it is the surveyor's.
    """

    kind: Literal["survey", "control point", "up", "pose", "side"]
    name: str
    residual: Array
    jacobian: Array
    place: IntArray
    sigma: Array
    lidar: int | None = None
    axis: int | None = field(default=None)


def survey_terms(state: JointState, surveyed: Surveyed) -> Iterator[SurveyTerm]:
    """Compare survey observations with a state."""
    tangents = state.of(0, np.arange(len(state.points))).tangents
    first = state.control_points().start
    for end in surveyed.ends:
        off = np.zeros(3) if end.side is None else state.control[end.side]
        away = end.at - off - state.points[end.axis]
        along = float(away @ state.directions[end.axis])
        B = tangents[end.axis]
        # Across the axis, along the axes of the ellipse of the error, so that it has two 1 σ.
        variances = np.broadcast_to(end.sigma, 3) ** 2
        variance, Q = variances[:2], np.eye(2)
        if np.ptp(variances) > 0.0:
            variance, Q = np.linalg.eigh((B.T * variances) @ B)
        # Turning the axis moves it sideways at the end by the angle times how far along that is.
        J = np.concatenate([-np.eye(2), -along * np.eye(2), -B.T], axis=1)
        place = state.axes(np.array([end.axis]))
        if end.side is not None:
            place = np.r_[place, first + 3 * end.side + np.arange(3)]
        yield SurveyTerm(
            "survey",
            end.name,
            Q.T @ B.T @ away,
            Q.T @ J[:, : len(place)],
            place,
            np.sqrt(variance + end.spread**2),
            axis=end.axis,
        )
    for q, point in enumerate(surveyed.known):
        yield SurveyTerm(
            "side" if point.is_side else "control point",
            point.name,
            state.control[q] - point.at,
            np.eye(3),
            first + 3 * q + np.arange(3),
            np.full(3, point.sigma),
        )
    for seen in surveyed.seen:
        rotated = state.T[seen.lidar][:3, :3] @ seen.at
        place = np.r_[POSE * seen.lidar + np.arange(POSE), first + 3 * seen.point + np.arange(3)]
        yield SurveyTerm(
            "control point",
            seen.name,
            rotated + state.T[seen.lidar][:3, 3] - state.control[seen.point],
            np.concatenate([-se3.hat(rotated), np.eye(3), -np.eye(3)], axis=1),
            place,
            np.full(3, seen.sigma),
            lidar=seen.lidar,
        )
    for up in surveyed.up:
        turned = state.T[up.lidar][:3, :3] @ up.direction
        yield SurveyTerm(
            "up",
            up.name,
            turned[:2],
            -se3.hat(turned)[:2],
            POSE * up.lidar + np.arange(3),
            np.full(2, up.sigma),
            lidar=up.lidar,
        )
    for pose in surveyed.poses:
        step = se3.local(pose.T, state.T[pose.lidar])
        yield SurveyTerm(
            "pose",
            pose.name,
            step,
            se3.local_jacobian(step),
            POSE * pose.lidar + np.arange(POSE),
            pose.sigma,
            lidar=pose.lidar,
        )
