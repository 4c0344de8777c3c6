"""Taped poles in two real recordings, met by the recordings' own beams.

Surroundings, other bright things and the pattern of the beams stay as they were recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from .. import se3
from ..datatypes import DEFAULT_RADIUS, PER_POINT, Array, IntArray, PointCloud
from ..sensors import Sensor
from .pairs import MIN_POLE_ANGLE, SimulationError
from .raycast import Cylinder, Hits, cast
from .recorded import RecordedBeams, recorded_beams
from .scenes import FOOT_HEIGHT, POLE_SPACING, TAPE, UP

RANGE_NOISE, DIVERGENCE = 0.010, 0.003
"""1 σ of the range, metres, and full angle of the beam, rad, where the sensor is not known: those
of most of the table of sensors."""

TAPE_OFFSET, RING_BIAS = 0.003, 0.003
"""1 σ of the errors of a LiDAR's ranges to tape and of each of its rings, metres (chosen)."""

LEAST_OF_FULL_SCALE = 0.8
"""The weakest tape as a share of the top of the cloud's intensities, where the sensor is not known:
8-bit sensors have it at 200 of 255 (Xue et al. 2019, Table I)."""

SATURATION = 6.0
"""The brightest tape, in thresholds, of a sensor whose full scale is higher (as in `scanning`)."""

FULL_SCALE = 255.0
"""Of a cloud without intensity, whose own returns then get 0."""

GRAZING, FLUCTUATION = 0.55, 0.15
"""Strength of tape at grazing incidence and 1 σ of its fluctuation, of 1 (as in `scanning`)."""

MIN_RETURNS = 8
"""Returns of each LiDAR on each pole."""

POLE_DISTANCES = 3.0, 10.0
"""Least and greatest horizontal distance of a pole's foot from each LiDAR, metres."""

POLE_LENGTHS, MAX_LEAN = (2.0, 2.4), float(np.radians(45.0))
"""Least and greatest length, metres; lean from the vertical, rad: what people set up by hand."""

GROUND_RADIUS, GROUND_POINTS, GROUND_QUANTILE = 0.5, 5, 0.1
"""The ground at a foot is this quantile of the heights within so many metres around it, of at least
so many returns."""

GROUND_SPREAD = 0.3
"""It is bare where the heights spread by less, metres: no car, hedge or wall stands there."""

GROUND_STEP, GROUND_AROUND = 0.5, 3.0
"""It is the ground, and not the top of something, where it lies less than this above the lowest
returns within so many metres around."""

CLEARANCE, CLEAR_FROM = 0.3, 0.25
"""Nothing was recorded this close to a pole, from so high above the ground, metres."""

MAX_DRAWS, MAX_SECOND_DRAWS = 20_000, 2_000
"""Draws of single poles before a `SimulationError`, and before earlier poles are drawn again."""


@dataclass(frozen=True, eq=False)
class InsertedPair:
    """Two recordings with poles put into them.

    Attributes
    ----------
    target, source
        Clouds, each in its own frame.
    T_target_source
        (4, 4) the reference by which the poles were placed: exact for them, and for the
        surroundings as good as it is.
    poles
        In the target's frame.
    labels
        For the target and the source, the index of the pole that each point lies on; −1 for what
        was recorded.
    sensors
        The two models; None where not known.
    """

    target: PointCloud
    source: PointCloud
    T_target_source: Array
    poles: tuple[Cylinder, ...]
    labels: tuple[IntArray, IntArray]
    sensors: tuple[Sensor | None, Sensor | None]

    @property
    def T_world_target(self) -> Array:
        """(4, 4): the world's frame is the target's."""
        return np.eye(4)

    @property
    def T_world_source(self) -> Array:
        """(4, 4) the reference."""
        return self.T_target_source

    @property
    def returns_on_poles(self) -> tuple[tuple[int, int], ...]:
        """Per pole, how many points the target and the source have on it."""
        target, source = (
            np.bincount(each[each >= 0], minlength=len(self.poles)) for each in self.labels
        )
        return tuple((int(t), int(s)) for t, s in zip(target, source, strict=True))


def insert_poles(
    target: PointCloud,
    source: PointCloud,
    T_target_source: Array,
    rng: np.random.Generator,
    *,
    sensors: tuple[Sensor | None, Sensor | None] = (None, None),
    poles: int | Sequence[Cylinder] = 2,
    radius: float = DEFAULT_RADIUS,
    up: Array = UP,
    tape_offset: float = TAPE_OFFSET,
    ring_bias: float = RING_BIAS,
) -> InsertedPair:
    """Put taped poles into two recordings.

    Parameters
    ----------
    target, source
        What was recorded, each in its own frame, the beams starting at `PointCloud.origin`.
    T_target_source
        (4, 4) the reference.
    rng
        Source of everything random; equal generators give equal pairs.
    sensors
        What recorded the target and the source; None where not known. They give the noise, the
        width of the beams and the intensity of tape.
    poles
        How many to draw, standing on the ground where both LiDARs see them; or the poles
        themselves, in the target's frame, wherever they are.
    radius
        Of poles that are drawn, metres.
    up
        (3,) unit vector, in the target's frame.
    tape_offset, ring_bias
        1 σ of the errors of ranges that all returns of one LiDAR on tape share, and all of one
        ring, metres.

    Raises
    ------
    SimulationError
        `MAX_DRAWS` draws gave no such poles.
    """
    beams = recorded_beams(target), recorded_beams(source)
    widths = tuple(DIVERGENCE if s is None else s.divergence for s in sensors)
    frames = np.eye(4), T_target_source
    if isinstance(poles, int):
        # Cast from the target's frame: drawing tries many poles, and beams turn only once.
        turned = tuple(_in_frame(b, T) for b, T in zip(beams, frames, strict=True))
        standing = _draw(target, source, T_target_source, turned, widths, rng, poles, radius, up)
    else:
        standing = list(poles)
    made = [
        _with_poles(cloud, beam, _moved(standing, T), width, sensor, rng, tape_offset, ring_bias)
        for cloud, beam, T, width, sensor in zip(
            (target, source), beams, frames, widths, sensors, strict=True
        )
    ]
    return InsertedPair(
        target=made[0][0],
        source=made[1][0],
        T_target_source=T_target_source,
        poles=tuple(standing),
        labels=(made[0][1], made[1][1]),
        sensors=sensors,
    )


def _in_frame(beams: RecordedBeams, T: Array) -> RecordedBeams:
    origin = se3.apply(T, beams.origin[None])[0]
    return replace(beams, origin=origin, directions=beams.directions @ T[:3, :3].T)


def _moved(poles: Sequence[Cylinder], T_target_cloud: Array) -> list[Cylinder]:
    """Poles of the target's frame in the cloud's."""
    T = se3.inverse(T_target_cloud)
    return [
        replace(pole, centre=se3.apply(T, pole.centre[None])[0], axis=T[:3, :3] @ pole.axis)
        for pole in poles
    ]


def _met(beams: RecordedBeams, poles: Sequence[Cylinder], width: float) -> tuple[Hits, IntArray]:
    """Cast the beams at the poles; the index is of those that meet one before their return."""
    hits = cast(beams.origin, beams.directions, poles, width)
    return hits, np.flatnonzero(hits.ranges < beams.ranges)


def _with_poles(
    cloud: PointCloud,
    beams: RecordedBeams,
    poles: Sequence[Cylinder],
    width: float,
    sensor: Sensor | None,
    rng: np.random.Generator,
    tape_offset: float,
    ring_bias: float,
) -> tuple[PointCloud, IntArray]:
    """Replace what the poles hide by returns on them; the labels (N',) are their index or −1."""
    hits, met = _met(beams, poles, width)
    biases = np.r_[ring_bias * rng.normal(size=max(int(beams.rings.max()), 0) + 1), 0.0]
    noise = RANGE_NOISE if sensor is None else sensor.range_noise
    ranges = hits.ranges[met] + tape_offset * rng.normal() + biases[beams.rings[met]]
    ranges += noise * rng.normal(size=len(met))
    points = beams.origin + ranges[:, None] * beams.directions[met]
    # Returns stay in their places in the file; beams that had none come last.
    count = len(cloud)
    rows = np.concatenate([np.arange(count), beams.like[met[met >= count]]])
    place = np.where(met < count, met, 0)
    place[met >= count] = np.arange(count, len(rows))
    arrays: dict[str, Any] = {"xyz": cloud.xyz[rows]}
    for name in PER_POINT:
        value = getattr(cloud, name)
        arrays[name] = None if value is None else value[rows]
    if cloud.intensity is None:
        arrays["intensity"] = np.zeros(len(rows))
    labels = np.full(len(rows), -1, dtype=np.int64)
    arrays["xyz"][place] = points
    arrays["intensity"][place] = _tape(cloud.intensity, sensor, hits.cosine[met], rng)
    labels[place] = hits.surface[met]
    return replace(cloud, **arrays), labels


def _tape(
    recorded: Array | None, sensor: Sensor | None, cosine: Array, rng: np.random.Generator
) -> Array:
    """Intensities of tape on the scale of the recording, saturated at normal incidence."""
    top = FULL_SCALE if recorded is None else float(recorded.max(initial=0.0))
    if sensor is None:
        least = LEAST_OF_FULL_SCALE * top
    else:
        scale = 1.0
        if recorded is not None and top <= 1.0 < sensor.threshold:
            scale = 1.0 / sensor.intensity_max
        least = scale * sensor.threshold
        top = scale * min(sensor.intensity_max, SATURATION * sensor.threshold)
    loss = FLUCTUATION * np.abs(rng.normal(size=len(cosine)))
    strength = np.clip((GRAZING + (1 - GRAZING) * cosine) * (1 - loss), 0, 1)
    bright = least + (top - least) * strength
    return np.asarray(np.round(bright) if top > 1.0 else bright)


def _draw(
    target: PointCloud,
    source: PointCloud,
    T_target_source: Array,
    beams: tuple[RecordedBeams, ...],
    widths: tuple[float, ...],
    rng: np.random.Generator,
    count: int,
    radius: float,
    up: Array,
) -> list[Cylinder]:
    """Draw poles, in the target's frame, that stand free on the ground where both see them."""
    level = _level(up)
    points = np.concatenate([target.xyz, se3.apply(T_target_source, source.xyz)]) @ level.T
    origins = [level @ each.origin for each in beams]
    near = np.linalg.norm(points[:, :2] - origins[0][:2], axis=1)
    points = points[near < POLE_DISTANCES[1] + GROUND_AROUND]
    trees = cKDTree(points[:, :2]), cKDTree(points)
    standing: list[Cylinder] = []
    feet: list[Array] = []
    since = 0
    for _ in range(MAX_DRAWS):
        since += 1
        if since > MAX_SECOND_DRAWS:
            standing, feet, since = [], [], 0
        bearing = rng.uniform(0, 2 * np.pi)
        away = np.sqrt(rng.uniform(POLE_DISTANCES[0] ** 2, POLE_DISTANCES[1] ** 2))
        foot = origins[0][:2] + away * np.array([np.cos(bearing), np.sin(bearing)])
        lean, toward = rng.uniform(0, MAX_LEAN), rng.uniform(0, 2 * np.pi)
        length = float(rng.uniform(*POLE_LENGTHS))
        axis = np.r_[np.sin(lean) * np.array([np.cos(toward), np.sin(toward)]), np.cos(lean)]
        if not POLE_DISTANCES[0] <= np.linalg.norm(foot - origins[1][:2]) <= POLE_DISTANCES[1]:
            continue
        gaps = [float(np.linalg.norm(foot - other)) for other in feet]
        if any(not POLE_SPACING[0] <= gap <= POLE_SPACING[1] for gap in gaps):
            continue
        cosines = [abs(float(level @ pole.axis @ axis)) for pole in standing]
        if any(cosine > np.cos(MIN_POLE_ANGLE) for cosine in cosines):
            continue
        ground = ground_height(points, trees[0], foot)
        if ground is None:
            continue
        centre = np.r_[foot, ground + FOOT_HEIGHT] + axis * length / 2
        if not _stands_free(points, trees[1], centre, axis, length, ground):
            continue
        pole = Cylinder(level.T @ centre, level.T @ axis, radius, length, TAPE)
        seen = [len(_met(b, [pole], w)[1]) for b, w in zip(beams, widths, strict=True)]
        if min(seen) < MIN_RETURNS:
            continue
        standing, since = [*standing, pole], 0
        feet.append(foot)
        if len(standing) == count:
            hidden = [
                np.bincount(h.surface[m], minlength=count)
                for h, m in (_met(b, standing, w) for b, w in zip(beams, widths, strict=True))
            ]
            if np.min(hidden) >= MIN_RETURNS:
                return standing
            standing, feet = [], []
    raise SimulationError(
        f"{MAX_DRAWS} draws gave no {count} poles on the ground of the recordings with "
        f"{MIN_RETURNS} returns of each LiDAR"
    )


def _level(up: Array) -> Array:
    """(3, 3) rotation from the target's frame to one whose z axis points up."""
    third = up / np.linalg.norm(up)
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(third)))], third)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third])


def ground_height(points: Array, tree: Any, foot: Array) -> float | None:
    """Height of bare ground at a foot (2,), metres; None where there is none.

    Parameters
    ----------
    points
        (N, 3) metres, z up.
    tree
        `cKDTree` of their x and y.
    foot
        (2,) x and y, metres.
    """
    heights = points[tree.query_ball_point(foot, GROUND_RADIUS), 2]
    if len(heights) < GROUND_POINTS:
        return None
    ground, high = np.quantile(heights, [GROUND_QUANTILE, 1 - GROUND_QUANTILE])
    around = points[tree.query_ball_point(foot, GROUND_AROUND), 2]
    if high - ground > GROUND_SPREAD:
        return None
    lowest = np.quantile(around, GROUND_QUANTILE / 2)
    return float(ground) if ground - lowest < GROUND_STEP else None


def _stands_free(
    points: Array, tree: Any, centre: Array, axis: Array, length: float, ground: float
) -> bool:
    """Whether nothing was recorded within `CLEARANCE` of a pole."""
    near = points[tree.query_ball_point(centre, length / 2 + CLEARANCE)] - centre
    along = np.clip(near @ axis, -length / 2, length / 2)
    away = np.linalg.norm(near - along[:, None] * axis, axis=1)
    return not np.any((away < CLEARANCE) & (near[:, 2] + centre[2] > ground + CLEAR_FROM))
