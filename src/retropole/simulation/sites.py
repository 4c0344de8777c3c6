"""Sites of several LiDARs: drawn, recorded one LiDAR after the other, surveyed, and disturbed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..datatypes import DEFAULT_RADIUS, MAX_POLES, Array, IntArray, PointCloud
from ..errors import UsageError
from ..sensors import Sensor, find_sensor
from ..site.description import ControlPoint, Frame, Site, SiteLidar, SurveyedPole
from .devices import Device, draw_device
from .noise import TYPICAL, NoiseModel
from .raycast import Cylinder, Surface
from .recording import SimulationError, is_seen, record_in_turn
from .site_arrangement import Arrangement, arrange
from .site_blunders import BLUNDERS, Blunder, choose, disturbed, exchanged, resurveyed
from .site_graph import Seen, are_linked
from .site_places import PLACES
from .site_survey import Survey, draw_survey

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

MAX_UNCHECKED = 12
"""Arrangements that are drawn for one where the others check a blunder."""

MAX_RECORDINGS = 5
"""Recordings of a placement before a `SimulationError`: noise hides too many poles."""


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
        point lies on: in `surroundings`, then `poles` of the placement; −1 on none of them. None
        where it recorded none. Where files were exchanged, so are these.
    surroundings
        All that stands there but the poles, in the world frame.
    poles
        Of each placement, as they stood first.
    seen
        ``seen[placement][lidar][pole]``: whether a LiDAR has enough returns of a pole, as recorded
        and before files were exchanged.
    noise
        How the recordings differ from exact geometry.
    radius
        Of the poles, metres.
    surveyed, points
        What was surveyed, as it is stated, in the world frame.
    true_surveyed, true_points
        The same without errors.
    blunder
        What is wrong, or None.
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
    blunder: Blunder | None = None

    @property
    def placements(self) -> tuple[str, ...]:
        """Names of the placements."""
        return tuple(str(k + 1) for k in range(len(self.poles)))

    def as_site(self) -> Site:
        """Give what a calibration starts from: nothing of the truth."""
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
    blunder: str | None = None,
    frames: int = 1,
) -> SimulatedSite:
    """Draw a site where poles link all LiDARs, and record it.

    Not every LiDAR sees every pole. But LiDARs that share two poles of a placement link all of
    them, some only through others.

    Parameters
    ----------
    kind
        One of `SITES`. In a ``ring`` each LiDAR shares a placement of its own with the next: two
        poles that a half turn about the vertical maps onto each other, on bare ground, so that only
        the ring as a whole decides. The others record nothing of it.
    rng
        Source of everything random; equal generators give equal sites.
    lidars
        2 to 12; a ring has 3 or more.
    placements
        1 to 8; None is 2. A ring has as many as LiDARs.
    poles
        Of each placement, at least 2; None is 3. A ring has 2.
    sensors
        Names of sensors, taken in turn; None takes the kind's own.
    radius
        Of the poles, metres.
    noise
        None takes `TYPICAL`.
    survey
        What is surveyed; None is nothing.
    blunder
        What goes wrong, one of `BLUNDERS`: ``pole``, a pole is bumped between two recordings of one
        placement, and those that record later see it elsewhere; ``slide``, it is pushed such that
        its angle and distance to another do not change; ``files``, two recordings are
        exchanged; ``control``, a surveyed point is off by 0.1 m. Where it can be, it is one that
        the others check.
    frames
        How many sweeps each LiDAR records.

    Raises
    ------
    UsageError
        An unknown kind, sensor or blunder, or numbers that the kind does not have.
    SimulationError
        No arrangement was found in which poles link all LiDARs.
    """
    if kind not in SITES:
        raise UsageError(f"no kind of site is called {kind!r}; there are {', '.join(SITES)}")
    placements, poles = _numbers(kind, lidars, placements, poles)
    if blunder is not None and blunder not in BLUNDERS:
        raise UsageError(f"no blunder is called {blunder!r}; there are {', '.join(BLUNDERS)}")
    if blunder == "files" and placements == 1:
        raise UsageError("files are exchanged where there are two placements or more")
    if blunder == "control" and (survey is None or not (survey.placements or survey.points)):
        raise UsageError("a control point can only be wrong where something is surveyed")
    if survey is not None and not all(0 <= k < placements for k in survey.placements):
        raise UsageError(f"surveyed placements are numbers from 0 to {placements - 1}")
    names = sensors or DEFAULT_SENSORS[kind]
    models = tuple(find_sensor(names[k % len(names)]) for k in range(lidars))
    noise = TYPICAL if noise is None else noise
    # The arrangement comes from rng alone, all that the noise model changes from its children.
    *for_devices, for_survey, for_blunder, for_recording = rng.spawn(lidars + 3)
    devices = tuple(
        draw_device(sensor, noise, own) for sensor, own in zip(models, for_devices, strict=True)
    )
    at = arrange(kind, rng, models, placements, poles, radius)
    wrong = choose(blunder, at.poles, at.seen, at.recorded, for_blunder)
    for _ in range(MAX_UNCHECKED):
        if wrong is None or wrong.checked:
            break
        at = arrange(kind, rng, models, placements, poles, radius)
        wrong = choose(blunder, at.poles, at.seen, at.recorded, for_blunder)
    clouds, labels, seen = _record(at, models, devices, noise, frames, wrong, for_recording)
    if wrong is not None and wrong.kind == "files":
        exchanged(clouds, wrong)
        exchanged(labels, wrong)
    true, stated = draw_survey(survey, at.place, at.poles, models, for_survey)
    if wrong is not None and wrong.kind == "control":
        stated, wrong = resurveyed(stated, for_blunder)
    return SimulatedSite(
        kind=kind,
        names=tuple(f"{kind}-{k + 1}" for k in range(lidars)),
        sensors=models,
        devices=devices,
        T_world_lidar=tuple(at.place.poses),
        clouds=tuple(tuple(own) for own in clouds),
        labels=tuple(tuple(own) for own in labels),
        surroundings=tuple(at.place.surroundings),
        poles=tuple(at.poles),
        seen=seen,
        noise=noise,
        radius=radius,
        surveyed=stated[0],
        points=stated[1],
        true_surveyed=true[0],
        true_points=true[1],
        blunder=wrong,
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
    at: Arrangement,
    sensors: tuple[Sensor, ...],
    devices: tuple[Device, ...],
    noise: NoiseModel,
    frames: int,
    wrong: Blunder | None,
    rng: np.random.Generator,
) -> tuple[list[list[PointCloud | None]], list[list[IntArray | None]], Seen]:
    """Record all placements, each until its recordings link what they are to link."""
    count, first = len(sensors), len(at.place.surroundings)
    clouds: list[list[PointCloud | None]] = [[None] * len(at.poles) for _ in sensors]
    labels: list[list[IntArray | None]] = [[None] * len(at.poles) for _ in sensors]
    seen: list[tuple[tuple[bool, ...], ...]] = []
    for p, (own, who) in enumerate(zip(rng.spawn(len(at.poles)), at.recorded, strict=True)):
        scenes = [[*at.place.surroundings, *disturbed(at.poles[p], wrong, k, p)] for k in who]
        for _ in range(MAX_RECORDINGS):
            scans = record_in_turn(
                scenes,
                [at.place.poses[k] for k in who],
                [sensors[k] for k in who],
                [devices[k] for k in who],
                noise,
                frames,
                at.place.reach,
                own,
            )
            view = [(False,) * len(at.poles[p])] * count
            for k, scanned in zip(who, scans, strict=True):
                clouds[k][p], labels[k][p] = scanned.cloud, scanned.labels
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
    return clouds, labels, tuple(seen)
