"""How long a point of a ``.bin`` file is, told by its values; never a guess."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from retropole.base.errors import ReadError
from retropole.io import read_cloud

COUNT = 2000
"""A multiple of 40, so that files of points of 16, 20, 24 and 32 bytes fit each other's size."""


def sweep(count: int = COUNT) -> NDArray[np.float32]:
    """Make x, y, z, intensity and ring of a sweep of 16 rings in a street of flat ground."""
    rng = np.random.default_rng(3)
    k = np.arange(count)
    ring, azimuth = k % 16, 2 * np.pi * (k // 16) / (count // 16)
    elevation = np.radians(2.0 * ring - 15.0)
    ranges = np.minimum(1.7 / np.maximum(np.sin(-elevation), 1e-9), 20 + 5 * np.cos(3 * azimuth))
    ranges = ranges + rng.normal(0, 0.01, count)
    x, y = ranges * np.cos(elevation) * [np.cos(azimuth), np.sin(azimuth)]
    intensity = rng.integers(0, 100, count)
    return np.column_stack([x, y, ranges * np.sin(elevation), intensity, ring]).astype("<f4")


def read(path: Path, data: NDArray[Any]) -> NDArray[np.float64]:
    (path / "a.pcd.bin").write_bytes(data.tobytes())
    cloud = read_cloud(path / "a.pcd.bin")
    columns = [cloud.xyz, cloud.intensity] + ([] if cloud.ring is None else [cloud.ring])
    return np.column_stack([each for each in columns if each is not None])


@pytest.mark.parametrize("columns", [4, 5])
@pytest.mark.parametrize("scale", [1.0, 1000.0, -1.0])
@pytest.mark.parametrize("order", ["as fired", "by ring", "shuffled", "before"])
def test_points_of_kitti_and_of_nuscenes(
    tmp_path: Path, columns: int, scale: float, order: str
) -> None:
    table = sweep()
    index = {
        "as fired": np.arange(COUNT),
        "by ring": np.argsort(table[:, 4], kind="stable"),
        "shuffled": np.random.default_rng(0).permutation(COUNT),
        "before": np.flatnonzero(table[:, 0] > 0)[: COUNT // 80 * 40],
    }[order]
    table = table[index, :columns] * np.array([scale, scale, scale, 1, 1], "<f4")[:columns]
    np.testing.assert_array_equal(read(tmp_path, table), table)


@pytest.mark.parametrize("garbage", ["pcl", "velodyne", "double", "three", "six", "time"])
def test_other_records_are_never_read_as_points(tmp_path: Path, garbage: str) -> None:
    table = sweep()
    x, y, z, intensity, ring = table.T
    one, none = np.ones_like(x), np.zeros_like(x)
    kinds: Any = {"names": [*"xyzir"], "formats": ["<f4"] * 4 + ["<u2"], "itemsize": 32}
    velodyne: Any = np.zeros(COUNT, np.dtype(kinds | {"offsets": [0, 4, 8, 16, 20]}))
    for name, column in zip("xyzir", table.T, strict=True):
        velodyne[name] = column
    data = {
        "pcl": np.column_stack([x, y, z, one, intensity, none, none, none]),
        "velodyne": velodyne,
        "double": table[:, :4].astype("<f8"),
        "three": table[:, :3],
        "six": np.column_stack([table, x / 100]),
        "time": np.column_stack([x, y, z, intensity, ring + 0.5]),
    }[garbage]
    expected = r"32 bytes.*\[0, 1, 2, 4\]" if garbage in ("pcl", "velodyne") else r"N\)\[:, :4\]"
    with pytest.raises(ReadError, match=expected):
        read(tmp_path, np.ascontiguousarray(data))


def test_the_advice_for_records_of_32_bytes_gives_the_points(tmp_path: Path) -> None:
    x, y, z, intensity, _ = sweep().T
    one, none = np.ones_like(x), np.zeros_like(x)
    records = np.column_stack([x, y, z, one, intensity, none, none, none])
    np.save(tmp_path / "a.npy", records[:, [0, 1, 2, 4]])
    cloud = read_cloud(tmp_path / "a.npy")
    np.testing.assert_array_equal(cloud.intensity, intensity)


def test_what_could_be_both_is_no_guess(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match=r"KITTI\) or five \(nuScenes\).*np\.save"):
        read(tmp_path, np.arange(80, dtype="<f4"))


def test_a_file_of_another_size_is_named(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match=r"28 bytes.*multiple of 16.*or of 20"):
        read(tmp_path, np.ones(7, "<f4"))
