"""One small cloud as a file of every format."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from retropole.base.datatypes import PointCloud
from retropole.io import write_pcd

T = TypeVar("T")

XYZ = np.array([[1.5, 2.0, 3.25], [-4.0, 5.5, 6.0], [7.0, -8.0, 9.0]])
INTENSITY = np.array([10.0, 20.0, 255.0])
TABLE = np.column_stack([XYZ, INTENSITY])


def required(value: T | None) -> T:
    """What a cloud must have."""
    assert value is not None
    return value


def numbers(rows: NDArray[Any], separator: str = " ") -> str:
    return "".join(separator.join(repr(float(v)) for v in row) + "\n" for row in rows)


def make_pcd(path: Path) -> None:
    write_pcd(path, PointCloud(XYZ, intensity=INTENSITY, ring=np.array([0, 1, 2])))


def make_ply(path: Path) -> None:
    text = "ply\nformat ascii 1.0\nelement vertex 3\n"
    text += "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    path.write_text(text + "end_header\n" + numbers(TABLE))


def make_las(path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    las = laspy.create(point_format=3, file_version="1.2")
    las.header.scales = [0.01] * 3
    las.x, las.y, las.z, las.intensity = *XYZ.T, INTENSITY
    las.write(path)


def make_bin(path: Path) -> None:
    path.write_bytes(TABLE.astype("<f4").tobytes())


def make_npy(path: Path) -> None:
    np.save(path, TABLE)


def make_npz(path: Path) -> None:
    np.savez_compressed(path, xyz=XYZ, intensity=INTENSITY, pose=np.eye(4))


def make_csv(path: Path) -> None:
    path.write_text("x,y,z,intensity\n" + numbers(TABLE, ","))


def make_xyz(path: Path) -> None:
    path.write_text(numbers(TABLE))


def make_pts(path: Path) -> None:
    colours = np.tile([0, 7, 255], (len(TABLE), 1))
    path.write_text(f"{len(TABLE)}\n" + numbers(np.column_stack([TABLE, colours])))


WRITERS: dict[str, Callable[[Path], None]] = {
    **{".pcd": make_pcd, ".ply": make_ply, ".las": make_las, ".laz": make_las, ".bin": make_bin},
    **{".npy": make_npy, ".npz": make_npz, ".csv": make_csv, ".xyz": make_xyz, ".txt": make_xyz},
    **{".asc": make_xyz, ".pts": make_pts},
}
