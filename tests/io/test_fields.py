"""Which points are returns, and what the names of fields mean, in any format."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from retropole.base.datatypes import PointCloud
from retropole.base.errors import ReadError, UsageError
from retropole.io import read_cloud, read_recording, write_pcd
from retropole.io.fields import Unit, Wanted, cloud_from_columns
from tests.io.files import INTENSITY, XYZ
from tests.paths import SHARED


class TestPoints:
    @pytest.mark.filterwarnings("error")
    def test_signalling_nan_is_dropped_without_a_warning(self, tmp_path: Path) -> None:
        bits = np.array([0x7F800001, 0x3F800000, 0x3F800000, 0x3F800000] * 2, "<u4")
        bits[4] = 0x3F800000
        bits[7] = 0x7F800001
        (tmp_path / "a.bin").write_bytes(bits.tobytes())
        cloud = read_cloud(tmp_path / "a.bin")
        np.testing.assert_array_equal(cloud.xyz, [[1, 1, 1]])
        assert (cloud.intensity, cloud.dropped) == (None, 1)

    def test_no_returns_are_dropped_and_counted(self, tmp_path: Path) -> None:
        rows = np.array([[1, 2, 3, 7], [0, 0, 0, 8], [np.nan, 1, 1, 9], [1, np.inf, 1, 9]])
        np.save(tmp_path / "a.npy", np.vstack([rows, [4, 5, 6, 10]]))
        cloud = read_cloud(tmp_path / "a.npy")
        np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3], [4, 5, 6]])
        np.testing.assert_array_equal(cloud.intensity, [7, 10])
        assert cloud.dropped == 3

    @pytest.mark.parametrize("rows", [np.full((4, 3), np.nan), np.zeros((4, 3)), np.zeros((0, 3))])
    def test_nothing_left_is_an_error(self, tmp_path: Path, rows: NDArray[np.float64]) -> None:
        np.save(tmp_path / "a.npy", rows)
        with pytest.raises(ReadError, match=r"points"):
            read_cloud(tmp_path / "a.npy")

    def test_missing_coordinate_names_the_fields(self, tmp_path: Path) -> None:
        np.savez(tmp_path / "a.npz", x=np.ones(3), y=np.ones(3), intensity=np.ones(3))
        with pytest.raises(ReadError, match=r"field z is missing.*x, y, intensity"):
            read_cloud(tmp_path / "a.npz")


class TestNames:
    @pytest.mark.parametrize(
        "name",
        ["intensity", "I", "Reflectivity", "reflectance", "REMISSION", "scalar_Intensity"],
    )
    def test_intensity(self, tmp_path: Path, name: str) -> None:
        (tmp_path / "a.csv").write_text(f"x,y,z,{name}\n1,2,3,4\n")
        np.testing.assert_array_equal(read_cloud(tmp_path / "a.csv").intensity, [4.0])

    @pytest.mark.parametrize("name", ["ring", "Channel", "laser_id", "laser_number", "Laser"])
    def test_ring(self, tmp_path: Path, name: str) -> None:
        (tmp_path / "a.csv").write_text(f"x,y,z,{name}\n1,2,3,4\n")
        np.testing.assert_array_equal(read_cloud(tmp_path / "a.csv").ring, [4])

    @pytest.mark.parametrize("name", ["time", "t", "Timestamp", "offset_time"])
    def test_time(self, tmp_path: Path, name: str) -> None:
        (tmp_path / "a.csv").write_text(f"x,y,z,{name}\n1,2,3,4.5\n")
        np.testing.assert_array_equal(read_cloud(tmp_path / "a.csv").time, [4.5])

    @pytest.mark.parametrize("name", ["rgb", "red", "intensity_image", "nx"])
    def test_others_are_no_intensity(self, tmp_path: Path, name: str) -> None:
        (tmp_path / "a.csv").write_text(f"x,y,z,{name}\n1,2,3,4\n")
        assert read_cloud(tmp_path / "a.csv").intensity is None

    def test_an_intensity_that_is_named(self, tmp_path: Path) -> None:
        fields = {"signal": "<u2", "reflectivity": "u1", "near_ir": "<u2"}
        points = np.ones(3, [*((axis, "<f4") for axis in "xyz"), *fields.items()])
        for k, name in enumerate(fields):
            points[name] = k + 5
        np.save(tmp_path / "a.npy", points)
        names = [*"xyz", *fields]
        columns: dict[str, Any] = {name: points[name] for name in names}
        np.savez(tmp_path / "a.npz", **columns)
        np.savetxt(tmp_path / "a.csv", points, delimiter=",", header=",".join(names))
        wanted = {None: 5, "signal": 5, "Reflectivity": 6, "near_ir": 7}
        for suffix in ("npy", "npz", "csv"):
            path = tmp_path / f"a.{suffix}"
            for named, value in wanted.items():
                found = read_cloud(path, intensity=named).intensity
                np.testing.assert_array_equal(found, [value] * 3)
            with pytest.raises(ReadError, match=r"intensity range: no such field; the fiel"):
                read_cloud(path, intensity="range")
            known = Wanted().or_known(Wanted("range"))
            np.testing.assert_array_equal(
                read_recording(path, wanted=known).cloud.intensity, [5] * 3
            )

    def test_ticks_of_unknown_length_are_no_seconds(self, tmp_path: Path) -> None:
        for dtype, first in (
            ("u2", 50),
            ("i4", 50),
            ("u8", 10**18),
            ("f8", 1.7e15),
            ("f8", np.nan),
        ):
            points = np.ones(2, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", dtype)])
            points["t"] = first
            np.save(tmp_path / "a.npy", points)
            assert read_cloud(tmp_path / "a.npy").time is None

    def test_intensity_without_a_value_is_weak(self, tmp_path: Path) -> None:
        rows = np.column_stack([XYZ, [np.nan, np.inf, 9.0]])
        np.save(tmp_path / "a.npy", rows)
        np.testing.assert_array_equal(read_cloud(tmp_path / "a.npy").intensity, [0, 0, 9])
        rows[:, 3] = np.nan
        np.save(tmp_path / "a.npy", rows)
        assert read_cloud(tmp_path / "a.npy").intensity is None

    def test_fractions_are_no_rings(self, tmp_path: Path) -> None:
        np.savez(tmp_path / "a.npz", xyz=XYZ, ring=[0.5, 1, 2])
        assert read_cloud(tmp_path / "a.npz").ring is None


def test_coordinates_that_are_no_places_are_dropped() -> None:
    x = np.array([1.0, 1e300, -1e10, 1e-200, 5e6])
    zero = np.zeros(5)
    cloud = cloud_from_columns({"x": x, "y": zero, "z": zero, "intensity": np.full(5, 1e300)})
    np.testing.assert_array_equal(cloud.xyz[:, 0], [1.0, 5e6])
    assert cloud.dropped == 3
    assert cloud.intensity is None, "no sensor counts so far"


IN_A_METRE: dict[Unit, float] = {"cm": 100, "mm": 1000, "ft": 1 / 0.3048, "in": 12 / 0.3048}


@pytest.mark.parametrize(("unit", "factor"), IN_A_METRE.items())
def test_a_file_is_read_in_its_unit(unit: Unit, factor: float, tmp_path: Path) -> None:
    cloud = PointCloud(XYZ, INTENSITY, origin=np.array([0.0, 0.0, 0.25]))
    path = tmp_path / "a.pcd"
    write_pcd(path, replace(cloud, xyz=factor * XYZ, origin=factor * cloud.origin))
    read = read_cloud(path, unit=unit)
    np.testing.assert_allclose(read.xyz, cloud.xyz, rtol=1e-6)
    np.testing.assert_allclose(read.origin, cloud.origin, rtol=1e-6)
    with pytest.raises(UsageError, match="unit is 'inch', expected m, cm, mm, ft, in"):
        read_cloud(path, unit="inch")  # type: ignore[arg-type]


def test_packets_are_metres(tmp_path: Path) -> None:
    capture = SHARED / "formats/velodyne/sample_velodyne_vlp16_gps.pcap"
    if not capture.exists():
        pytest.skip("recordings are not here")
    pytest.importorskip("velodyne_decoder")
    with pytest.raises(UsageError, match="packets are decoded to metres"):
        read_recording(capture, unit="mm")
