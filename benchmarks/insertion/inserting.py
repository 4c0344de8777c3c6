"""Taped poles in real recordings, met by the recordings' own beams.

Surroundings, other bright things and the pattern of the beams stay as they were recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import DEFAULT_RADIUS, Array, IntArray, PointCloud
from retropole.base.sensors import Sensor
from retropole.simulation.raycast import Cylinder
from retropole.simulation.recorded import (
    DIVERGENCE,
    in_frame,
    in_sensor_frame,
    recorded_beams,
    with_poles,
)
from retropole.simulation.scenes import UP

from .standing import draw_standing_poles

TAPE_OFFSET, RING_BIAS = 0.003, 0.003
"""1 σ of the errors of a LiDAR's ranges to tape and of each of its rings, metres (chosen)."""


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
                with_poles(cloud, beam, in_sensor_frame(each, T), width, sensor, rng, biases)
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
