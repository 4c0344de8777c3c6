"""Hard scenes: everything that makes a calibration hard, drawn at once, for `hard_scenes`.

A scene has all the errors of a field, new LiDARs of one of several pairs of models, and two to four
poles. Its difficulties are drawn first and kept; arrangements are drawn until one is possible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from detection_hard import PAINT, TAPE, UP, beside
from retropole.base import se3
from retropole.base.datatypes import DEFAULT_RADIUS, Array
from retropole.base.sensors import find_sensor
from retropole.simulation import FIELD, Cylinder, Rectangle, SimulatedPair, Surface, draw_device
from retropole.simulation.pairs import (
    LIDAR_SPACING,
    MAX_POLE_ANGLE,
    MIN_POLE_ANGLE,
    Arrangement,
    Recorders,
    are_in_view,
    record,
)
from retropole.simulation.scenes import LIDAR_HEIGHTS, SURROUNDINGS, draw_poles

PLACES = "corridor", "street", "harbor"
SENSORS = (
    ("VLP-16", "VLP-16"),
    ("VLP-16", "HDL-32E"),
    ("XT32", "VLP-16"),
    ("XT32", "PandarQT"),
    ("HDL-32E", "OS1"),
    ("Pandar64", "OS1"),
)
POLES = 2, 2, 3, 4
BOLLARDS = "", "", "painted bollard", "taped bollard"
FEW = "", "", "short poles", "far poles"
LAYOUTS = "", "facing", "side by side"
"""What is drawn with equal chances; of the other difficulties a scene has each with one half."""

DIFFICULTIES = (
    *("vests", "plates", *BOLLARDS[2:], "wall", *FEW[2:], *LAYOUTS[1:], "tilted"),
    *("2 poles", "3 poles", "4 poles", *PLACES),
)
"""The rows of the table."""

DISTANCES, FAR_DISTANCES = (2.2, 8.0), (5.0, 12.0)
"""Least and greatest horizontal distance of a LiDAR from a pole, metres; where poles are far."""

FAR_REACH = 10.0
"""Along x LiDARs stand up to so far from the middle of an open place where poles are far, m."""

SIDE_BY_SIDE, FACING = (0.2, 1.0), float(np.radians(150.0))
"""Distance of LiDARs side by side, metres; facing ones stand so far apart, or more, as seen from
the middle of the poles, rad."""

LEVEL, TILT = float(np.radians(5.0)), (float(np.radians(10.0)), float(np.radians(30.0)))
"""Greatest tilt of a LiDAR; least and greatest where LiDARs are tilted, rad."""

UPSIDE_DOWN = 0.25
"""Share of the tilted LiDARs that hang upside down."""

SHORT = 0.5, 1.2
"""Least and greatest length of short poles, metres."""

GAP, AROUND_LIDAR = 0.04, 0.4
"""Nothing comes closer to a pole's axis, and to a LiDAR, metres."""

MIN_RETURNS = 3
"""Arrangements in which thin beams give a LiDAR less on a pole are drawn again."""

MAX_DRAWS, MAX_EYE_DRAWS = 4000, 100
"""Draws of an arrangement before the scene is given up, and of both LiDARs' places in each."""


@dataclass(frozen=True)
class Scene:
    """What is hard about a scene."""

    place: str
    sensors: tuple[str, str]
    poles: int
    vests: bool
    plates: bool
    wall: bool
    tilted: bool
    bollard: str
    few: str
    layout: str

    @property
    def difficulties(self) -> tuple[str, ...]:
        """Rows of the table in which the scene counts."""
        named = [name for name in ("vests", "plates", "wall", "tilted") if getattr(self, name)]
        rows = (*named, self.bollard, self.few, self.layout, f"{self.poles} poles", self.place)
        return tuple(row for row in rows if row)


def draw_scene(rng: np.random.Generator) -> Scene:
    one_of = [int(rng.integers(len(x))) for x in (PLACES, SENSORS, POLES, BOLLARDS, FEW, LAYOUTS)]
    place, sensors, poles, bollard, few, layout = one_of
    drawn = rng.uniform(size=4) < 0.5
    return Scene(
        PLACES[place],
        SENSORS[sensors],
        POLES[poles],
        *(bool(each) for each in drawn),
        BOLLARDS[bollard],
        FEW[few],
        LAYOUTS[layout],
    )


def draw_arrangement(scene: Scene, rng: np.random.Generator) -> Arrangement | None:
    """Draw who stands where; None where this draw has nothing possible."""
    place = SURROUNDINGS[scene.place](rng)
    if min(place.clear) <= 0:
        return None
    angles = MIN_POLE_ANGLE, MAX_POLE_ANGLE
    poles = draw_poles(rng, scene.poles, place.clear, angles, DEFAULT_RADIUS)
    if poles is None:
        return None
    if scene.few == "short poles":
        poles = [
            replace(
                pole,
                centre=pole.centre + rng.uniform(0, 0.5) * pole.axis,
                length=float(rng.uniform(*SHORT)),
            )
            for pole in poles
        ]
    eyes = _draw_eyes(scene, poles, place.clear, rng)
    if eyes is None:
        return None
    things = _draw_things(scene, poles, eyes, place.clear, rng)
    surroundings = [*place.surfaces, *things]
    lidars = [Cylinder(eye, UP, 0.1, 0.2, PAINT) for eye in eyes]
    if any(_touches(thing, pole, GAP) for pole in poles for thing in surroundings) or any(
        _touches(thing, lidar, AROUND_LIDAR) for lidar in lidars for thing in things
    ):
        return None
    poses = _pose(eyes[0], scene.tilted, rng), _pose(eyes[1], scene.tilted, rng)
    return Arrangement(surroundings, poles, poses, place.clear)


def _draw_eyes(
    scene: Scene, poles: Sequence[Cylinder], clear: tuple[float, float], rng: np.random.Generator
) -> Array | None:
    """Where the LiDARs stand (2, 3); None where these draws have nothing."""
    feet = np.stack([pole.centre[:2] for pole in poles])
    is_far = scene.few == "far poles"
    nearest, farthest = FAR_DISTANCES if is_far else DISTANCES
    reach = (max(clear[0], FAR_REACH), clear[1]) if is_far and scene.place != "corridor" else clear
    for _ in range(MAX_EYE_DRAWS):
        at = rng.uniform(-1, 1, (2, 2)) * reach
        if scene.layout == "side by side":
            bearing = rng.uniform(0, 2 * np.pi)
            at[1] = at[0] + rng.uniform(*SIDE_BY_SIDE) * np.array(
                [np.cos(bearing), np.sin(bearing)]
            )
        elif scene.layout != "facing":
            apart = float(np.linalg.norm(at[0] - at[1]))
            if not LIDAR_SPACING[0] <= apart <= LIDAR_SPACING[1]:
                continue
        else:
            toward = at - feet.mean(axis=0)
            cosine = toward[0] @ toward[1] / np.prod(np.linalg.norm(toward, axis=1))
            if cosine > np.cos(FACING):
                continue
        away = np.linalg.norm(at[:, None] - feet, axis=2)
        if np.all((away > nearest) & (away < farthest) & np.all(np.abs(at) < reach)):
            return np.column_stack([at, rng.uniform(*LIDAR_HEIGHTS, 2)])
    return None


def _draw_things(
    scene: Scene,
    poles: Sequence[Cylinder],
    eyes: Array,
    clear: tuple[float, float],
    rng: np.random.Generator,
) -> list[Surface]:
    """What stands beside the poles and about the place."""

    def about() -> Cylinder:
        spot = rng.uniform(-1.2, 1.2, 2) * clear
        return (
            poles[int(rng.integers(len(poles)))]
            if rng.uniform() < 0.5
            else Cylinder(np.r_[spot, 1.0], UP, DEFAULT_RADIUS, 2.0, PAINT)
        )

    things: list[Surface] = []
    if scene.wall:
        for pole in poles[: 1 + int(rng.integers(len(poles)))]:
            things += beside(pole, "wall", eyes, rng)
    if scene.vests:
        for _ in range(rng.integers(1, 4)):
            things += beside(about(), "vest", eyes, rng)
    if scene.plates:
        for _ in range(rng.integers(1, 5)):
            things += beside(about(), "plate", eyes, rng)
    if scene.bollard:
        spot, height = rng.uniform(-1, 1, 2) * clear, rng.uniform(0.6, 1.2)
        material = TAPE if scene.bollard == "taped bollard" else PAINT
        radius = float(rng.uniform(0.04, 0.15))
        things.append(Cylinder(np.r_[spot, height / 2], UP, radius, float(height), material))
    return things


def _touches(thing: Surface, pole: Cylinder, gap: float) -> bool:
    """Whether a thing comes so close to a pole's axis, metres."""
    along = np.linspace(-0.5, 0.5, 51)[:, None] * pole.length
    off = pole.centre + along * pole.axis - thing.centre
    if isinstance(thing, Cylinder):
        up = off @ thing.axis
        beyond = [np.abs(up) - thing.length / 2]
        beyond += [np.linalg.norm(off - up[:, None] * thing.axis, axis=1) - thing.radius]
    else:
        flat = isinstance(thing, Rectangle)
        axes = np.stack([thing.u, thing.v, np.cross(thing.u, thing.v)], 1) if flat else thing.axes
        half = np.r_[thing.half_sides, 0.0] if flat else thing.half_sides
        beyond = list((np.abs(off @ axes) - half).T)
    return bool(np.any(np.max(beyond, axis=0) < gap))


def _pose(eye: Array, is_tilted: bool, rng: np.random.Generator) -> Array:
    tilt = float(rng.uniform(*TILT) if is_tilted else rng.uniform(0, LEVEL))
    if is_tilted and rng.uniform() < UPSIDE_DOWN:
        tilt += np.pi
    bearing, yaw = rng.uniform(0, 2 * np.pi, 2)
    lean = Rotation.from_rotvec(tilt * np.array([np.cos(bearing), np.sin(bearing), 0.0]))
    R = (lean * Rotation.from_euler("z", yaw)).as_matrix()
    return se3.from_rt(np.asarray(R), eye)


def draw_pair(seed: int) -> tuple[Scene, SimulatedPair] | None:
    """Draw a scene and record it once, come what may; None where nothing possible was drawn."""
    rng = np.random.default_rng(seed)
    scene = draw_scene(rng)
    sensors = find_sensor(scene.sensors[0]), find_sensor(scene.sensors[1])
    target, source, for_recording = rng.spawn(3)
    devices = draw_device(sensors[0], FIELD, target), draw_device(sensors[1], FIELD, source)
    recorders = Recorders(sensors, devices, FIELD, frames=1)
    for _ in range(MAX_DRAWS):
        at = draw_arrangement(scene, rng)
        if at is not None and are_in_view(at, recorders, rng, MIN_RETURNS):
            return scene, record(at, recorders, for_recording)
    return None
