"""The pose as the lines that other programs take, ready to copy."""

from __future__ import annotations

import json

import numpy as np
from scipy.spatial.transform import Rotation

from ..datatypes import Array


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
        Text to copy, by the name of the program or form.
    """
    t, q = T[:3, 3], np.asarray(Rotation.from_matrix(T[:3, :3]).as_quat())
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    values = [f"{value:.9f}" for value in (*t, *q)]
    named = " ".join(f"--{name} {value}" for name, value in zip(names, values, strict=True))
    document = {
        "target_frame": parent,
        "source_frame": child,
        "T_target_source": T.tolist(),
        "translation_m": dict(zip("xyz", t.tolist(), strict=True)),
        "quaternion": dict(zip("xyzw", q.tolist(), strict=True)),
    }
    command = "tf2_ros static_transform_publisher"
    return {
        "ROS 2": f"ros2 run {command} {named} --frame-id {parent} --child-frame-id {child}",
        "ROS 1": f"rosrun {command} {' '.join(values)} {parent} {child}",
        "Matrix": "\n".join(" ".join(f"{v:.12g}" for v in row) for row in T),
        "JSON": json.dumps(document),
    }
