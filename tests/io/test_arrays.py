"""Plain arrays of numbers, in files and in memory."""

import struct
import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from retropole.base.datatypes import PointCloud
from retropole.base.errors import ReadError, UsageError
from retropole.io import cloud_from_array, read_cloud
from tests.io.exports import EXPORTS
from tests.io.files import INTENSITY, TABLE, XYZ, numbers


class TestText:
    @pytest.mark.parametrize("separator", [",", ", ", ";", "\t", " ", "   "])
    @pytest.mark.parametrize("head", ["", "# written today\n", "\ufeff", "\n\n"])
    @pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
    def test_separators(self, tmp_path: Path, separator: str, head: str, end: str) -> None:
        text = head + numbers(TABLE, separator)
        (tmp_path / "a.txt").write_bytes(text.replace("\n", end).encode())
        cloud = read_cloud(tmp_path / "a.txt")
        np.testing.assert_array_equal(cloud.xyz, XYZ)
        np.testing.assert_array_equal(cloud.intensity, INTENSITY)

    @pytest.mark.parametrize(
        "head", ["Z,I,Y,X", '"z","i","y","x"', "//Z I Y X", "# z i y x", "# hi\nz;i;y;x"]
    )
    def test_names_rule_the_order(self, tmp_path: Path, head: str) -> None:
        (tmp_path / "a.csv").write_text(head + "\n3,4,2,1\n")
        cloud = read_cloud(tmp_path / "a.csv")
        np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3]])
        np.testing.assert_array_equal(cloud.intensity, [4])

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("1,2,3\n1,2,x\n", r"line 2.*1,2,x.*3 numbers"),
            ("x,y,z\n\n1,2,3\n1,2\n", "line 4"),
            ("x y z\n# no\n1 2 3\n1 2 3 4\n", "line 4"),
            ("1,2,,3\n4,5,,6\n", "line 1"),  # an empty cell must not move the others
            ("1,5;2.5;3,5\n", "line 1"),  # commas beside points may separate thousands
            ("1,5 2.5 3,5\n", "line 1"),
            ("1,2,3 4,5,6\n", "line 1"),
            ("60\n1 2 3\n", "line 1: promises 60 points, 1 lines"),
            ("x y z\n1\n1 2 3\n4 5 6\n", "line 2: promises 1 points, 2 lines"),
            ("60\n", "no lines of numbers"),
            ("1\n2\n3\n", r"line 1: promises 1 points, 2 lines|\(2, 1\)"),
            ("0x1g 2 3\n", "line 1"),
            ("X (deg),Y (deg),Z (m)\n1,2,3\n", r"X \(deg\), Y \(deg\).*one unit of m, cm"),
            ("X (m),Y (m),Z (mm)\n1,2,3\n", "one unit of m, cm"),
            ("x,y,z\n0TFDFCE00502501,1,2,3\n0TFDFCE00502501,1,2,3\n1,2,3\n", "line 3"),
            ("1 2 3 255 0 0\n", r"\(N, 3\)"),  # colours are no intensity
            ("1 2\n", r"\(1, 2\)"),
            ("x,y,z\n", "no lines of numbers"),
            ("# only words\n", "no lines of numbers"),
            ("a title\nanother\n1 2 3\n", "line 2"),
            ("x,X,y,z\n1,2,3,4\n", "one name"),
            ("a,b,c\n1,2,3\n", "x, y, z is missing"),
            ("1_0 2 3\n", "numbers"),
        ],
    )
    def test_errors_name_the_place(self, tmp_path: Path, text: str, message: str) -> None:
        (tmp_path / "a.xyz").write_text(text)
        with pytest.raises(ReadError, match=message):
            read_cloud(tmp_path / "a.xyz")


CLOUD = PointCloud(
    np.round(np.random.default_rng(1).uniform(-40, 40, (30, 3)), 3),
    intensity=np.arange(30.0) * 8,
    ring=np.arange(30) % 16,
)


class TestExports:
    """What viewers of makers, and programs of surveyors, write."""

    @pytest.mark.parametrize("name", EXPORTS)
    def test_the_points_are_those_of_the_viewer(self, tmp_path: Path, name: str) -> None:
        (tmp_path / name).write_bytes(EXPORTS[name](CLOUD))
        in_mm = "in mm" in name
        cloud = read_cloud(tmp_path / name, unit="mm" if in_mm else "m")
        np.testing.assert_allclose(cloud.xyz, CLOUD.xyz, atol=1e-9)
        assert cloud.intensity is not None
        scale = (16, -2048) if name == "leica.pts" else (1, 0)
        np.testing.assert_array_equal(cloud.intensity, np.arange(30.0) * 8 * scale[0] + scale[1])
        if name.split(".")[0] in ("veloview", "veloview 3", "pandarview", "ouster"):
            np.testing.assert_array_equal(cloud.ring, CLOUD.ring)
        # Ticks of a length that is not stated are no seconds.
        assert (cloud.time, cloud.dropped) == (None, 0)
        said = {"ouster in mm.csv": "--unit mm", "livox viewer 2.csv": "line 2 has 10 values"}
        said |= dict.fromkeys(("spreadsheet.csv", "commas and blanks.txt"), "decimal marks")
        assert [said.get(name, "") in note for note in cloud.notes] == [True] * (name in said)

    def test_a_time_in_another_unit_is_not_taken_for_seconds(self, tmp_path: Path) -> None:
        for unit, is_taken in (("s", True), ("", True), ("us", False), ("ms", False)):
            name = f"time ({unit})" if unit else "time"
            (tmp_path / "a.csv").write_text(f"x,y,z,{name}\n1,2,3,0.5\n1,2,4,1.5\n")
            assert (read_cloud(tmp_path / "a.csv").time is not None) == is_taken

    def test_columns_of_a_pts_that_are_no_colours_are_no_guess(self, tmp_path: Path) -> None:
        for row in ("1 2 3 200 100 50 0.5", "1 2 3 4 5 256", "1 2 3 4 5 6 -7"):
            (tmp_path / "a.pts").write_text(f"{row}\n")
            with pytest.raises(ReadError, match="not colours from 0 to 255"):
                read_cloud(tmp_path / "a.pts")

    def test_an_intensity_that_is_missing_is_the_lowest(self, tmp_path: Path) -> None:
        (tmp_path / "a.pts").write_text("2\n1 2 3 -1500\n1 2 4 nan\n")
        np.testing.assert_array_equal(read_cloud(tmp_path / "a.pts").intensity, [-1500, -1500])


class TestArrays:
    def test_structured(self, tmp_path: Path) -> None:
        points = np.zeros(3, [("intensity", "u1"), ("z", ">f8"), ("y", "f4"), ("x", "i2")])
        points["x"], points["y"], points["z"] = [1, 2, 3], [4, 5, 6], [7, 8, 9]
        points["intensity"] = INTENSITY
        np.save(tmp_path / "a.npy", points)
        cloud = read_cloud(tmp_path / "a.npy")
        np.testing.assert_array_equal(cloud.xyz, [[1, 4, 7], [2, 5, 8], [3, 6, 9]])
        np.testing.assert_array_equal(cloud.intensity, INTENSITY)

    @pytest.mark.parametrize("order", ["C", "F"])
    def test_memory_order_does_not_matter(self, tmp_path: Path, order: Literal["C", "F"]) -> None:
        np.save(tmp_path / "a.npy", np.asarray(XYZ, order=order))
        np.testing.assert_array_equal(read_cloud(tmp_path / "a.npy").xyz, XYZ)

    @pytest.mark.parametrize(
        "array",
        [
            np.ones((3, 6)),
            np.ones(3),
            np.ones((2, 2, 3)),
            np.ones((3, 3), complex),
            np.array([["a"] * 3]),
            np.array(1.0),
            np.array([[None] * 3]),
            np.ones((3, 0)),
            np.ones(2, [("x", "f4"), ("y", "S3"), ("z", "f4")]),
            np.ones(2, [("x", "f4"), ("y", "f4", (2, 2)), ("z", "f4")]),
        ],
        ids=str,
    )
    def test_no_table_of_points(self, tmp_path: Path, array: NDArray[Any]) -> None:
        np.save(tmp_path / "a.npy", array)
        np.savez(tmp_path / "a.npz", array)
        for path in (tmp_path / "a.npy", tmp_path / "a.npz"):
            with pytest.raises(ReadError, match="expected"):
                read_cloud(path)

    def test_promise_of_a_header_takes_no_memory(self, tmp_path: Path) -> None:
        text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3), }\n"
        body = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text
        (tmp_path / "a.npy").write_bytes(body)
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
            archive.writestr("xyz.npy", body)
        for path in (tmp_path / "a.npy", tmp_path / "a.npz"):
            with pytest.raises(ReadError, match="promises 24000000000000 bytes"):
                read_cloud(path)

    @pytest.mark.parametrize(
        "arrays",
        [
            {"x": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2], "i": INTENSITY},
            {"points": TABLE},
            {"cloud": TABLE},
            {
                "points": TABLE * [1, 1, 1, 0],
                "intensity": INTENSITY,
                "pose": np.eye(4),
            },
        ],
    )
    def test_npz_keys(self, tmp_path: Path, arrays: dict[str, Any]) -> None:
        np.savez(tmp_path / "a.npz", **arrays)
        cloud = read_cloud(tmp_path / "a.npz")
        np.testing.assert_array_equal(cloud.xyz, XYZ)
        np.testing.assert_array_equal(cloud.intensity, INTENSITY)

    def test_npz_lengths_must_agree(self, tmp_path: Path) -> None:
        np.savez(tmp_path / "a.npz", xyz=XYZ, intensity=INTENSITY[:2])
        with pytest.raises(ReadError, match="2 values for 3 points"):
            read_cloud(tmp_path / "a.npz")
        np.savez(tmp_path / "a.npz", x=XYZ[:, 0], y=XYZ[:2, 1], z=XYZ[:, 2])
        with pytest.raises(ReadError, match="3, 2, 3 values"):
            read_cloud(tmp_path / "a.npz")

    def test_npz_with_two_tables_is_no_guess(self, tmp_path: Path) -> None:
        np.savez(tmp_path / "a.npz", xyz=XYZ, points=2 * XYZ)
        with pytest.raises(ReadError, match="xyz and points"):
            read_cloud(tmp_path / "a.npz")

    def test_kitti_of_odd_length(self, tmp_path: Path) -> None:
        (tmp_path / "a.bin").write_bytes(b"\0" * 30)
        with pytest.raises(ReadError, match=r"30 bytes.*multiple of 16"):
            read_cloud(tmp_path / "a.bin")


class TestMemory:
    def test_an_array_is_what_its_file_is(self, tmp_path: Path) -> None:
        table = np.vstack([TABLE, [np.nan, 1, 1, 1], [0, 0, 0, 9]])
        np.save(tmp_path / "a.npy", table)
        of_file, of_array = read_cloud(tmp_path / "a.npy"), cloud_from_array(table)
        np.testing.assert_array_equal(of_array.xyz, of_file.xyz)
        np.testing.assert_array_equal(of_array.intensity, of_file.intensity)
        assert of_array.dropped == of_file.dropped == 2
        assert of_array.source == "<array>"

    @pytest.mark.parametrize("kind", ["f4", "f8", "i2", "u1"])
    def test_the_cloud_does_not_share_its_memory(self, kind: str) -> None:
        table = np.abs(TABLE).astype(kind)
        cloud = cloud_from_array(table)
        expected = cloud.xyz.copy(), table[:, 3].astype(float)
        table[:] = 0
        np.testing.assert_array_equal(cloud.xyz, expected[0])
        np.testing.assert_array_equal(cloud.intensity, expected[1])

    def test_errors_name_what_was_given(self) -> None:
        with pytest.raises(UsageError, match=r"front: an array of float64 of shape \(5, 2\)"):
            cloud_from_array(np.ones((5, 2)), "front")
        points = np.ones(2, [("x", "f4"), ("y", "f4"), ("intensity", "f4")])
        with pytest.raises(UsageError, match="front: field z is missing"):
            cloud_from_array(points, "front")


@pytest.mark.parametrize(
    "body",
    [b"\n" * 2_000_000, b"# x\n" * 500_000, b" " * 2_000_000, b"1 " * 1_000_000 + b"\n1 2 3 4\n"],
    ids=["blank lines", "comments", "blanks", "one line"],
)
@pytest.mark.full
def test_a_text_of_endless_heads_or_lines_is_refused(body: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(body)
    with pytest.raises(ReadError, match=r"1,048,576 bytes|2,000,000 bytes"):
        read_cloud(path)


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
