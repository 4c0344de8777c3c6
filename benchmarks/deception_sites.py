"""Sites where recordings may deceive, and what each LiDAR records there, for `deception_scenes`.

A site is a place with poles and two LiDARs, as nothing but geometry. What each LiDAR records is
said by a `Shot` of its own: between the target's and the source's anything may have changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from retropole.base import se3
from retropole.base.datatypes import DEFAULT_RADIUS, Array, PointCloud
from retropole.base.sensors import SWEEP_SECONDS, Sensor
from retropole.simulation import Cylinder, Device, NoiseModel, Surface, scan
from retropole.simulation.pairs import (
    LIDAR_SPACING,
    MAX_POLE_ANGLE,
    MIN_POLE_ANGLE,
    Arrangement,
    Recorders,
    are_in_view,
)
from retropole.simulation.scanning import DELAY, Mover, draw_movers
from retropole.simulation.scenes import (
    FOOT_HEIGHT,
    MAX_LEAN,
    MAX_POLE_X,
    POLE_LENGTHS,
    POLE_SPACING,
    SURROUNDINGS,
    TAPE,
    UP,
    Surroundings,
    draw_lidar,
    draw_poles,
)

KEPT_FREE = 1.2
"""What is set or carried somewhere comes no closer to a LiDAR, metres."""

LEAN = MIN_POLE_ANGLE, MAX_LEAN
"""Least and greatest lean of a pole beside an upright one, rad."""

SQUARE, NEARLY_MEET = float(np.radians(4.0)), (0.08, 0.2)
"""Poles at about 90° are off it by no more than this, rad, and their axes come so near, metres."""

Poses = tuple[Array, Array]
DrawPoles = Callable[[np.random.Generator, tuple[float, float]], list[Cylinder] | None]


@dataclass(frozen=True, eq=False)
class Site:
    """A place with poles and LiDARs at ``poses`` (4, 4) in the world; ``clear`` as there."""

    scene: str
    surroundings: list[Surface]
    clear: tuple[float, float]
    poles: list[Cylinder]
    poses: Poses

    @property
    def truth(self) -> Array:
        """(4, 4) target from source."""
        return se3.inverse(self.poses[0]) @ self.poses[1]

    def shot(self, k: int) -> Shot:
        """What the target (0) or the source (1) records where nothing has changed."""
        return Shot(self.surroundings, self.poles, (self.poses[k],))

    def allows(self, *spots: Array) -> bool:
        """Whether spots (3,) lie on clear ground and away from the LiDARs."""
        return all(
            bool(np.all(np.abs(spot[:2]) < self.clear))
            and min(float(np.linalg.norm((spot - pose[:3, 3])[:2])) for pose in self.poses)
            > KEPT_FREE
            for spot in spots
        )


@dataclass(frozen=True, eq=False)
class Shot:
    """What one LiDAR records.

    Attributes
    ----------
    surroundings
        All but the poles.
    poles
        What must be in view: the taped poles, and what may be taken for one.
    poses
        (4, 4) of the LiDAR in the world, one for each sweep.
    change
        What becomes of the cloud once it is recorded.
    """

    surroundings: Sequence[Surface]
    poles: Sequence[Cylinder]
    poses: tuple[Array, ...]
    change: Callable[[PointCloud], PointCloud] = lambda cloud: cloud

    def with_things(self, *things: Surface) -> Shot:
        """Add to the surroundings."""
        return replace(self, surroundings=[*self.surroundings, *things])


def place_of(scene: str, rng: np.random.Generator) -> Surroundings:
    return SURROUNDINGS[scene](rng)


def standing(count: int) -> DrawPoles:
    """So many poles, as `simulate_pair` draws them."""
    angles = MIN_POLE_ANGLE, MAX_POLE_ANGLE
    return lambda rng, clear: draw_poles(rng, count, clear, angles, DEFAULT_RADIUS)


def upright_and_leaning(
    rng: np.random.Generator, clear: tuple[float, float]
) -> list[Cylinder] | None:
    """An upright pole, and a leaning one."""
    feet = _two_feet(rng, clear)
    if feet is None:
        return None
    axes = UP, leaning(float(rng.uniform(*LEAN)), float(rng.uniform(0, 2 * np.pi)))
    lengths = rng.uniform(*POLE_LENGTHS, 2)
    return [on_foot(*each) for each in zip(feet, axes, lengths, strict=True)]


def leaning_and_band(rng: np.random.Generator, clear: tuple[float, float]) -> list[Cylinder] | None:
    """A leaning pole, and an upright band as a person may wear."""
    poles = upright_and_leaning(rng, clear)
    if poles is None:
        return None
    band, pole = poles
    middle = np.r_[band.centre[:2], rng.uniform(0.9, 1.2)]
    return [pole, replace(band, centre=middle, length=float(rng.uniform(0.5, 1.0)))]


def at_right_angles(rng: np.random.Generator, clear: tuple[float, float]) -> list[Cylinder] | None:
    """Two poles at about 90° whose axes nearly meet."""
    angle = np.pi / 2 + float(rng.uniform(-1, 1)) * SQUARE
    return _nearly_meeting(rng, clear, angle, rng.uniform(0.0, 1.8), rng.uniform(*NEARLY_MEET))


def at_times_meeting(rng: np.random.Generator, clear: tuple[float, float]) -> list[Cylinder] | None:
    """Two poles; in half of the draws their axes meet within 5 cm, below or above the poles.

    Such poles look the same mirrored, and where each stands on the other's foot.
    """
    if rng.uniform() < 0.5:
        return standing(2)(rng, clear)
    angle, gap = float(rng.uniform(MIN_POLE_ANGLE, MAX_POLE_ANGLE)), float(rng.uniform(0.0, 0.05))
    height = rng.uniform(-1.5, -0.3) if rng.uniform() < 0.5 else rng.uniform(2.7, 4.0)
    return _nearly_meeting(rng, clear, angle, float(height), gap)


def _nearly_meeting(
    rng: np.random.Generator, clear: tuple[float, float], angle: float, height: float, gap: float
) -> list[Cylinder] | None:
    """Two poles at an angle, rad, whose axes come so near, metres, at a height, metres."""
    toward, length = rng.uniform(0, 2 * np.pi), rng.uniform(*POLE_LENGTHS, 2)
    lean = rng.uniform(0.35, 0.65) * angle
    axes = leaning(lean, toward), leaning(angle - lean, toward + np.pi)
    at = np.r_[rng.uniform(-1, 1, 2) * (min(clear[0], MAX_POLE_X), clear[1]), height]
    across = np.cross(axes[0], axes[1])
    across *= rng.choice([-0.5, 0.5]) * gap / np.linalg.norm(across)
    feet = [
        at + side * across + (FOOT_HEIGHT - at[2] - side * across[2]) / axis[2] * axis
        for axis, side in zip(axes, (-1, 1), strict=True)
    ]
    if any(np.any(np.abs(foot[:2]) > clear) for foot in feet):
        return None
    return [on_foot(*each) for each in zip(feet, axes, length, strict=True)]


def _two_feet(rng: np.random.Generator, clear: tuple[float, float]) -> Array | None:
    feet = rng.uniform(-1, 1, (2, 2)) * (min(clear[0], MAX_POLE_X), clear[1])
    gap = float(np.linalg.norm(feet[0] - feet[1]))
    return feet if POLE_SPACING[0] <= gap <= POLE_SPACING[1] else None


def leaning(lean: float, toward: float) -> Array:
    """Axis (3,) that leans so far, rad, toward a bearing."""
    level = np.sin(lean) * np.array([np.cos(toward), np.sin(toward)])
    return np.r_[level, np.cos(lean)]


def on_foot(foot: Array, axis: Array, length: float) -> Cylinder:
    """A taped pole on a foot (2,) or (3,)."""
    start = np.r_[foot[:2], FOOT_HEIGHT]
    return Cylinder(start + axis * length / 2, axis, DEFAULT_RADIUS, float(length), TAPE)


def foot_of(pole: Cylinder) -> Array:
    """Lower end (3,) of a pole."""
    return np.asarray(pole.centre - pole.length / 2 * pole.axis)


def carried(pole: Cylinder, G: Array) -> Cylinder:
    """Carry a pole by a motion (4, 4) of the world."""
    return replace(pole, centre=se3.apply(G, pole.centre[None])[0], axis=G[:3, :3] @ pole.axis)


def about_vertical(angle: float, through: Array, shift: Array) -> Array:
    """Motion (4, 4) that turns about the vertical through a point (3,) and then shifts by (2,)."""
    R = np.asarray(Rotation.from_euler("z", angle).as_matrix())
    return se3.from_rt(R, through - R @ through + np.r_[shift, 0.0])


def draw_site(
    scene: str,
    rng: np.random.Generator,
    poles: DrawPoles,
    around: Callable[[str, np.random.Generator], Surroundings],
) -> Site | None:
    """Draw who stands where; None where this draw has nothing."""
    place = around(scene, rng)
    if min(place.clear) <= 0:
        return None
    standing_poles = poles(rng, place.clear)
    if standing_poles is None:
        return None
    drawn = [draw_lidar(rng, standing_poles, place.clear) for _ in range(2)]
    if drawn[0] is None or drawn[1] is None:
        return None
    apart = float(np.linalg.norm(drawn[0][:3, 3] - drawn[1][:3, 3]))
    if not LIDAR_SPACING[0] <= apart <= LIDAR_SPACING[1]:
        return None
    return Site(scene, place.surfaces, place.clear, standing_poles, (drawn[0], drawn[1]))


def is_in_view(shot: Shot, sensor: Sensor, device: Device, rng: np.random.Generator) -> bool:
    """Whether a LiDAR sees all that it must."""
    if not shot.poles:
        return True
    pose = shot.poses[0]
    # Both LiDARs of the arrangement are this one: who else looks is another shot's.
    at = Arrangement(shot.surroundings, shot.poles, (pose, pose), (0.0, 0.0))
    recorders = Recorders((sensor, sensor), (device, device), NoiseModel(), frames=1)
    return are_in_view(at, recorders, rng)


def recorded(
    shots: tuple[Shot, Shot],
    clear: tuple[float, float],
    sensors: tuple[Sensor, Sensor],
    devices: tuple[Device, Device],
    noise: NoiseModel,
    rng: np.random.Generator,
) -> tuple[tuple[PointCloud, PointCloud], int]:
    """Record both shots, the source's some seconds after the target's, and change the clouds.

    Gives the least returns that a LiDAR has on a pole besides.
    """
    starts = 0.0, float(rng.uniform(*DELAY))
    lidars = [shot.poses[0][:3, 3] for shot in shots]
    until = starts[1] + len(shots[1].poses) * SWEEP_SECONDS
    movers = draw_movers(noise.movers, clear, lidars, until, rng)
    target, source = (
        _sweeps(shot, sensor, device, noise, movers, start, rng)
        for shot, sensor, device, start in zip(shots, sensors, devices, starts, strict=True)
    )
    clouds = shots[0].change(target[0]), shots[1].change(source[0])
    return clouds, min(target[1], source[1])


def _sweeps(
    shot: Shot,
    sensor: Sensor,
    device: Device,
    noise: NoiseModel,
    movers: Sequence[Mover],
    start: float,
    rng: np.random.Generator,
) -> tuple[PointCloud, int]:
    everything: list[Surface] = [*shot.surroundings, *shot.poles]
    sweeps = [
        scan(
            everything,
            sensor,
            pose,
            rng,
            noise,
            device=device,
            movers=movers,
            start=start + k * SWEEP_SECONDS,
        )
        for k, pose in enumerate(shot.poses)
    ]
    labels = np.concatenate([each.labels for each in sweeps])
    first, last = len(shot.surroundings), len(everything)
    returns = min(int(np.count_nonzero(labels == label)) for label in range(first, last))
    clouds = [each.cloud for each in sweeps]
    if len(clouds) == 1:
        return clouds[0], returns
    merged = {
        name: np.concatenate([getattr(each, name) for each in clouds])
        for name in ("xyz", "intensity", "ring", "time")
        if getattr(clouds[0], name) is not None
    }
    number = np.repeat(np.arange(len(clouds)), [len(each) for each in clouds])
    merged["time"] = merged["time"] + number * SWEEP_SECONDS
    return PointCloud(frame=number.astype(np.int64), **merged), returns
