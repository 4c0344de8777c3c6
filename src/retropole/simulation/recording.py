"""Two LiDARs record an arrangement of poles: what is in view, and the pair of scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..base import se3
from ..base.datatypes import Array, BoolArray, IntArray, PointCloud
from ..base.errors import RetropoleError
from ..base.sensors import Sensor
from . import paper
from .devices import Device, NoiseModel
from .environment import DELAY, draw_movers
from .raycast import Cylinder, Surface, cast
from .scanning import SWEEP_SECONDS, LabelledScan, beams, scan

MIN_RETURNS, MIN_RINGS = 6, 3
"""A LiDAR sees a pole with at least so many returns on so many rings: fewer give no line."""

MAX_RECORDINGS = 20
"""Recordings of an arrangement before a `SimulationError`: noise seldom leaves too few returns of a
pole in view, and in 30 seeds no scene needed more than 2."""


class SimulationError(RetropoleError):
    """No arrangement of poles and LiDARs, or no recording of it, meets the demands."""


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
        point on something that moves, or beside tape that blooms.
    returns_on_poles
        Per pole, how many points the target and the source have on it.
    sensors
        The two models.
    devices
        The two LiDARs themselves, with the systematic errors that they keep.
    noise
        How the recordings differ from exact geometry.
    clear
        Half extents of the ground around the world's origin where poles may stand, metres.
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
    """Who stands where, as nothing but geometry.

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
    """Whether both LiDARs see every pole along thin, exact beams, with so many returns or more.

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

    Only beams that may meet a pole are cast.
    """
    everything, first = [*surroundings, *poles], len(surroundings)
    surface, rings = [], []
    for _ in range(frames):
        sweep = beams(sensor, rng)
        world = sweep.rays @ pose[:3, :3].T
        toward = np.flatnonzero(cast(pose[:3, 3], world, poles).surface >= 0)
        hits = cast(pose[:3, 3], world[toward], everything)
        near = (hits.ranges > sensor.min_range) & (hits.ranges < sensor.max_range)
        surface.append(np.where(near, hits.surface, -1))
        rings.append(sweep.rings[toward])
    own = np.concatenate(rings) if sensor.pattern == "spinning" else None
    met = np.concatenate(surface)
    return tuple(is_seen(met == first + k, own, returns) for k in range(len(poles)))


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
        All surfaces as they stand when each LiDAR records.
    poses, recorders
        Of each LiDAR, and each of them.
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
    reach = at.clear if min(at.clear) > 0 else paper.PAPER_CLEAR
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
