"""`plan`: bare recordings in, positions of the poles out, as a document, a page and a card."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from ..base import se3
from ..base.datatypes import DEFAULT_RADIUS, MAX_RADIUS, MIN_RADIUS, Array, Scan
from ..base.errors import UsageError
from ..base.files import write_together
from ..base.sensors import find_sensor
from ..base.uncertainty.purpose import DEFAULT_AT, Need
from ..export import read_transform
from ..pipeline import Options, calibrate
from ..planning.place import Area, Station
from ..planning.plan_text import plan_document
from ..planning.planner import LENGTH, Planned
from ..planning.planner import plan as plan_poles
from ..planning.stations import bare_scan, place_drawn_lidars, place_lidars
from ..report.pole_plan import render_pole_plan
from ..report.pole_plan_picture import PlanPicture
from ..result import DEFAULT_CONFIG, PLAN_FILE, PLAN_PAGE, RunConfig, encode
from ..result.pole_plan import (
    FEWEST_POLES,
    LONGEST,
    MOST_PLACEMENTS,
    MOST_POLES,
    SHORTEST,
    PolePlanDoc,
)
from ..simulation.raycast import Material
from ..simulation.scenes import box
from .inputs import SILENT, CloudSource, Input, Listener, input_documents, read_input
from .options import with_keywords
from .result import load_site_result
from .site_file import SiteFile, read_site_file
from .site_inputs import site_file_in

CONCRETE = Material(0.4)
"""Of boxes that are drawn."""


@dataclass(frozen=True, eq=False)
class Wish:
    """What is required of a plan.

    Attributes
    ----------
    poles, placements
        How many poles at once, and how often they are moved.
    length, radius
        Of the poles, metres.
    need
        How accurate the answer must be; None makes the error at 30 m small.
    allowed, forbidden
        Rectangles (x, y, x, y) of the ground, metres, in the frame of the plan.
    """

    poles: int = 2
    placements: int = 1
    length: float = LENGTH
    radius: float = DEFAULT_RADIUS
    need: Need | None = None
    allowed: tuple[tuple[float, float, float, float], ...] = ()
    forbidden: tuple[tuple[float, float, float, float], ...] = ()

    def __post_init__(self) -> None:
        """Refuse what no plan is made for, before anything is read: `UsageError` names it."""
        bounds: tuple[tuple[str, type[Integral] | type[Real], float, float], ...] = (
            ("poles", Integral, FEWEST_POLES, MOST_POLES),
            ("placements", Integral, 1, MOST_PLACEMENTS),
            ("length", Real, SHORTEST, LONGEST),
            ("radius", Real, MIN_RADIUS, MAX_RADIUS),
        )
        for name, kind, least, most in bounds:
            value = getattr(self, name)
            if not isinstance(value, kind) or not least <= float(value) <= most:
                what = "a whole number" if kind is Integral else "metres"
                raise UsageError(f"{name} is {value!r}, expected {what} from {least:g} to {most:g}")
        for area in (*self.allowed, *self.forbidden):
            if len(area) != 4 or not np.isfinite(area).all():
                raise UsageError(f"an area is {area!r}, expected four numbers: x, y, x, y, metres")


@dataclass(frozen=True, eq=False)
class PolePlan:
    """Planned positions of the poles.

    Attributes
    ----------
    document
        As in ``plan.json``.
    planned
        All that it was chosen from.
    """

    document: PolePlanDoc
    planned: Planned

    def __repr__(self) -> str:
        """Describe the positions of the poles and the expected result, a line each."""
        poles = [pole.words for each in self.document.placements for pole in each.poles]
        return "\n".join(["PolePlan:", *poles, *self.document.words])

    def page(self) -> str:
        """Write the page: the picture with the lengths to measure, the tables, and the card."""
        stations = self.planned.stations
        picture = PlanPicture(
            lidars=np.stack([each.T for each in stations]),
            points=[se3.apply(each.T, each.cloud.xyz) for each in stations],
            feet=self.planned.candidates.foot,
        )
        return render_pole_plan(self.document, picture)

    def save(self, out: str | Path) -> tuple[Path, Path]:
        """Write ``plan.json`` and ``plan.html`` into a folder."""
        document, page = Path(out) / PLAN_FILE, Path(out) / PLAN_PAGE
        write_together({document: encode(self.document), page: self.page().encode()})
        return document, page


def plan(
    target: CloudSource,
    source: CloudSource,
    *,
    rough: Array | str | Path | None = None,
    poles: int = 2,
    placements: int = 1,
    length: float = LENGTH,
    radius: float | None = None,
    need: float | None = None,
    at: float | None = None,
    allowed: Sequence[tuple[float, float, float, float]] = (),
    forbidden: Sequence[tuple[float, float, float, float]] = (),
    options: RunConfig = DEFAULT_CONFIG,
    progress: Callable[[str], None] = lambda step: None,
    **older: Any,
) -> PolePlan:
    """Plan the positions of the poles, from recordings of the scene without poles.

    Parameters
    ----------
    target, source
        As `calibrate` takes them.
    rough
        (4, 4) maps points of the source into the target's frame, good to 10° and 1 m, or a file
        that `export` reads; None finds it from the surroundings.
    poles, placements
        How many poles at once, and how often they are moved.
    length, radius
        Of the poles, metres.
    need, at
        How accurate the answer must be, as `calibrate` takes it.
    allowed, forbidden
        Rectangles (x, y, x, y) of the ground, metres, from the point on the ground below the
        target, x where its x axis points.
    options, older
        As `calibrate` takes them: sensors, and how the recordings are read.
    progress
        Called with the name of each step as it starts.

    Raises
    ------
    Refusal
        If there is no such plan; see `planner.plan`.
    UsageError
        If the pose is needed and not given, and for options that make no sense.
    ReadError, MissingExtraError
        If a file cannot be read.
    """
    config = with_keywords(options, {"radius": radius, "need": need, "at": at}, older)
    areas = tuple(allowed), tuple(forbidden)
    wish = Wish(poles, placements, length, config.radius_m, config.need, *areas)
    pose = Path(rough) if isinstance(rough, str) else rough
    return plan_pair(target, source, wish, config, pose, Listener(progress))


def plan_pair(
    target: CloudSource,
    source: CloudSource,
    wish: Wish,
    config: RunConfig,
    rough: Array | Path | None = None,
    listener: Listener = SILENT,
) -> PolePlan:
    """Plan for two LiDARs that recorded the scene without poles.

    Parameters
    ----------
    target, source
        Their recordings.
    wish
        What is requested.
    config
        How they are read.
    rough
        (4, 4) target from source, good to 10° and 1 m, or a file that `export` reads; None
        finds it from the surroundings.

    Raises
    ------
    Refusal
        If there is no such plan; see `planner.plan`.
    UsageError
        If the pose is needed and not given.
    """
    inputs = [
        read_input(target, config.of_target, listener, role="target"),
        read_input(source, config.of_source, listener, role="source"),
    ]
    names = _names([target, source], ("target", "source"))
    T = read_transform(rough).T_parent_child if isinstance(rough, Path) else rough
    return _planned(names, inputs, [None, T], wish, listener)


def plan_site(
    path: Path, wish: Wish, rough: Path | None = None, listener: Listener = SILENT
) -> PolePlan:
    """Plan for the LiDARs of a site file, whose first recordings show the scene without poles.

    Parameters
    ----------
    path
        Of the site file, or of its folder.
    wish
        What is requested; the radius is the file's.
    rough
        An older result of the site, good to 10° and 1 m; None takes all poses from the
        surroundings.
    """
    path = site_file_in(path)
    file: SiteFile = read_site_file(path)
    inputs, names = [], []
    for lidar in file.lidar:
        first = next(each for each in lidar.recordings if each)
        given = path.parent / first
        inputs.append(read_input(given, lidar.reading(file.max_points), listener))
        names.append(lidar.name)
    known = {} if rough is None else _poses_in(rough)
    unknown = [name for name in names if known and name not in known]
    if unknown:
        raise UsageError(
            f"no pose of {', '.join(unknown)} is given; the poses given are those of "
            f"{', '.join(known)}"
        )
    first_pose = se3.inverse(known[names[0]]) if known else None
    poses = [None if first_pose is None else first_pose @ known[name] for name in names]
    return _planned(names, inputs, poses, wish, listener)


def _poses_in(path: Path) -> dict[str, Array]:
    """Poses (4, 4) of a site's result in its frame, by the names of the LiDARs."""
    return {
        each.name: np.array(each.T_site_lidar)
        for each in load_site_result(path).document.lidars
        if each.T_site_lidar is not None
    }


def plan_drawn(
    lidars: Sequence[tuple[str, str, Array]],
    boxes: Sequence[Sequence[float]],
    wish: Wish,
    listener: Listener = SILENT,
) -> PolePlan:
    """Plan for LiDARs that have recorded nothing yet, over flat ground.

    Parameters
    ----------
    lidars
        Name, sensor and pose (4, 4) of each, in a frame whose ground is z = 0.
    boxes
        What is there: x and y of the middle of each, and its three sides, metres.
    wish
        What is requested.
    """
    listener.progress("draw")
    drawn = [
        box(np.array([x, y, high / 2]), np.array([long, wide, high]) / 2, 0.0, CONCRETE)
        for x, y, long, wide, high in boxes
    ]
    names = [name for name, _, _ in lidars]
    sensors = [find_sensor(sensor) for _, sensor, _ in lidars]
    stations = place_drawn_lidars(names, sensors, [T for _, _, T in lidars], drawn)
    planned = _ask(stations, wish, listener)
    nothing = [("", "")] * len(lidars)
    return PolePlan(plan_document(planned, nothing, wish.need), planned)


def _planned(
    names: Sequence[str],
    inputs: Sequence[Input],
    rough: Sequence[Array | None],
    wish: Wish,
    listener: Listener,
) -> PolePlan:
    listener.progress("read")
    scans = [bare_scan(each.cloud, each.sensor) for each in inputs]
    listener.progress("place the LiDARs")
    poses = _poses(names, scans, rough)
    stations = place_lidars(names, scans, poses)
    planned = _ask(stations, wish, listener)
    recordings = [(each.path, each.sha256) for each in input_documents(inputs)]
    return PolePlan(plan_document(planned, recordings, wish.need), planned)


def _ask(stations: Sequence[Station], wish: Wish, listener: Listener) -> Planned:
    areas = [
        [
            Area(np.minimum(each[:2], each[2:]), np.maximum(each[:2], each[2:]))
            for each in (np.array(one) for one in given)
        ]
        for given in (wish.allowed, wish.forbidden)
    ]
    # Matrices here are small: threads of BLAS, which wait by spinning, only get in the way.
    with threadpool_limits(1, user_api="blas"):
        return plan_poles(
            stations,
            poles=wish.poles,
            placements=wish.placements,
            length=wish.length,
            radius=wish.radius,
            reach=DEFAULT_AT if wish.need is None else wish.need.at,
            need=wish.need,
            allowed=areas[0],
            forbidden=areas[1],
            progress=listener.progress,
        )


def _names(given: Sequence[CloudSource], roles: tuple[str, str]) -> list[str]:
    """Name two LiDARs by their files, where these differ and are short."""
    stems = [Path(each).stem if isinstance(each, str | Path) else "" for each in given]
    good = len(set(stems)) == len(stems) and all(0 < len(each) <= 20 for each in stems)
    return stems if good else list(roles)


def _poses(
    names: Sequence[str], scans: Sequence[Scan], rough: Sequence[Array | None]
) -> list[Array]:
    """Give all LiDARs a rough pose in the frame of the first: as given, or as the surroundings
    show.

    Raises
    ------
    UsageError
        Where neither determines it.
    """
    found = [np.eye(4)]
    for i in range(1, len(scans)):
        T = rough[i]
        if T is None:
            T = next(_by_place(scans, found, i), None)
        if T is None:
            raise UsageError(
                f"the recordings do not show where {names[i]} is: give its rough pose, accurate to "
                "10° and 1 m (--xyz and --rpy-deg, or --pose FILE)"
            )
        found.append(T)
    return found


def _by_place(scans: Sequence[Scan], found: Sequence[Array], i: int) -> Iterator[Array]:
    """Find a pose of a LiDAR from the surroundings, against each that has one already."""
    for j, T in enumerate(found):
        sensors = scans[j].sensor, scans[i].sensor
        answer = calibrate(
            scans[j].cloud, scans[i].cloud, options=Options(sensors=sensors, poles=0)
        )
        if answer.T_target_source is not None:
            yield T @ answer.T_target_source
