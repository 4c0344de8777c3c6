"""The pose as the lines that other programs take, ready to copy."""

from __future__ import annotations

import json

import numpy as np
from scipy.spatial.transform import Rotation

from ..datatypes import Array

TITLES = {"ros2": "ROS 2", "ros1": "ROS 1", "matrix": "Matrix", "json": "JSON"}
"""What the page calls each form."""


def export_lines(T: Array, parent: str, child: str) -> dict[str, str]:
    """Write a pose for other programs.

    Parameters
    ----------
    T
        (4, 4) pose of the child frame in the parent frame, ``T_target_source``.
    parent, child
        Names of the frames; the child of a ROS static transform is the source.

    Returns
    -------
    dict
        Text to copy, by the key of its form (`TITLES`).
    """
    t, q = T[:3, 3], np.asarray(Rotation.from_matrix(T[:3, :3]).as_quat())
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    values = [f"{value:.9f}" for value in (*t, *q)]
    named = " ".join(f"--{name} {value}" for name, value in zip(names, values, strict=True))
    document = {
        "parent": parent,
        "child": child,
        "T_target_source": T.tolist(),
        "translation_m": dict(zip("xyz", t.tolist(), strict=True)),
        "quaternion": dict(zip("xyzw", q.tolist(), strict=True)),
    }
    command = "tf2_ros static_transform_publisher"
    return {
        "ros2": f"ros2 run {command} {named} --frame-id {parent} --child-frame-id {child}",
        "ros1": f"rosrun {command} {' '.join(values)} {parent} {child}",
        "matrix": "\n".join(" ".join(f"{v:.12g}" for v in row) for row in T),
        "json": json.dumps(document),
    }
