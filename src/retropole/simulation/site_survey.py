"""What a surveyor measures at a simulated site: ends of poles, and control points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from ..base import se3
from ..base.datatypes import Array
from ..base.description import ControlPoint, Sighting, SurveyedPole
from ..base.sensors import Sensor
from .raycast import Cylinder, cast
from .recording import SimulationError
from .site_places import SitePlace

Surveyed = tuple[tuple[SurveyedPole, ...], tuple[ControlPoint, ...]]
"""Poles and control points."""

POINT_DISTANCES = 2.0, 20.0
"""Least and greatest distance of a control point from a LiDAR that sees it, metres (chosen)."""

POINT_HEIGHTS = 0.2, 3.0
"""Least and greatest height of a control point, metres (chosen)."""

MAX_POINT_DRAWS = 500
"""Draws of a control point before a `SimulationError`."""


@dataclass(frozen=True)
class Survey:
    """What is surveyed.

    Attributes
    ----------
    placements
        Indices of the placements whose poles are surveyed, foot and top.
    points
        Number of control points, each of which two LiDARs or more see as a target.
    sigma
        1 σ of each surveyed coordinate, metres: 5 mm, a total station's (chosen).
    sighting_sigma
        1 σ of each coordinate of a target in a LiDAR's frame, metres (chosen).
    """

    placements: tuple[int, ...] = ()
    points: int = 0
    sigma: float = 0.005
    sighting_sigma: float = 0.005


def draw_survey(
    survey: Survey | None,
    place: SitePlace,
    poles: Sequence[Sequence[Cylinder]],
    sensors: Sequence[Sensor],
    rng: np.random.Generator,
) -> tuple[Surveyed, Surveyed]:
    """Survey a site: what is true, and what is stated, with errors drawn by their σ."""
    if survey is None:
        return ((), ()), ((), ())
    for_poles, for_places, for_points = rng.spawn(3)
    true, stated = [], []
    standing = [(p, k, pole) for p in survey.placements for k, pole in enumerate(poles[p])]
    for p, k, pole in standing:
        name = f"P{p + 1}-{k + 1}"
        half = pole.axis * pole.length / 2
        foot, top = pole.centre - half, pole.centre + half
        errors = for_poles.normal(0, survey.sigma, (2, 3))
        true.append(SurveyedPole(name, p, foot, top, survey.sigma))
        stated.append(SurveyedPole(name, p, foot + errors[0], top + errors[1], survey.sigma))
    points = _points(survey, place, sensors, for_places)
    seen = [
        replace(
            point,
            at=point.at + for_points.normal(0, survey.sigma, 3),
            seen=tuple(
                replace(own, at=own.at + for_points.normal(0, own.sigma, 3)) for own in point.seen
            ),
        )
        for point in points
    ]
    return (tuple(true), points), (tuple(stated), tuple(seen))


def _points(
    survey: Survey, place: SitePlace, sensors: Sequence[Sensor], rng: np.random.Generator
) -> tuple[ControlPoint, ...]:
    """Draw control points in all directions around the middle of the LiDARs."""
    middle = np.mean([pose[:2, 3] for pose in place.poses], axis=0)
    start = rng.uniform(0, 2 * np.pi)
    reach = np.array(place.reach) + 4.0
    points = []
    for k in range(survey.points):
        for _ in range(MAX_POINT_DRAWS):
            heading = start + 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / survey.points
            out = rng.uniform(0.3, 1.0) * reach * [np.cos(heading), np.sin(heading)]
            at = np.r_[middle + out, rng.uniform(*POINT_HEIGHTS)]
            seen = tuple(
                Sighting(lidar, se3.apply(se3.inverse(pose), at[None])[0], survey.sighting_sigma)
                for lidar, (pose, sensor) in enumerate(zip(place.poses, sensors, strict=True))
                if _is_in_view(at, pose, sensor, place)
            )
            if len(seen) >= 2:
                points.append(ControlPoint(f"C{k + 1}", at, survey.sigma, seen))
                break
        else:
            raise SimulationError(
                f"{MAX_POINT_DRAWS} draws gave no place for control point {k + 1}"
            )
    return tuple(points)


def _is_in_view(at: Array, pose: Array, sensor: Sensor, place: SitePlace) -> bool:
    """Whether a LiDAR sees a point (3,): within its field of view, with nothing before it."""
    own = se3.apply(se3.inverse(pose), at[None])[0]
    distance = float(np.linalg.norm(own))
    if not POINT_DISTANCES[0] <= distance <= POINT_DISTANCES[1]:
        return False
    elevation = np.arcsin(own[2] / distance)
    if not sensor.elevation_span[0] <= elevation <= sensor.elevation_span[1]:
        return False
    ray = (at - pose[:3, 3]) / distance
    return bool(cast(pose[:3, 3], ray[None], place.surroundings).ranges[0] > distance)
