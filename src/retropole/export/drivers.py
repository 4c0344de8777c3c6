"""Configurations of LiDAR drivers, which then publish the source's points in the target's frame.

Each driver applies ``p' = Rz(yaw) Ry(pitch) Rx(roll) p + t`` to the points in the frame that it
publishes them in otherwise: ``T_target_source`` if the recordings are from that driver. Units
differ.
"""

from __future__ import annotations

import json
import re

import msgspec
import numpy as np

from ..base import se3
from ..base.errors import ReadError, said
from .text import (
    RPY,
    RPY_MEANING,
    TRANSLATION_KEYS,
    comments,
    named_lines,
    pose_of,
    pose_values,
    read_named,
)
from .transform import Found, Transform, from_quaternion, names_in_words, number, to_quaternion

LIVOX = "extrinsic_parameter"
"""Member of ``lidar_configs`` in Livox's configuration (livox_ros_driver2, README)."""

HESAI = "transform_flag"
"""Option of ``driver`` in Hesai's configuration that its transform needs (HesaiLidar_ROS_2.0)."""

OUSTER = "ouster-cli source"
"""Command that takes ``-e "X Y Z QX QY QZ QW"``, metres (ouster-sdk, ``ouster.sdk.util``)."""

MILLIMETRES = 1000
"""Livox's driver takes the translation in whole millimetres, and degrees."""


def write_livox(transform: Transform) -> str:
    """Write ``extrinsic_parameter`` of an entry of ``lidar_configs`` in ``MID360_config.json``.

    The translation is rounded by at most 0.5 mm along each axis, as the driver takes no fractions.
    """
    T = transform.T_parent_child
    degrees = np.degrees(se3.rpy_from_rotation(T[:3, :3])) + 0.0
    whole = np.rint(MILLIMETRES * T[:3, 3]).astype(int)
    parameter: dict[str, float | int] = dict(zip(RPY, degrees.tolist(), strict=True))
    parameter |= dict(zip(TRANSLATION_KEYS, whole.tolist(), strict=True))
    units = "degrees and whole millimetres (rounded by up to 0.5 mm)"
    place = "MID360_config.json: extrinsic_parameter of the LiDAR's entry in lidar_configs"
    document = {"description": "; ".join((*transform.notes, units, place)), LIVOX: parameter}
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


class _Livox(msgspec.Struct):
    """What is read of the configuration."""

    extrinsic_parameter: dict[str, float]
    description: str = ""


def read_livox(data: bytes) -> list[Found]:
    """Read ``extrinsic_parameter``, as `write_livox` writes it."""
    try:
        read = msgspec.json.decode(data, type=_Livox)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ReadError(f"no {LIVOX} of Livox's driver: {said(error)}") from None
    values = dict(read.extrinsic_parameter)
    for name in values.keys() & {*TRANSLATION_KEYS}:
        values[name] /= MILLIMETRES
    in_degrees = {f"{name}_deg" if name in RPY else name: number(v) for name, v in values.items()}
    return [Found(*names_in_words(read.description), lambda: pose_of(in_degrees))]


def write_rslidar(transform: Transform) -> str:
    """Write the options of ``driver`` in the ``config.yaml`` of RoboSense's ``rslidar_sdk``."""
    how = "rslidar_sdk, config.yaml: under lidar: - driver:; build it with -DENABLE_TRANSFORM=ON"
    notes = (*transform.notes, RPY_MEANING, how)
    return comments(notes) + named_lines(pose_values(transform, RPY))


def write_hesai(transform: Transform) -> str:
    """Write the options of ``driver`` in the ``config.yaml`` of ``hesai_ros_driver``."""
    notes = (*transform.notes, RPY_MEANING, "hesai_ros_driver, config.yaml: under lidar: - driver:")
    return comments(notes) + f"{HESAI}: true\n" + named_lines(pose_values(transform, RPY))


def read_driver(data: bytes) -> list[Found]:
    """Read ``x y z roll pitch yaw`` of the drivers of RoboSense and Hesai: metres and radians."""
    text = data.decode()
    flags = re.findall(rf"^\s*{HESAI}\s*:\s*(\w*)", text, re.MULTILINE)
    if flags not in ([], ["true"]):
        raise ReadError(f"{HESAI} is not true: the driver does not apply the transform")
    options = re.sub(rf"^\s*{HESAI}\s*:.*$", "", text, flags=re.MULTILINE)
    return read_named(f"{options}\n# {RPY_MEANING}".encode())


def write_ouster(transform: Transform) -> str:
    """Write the command that shows a source with its extrinsics; programs of Ouster's SDK take the
    same string.
    """
    T = transform.T_parent_child
    values = " ".join(map(number, (*T[:3, 3], *to_quaternion(T))))
    notes = (*transform.notes, "metres; x y z qx qy qz qw, sensor's frame with the SDK's axes")
    return comments(notes) + f'{OUSTER} -e "{values}" SOURCE viz\n'


def read_ouster(data: bytes) -> list[Found]:
    """Read the seven numbers of ``-e`` in a command of ``ouster-cli``."""
    text = data.decode()
    found = re.findall(r"(?:-e|--extrinsics)\s+[\"']([-+\d.eE ,]+)[\"']", text)
    if len(found) != 1:
        raise ReadError(f'expected one -e "X Y Z QX QY QZ QW" of {OUSTER}, found {len(found)}')
    numbers = found[0].replace(",", " ").split()
    if len(numbers) != 7:
        raise ReadError(f"expected 7 numbers X Y Z QX QY QZ QW, got {len(numbers)}")
    try:
        values = np.array(list(map(float, numbers)))
    except ValueError as error:
        raise ReadError(f"{found[0]!r} is not a row of numbers: {said(error)}") from None
    return [Found(*names_in_words(text), lambda: from_quaternion(values[:3], values[3:]))]
