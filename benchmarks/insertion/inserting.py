"""Taped poles in real recordings, met by the recordings' own beams.

Surroundings, other bright things and the pattern of the beams stay as they were recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import DEFAULT_RADIUS, PER_POINT, Array, IntArray, PointCloud
from retropole.base.sensors import Sensor
from retropole.simulation.intensity import RETRO_GRAZING, RETRO_INCIDENCE, saturation
from retropole.simulation.raycast import Cylinder
from retropole.simulation.scenes import UP

from .recorded import RecordedBeams, in_frame, met_by, recorded_beams
from .standing import draw_standing_poles

RANGE_NOISE, DIVERGENCE = 0.010, 0.003
"""1 σ of the range, metres, and full angle of the beam, rad, where the sensor is not known: those
of most of the table of sensors."""

TAPE_OFFSET, RING_BIAS = 0.003, 0.003
"""1 σ of the errors of a LiDAR's ranges to tape and of each of its rings, metres (chosen)."""

LEAST_OF_FULL_SCALE = 0.8
"""The weakest tape as a share of the top of the cloud's intensities, where the sensor is not known:
8-bit sensors have it at 200 of 255 (Xue et al. 2019, Table I)."""

FULL_SCALE = 255.0
"""Of a cloud without intensity, whose own returns then get 0."""

FLUCTUATION = 0.15
"""1 σ of the fluctuation of the strength of tape, of 1 (as `NoiseModel.intensity_noise`)."""


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


@dataclass(frozen=True, eq=False)
class InsertedSite:
    """Recordings of several LiDARs with poles put into them.

    Attributes
    ----------
    clouds
        For each LiDAR one for each placement, in the LiDAR's frame.
    poses
        (4, 4) each, the reference by which the poles were placed, into the first LiDAR's frame.
    poles
        Of each placement, in the first LiDAR's frame.
    labels
        As `clouds`: the index of the pole that each point lies on; −1 for what was recorded.
    sensors
        The models; None where not known.
    """

    clouds: tuple[tuple[PointCloud, ...], ...]
    poses: tuple[Array, ...]
    poles: tuple[tuple[Cylinder, ...], ...]
    labels: tuple[tuple[IntArray, ...], ...]
    sensors: tuple[Sensor | None, ...]


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
    devices: np.random.Generator | None = None,
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
    devices
        Source of these errors: equal generators give equal LiDARs, wherever the poles stand; None
        draws them from `rng`.

    Raises
    ------
    SimulationError
        No such poles were found in many draws.
    """
    made = insert_into_site(
        (target, source),
        (np.eye(4), T_target_source),
        rng,
        sensors=sensors,
        poles=poles if isinstance(poles, int) else (poles,),
        radius=radius,
        up=up,
        tape_offset=tape_offset,
        ring_bias=ring_bias,
        devices=devices,
    )
    return InsertedPair(
        target=made.clouds[0][0],
        source=made.clouds[1][0],
        T_target_source=T_target_source,
        poles=made.poles[0],
        labels=(made.labels[0][0], made.labels[1][0]),
        sensors=sensors,
    )


def insert_into_site(
    clouds: Sequence[PointCloud],
    poses: Sequence[Array],
    rng: np.random.Generator,
    *,
    sensors: Sequence[Sensor | None],
    poles: int | Sequence[Sequence[Cylinder]] = 2,
    placements: int = 1,
    radius: float = DEFAULT_RADIUS,
    up: Array = UP,
    tape_offset: float = TAPE_OFFSET,
    ring_bias: float = RING_BIAS,
    devices: np.random.Generator | None = None,
) -> InsertedSite:
    """Put taped poles into recordings of several LiDARs of one place.

    Every placement of the poles is put into the same recordings: what surrounds the poles, with
    its noise, is the same in all. A LiDAR's errors on tape are the same in all placements too.

    Parameters
    ----------
    clouds
        One for each LiDAR, in its own frame, the beams starting at `PointCloud.origin`.
    poses
        (4, 4) each, the reference: they map points of a LiDAR into the frame of the first.
    rng
        Source of everything random; equal generators give equal sites.
    sensors
        What recorded each, as in `insert_poles`.
    poles
        How many to draw for each placement, standing where all LiDARs see them; or the poles of
        each placement, in the first LiDAR's frame, wherever they are.
    placements
        How often poles are drawn.
    radius, up, tape_offset, ring_bias, devices
        As in `insert_poles`; `up` in the first LiDAR's frame.

    Raises
    ------
    SimulationError
        No such poles were found in many draws.
    """
    beams = [recorded_beams(cloud) for cloud in clouds]
    widths = [DIVERGENCE if s is None else s.divergence for s in sensors]
    if isinstance(poles, int):
        # Cast from the first frame: drawing tries many poles, and beams turn only once.
        turned = [in_frame(b, T) for b, T in zip(beams, poses, strict=True)]
        points = np.concatenate(
            [se3.apply(T, cloud.xyz) for T, cloud in zip(poses, clouds, strict=True)]
        )
        standing = [
            draw_standing_poles(points, turned, widths, rng, poles, radius, up)
            for _ in range(placements)
        ]
    else:
        standing = [list(each) for each in poles]
    made = []
    own = [rng] * len(clouds) if devices is None else devices.spawn(len(clouds))
    for cloud, beam, T, width, sensor, device in zip(
        clouds, beams, poses, widths, sensors, own, strict=True
    ):
        rings = ring_bias * device.normal(size=max(int(beam.rings.max()), 0) + 1)
        biases = np.r_[rings, 0.0] + tape_offset * device.normal()
        made.append(
            [
                _with_poles(cloud, beam, _moved(each, T), width, sensor, rng, biases)
                for each in standing
            ]
        )
    return InsertedSite(
        clouds=tuple(tuple(cloud for cloud, _ in each) for each in made),
        poses=tuple(poses),
        poles=tuple(tuple(each) for each in standing),
        labels=tuple(tuple(labels for _, labels in each) for each in made),
        sensors=tuple(sensors),
    )


def _moved(poles: Sequence[Cylinder], T_target_cloud: Array) -> list[Cylinder]:
    """Poles of the target's frame in the cloud's."""
    T = se3.inverse(T_target_cloud)
    return [
        replace(pole, centre=se3.apply(T, pole.centre[None])[0], axis=T[:3, :3] @ pole.axis)
        for pole in poles
    ]


def _with_poles(
    cloud: PointCloud,
    beams: RecordedBeams,
    poles: Sequence[Cylinder],
    width: float,
    sensor: Sensor | None,
    rng: np.random.Generator,
    biases: Array,
) -> tuple[PointCloud, IntArray]:
    """Replace what the poles hide by returns on them; the labels (N',) are their index or −1.

    The biases are those of ranges to tape, metres: of each ring, and last where none is known.
    """
    hits, met = met_by(beams, poles, width)
    noise = RANGE_NOISE if sensor is None else sensor.range_noise
    ranges = hits.ranges[met] + biases[beams.rings[met]]
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
        top = scale * saturation(sensor)
    loss = FLUCTUATION * np.abs(rng.normal(size=len(cosine)))
    strength = np.clip((RETRO_GRAZING + RETRO_INCIDENCE * cosine) * (1 - loss), 0, 1)
    bright = least + (top - least) * strength
    return np.asarray(np.round(bright) if top > 1.0 else bright)
