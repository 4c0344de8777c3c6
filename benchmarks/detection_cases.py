"""Clouds in which every pole is known, for `detection`: simulated, staged and recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array, Detection, IntArray, PointCloud, Pole
from retropole.base.sensors import find_sensor
from retropole.io import read_cloud
from retropole.simulation import (
    Box,
    Cylinder,
    Material,
    Rectangle,
    SimulatedPair,
    Surface,
    scan,
    simulate_pair,
)

ENOUGH_RETURNS, ENOUGH_RINGS = 6, 3
"""A pole with so many returns above the threshold, on so many rings, should be found."""

PURE, WHOLE = 0.8, 0.6
"""A detected pole is a true one if so much of it lies on one, and holds so much of its returns."""

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
"""Where the real recordings are, if they are."""

STAGED_SENSORS = ("VLP-16", "HDL-32E", "XT32", "OS1", "Pandar64")
"""LiDARs that look at the staged things."""

TAPE, PAINT, ASPHALT = Material(0.9, retro=True), Material(0.5), Material(0.2)
X, Y, UP = np.eye(3)
SENSOR_HEIGHT, STAGE_RADIUS = 1.2, 4.0
"""Of the staged scenes, metres: above the floor, and how far around the thing the cloud is kept."""


@dataclass(frozen=True, eq=False)
class TruePole:
    """A pole that is there: its label, a point (3,) of its axis and its direction (3,)."""

    label: int
    centre: Array
    axis: Array


@dataclass(frozen=True, eq=False)
class Truth:
    """What the points of a cloud lie on: labels (N,), the kind of each surface, and the poles."""

    labels: IntArray
    rings: IntArray | None
    surfaces: tuple[str, ...]
    poles: tuple[TruePole, ...]


@dataclass(frozen=True, eq=False)
class Case:
    """A cloud, and the truth about it: by labels, or by a test of what was found.

    ``thing`` is what it shows, ``name`` says which draw of it.
    """

    thing: str
    name: str
    cloud: PointCloud
    truth: Truth | Callable[[Pole], bool]
    threshold: float | None = None


@dataclass(frozen=True)
class Score:
    """Poles that should be found and are, false ones, errors of the found; what went wrong."""

    visible: int
    found: int
    false: int
    angles: tuple[float, ...] = ()
    offsets: tuple[float, ...] = ()
    faults: tuple[str, ...] = ()


def score(case: Case, detection: Detection) -> Score:
    if not isinstance(case.truth, Truth):
        found = sum(case.truth(pole) for pole in detection.poles)
        return Score(found, found, len(detection.poles) - found)
    truth = case.truth
    assert case.cloud.intensity is not None
    bright = case.cloud.intensity >= detection.threshold
    taken: set[int] = set()
    angles, offsets, faults = [], [], []
    visible = 0
    for pole in truth.poles:
        on_it = (truth.labels == pole.label) & bright
        count = int(np.count_nonzero(on_it))
        rings = count if truth.rings is None else len(np.unique(truth.rings[on_it]))
        if count < ENOUGH_RETURNS or rings < ENOUGH_RINGS:
            continue
        visible += 1
        for j, line in enumerate(detection.poles):
            share = float(np.mean(truth.labels[line.index] == pole.label))
            if j not in taken and share >= PURE and share * len(line.index) >= WHOLE * count:
                taken.add(j)
                sine = np.linalg.norm(np.cross(line.direction, pole.axis))
                angles.append(float(np.arctan2(sine, abs(line.direction @ pole.axis))))
                offset = line.point - pole.centre
                offsets.append(float(np.linalg.norm(offset - (offset @ pole.axis) * pole.axis)))
                break
        else:
            own = np.flatnonzero(on_it)
            why = [r.reason for r in detection.rejected if np.isin(own, r.index).mean() > 0.3]
            faults.append(f"missed pole: {count} returns, {rings} rings: {'; '.join(why)}")
    for j, line in enumerate(detection.poles):
        if j not in taken:
            on, counts = np.unique(truth.labels[line.index], return_counts=True)
            parts = [f"{n} on {truth.surfaces[s]}" for s, n in zip(on, counts, strict=True)]
            faults.append(f"false pole: {line.length:.2f} m, {', '.join(parts)}")
    false = len(detection.poles) - len(taken)
    return Score(visible, len(taken), false, tuple(angles), tuple(offsets), tuple(faults))


def simulated_case(pair: SimulatedPair, side: int, name: str) -> Case:
    """The target's scan (side 0) or the source's of a simulated pair."""
    cloud = (pair.target, pair.source)[side]
    T_sensor_world = se3.inverse((pair.T_world_target, pair.T_world_source)[side])
    first = len(pair.surfaces) - len(pair.poles)
    poles = tuple(
        TruePole(
            first + k,
            se3.apply(T_sensor_world, pole.centre[None])[0],
            T_sensor_world[:3, :3] @ pole.axis,
        )
        for k, pole in enumerate(pair.poles)
    )
    names = tuple(f"{type(s).__name__} {k}" for k, s in enumerate(pair.surfaces))
    sensor = pair.sensors[side].name
    return Case(
        "pair", f"{name} {sensor}", cloud, Truth(pair.labels[side], cloud.ring, names, poles)
    )


def forgotten(case: Case, seed: int) -> Case:
    """As another program would leave it: points transformed, beam origin and rings forgotten."""
    assert isinstance(case.truth, Truth)
    T = se3.random(np.random.default_rng(seed), 20.0)
    cloud = PointCloud(se3.apply(T, case.cloud.xyz), case.cloud.intensity)
    poles = tuple(
        TruePole(p.label, se3.apply(T, p.centre[None])[0], T[:3, :3] @ p.axis)
        for p in case.truth.poles
    )
    return replace(
        case,
        name=f"{case.name} forgotten",
        cloud=cloud,
        truth=replace(case.truth, poles=poles),
    )


def simulated(scene: str, seed: int) -> Iterator[Case]:
    """A pair of one of the simulator's scenes: one scan as recorded, the other forgotten.

    The scene ``rosette`` is one sweep of a Mid-360 in the harbor: a few returns on each pole.
    """
    if scene == "rosette":
        rng = np.random.default_rng(seed)
        pair = simulate_pair("harbor", rng, sensor_target="Mid-360", sensor_source="VLP-16")
        yield simulated_case(pair, 0, f"{scene} {seed}")
        return
    pair = simulate_pair(scene, np.random.default_rng(seed))
    first, second = (simulated_case(pair, side, f"{scene} {seed}") for side in (0, 1))
    yield from (first, forgotten(second, seed)) if seed % 2 else (forgotten(first, seed), second)


def _pole(at: tuple[float, float], lean: tuple[float, float], radius: float = 0.02) -> Cylinder:
    axis = np.array([*lean, 1.0]) / np.linalg.norm([*lean, 1.0])
    return Cylinder(np.array([*at, 0.05]) + axis, axis, radius, 2.0, TAPE)


def _post(height: float, radius: float, middle: float, material: Material) -> Cylinder:
    return Cylinder(np.array([0, 0, middle]), UP, radius, height, material)


def _plate(at: tuple[float, float, float], half: tuple[float, float], yaw: float = 0) -> Rectangle:
    """A taped plate that faces −x, turned about the vertical by ``yaw``."""
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    return Rectangle(np.array(at), across, UP, half, TAPE)


def _box(
    at: tuple[float, float, float],
    half: tuple[float, float, float],
    yaw: float = 0,
    material: Material = PAINT,
) -> Box:
    u, v = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    return Box(np.array(at), np.stack([u, v, UP], axis=1), np.array(half), material)


def _wall(at: float) -> Rectangle:
    return Rectangle(np.array([at, 0, 1.5]), Y, UP, (3, 1.5), PAINT)


def _vest(aside: float) -> list[Surface]:
    """A person with two retro-reflective bands, so far to the side."""
    bands = [_box((0, aside, z), (0.14, 0.24, 0.025), 0, TAPE) for z in (1.05, 1.3)]
    return [_box((0, aside, 0.85), (0.12, 0.22, 0.85)), *bands]


def _things(rng: np.random.Generator) -> Mapping[str, tuple[list[Surface], list[Cylinder]]]:
    """Draw, at the origin, things that may be taken for poles, and poles that are hard to find.

    First come the surfaces that are not poles, then the poles.
    """
    yaw, size = rng.uniform(-0.8, 0.8), rng.uniform(0.6, 1.4)
    lean_x, lean_y = rng.uniform(-0.4, 0.4, 2)
    gap, aside = rng.uniform(0.1, 0.5), rng.uniform(0.25, 0.6)
    post, car = _post(2.4, 0.03, 1.2, PAINT), _box((2, 0, 0.6), (2, 0.9, 0.5))
    lamps = [_plate((-0.02, y, 0.7), (0.1, 0.2)) for y in (-0.8, 0.8)]
    corner = _box((1, 0, 1.2), (0.7, 0.7, 1.2), 0.8)
    mark = _box((0.01, 0, 1.2), (0.03, 0.03, 0.9), 0, TAPE)
    ground = Rectangle(np.array([0, 0, 0.01]), X, Y, (1.5, 1.5), TAPE)
    bar = _box((-0.5, 0, 1.1), (0.02, 1.0, 0.25))
    upright, tilted = _pole((0, 0), (0, 0)), _pole((0, 0), (lean_x, lean_y))
    crossing = [_pole((0, -aside), (0, aside)), _pole((0.1, aside), (0, -aside))]
    return {
        "sign on a post": ([post, _plate((-0.1, 0, 2), (0.3, 0.3), yaw)], []),
        "plate": ([_plate((0, 0, 1.2), (0.35 * size, 0.35 * size), yaw)], []),
        "level band": ([_plate((0, 0, 1.2), (0.6, 0.05 * size), yaw)], []),
        "band on a post": ([post, _post(0.45 * size, 0.032, 1.3, TAPE)], []),
        "stripe on a wall": ([_wall(0), _plate((-0.01, 0, 1.2), (0.025, 0.9))], []),
        "marked corner of a box": ([corner, mark], []),
        "lane mark": ([replace(ground, half_sides=(1.5, 0.07))], []),
        "number plate": ([car, _plate((-0.02, 0, 0.6), (0.26, 0.055))], []),
        "lamps of a car": ([car, *lamps], []),
        "cone": ([_post(0.7, 0.1, 0.35, PAINT), _post(0.15 * size, 0.11, 0.4, TAPE)], []),
        "vest": (_vest(0), []),
        "bright ground": ([ground], []),
        "taped column": ([_post(2.4, 0.3 * size, 1.2, TAPE)], []),
        "pole": ([], [tilted]),
        "thick pole": ([], [replace(tilted, radius=0.05 * size)]),
        "crossing poles": ([], crossing),
        "poles side by side": ([], [upright, _pole((0, gap), (0, aside))]),
        "pole held by a person": (_vest(aside), [upright]),
        "pole before a wall": ([_wall(gap)], [tilted]),
        "pole leaning on a wall": ([_wall(0.45 + 0.05 * size)], [_pole((0, 0), (0.25, 0))]),
        "pole behind a bar": ([bar], [tilted]),
        "pole on bright ground": ([ground], [tilted]),
    }


def staged(sensor_name: str, seed: int) -> Iterator[Case]:
    """Each thing by itself, as a LiDAR sees it from some place; as recorded, and forgotten."""
    sensor = find_sensor(sensor_name)
    rng = np.random.default_rng([seed, STAGED_SENSORS.index(sensor_name)])
    floor = Rectangle(np.zeros(3), X, Y, (30, 30), ASPHALT)
    for name, (things, poles) in _things(rng).items():
        bearing, distance, yaw = rng.uniform(-0.9, 0.9), rng.uniform(3, 8), rng.uniform(-3, 3)
        T = se3.from_rt(
            se3.exp_so3(np.array([0, 0, yaw])),
            np.array([-distance * np.cos(bearing), -distance * np.sin(bearing), SENSOR_HEIGHT]),
        )
        seen = scan([floor, *things, *poles], sensor, T, rng)
        T_sensor_world = se3.inverse(T)
        near = np.linalg.norm(seen.cloud.xyz - T_sensor_world[:3, 3], axis=1) < STAGE_RADIUS
        cloud = seen.cloud.select(near)
        truth = Truth(
            seen.labels[near],
            cloud.ring,
            ("floor", *[type(s).__name__ for s in things], *["pole"] * len(poles)),
            tuple(
                TruePole(
                    1 + len(things) + k,
                    se3.apply(T_sensor_world, pole.centre[None])[0],
                    T_sensor_world[:3, :3] @ pole.axis,
                )
                for k, pole in enumerate(poles)
            ),
        )
        case = Case(name, f"{name} {seed} {sensor_name}", cloud, truth, sensor.threshold)
        yield from (case, forgotten(case, seed))


def _is_roadside_post(pole: Pole) -> bool:
    """In `pandar_scene1` two rows of short posts line the road, 4.5 to 6.5 m from the LiDAR."""
    beside_the_road = 4.5 < abs(pole.point[0]) < 6.5
    return bool(beside_the_road and abs(pole.direction[2]) > np.cos(np.radians(20)))


def _is_no_pole(pole: Pole) -> bool:
    return False


def recorded(name: str) -> Iterator[Case]:
    """The cases of one of `RECORDINGS`."""
    cloud = read_cloud(SHARED / name)
    thresholds, truth = RECORDINGS[name]
    for threshold in thresholds:
        yield Case(name, f"{name} {threshold}", cloud, truth, threshold)


RECORDINGS: Mapping[str, tuple[tuple[float | None, ...], Callable[[Pole], bool]]] = {
    "pandar_scene1/p64.pcd": ((None, 200.0), _is_roadside_post),
    "pandar_0001/left.pcd": ((None,), _is_no_pole),
    "pandar_0001/right.pcd": ((None,), _is_no_pole),
    **{
        f"pandaset/pandaset002_{frame}_{sensor}.pcd": ((None,), _is_no_pole)
        for frame in ("00", "05")
        for sensor in ("pandar64", "pandargt")
    },
}
"""Posts along a road; near asphalt that saturates; signs and cars: with which thresholds to look,
None finding it, and what of the found is a pole."""
