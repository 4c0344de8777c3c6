"""Sites of several LiDARs: drawn, recorded one LiDAR after the other, and surveyed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from ..base import se3
from ..base.datatypes import DEFAULT_RADIUS, MAX_POLES, Array, IntArray, PointCloud
from ..base.description import ControlPoint, Frame, Sighting, Site, SiteLidar, SurveyedPole
from ..base.errors import UsageError
from ..base.sensors import Sensor, find_sensor
from .devices import TYPICAL, Device, NoiseModel, draw_device
from .pairs import Recorders, SimulationError, is_seen, record_in_turn
from .raycast import Cylinder, Surface, cast
from .scanning import LabelledScan
from .site_places import PLACES, Arrangement, Seen, SiteScene, are_linked, arrange

SITES = tuple(PLACES)
"""Kinds of sites. ``ring`` is for ambiguity: see `simulate_site`."""

DEFAULT_SENSORS = {
    "posts": ("OS1", "XT32", "VLP-16"),
    "crane": ("XT32", "OS1"),
    "truck": ("XT32", "VLP-16", "XT32"),
    "ring": ("XT32", "VLP-16"),
}
"""Sensors of each kind of site, in turn (chosen: few rings cost little time)."""

MAX_LIDARS, MAX_PLACEMENTS = 12, 8
"""Of a simulated site."""

PlacedPoles = Sequence[Sequence[Sequence[Cylinder]]]
"""``standing[lidar][placement]``: the poles as they are when a LiDAR records them."""


@dataclass(frozen=True, eq=False)
class DrawnSite:
    """A site that is not recorded yet.

    Attributes
    ----------
    kind, sensors, devices, noise, radius
        As of the `SimulatedSite`.
    at
        Positions of everything, and who records what.
    for_survey, for_changes, for_recording
        Generators of what comes next. ``for_changes`` is for those who change the site before it
        is recorded: whatever they draw, all else stays the same.
    """

    kind: str
    sensors: tuple[Sensor, ...]
    devices: tuple[Device, ...]
    noise: NoiseModel
    radius: float
    at: Arrangement
    for_survey: np.random.Generator
    for_changes: np.random.Generator
    for_recording: np.random.Generator


@dataclass(frozen=True, eq=False)
class SimulatedSite:
    """The recordings of a site and the truth about them.

    Attributes
    ----------
    kind
        One of `SITES`.
    names, sensors, devices
        Of each LiDAR; a device keeps its systematic errors in all its recordings.
    T_world_lidar
        (4, 4) true pose of each LiDAR.
    clouds, labels
        ``clouds[lidar][placement]`` in the LiDAR's frame, and the index of the surface that each
        point lies on: in `surroundings`, then `poles` of the placement; −1 on none. None
        where it recorded none.
    surroundings
        All objects but the poles, in the world frame.
    poles
        Of each placement.
    seen
        ``seen[placement][lidar][pole]``: whether a LiDAR has enough returns of a pole.
    noise
        How the recordings differ from exact geometry.
    radius
        Of the poles, metres.
    surveyed, points
        What was surveyed, as it is stated, in the world frame.
    true_surveyed, true_points
        The same without errors.
    """

    kind: str
    names: tuple[str, ...]
    sensors: tuple[Sensor, ...]
    devices: tuple[Device, ...]
    T_world_lidar: tuple[Array, ...]
    clouds: tuple[tuple[PointCloud | None, ...], ...]
    labels: tuple[tuple[IntArray | None, ...], ...]
    surroundings: tuple[Surface, ...]
    poles: tuple[tuple[Cylinder, ...], ...]
    seen: Seen
    noise: NoiseModel
    radius: float
    surveyed: tuple[SurveyedPole, ...] = ()
    points: tuple[ControlPoint, ...] = ()
    true_surveyed: tuple[SurveyedPole, ...] = ()
    true_points: tuple[ControlPoint, ...] = ()

    @property
    def placements(self) -> tuple[str, ...]:
        """Names of the placements."""
        return tuple(str(k + 1) for k in range(len(self.poles)))

    def as_site(self) -> Site:
        """Give the input of a calibration, without the truth."""
        surveyed = bool(self.surveyed or self.points)
        return Site(
            name=f"simulated {self.kind}",
            lidars=tuple(
                SiteLidar(name, clouds, sensor=sensor)
                for name, clouds, sensor in zip(self.names, self.clouds, self.sensors, strict=True)
            ),
            placements=self.placements,
            radius=self.radius,
            frame=Frame("simulated world", surveyed=True)
            if surveyed
            else Frame(f"LiDAR {self.names[0]}"),
            poles=self.surveyed,
            points=self.points,
        )


def simulate_site(
    kind: str,
    rng: np.random.Generator,
    *,
    lidars: int = 4,
    placements: int | None = None,
    poles: int | None = None,
    sensors: Sequence[str] | None = None,
    radius: float = DEFAULT_RADIUS,
    noise: NoiseModel | None = None,
    survey: Survey | None = None,
    frames: int = 1,
) -> SimulatedSite:
    """Draw a site where poles link all LiDARs, and record it.

    Not every LiDAR sees every pole. But LiDARs that share two poles of a placement link all of
    them, some only through others.

    Parameters
    ----------
    kind
        One of `SITES`. In a ``ring`` each LiDAR shares a separate placement with the next: two
        poles that a half turn about the vertical maps onto each other, on bare ground, so that only
        the ring as a whole decides. The others record nothing there.
    rng
        Source of everything random; equal generators give equal sites.
    lidars
        2 to 12; a ring has 3 or more.
    placements
        1 to 8; None is 2. A ring has as many as LiDARs.
    poles
        Of each placement, at least 2; None is 3. A ring has 2.
    sensors
        Names of sensors, used in turn; None takes those of the kind.
    radius
        Of the poles, metres.
    noise
        None takes `TYPICAL`.
    survey
        What is surveyed; None is nothing.
    frames
        How many sweeps each LiDAR records.

    Raises
    ------
    UsageError
        An unknown kind or sensor, or numbers that the kind does not have.
    SimulationError
        No arrangement was found in which poles link all LiDARs.
    """
    drawn = draw_site(
        kind,
        rng,
        lidars=lidars,
        placements=placements,
        poles=poles,
        sensors=sensors,
        radius=radius,
        noise=noise,
    )
    return record_site(drawn, survey=survey, frames=frames)


def draw_site(
    kind: str,
    rng: np.random.Generator,
    *,
    lidars: int = 4,
    placements: int | None = None,
    poles: int | None = None,
    sensors: Sequence[str] | None = None,
    radius: float = DEFAULT_RADIUS,
    noise: NoiseModel | None = None,
) -> DrawnSite:
    """Draw a site where poles link all LiDARs: the first half of `simulate_site`, as there."""
    if kind not in SITES:
        raise UsageError(f"no kind of site is named {kind!r}; there are {', '.join(SITES)}")
    placements, poles = _numbers(kind, lidars, placements, poles)
    names = sensors or DEFAULT_SENSORS[kind]
    models = tuple(find_sensor(names[k % len(names)]) for k in range(lidars))
    noise = TYPICAL if noise is None else noise
    # The arrangement comes from rng alone, all that the noise model changes from its children.
    *for_devices, for_survey, for_changes, for_recording = rng.spawn(lidars + 3)
    devices = tuple(
        draw_device(sensor, noise, own) for sensor, own in zip(models, for_devices, strict=True)
    )
    at = arrange(kind, rng, models, placements, poles, radius)
    return DrawnSite(
        kind, models, devices, noise, radius, at, for_survey, for_changes, for_recording
    )


def record_site(
    drawn: DrawnSite,
    *,
    survey: Survey | None = None,
    frames: int = 1,
    standing: PlacedPoles | None = None,
) -> SimulatedSite:
    """Record and survey a site that was drawn, once: the second half of `simulate_site`.

    Parameters
    ----------
    drawn
        By `draw_site`.
    survey, frames
        As of `simulate_site`.
    standing
        Where poles move between two recordings; None if they are as they were drawn.
    """
    at, lidars = drawn.at, len(drawn.sensors)
    if survey is not None and not all(0 <= k < len(at.poles) for k in survey.placements):
        raise UsageError(f"surveyed placements are numbers from 0 to {len(at.poles) - 1}")
    standing = [at.poles] * lidars if standing is None else standing
    scans, seen = _record(drawn, frames, standing)
    true, stated = draw_survey(survey, at.place, at.poles, drawn.sensors, drawn.for_survey)
    return SimulatedSite(
        kind=drawn.kind,
        names=tuple(f"{drawn.kind}-{k + 1}" for k in range(lidars)),
        sensors=drawn.sensors,
        devices=drawn.devices,
        T_world_lidar=tuple(at.place.poses),
        clouds=tuple(tuple(None if one is None else one.cloud for one in own) for own in scans),
        labels=tuple(tuple(None if one is None else one.labels for one in own) for own in scans),
        surroundings=tuple(at.place.surroundings),
        poles=tuple(at.poles),
        seen=seen,
        noise=drawn.noise,
        radius=drawn.radius,
        surveyed=stated[0],
        points=stated[1],
        true_surveyed=true[0],
        true_points=true[1],
    )


def _numbers(kind: str, lidars: int, placements: int | None, poles: int | None) -> tuple[int, int]:
    """Numbers of placements and poles, or a `UsageError`."""
    if not (3 if kind == "ring" else 2) <= lidars <= MAX_LIDARS:
        raise UsageError(f"a site has 2 to {MAX_LIDARS} LiDARs, a ring 3 or more; not {lidars}")
    if kind == "ring":
        if placements not in (None, lidars) or poles not in (None, 2):
            raise UsageError("a ring has as many placements as LiDARs, of two poles each")
        return lidars, 2
    placements, poles = 2 if placements is None else placements, 3 if poles is None else poles
    if not 1 <= placements <= MAX_PLACEMENTS:
        raise UsageError(f"a site has 1 to {MAX_PLACEMENTS} placements, not {placements}")
    if not 2 <= poles <= MAX_POLES:
        raise UsageError(f"a placement has 2 to {MAX_POLES} poles, not {poles}")
    return placements, poles


def _record(
    drawn: DrawnSite, frames: int, standing: PlacedPoles
) -> tuple[list[list[LabelledScan | None]], Seen]:
    """Record all placements, each until its recordings link what they are to link.

    Of each LiDAR, its recording of each placement, or None if it has none.
    """
    at, sensors = drawn.at, drawn.sensors
    count, first = len(sensors), len(at.place.surroundings)
    found: list[list[LabelledScan | None]] = [[None] * len(at.poles) for _ in sensors]
    seen: list[tuple[tuple[bool, ...], ...]] = []
    for_each = drawn.for_recording.spawn(len(at.poles))
    for p, (own, who) in enumerate(zip(for_each, at.recorded, strict=True)):
        scenes = [[*at.place.surroundings, *standing[k][p]] for k in who]
        poses = [at.place.poses[k] for k in who]
        recorders = Recorders(
            [sensors[k] for k in who], [drawn.devices[k] for k in who], drawn.noise, frames
        )
        # Noise may hide too many poles, five times.
        for _ in range(5):
            scans = record_in_turn(scenes, poses, recorders, at.place.reach, own)
            view = [(False,) * len(at.poles[p])] * count
            for k, scanned in zip(who, scans, strict=True):
                found[k][p] = scanned
                view[k] = tuple(
                    is_seen(scanned.labels == first + j, scanned.cloud.ring)
                    for j in range(len(at.poles[p]))
                )
            # Where few record, each is there to see all poles: else a ring would not close.
            needed = len(who) == count or all(all(view[k]) for k in who)
            if needed and are_linked([*seen, tuple(view), *at.seen[p + 1 :]], count):
                seen.append(tuple(view))
                break
        else:
            raise SimulationError(f"the noise hides poles of placement {p + 1} from every link")
    return found, tuple(seen)


Surveyed = tuple[tuple[SurveyedPole, ...], tuple[ControlPoint, ...]]
"""Poles and control points."""

POINT_DISTANCES = 2.0, 20.0
"""Least and greatest distance of a control point from a LiDAR that sees it, metres (chosen)."""

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
    place: SiteScene,
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
    survey: Survey, place: SiteScene, sensors: Sequence[Sensor], rng: np.random.Generator
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
            at = np.r_[middle + out, rng.uniform(0.2, 3.0)]
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


def _is_in_view(at: Array, pose: Array, sensor: Sensor, place: SiteScene) -> bool:
    """Whether a LiDAR sees a point (3,): within its field of view, with nothing before it."""
    own = se3.apply(se3.inverse(pose), at[None])[0]
    distance = float(np.linalg.norm(own))
    if not POINT_DISTANCES[0] <= distance <= POINT_DISTANCES[1]:
        return False
    elevation = np.arcsin(own[2] / distance)
    if not sensor.elevation_span[0] <= elevation <= sensor.elevation_span[1]:
        return False
    if not sensor.has_in_view(own[None])[0]:
        return False
    ray = (at - pose[:3, 3]) / distance
    return bool(cast(pose[:3, 3], ray[None], place.surroundings).ranges[0] > distance)
