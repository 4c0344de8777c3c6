"""A person who carries a taped pole through the view of LiDARs, recorded return by return.

All that moves is hit where it is when each beam leaves. Static objects are cast once for a few
phases of a LiDAR whose lines repeat, since nothing changes from sweep to sweep.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from ..base import se3
from ..base.datatypes import Array, PointCloud
from ..base.sensors import SWEEP_SECONDS, Sensor, find_sensor
from .devices import TYPICAL, Device, NoiseModel, draw_device
from .pairs import MAX_DRAWS, SimulationError, turned_to
from .raycast import Hits, Material, Surface, cast, meet
from .returns import Echoes, Materials, intensities, with_glow
from .scanning import Sweep, sweeps
from .scenes import BARK, PAPER_RADIUS, SURROUNDINGS, TAPE, UP, draw_rotation

SPEED, LEAN_RATE = 1.5, float(np.radians(60.0))
"""Greatest speed of the person, m/s, and rate at which the pole leans, rad/s: a brisk walk."""

KEPT_FROM_LIDARS = 1.5
"""The person comes no closer to a LiDAR, metres."""

APART = 1.0
"""Least distance between the LiDARs, metres."""

PHASES = 4
"""For this many starts of a sweep within its azimuth step static objects are cast."""

GAIT = np.array([0.02, 0.02, 0.015])
"""Amplitude of a walker's hand at each step, metres (chosen)."""

GAIT_KNOT, TREMOR = 0.15, 0.003
"""A hand is unsteady by this amount, metres and as a slope, from knot to knot, s: with both, the
noise of the acceleration is 0.1 to 0.3 m²/s³ (chosen; a prototype's people had 0.1 to 0.2)."""

REST, EASE = 2.0, 0.5
"""Duration of a stop, s, and of slowing down before and starting after it."""

REACH = 0.35
"""Distance from the pole to the middle of the body, metres: an arm that is bent."""


class Part(NamedTuple):
    """A cylinder that moves: middle (N, 3) and axis (N, 3) at N times, radius and length, m."""

    middle: Array
    axis: Array
    size: tuple[float, float]
    material: Material


@dataclass(frozen=True, eq=False)
class Walk:
    """How one pole is carried.

    Attributes
    ----------
    hand
        Where the hand is on the pole at a time, s: (3,) metres, world frame.
    lean
        Slope of the pole in x and y at a time, s.
    behind
        Heading of the body, seen from the pole, at a time, rad.
    seconds
        How long the walk takes.
    size
        Radius and length of the pole, metres.
    below
        Length of the pole below the hand, metres.
    wears_vest
        Whether the person wears a band that is as bright as the pole.
    """

    hand: CubicSpline
    lean: CubicSpline
    behind: CubicSpline
    seconds: float
    size: tuple[float, float]
    below: float
    wears_vest: bool = False

    def axis(self, times: Array) -> Array:
        """(N, 3) unit direction of the pole, upward, at times (N,), s."""
        slope = np.concatenate([self.lean(times), np.ones((len(times), 1))], axis=1)
        return np.asarray(slope / np.linalg.norm(slope, axis=1, keepdims=True))

    def parts(self, times: Array) -> list[Part]:
        """Pole, hand, body and vest at times (N,), s."""
        hand, axis, away = self.hand(times), self.axis(times), self.behind(times)
        upright = np.broadcast_to(UP, axis.shape)
        radius, length = self.size
        body = hand + REACH * np.stack([np.cos(away), np.sin(away), 0 * away], axis=1)
        body[:, 2] = 0.9
        chest = body + 0.3 * UP
        found = [
            Part(hand + (length / 2 - self.below) * axis, axis, self.size, TAPE),
            Part(hand, axis, (radius + 0.02, 0.1), BARK),
            Part(body, upright, (0.2, 1.8), BARK),
        ]
        return [*found, Part(chest, upright, (0.205, 0.3), TAPE)] if self.wears_vest else found


def draw_walk(
    rng: np.random.Generator,
    seconds: float,
    clear: tuple[float, float],
    lidars: Sequence[Array],
    *,
    radius: float = PAPER_RADIUS,
    lean: float = float(np.radians(14.0)),
    wears_vest: bool = False,
    stops: int = 0,
) -> Walk:
    """Draw a walk between random places, with a pole that leans to and fro.

    Parameters
    ----------
    rng
        Source of the draws.
    seconds
        How long it takes.
    clear
        Half extents of the ground that is walked on, metres.
    lidars
        (3,) places to which `KEPT_FROM_LIDARS` applies.
    radius
        Of the pole, metres.
    lean
        1 σ of the lean in each of two directions, rad.
    wears_vest
        Whether the person wears a bright band.
    stops
        How many times the pole is put down for a while, spread over the walk.
    """
    places: list[Array] = []
    at = [0.0]
    while at[-1] < seconds + 2.0:
        place = rng.uniform(-1, 1, 2) * np.minimum(clear, 6.0)
        # Beyond what a spline overshoots, the way between two places keeps off the LiDARs.
        way = place if not places else np.linspace(places[-1], place, 12)
        away = [np.linalg.norm(way - lidar[:2], axis=-1).min() for lidar in lidars]
        if min(away) < KEPT_FROM_LIDARS + 0.5:
            continue
        if places:
            at.append(at[-1] + max(float(np.linalg.norm(place - places[-1])) / 1.2, 0.8))
        places.append(place)
    height = 1.15 + 0.08 * rng.normal(size=len(places))
    hand = _no_faster(at, np.column_stack([places, height]), SPEED)
    turns = np.arange(0.0, seconds + 3.0, 1.1) + rng.uniform(-0.3, 0.3)
    slopes = np.tan(np.clip(lean * rng.normal(size=(len(turns), 2)), -2 * lean, 2 * lean))
    fine = np.arange(0.0, seconds + 1.0, GAIT_KNOT)
    pace, phase = rng.uniform(0.8, 1.0), rng.uniform(0, 2 * np.pi, 3)
    # From foot to foot to the sides and ahead, and twice as often up and down.
    beat = 2 * np.pi * pace * fine[:, None] * np.array([1.0, 1.0, 2.0]) + phase
    unsteady = rng.normal(size=(len(fine), 5)) * [*3 * [TREMOR], TREMOR, TREMOR]
    swing = GAIT * np.sin(beat) + unsteady[:, :3]
    lean_to = _no_faster(turns, slopes, LEAN_RATE)(fine) + unsteady[:, 3:]
    steady = np.arange(0.0, seconds + 4.0, 2.0)
    held, leant = CubicSpline(fine, hand(fine) + swing), CubicSpline(fine, lean_to)
    if stops:
        # What moves is as far as it would be without the previous stops.
        knots = np.arange(0.0, seconds + 1.0, GAIT_KNOT / 3)
        rests = seconds * (np.arange(stops) + 0.5) / stops
        away = np.abs(knots[:, None] - rests).min(axis=1)
        gone = np.cumsum(np.clip((away - REST / 2) / EASE, 0.0, 1.0)) * GAIT_KNOT / 3
        held, leant = CubicSpline(knots, held(gone)), CubicSpline(knots, leant(gone))
    return Walk(
        held,
        leant,
        CubicSpline(steady, np.cumsum(rng.normal(0, 0.6, len(steady))) + rng.uniform(0, 6)),
        seconds,
        (radius, float(rng.uniform(1.8, 2.3))),
        1.0,
        wears_vest,
    )


def _no_faster(times: Sequence[float] | Array, values: Array, most: float) -> CubicSpline:
    """A spline through values (N, K), run more slowly where its speed is above the most."""
    spline = CubicSpline(times, values)
    fine = np.linspace(times[0], times[-1], 40 * len(times))
    speed = np.linalg.norm(spline(fine, 1), axis=1)
    slower = np.maximum(speed / most, 1.0).max()
    return CubicSpline(np.asarray(times) * slower, values)


@dataclass(frozen=True, eq=False)
class Recorder:
    """One LiDAR that records a walk: its model, itself, its pose (4, 4), errors, and its clock.

    ``clock`` is added to the true time, s; ``drift`` is by how much it runs fast.
    """

    sensor: Sensor
    device: Device
    T_world_sensor: Array
    noise: NoiseModel
    clock: float = 0.0
    drift: float = 0.0


@dataclass(frozen=True, eq=False)
class SimulatedWalk:
    """A walk, who records it, where, and the truth.

    Attributes
    ----------
    walks
        The persons who carry a pole, the first the one that matters.
    surfaces
        Static objects, in the world frame.
    recorders
        The target, and the source or several.
    """

    walks: tuple[Walk, ...]
    surfaces: tuple[Surface, ...]
    recorders: tuple[Recorder, ...]

    @property
    def T_target_lidar(self) -> Array:
        """(L, 4, 4) true pose of each LiDAR in the frame of the target."""
        world = np.stack([each.T_world_sensor for each in self.recorders])
        return np.asarray(se3.inverse(world[0]) @ world)

    @property
    def T_target_source(self) -> Array:
        """(4, 4) true pose of the source."""
        return np.asarray(self.T_target_lidar[1])

    def clock_offset(self, lidar: int = 1) -> float:
        """What is added to a LiDAR's times to have the target's, at the walk's middle, s."""
        source = self.recorders[lidar]
        return -source.clock - source.drift * self.walks[0].seconds / 2

    def record(self, lidar: int, rng: np.random.Generator) -> Iterator[PointCloud]:
        """Give the sweeps of the target (0) or another LiDAR, with the times of its clock."""
        return record_walk(self.walks, self.surfaces, self.recorders[lidar], rng)


def simulate_walk(
    scene: str,
    rng: np.random.Generator,
    *,
    seconds: float = 40.0,
    sensors: Sequence[str] = ("VLP-16", "VLP-16"),
    noise: NoiseModel = TYPICAL,
    radius: float = PAPER_RADIUS,
    clock: float = 2.0,
    lean: float = float(np.radians(14.0)),
    people: int = 1,
    wears_vest: bool = False,
    stops: int = 0,
) -> SimulatedWalk:
    """Draw a place, two LiDARs or more and a walk.

    Parameters
    ----------
    scene
        One of `SURROUNDINGS`.
    rng
        Source of all that is random.
    seconds
        How long is walked.
    sensors
        Names of the models, the target's first.
    noise
        How recordings differ from exact geometry.
    radius
        Of the pole, metres.
    clock
        Clocks are off that of the target by up to this, s.
    lean
        As in `draw_walk`.
    people
        How many carry a pole.
    wears_vest
        Whether they wear a bright band.
    stops
        As in `draw_walk`.
    """
    models = [find_sensor(name) for name in sensors]
    place = SURROUNDINGS[scene](rng)
    clear = (min(place.clear[0], 3.0), min(place.clear[1], 3.0))
    for _ in range(MAX_DRAWS):
        poses = [_draw_pose(model, rng) for model in models]
        at = [pose[:3, 3] for pose in poses]
        walks = tuple(
            draw_walk(
                rng,
                seconds,
                clear,
                at,
                radius=radius,
                lean=lean,
                wears_vest=wears_vest,
                stops=stops,
            )
            for _ in range(people)
        )
        in_view = all(_is_in_view(walks[0], *each) for each in zip(models, poses, strict=True))
        near = min(np.linalg.norm(one - other) for one, other in combinations(at, 2))
        if in_view and near > APART:
            break
    else:
        raise SimulationError(
            f"{MAX_DRAWS} draws of {scene!r} gave no walk in which {' and '.join(sensors)} all "
            "have the pole in view"
        )
    clocks = [(rng.uniform(-clock, clock), rng.normal(0, 5e-6)) for _ in sensors[1:]]
    recorders = tuple(
        Recorder(model, draw_device(model, noise, rng), pose, noise, *own)
        for model, pose, own in zip(models, poses, [(0.0, 0.0), *clocks], strict=True)
    )
    return SimulatedWalk(walks, tuple(place.surfaces), recorders)


def _draw_pose(model: Sensor, rng: np.random.Generator) -> Array:
    """Draw a pose (4, 4) of a LiDAR next to the ground that is walked on."""
    bearing, away = rng.uniform(0, 2 * np.pi), rng.uniform(3.5, 5.0)
    spot = away * np.array([np.cos(bearing), np.sin(bearing)])
    pose = se3.from_rt(draw_rotation(rng), np.r_[spot, rng.uniform(1.0, 1.8)])
    return turned_to(pose, model, np.zeros(3), 0.0)


def _is_in_view(walk: Walk, model: Sensor, pose: Array) -> bool:
    """Whether a half of the pole or more is mostly in a LiDAR's field of view."""
    times = np.arange(0.0, walk.seconds, 0.5)
    pole = walk.parts(times)[0]
    along = np.linspace(-0.5, 0.5, 7)[:, None, None] * pole.size[1]
    points = se3.apply(se3.inverse(pose), (pole.middle + along * pole.axis).reshape(-1, 3))
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    low, high = model.elevation_span
    seen = (elevation > low) & (elevation < high) & model.has_in_view(points)
    return bool(np.mean(seen.reshape(7, -1).mean(axis=0) >= 0.5) > 0.8)


def record_walk(
    walks: Sequence[Walk],
    surfaces: Sequence[Surface],
    recorder: Recorder,
    rng: np.random.Generator,
) -> Iterator[PointCloud]:
    """Record walks sweep by sweep.

    Parameters
    ----------
    walks
        Who carries a pole; the first gives the duration.
    surfaces
        Static objects, in the world frame.
    recorder
        The LiDAR.
    rng
        Source of all that is random.

    Yields
    ------
    PointCloud
        Of a sweep, in the sensor's frame, with the time of each point by the sensor's clock.
    """
    sensor, pose, noise = recorder.sensor, recorder.T_world_sensor, recorder.noise
    count, begun = int(walks[0].seconds / SWEEP_SECONDS), rng.uniform(0, SWEEP_SECONDS)
    repeats = sensor.pattern == "spinning"
    known: list[tuple[Sweep, Array, Hits]] = []
    for k, sweep in enumerate(sweeps(sensor, rng, PHASES if repeats else count)):
        world = recorder.device.directions(sweep.rays, sweep.rings) @ pose[:3, :3].T
        wide = sensor.divergence if noise.beam_width else 0.0
        known.append((sweep, world, cast(pose[:3, 3], world, surfaces, wide)))
        if not repeats:
            yield _swept(walks, surfaces, recorder, known.pop(), begun + k * SWEEP_SECONDS, rng)
    for k in range(count if repeats else 0):
        some = known[int(rng.integers(PHASES))]
        yield _swept(walks, surfaces, recorder, some, begun + k * SWEEP_SECONDS, rng)


def _swept(
    walks: Sequence[Walk],
    surfaces: Sequence[Surface],
    recorder: Recorder,
    cast_before: tuple[Sweep, Array, Hits],
    start: float,
    rng: np.random.Generator,
) -> PointCloud:
    """One sweep that starts at a true time, s."""
    sweep, world, still = cast_before
    sensor, noise = recorder.sensor, recorder.noise
    hits, moving = _in_front(walks, recorder, world, still, start + sweep.times, len(surfaces))
    materials = Materials(
        *(
            np.concatenate([own, np.array([getattr(p, name) for p in moving])])
            for own, name in zip(Materials.of(surfaces), ("retro", "reflectance"), strict=True)
        )
    )
    seen = (hits.ranges > sensor.min_range) & (hits.ranges < sensor.max_range)
    seen &= rng.uniform(size=len(seen)) >= noise.dropout
    beam = np.flatnonzero(seen)
    surface, cosine, true = hits.surface[beam], hits.cosine[beam], hits.ranges[beam]
    retro, reflectance = materials.retro[surface], materials.reflectance[surface]
    ranges = recorder.device.ranges(true, sweep.rings[beam], cosine, retro)
    ranges += noise.range_noise * sensor.range_noise * rng.normal(size=len(beam))
    bright = intensities(sensor, retro, reflectance, cosine, true, np.ones(len(beam)), rng, noise)
    echoes = Echoes(ranges, bright, surface, beam)
    if noise.blooming and retro.any():
        echoes = with_glow(echoes, retro, world, noise.blooming, sensor, len(surfaces), rng)
    own = echoes.beam
    rays = sweep.rays[own]
    if noise.pointing_noise:
        rays = rays + noise.pointing_noise * rng.normal(size=rays.shape)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rings = sweep.rings[own] if sensor.rings else None
    true_time = start + sweep.times[own]
    times = true_time * (1 + recorder.drift) + recorder.clock
    return PointCloud(echoes.ranges[:, None] * rays, echoes.intensity, rings, times)


def _in_front(
    walks: Sequence[Walk],
    recorder: Recorder,
    world: Array,
    still: Hits,
    times: Array,
    first: int,
) -> tuple[Hits, list[Material]]:
    """Put moving objects before static ones, on the rays that pass near enough to a person."""
    hits = Hits(still.ranges.copy(), still.surface.copy(), still.cosine.copy())
    moving: list[Material] = []
    origin = recorder.T_world_sensor[:3, 3]
    wide = recorder.sensor.divergence if recorder.noise.beam_width else 0.0
    for walk in walks:
        middle = walk.hand(float(times[len(times) // 2]))
        # Within a sweep nothing of a person is farther than this from where the hand is midway.
        toward, room = middle - origin, 1.8
        away = float(np.linalg.norm(toward))
        cone = np.sqrt(1 - (room / away) ** 2) if away > room else -1.0
        near = np.flatnonzero(world @ (toward / away) >= cone)
        for part in walk.parts(times[near]):
            found, cosine = meet(origin - part.middle, part.axis, world[near], part.size, wide)
            nearer = found < hits.ranges[near]
            index = near[nearer]
            hits.ranges[index], hits.cosine[index] = found[nearer], cosine[nearer]
            hits.surface[index] = first + len(moving)
            moving.append(part.material)
    return hits, moving
