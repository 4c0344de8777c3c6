"""Roll, pitch and height of LiDARs over the ground as a separate JSON document.

Schema ``retropole/level/1``: metres and radians, matrices row by row. The frame ``ground`` has z
along the normal of the ground, its origin at the foot of the perpendicular from the origin of the
target's (or the site's) frame, and x along that frame's x axis, laid along the ground. A vehicle's
``base_footprint`` (REP 120) is on the ground too; its x, y and yaw are the vehicle's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import msgspec
import numpy as np

from ..base.bounded import Covariance, Number, PartCovariance, Pose, Size, Text
from ..base.datatypes import Array
from ..base.errors import UsageError
from ..ground.level import Leveled, LidarLevel
from ..ground.steps import Level
from . import COVARIANCE_ORDER, InputDoc, document_of, made_now
from .decoding import parsed
from .site import LidarDoc

LEVEL_SCHEMA: Literal["retropole/level/1"] = "retropole/level/1"
LEVEL_COVARIANCE_FRAME = "ground axes: R_true = Exp(phi) R, t_true = t + delta; rad and m"

SAME_POSE = 1e-6
"""Poses of one result agree within this, metres and parts of 1."""


class LidarLevelDoc(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """One LiDAR over the ground.

    `covariance` is of `T_ground_lidar`, over the document's `covariance_order`; what the definition
    of the frame fixes has no variance. `roll_pitch_height` is (3, 3), rad and m. The pose in
    ``base_footprint`` and its covariance are null if the vehicle's axes were not given.
    """

    name: Text
    T_ground_lidar: Pose
    covariance: PartCovariance
    roll_rad: Number
    pitch_rad: Number
    height_m: Number
    roll_pitch_height: Array
    T_base_footprint_lidar: Pose | None = None
    base_covariance: Covariance | None = None


class LevelDoc(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """The ground and the LiDARs over it.

    `disc_radius_m` and `disc_middle_m`, in the frame `frame`, are of the disc that the plane is the
    best for; `area_m2` of it are seen. `bend_m` is how far the edge of the disc lies below its
    middle where the ground is bent most, `other_levels` are next to the ground.
    """

    schema: Literal["retropole/level/1"] = LEVEL_SCHEMA
    result: Text
    frame: Text
    T_ground_frame: Pose
    lidars: list[LidarLevelDoc]
    covariance_order: tuple[str, ...] = COVARIANCE_ORDER
    covariance_frame: str = LEVEL_COVARIANCE_FRAME
    disc_radius_m: Size
    disc_middle_m: list[Number]
    about_foot: bool
    area_m2: Size
    bend_m: Number
    bend_sigma_m: Size
    roughness_m: Size
    ceiling_m: Size | None
    other_levels: list[Level]
    inputs: list[InputDoc]
    version: Text
    created: Text


def level_document(
    leveled: Leveled,
    *,
    result: str,
    frame: str,
    inputs: Sequence[InputDoc],
    bases: Mapping[str, tuple[Array, Array]],
) -> LevelDoc:
    """Write what was found as a document.

    Parameters
    ----------
    leveled
        The ground and the LiDARs.
    result, frame
        The result, and the frame that its poses are in.
    inputs
        The recordings that were used.
    bases
        Pose (4, 4) of LiDARs in ``base_footprint`` and its covariance (6, 6), by their names.
    """
    return document_of(
        LevelDoc,
        made_now(),
        result=result,
        frame=frame,
        T_ground_frame=leveled.T_ground_frame,
        lidars=[_lidar(lidar, *bases.get(lidar.name, (None, None))) for lidar in leveled.lidars],
        disc_radius_m=leveled.radius,
        disc_middle_m=leveled.middle.tolist(),
        about_foot=not leveled.centre.any(),
        area_m2=leveled.area,
        bend_m=leveled.bend,
        bend_sigma_m=leveled.bend_sigma,
        roughness_m=leveled.roughness,
        ceiling_m=leveled.ceiling,
        other_levels=list(leveled.others),
        inputs=list(inputs),
    )


def _lidar(lidar: LidarLevel, T_base: Array | None, covariance: Array | None) -> LidarLevelDoc:
    return document_of(
        LidarLevelDoc,
        lidar,
        roll_rad=lidar.roll,
        pitch_rad=lidar.pitch,
        height_m=lidar.height,
        T_base_footprint_lidar=T_base,
        base_covariance=covariance,
    )


def level_of(data: bytes, lidars: Sequence[LidarDoc]) -> LevelDoc:
    """Read the level of a result, whose LiDARs have poses.

    Raises
    ------
    ReadError
        If it is none.
    UsageError
        If it is of another result.
    """
    found = parsed(data, LevelDoc, "level document")
    poses = {lidar.name: lidar.T_site_lidar for lidar in lidars}
    for lidar in found.lidars:
        pose = poses.get(lidar.name)
        own = None if pose is None else found.T_ground_frame @ np.asarray(pose)
        if own is None or not np.allclose(own, lidar.T_ground_lidar, atol=SAME_POSE):
            raise UsageError("is of another result: 'retropole level' writes it again")
    return found
