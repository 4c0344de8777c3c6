"""Two LiDARs and taped poles in one scene: drawn and recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.errors import RetropoleError, UsageError
from ..base.sensors import SWEEP_SECONDS, Sensor, find_sensor
from .devices import TYPICAL, Device, NoiseModel, draw_device
from .raycast import Cylinder, Surface, cast
from .scanning import DELAY, LabelledScan, draw_movers, scan, sweeps
from .scenes import (
    PAPER_CLEAR,
    PAPER_NOISE,
    PAPER_RADIUS,
    SURROUNDINGS,
    draw_lidar,
    draw_paper_poles,
    draw_poles,
    paper_lidar_poses,
    rotated_by_180,
    symmetric_poles,
)

SCENES = (*SURROUNDINGS, "paper")
"""Names of the scenes; ``paper`` is the set-up of Xue et al. 2019 without surroundings."""

DEFAULT_SENSORS = {
    "corridor": ("XT32", "VLP-16"),
    "street": ("Pandar64", "OS1"),
    "harbor": ("Pandar64", "HDL-32E"),
    "bare": ("Pandar64", "HDL-32E"),
    "square": ("VLP-32C", "VLP-32C"),
    "camber": ("VLP-32C", "VLP-16"),
    "kerb": ("VLP-32C", "VLP-16"),
    "paper": ("VLP-16", "VLP-16"),
}
"""Target and source sensor of each scene; those of the paper are given there, the others chosen."""

MIN_POLE_ANGLE, MAX_POLE_ANGLE = float(np.radians(15.0)), float(np.radians(60.0))
"""Between any two poles, rad: nearly parallel poles determine no pose, and people do not lean poles
further (chosen)."""

LIDAR_SPACING = 0.5, 6.0
"""Least and greatest distance between the two LiDARs, metres (chosen)."""

MAX_DRAWS = 400
"""Draws of an arrangement before a `SimulationError`; in 30 seeds no scene needed more than 32."""


def simulate_pair(
    scene: str,
    rng: np.random.Generator,
    *,
    sensor_target: str | None = None,
    sensor_source: str | None = None,
    poles: int = 2,
    radius: float = PAPER_RADIUS,
    min_pole_angle: float = MIN_POLE_ANGLE,
    max_pole_angle: float = MAX_POLE_ANGLE,
    noise: NoiseModel | None = None,
    symmetric: bool = False,
    frames: int = 1,
) -> SimulatedPair:
    """Draw a scene with taped poles that two LiDARs see, and scan it.

    Parameters
    ----------
    scene
        One of `SCENES`. ``paper`` always has the two poles of Xue et al. 2019.
    rng
        Source of everything random; equal generators give equal pairs.
    sensor_target, sensor_source
        Names of sensors; None takes those of the scene.
    poles
        How many taped poles. 0 omits those that 2 would put there: the same scene, recorded
        before the poles are set up.
    radius
        Of the poles, metres.
    min_pole_angle, max_pole_angle
        Between any two poles, rad.
    noise
        How the scans differ from exact geometry; None takes `TYPICAL`, and for ``paper`` the
        paper's noise.
    symmetric
        Make surroundings and two poles that a rotation by 180° about the vertical maps onto
        themselves, so that nothing distinguishes the hypotheses.
    frames
        How many sweeps each LiDAR records.

    Raises
    ------
    UsageError
        An unknown scene or sensor.
    SimulationError
        No arrangement was found in `MAX_DRAWS` draws in which both LiDARs see every pole.
    """
    if scene not in SCENES:
        raise UsageError(f"no scene is named {scene!r}; there are {', '.join(SCENES)}")
    if poles == 0 and scene == "paper":
        raise UsageError("the paper's set-up has only its poles")
    names = DEFAULT_SENSORS[scene]
    sensors = (find_sensor(sensor_target or names[0]), find_sensor(sensor_source or names[1]))
    if noise is None:
        noise = PAPER_NOISE if scene == "paper" else TYPICAL
    # The arrangement comes from rng alone, all that the noise model changes from its children.
    *for_devices, for_recording = rng.spawn(3)
    target, source = (
        draw_device(sensor, noise, own) for sensor, own in zip(sensors, for_devices, strict=True)
    )
    recorders = Recorders(sensors, (target, source), noise, frames)
    for _ in range(MAX_DRAWS):
        at = (
            Arrangement([], draw_paper_poles(rng, radius), paper_lidar_poses(), (0.0, 0.0))
            if scene == "paper"
            else _draw(scene, rng, poles or 2, (min_pole_angle, max_pole_angle), radius, symmetric)
        )
        if at is not None:
            at = facing_poles(at, sensors, rng)
        if at is not None and are_in_view(at, recorders, rng):
            if poles == 0:
                return record(replace(at, poles=()), recorders, for_recording)
            return record_every_pole(at, recorders, for_recording)
    raise SimulationError(
        f"{MAX_DRAWS} draws of {scene!r} gave no scene in which {sensors[0].name} and "
        f"{sensors[1].name} both see {poles or 2} poles with {MIN_RETURNS} returns on "
        f"{MIN_RINGS} rings"
    )


def _draw(
    scene: str,
    rng: np.random.Generator,
    poles: int,
    angles: tuple[float, float],
    radius: float,
    symmetric: bool,
) -> Arrangement | None:
    """Draw surroundings, poles and LiDARs; None if this draw has none."""
    place = SURROUNDINGS[scene](rng)
    if min(place.clear) <= 0:
        return None
    surfaces = place.surfaces
    if symmetric:
        surfaces = [*surfaces, *rotated_by_180(surfaces)]
        drawn: list[Cylinder] | None = symmetric_poles(rng, radius)
    else:
        drawn = draw_poles(rng, poles, place.clear, angles, radius)
    if drawn is None:
        return None
    target, source = (draw_lidar(rng, drawn, place.clear) for _ in range(2))
    if target is None or source is None:
        return None
    distance = np.linalg.norm(target[:3, 3] - source[:3, 3])
    if not LIDAR_SPACING[0] <= distance <= LIDAR_SPACING[1]:
        return None
    return Arrangement(surfaces, drawn, (target, source), place.clear)


def facing_poles(
    at: Arrangement, sensors: Sequence[Sensor], rng: np.random.Generator
) -> Arrangement:
    """Turn LiDARs that do not see all around toward the poles, as people do.

    Up to a quarter of the field of view stays between its middle and that of the poles.
    """
    if all(sensor.sees_all_around for sensor in sensors):
        return at
    middle = np.mean([pole.centre for pole in at.poles], axis=0)
    target, source = (
        turned_to(pose, sensor, middle, float(rng.uniform(-0.25, 0.25)))
        for pose, sensor in zip(at.poses, sensors, strict=True)
    )
    return replace(at, poses=(target, source))


def turned_to(pose: Array, sensor: Sensor, point: Array, off: float) -> Array:
    """Turn a LiDAR about the vertical until a point (3,) is in the middle of its field of view.

    The point is off the middle by `off`, as a part of the field. A LiDAR that sees all around is
    left as it is.
    """
    if sensor.sees_all_around:
        return pose
    ahead = np.mean(sensor.azimuth_span)
    forward = pose[:3, :3] @ np.array([np.cos(ahead), np.sin(ahead), 0.0])
    to = point - pose[:3, 3]
    angle = np.arctan2(to[1], to[0]) - np.arctan2(forward[1], forward[0]) + off * sensor.turn
    turn = se3.exp_so3(np.array([0.0, 0.0, angle]))
    return se3.from_rt(turn @ pose[:3, :3], pose[:3, 3])


MIN_RETURNS, MIN_RINGS = 6, 3
"""A LiDAR sees a pole with at least this many returns on this many rings: fewer give no line."""

MAX_RECORDINGS = 20
"""Recordings of an arrangement before a `SimulationError`: noise seldom leaves too few returns of a
pole in view, and in 30 seeds no scene needed more than 2."""


class SimulationError(RetropoleError):
    """No arrangement of poles and LiDARs, or no recording, fulfils the demands."""


@dataclass(frozen=True, eq=False)
class SimulatedPair:
    """Two scans and the truth about them.

    Attributes
    ----------
    target, source
        Clouds, each in its sensor's frame.
    T_target_source, T_world_target, T_world_source
        (4, 4) true poses.
    surfaces
        Everything in the scene, in the world frame; the poles come last.
    poles
        The taped poles.
    labels
        For the target and the source, the index of the surface that each point lies on; −1 for a
        point on something that moves, or next to tape that blooms.
    returns_on_poles
        Per pole, how many points the target and the source have on it.
    sensors
        The two models.
    devices
        The two LiDARs themselves, with the systematic errors that they keep.
    noise
        How the recordings differ from exact geometry.
    clear
        Half extents of the ground around the world's origin where poles are allowed, metres.
    """

    target: PointCloud
    source: PointCloud
    T_target_source: Array
    T_world_target: Array
    T_world_source: Array
    surfaces: tuple[Surface, ...]
    poles: tuple[Cylinder, ...]
    labels: tuple[IntArray, IntArray]
    returns_on_poles: tuple[tuple[int, int], ...]
    sensors: tuple[Sensor, Sensor]
    devices: tuple[Device, Device]
    noise: NoiseModel
    clear: tuple[float, float] = (0.0, 0.0)

    @property
    def surroundings(self) -> tuple[Surface, ...]:
        """Everything but the poles."""
        return self.surfaces[: len(self.surfaces) - len(self.poles)]

    @property
    def sees_every_pole(self) -> bool:
        """Whether both LiDARs see every pole, with `MIN_RETURNS` on `MIN_RINGS`."""
        return all(
            is_seen(labels == len(self.surroundings) + k, cloud.ring)
            for cloud, labels in zip((self.target, self.source), self.labels, strict=True)
            for k in range(len(self.poles))
        )


@dataclass(frozen=True, eq=False)
class Arrangement:
    """Positions of everything, as nothing but geometry.

    Attributes
    ----------
    surroundings, poles
        In the world frame.
    poses
        (4, 4) poses of the target and the source in the world frame.
    clear
        As in `SimulatedPair`.
    """

    surroundings: Sequence[Surface]
    poles: Sequence[Cylinder]
    poses: tuple[Array, Array]
    clear: tuple[float, float]


class Recorders(NamedTuple):
    """What records an arrangement: models and LiDARs, those of one as of the other; noise; sweeps.

    Of a pair, target and source.
    """

    sensors: Sequence[Sensor]
    devices: Sequence[Device]
    noise: NoiseModel
    frames: int


def is_seen(on_pole: BoolArray, rings: IntArray | None, returns: int = MIN_RETURNS) -> bool:
    """Whether a pole's returns, a mask (N,) of those with rings (N,), are enough to find it."""
    count = int(np.count_nonzero(on_pole))
    return count >= returns and (rings is None or len(np.unique(rings[on_pole])) >= MIN_RINGS)


def are_in_view(
    at: Arrangement, recorders: Recorders, rng: np.random.Generator, returns: int = MIN_RETURNS
) -> bool:
    """Whether both LiDARs see every pole along thin, exact beams, with this many returns or more.

    This is the demand on an arrangement, so that it is the same under every noise model.
    """
    return all(
        all(poles_in_view(at.surroundings, at.poles, sensor, pose, rng, returns, recorders.frames))
        for sensor, pose in zip(recorders.sensors, at.poses, strict=True)
    )


def poles_in_view(
    surroundings: Sequence[Surface],
    poles: Sequence[Cylinder],
    sensor: Sensor,
    pose: Array,
    rng: np.random.Generator,
    returns: int = MIN_RETURNS,
    frames: int = 1,
) -> tuple[bool, ...]:
    """Which poles a LiDAR at a pose (4, 4) sees along thin, exact beams.

    Only beams that may hit a pole are cast.
    """
    everything, first = [*surroundings, *poles], len(surroundings)
    surface, rings = [], []
    for sweep in sweeps(sensor, rng, frames):
        world = sweep.rays @ pose[:3, :3].T
        toward = np.flatnonzero(cast(pose[:3, 3], world, poles).surface >= 0)
        hits = cast(pose[:3, 3], world[toward], everything)
        near = (hits.ranges > sensor.min_range) & (hits.ranges < sensor.max_range)
        surface.append(np.where(near, hits.surface, -1))
        rings.append(sweep.rings[toward])
    own = np.concatenate(rings) if sensor.rings else None
    seen_patches = np.concatenate(surface)
    return tuple(is_seen(seen_patches == first + k, own, returns) for k in range(len(poles)))


def record_in_turn(
    scenes: Sequence[Sequence[Surface]],
    poses: Sequence[Array],
    recorders: Recorders,
    reach: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[LabelledScan, ...]:
    """Scan with one LiDAR after the other.

    Parameters
    ----------
    scenes
        All surfaces as they are when each LiDAR records.
    poses, recorders
        Of each LiDAR, and each LiDAR itself.
    reach
        Half extents in x and y in which movers start, metres.
    rng
        Source of all that is random.
    """
    sensors, devices, noise, frames = recorders
    *each, for_movers = rng.spawn(len(scenes) + 1)
    waits = [float(for_movers.uniform(*DELAY)) for _ in range(len(scenes) - 1)]
    starts = np.cumsum([0.0, *waits])
    until = float(starts[-1]) + frames * SWEEP_SECONDS
    movers = draw_movers(noise.movers, reach, [pose[:3, 3] for pose in poses], until, for_movers)
    scans = []
    in_turn = zip(scenes, sensors, poses, each, devices, starts.tolist(), strict=True)
    for scene, sensor, pose, own, device, start in in_turn:
        one = scan(
            scene, sensor, pose, own, noise, frames, device=device, movers=movers, start=start
        )
        scans.append(one)
    return tuple(scans)


def record(at: Arrangement, recorders: Recorders, rng: np.random.Generator) -> SimulatedPair:
    """Scan an arrangement once with both LiDARs."""
    everything: list[Surface] = [*at.surroundings, *at.poles]
    reach = at.clear if min(at.clear) > 0 else PAPER_CLEAR
    target, source = record_in_turn((everything, everything), at.poses, recorders, reach, rng)
    first = len(at.surroundings)
    return SimulatedPair(
        target=target.cloud,
        source=source.cloud,
        T_target_source=se3.inverse(at.poses[0]) @ at.poses[1],
        T_world_target=at.poses[0],
        T_world_source=at.poses[1],
        surfaces=tuple(everything),
        poles=tuple(at.poles),
        labels=(target.labels, source.labels),
        returns_on_poles=tuple(
            (_returns_on(target, first + k), _returns_on(source, first + k))
            for k in range(len(at.poles))
        ),
        sensors=(recorders.sensors[0], recorders.sensors[1]),
        devices=(recorders.devices[0], recorders.devices[1]),
        noise=recorders.noise,
        clear=at.clear,
    )


def _returns_on(scanned: LabelledScan, label: int) -> int:
    return int(np.count_nonzero(scanned.labels == label))


def record_every_pole(
    at: Arrangement, recorders: Recorders, rng: np.random.Generator
) -> SimulatedPair:
    """Scan an arrangement until both LiDARs see every pole."""
    for _ in range(MAX_RECORDINGS):
        pair = record(at, recorders, rng)
        if pair.sees_every_pole:
            return pair
    raise SimulationError(
        f"{MAX_RECORDINGS} recordings gave none in which both LiDARs see every pole: "
        "the noise hides it"
    )


def place_again(
    pair: SimulatedPair,
    rng: np.random.Generator,
    *,
    noise: NoiseModel | None = None,
    frames: int = 1,
) -> SimulatedPair:
    """Put the poles of a pair in other places, with the same LiDARs and surroundings.

    Parameters
    ----------
    pair
        From `simulate_pair`; its poles are removed.
    rng
        As there.
    noise
        As there, but the LiDARs are the pair's and keep their systematic errors; None takes the
        pair's.
    frames
        How many sweeps each LiDAR records.

    Raises
    ------
    SimulationError
        No arrangement was found in `MAX_DRAWS` draws in which both LiDARs see every pole.
    """
    count, radius = len(pair.poles), pair.poles[0].radius
    angles = MIN_POLE_ANGLE, MAX_POLE_ANGLE
    poses = pair.T_world_target, pair.T_world_source
    recorders = Recorders(pair.sensors, pair.devices, noise or pair.noise, frames)
    (for_recording,) = rng.spawn(1)
    for _ in range(MAX_DRAWS):
        drawn = (
            draw_poles(rng, count, pair.clear, angles, radius)
            if min(pair.clear) > 0
            else draw_paper_poles(rng, radius)
        )
        if drawn is None:
            continue
        at = Arrangement(pair.surroundings, drawn, poses, pair.clear)
        if are_in_view(at, recorders, rng):
            return record_every_pole(at, recorders, for_recording)
    raise SimulationError(f"{MAX_DRAWS} draws gave no other positions for {count} poles")
