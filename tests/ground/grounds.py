"""Ground that one LiDAR sees, made point by point, and LiDARs over it."""

import numpy as np
from scipy.spatial.transform import Rotation

from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.systematic import sizes_of
from retropole.ground.surface import Viewer, viewer_of


def pose(height: float, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Array:
    """(4, 4) of a LiDAR over z = 0, angles in degrees."""
    R = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
    return se3.from_rt(R, np.array([0.0, 0.0, height]))


def rings(count: int = 24, far: float = 20.0, near: float = 2.0, height: float = 2.0) -> Array:
    """(N, 2) places on level ground that rings at even angles below a LiDAR meet."""
    falls = np.linspace(np.arctan2(height, near), np.arctan2(height, far), count)
    around = np.linspace(0, 2 * np.pi, 700, endpoint=False)
    r, a = np.meshgrid(height / np.tan(falls), around, indexing="ij")
    return np.stack([(r * np.cos(a)).ravel(), (r * np.sin(a)).ravel()], axis=1)


def viewer(at: Array, z: Array, T_world_lidar: Array, name: str = "a") -> Viewer:
    """A LiDAR that is alone and sees ground at places (N, 2) and heights (N,)."""
    xyz = se3.apply(se3.inverse(T_world_lidar), np.c_[at, z])
    return viewer_of(name, PointCloud(xyz), np.eye(4), sizes_of(None))
