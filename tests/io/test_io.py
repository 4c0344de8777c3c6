"""What any reader must do: say what is wrong, drop what is no return, join frames in order."""

import struct
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from retropole.datatypes import PointCloud
from retropole.errors import MissingExtraError, ReadError
from retropole.io import READERS, read_cloud, sha256_of, write_pcd

XYZ = np.array([[1.5, 2.0, 3.25], [-4.0, 5.5, 6.0], [7.0, -8.0, 9.0]])
SCALE = np.array([10.0, 20.0, 255.0])


def numbers(rows: np.ndarray, mark: str = " ") -> str:
    return "".join(mark.join(repr(float(v)) for v in row) + "\n" for row in rows)


def make_pcd(path: Path) -> None:
    write_pcd(path, PointCloud(XYZ, intensity=SCALE, ring=np.array([0, 1, 2])))


def make_ply(path: Path) -> None:
    text = "ply\nformat ascii 1.0\nelement vertex 3\n"
    text += "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    path.write_text(text + "end_header\n" + numbers(np.column_stack([XYZ, SCALE])))


def make_las(path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    las = laspy.create(point_format=3, file_version="1.2")
    las.header.scales = [0.01] * 3
    las.x, las.y, las.z, las.intensity = *XYZ.T, SCALE
    las.write(path)


def make_bin(path: Path) -> None:
    path.write_bytes(np.column_stack([XYZ, SCALE]).astype("<f4").tobytes())


def make_npy(path: Path) -> None:
    np.save(path, np.column_stack([XYZ, SCALE]))


def make_npz(path: Path) -> None:
    np.savez_compressed(path, xyz=XYZ, intensity=SCALE, pose=np.eye(4))


def make_csv(path: Path) -> None:
    path.write_text("x,y,z,intensity\n" + numbers(np.column_stack([XYZ, SCALE]), ","))


def make_xyz(path: Path) -> None:
    path.write_text(numbers(np.column_stack([XYZ, SCALE])))


MAKERS: dict[str, Callable[[Path], None]] = {
    **{".pcd": make_pcd, ".ply": make_ply, ".las": make_las, ".laz": make_las, ".bin": make_bin},
    **{".npy": make_npy, ".npz": make_npz, ".csv": make_csv, ".xyz": make_xyz, ".txt": make_xyz},
}


def assert_valid(cloud: PointCloud) -> None:
    assert len(cloud) > 0
    assert cloud.xyz.dtype == np.float64
    assert cloud.xyz.flags.c_contiguous
    assert np.all(np.isfinite(cloud.xyz))
    assert np.all(np.any(cloud.xyz != cloud.origin, axis=1))
    for column in (cloud.intensity, cloud.time):
        assert column is None or (column.dtype == np.float64 and np.all(np.isfinite(column)))
    assert cloud.ring is None or cloud.ring.dtype == np.int64


def test_every_suffix_has_a_maker() -> None:
    assert set(MAKERS) == set(READERS)


@pytest.mark.parametrize("suffix", MAKERS)
def test_all_formats_give_the_same_cloud(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud{suffix.upper()}"
    # NumPy adds its suffix where it is not spelled in lower case.
    MAKERS[suffix](path.with_suffix(suffix))
    path.with_suffix(suffix).replace(path)
    cloud = read_cloud(str(path))
    assert_valid(cloud)
    np.testing.assert_allclose(cloud.xyz, XYZ, atol=1e-12)
    np.testing.assert_array_equal(cloud.intensity, SCALE)
    assert (cloud.dropped, cloud.frame, cloud.source) == (0, None, str(path))


@pytest.mark.parametrize("suffix", READERS)
def test_empty_file_is_named(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"nothing{suffix}"
    path.touch()
    with pytest.raises(ReadError, match=r"nothing.*empty"):
        read_cloud(path)


@pytest.mark.parametrize("suffix", READERS)
def test_missing_file_is_named(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(ReadError, match=r"absent.*no such"):
        read_cloud(tmp_path / f"absent{suffix}")


def test_unknown_suffix_lists_the_known(tmp_path: Path) -> None:
    (tmp_path / "cloud.obj").write_bytes(b"x")
    with pytest.raises(ReadError) as caught:
        read_cloud(tmp_path / "cloud.obj")
    assert all(suffix in str(caught.value) for suffix in READERS)


def test_missing_laspy_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.las").write_bytes(b"LASF")
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(MissingExtraError, match=r"retropole\[las\]"):
        read_cloud(tmp_path / "a.las")


@pytest.mark.parametrize("point_format", [3, 6, 7, 8])
@pytest.mark.parametrize("count", [1, 50_001])
def test_every_packing_of_laz_is_read(tmp_path: Path, point_format: int, count: int) -> None:
    laspy = pytest.importorskip("laspy")
    las = laspy.create(point_format=point_format, file_version="1.4")
    las.header.scales = [0.001] * 3
    las.add_extra_dim(laspy.ExtraBytesParams("ring", "u2"))
    las.x, las.y, las.z = np.random.default_rng(1).uniform(1, 9, (3, count))
    las.ring = np.arange(count) % 64
    las.write(tmp_path / "a.laz")
    cloud = read_cloud(tmp_path / "a.laz")
    np.testing.assert_array_equal(cloud.xyz, np.column_stack([las.x, las.y, las.z]))
    np.testing.assert_array_equal(cloud.ring, las.ring)


def test_laz_layers_are_checked_before_they_are_believed(tmp_path: Path) -> None:
    """The decoder would make room for such a layer, and end the process where there is none."""
    laspy = pytest.importorskip("laspy")
    las = laspy.create(point_format=6, file_version="1.4")
    las.x, las.y, las.z = XYZ.T
    path = tmp_path / "a.laz"
    las.write(path)
    content = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", content, 96)
    # After the place of the table come the first point, the count of points, and the sizes.
    for layer in range(9):
        damaged = content.copy()
        struct.pack_into("<I", damaged, start + 8 + 30 + 4 + 4 * layer, 2**32 - 1)
        path.write_bytes(damaged)
        with pytest.raises(ReadError, match="promises layers up to byte"):
            read_cloud(path)


def test_las_counts_are_checked_before_they_are_believed(tmp_path: Path) -> None:
    path = tmp_path / "a.las"
    make_las(path)
    content = path.read_bytes()
    path.write_bytes(content[:100] + struct.pack("<I", 10**9) + content[104:])
    with pytest.raises(ReadError, match="1000000000 variable length records"):
        read_cloud(path)
    path.write_bytes(content[:-1])
    with pytest.raises(ReadError, match="promises 3 points"):
        read_cloud(path)


def test_laz_chunks_are_checked_before_they_are_believed(tmp_path: Path) -> None:
    """The decoder would end the process where it cannot have the memory it asks for."""
    path = tmp_path / "a.laz"
    make_las(path)
    assert len(read_cloud(path)) == 3
    content = bytearray(path.read_bytes())
    points = struct.unpack_from("<I", content, 96)[0]
    table = struct.unpack_from("<q", content, points)[0]
    struct.pack_into("<I", content, table + 4, 2**32 - 1)
    path.write_bytes(bytes(content))
    with pytest.raises(ReadError, match="promises 4294967295 chunks"):
        read_cloud(path)
    struct.pack_into("<q", content, points, 2**60)
    path.write_bytes(bytes(content))
    with pytest.raises(ReadError, match="table of chunks"):
        read_cloud(path)


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
    def test_nothing_left_is_an_error(self, tmp_path: Path, rows: np.ndarray) -> None:
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

    @pytest.mark.parametrize("name", ["ring", "Channel", "laser_id"])
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

    def test_ticks_of_unknown_length_are_no_seconds(self, tmp_path: Path) -> None:
        for dtype, first in (("u4", 50), ("u8", 10**18), ("f8", 1.7e18), ("f8", np.nan)):
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


class TestFolder:
    def test_frames_join_in_natural_order(self, tmp_path: Path) -> None:
        for k in (10, 9, 100, 1):
            write_pcd(tmp_path / f"f{k}.pcd", PointCloud(np.full((k, 3), float(k))))
        (tmp_path / "notes.json").write_text("{}")
        (tmp_path / ".hidden.txt").write_text("no cloud")
        cloud = read_cloud(tmp_path)
        expected = np.repeat([1, 9, 10, 100], [1, 9, 10, 100])
        np.testing.assert_array_equal(cloud.xyz[:, 0], expected)
        np.testing.assert_array_equal(cloud.frame, np.repeat(range(4), [1, 9, 10, 100]))

    def test_odd_digits_sort(self, tmp_path: Path) -> None:
        for name in ("f².pcd", "f٣.pcd", "3.pcd", "f.pcd", "f01.pcd", "f1.pcd"):
            write_pcd(tmp_path / name, PointCloud(XYZ))
        assert len(read_cloud(tmp_path)) == 6 * len(XYZ)

    def test_empty_folder(self, tmp_path: Path) -> None:
        with pytest.raises(ReadError, match="no point clouds"):
            read_cloud(tmp_path)

    def test_mixed_folder(self, tmp_path: Path) -> None:
        make_pcd(tmp_path / "a.pcd")
        make_ply(tmp_path / "a.ply")
        with pytest.raises(ReadError, match=r"different formats.*\.pcd, \.ply"):
            read_cloud(tmp_path)

    def test_frames_must_agree(self, tmp_path: Path) -> None:
        write_pcd(tmp_path / "0.pcd", PointCloud(XYZ, intensity=SCALE))
        write_pcd(tmp_path / "1.pcd", PointCloud(XYZ))
        with pytest.raises(ReadError, match=r"1\.pcd.*no intensity"):
            read_cloud(tmp_path)
        write_pcd(tmp_path / "1.pcd", PointCloud(XYZ, intensity=SCALE, origin=np.ones(3)))
        with pytest.raises(ReadError, match=r"1\.pcd.*viewpoint"):
            read_cloud(tmp_path)

    def test_a_bad_frame_is_named(self, tmp_path: Path) -> None:
        make_pcd(tmp_path / "0.pcd")
        (tmp_path / "1.pcd").write_bytes((tmp_path / "0.pcd").read_bytes()[:-1])
        with pytest.raises(ReadError, match=r"1\.pcd"):
            read_cloud(tmp_path)


def test_sha256_is_of_the_bytes_in_natural_order(tmp_path: Path) -> None:
    (tmp_path / "2.bin").write_bytes(b"ab")
    (tmp_path / "10.bin").write_bytes(b"c")
    (tmp_path / "whole.dat").write_bytes(b"abc")
    abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert sha256_of(tmp_path) == sha256_of(tmp_path / "whole.dat") == abc
    with pytest.raises(ReadError, match="no such"):
        sha256_of(tmp_path / "absent")


class TestText:
    @pytest.mark.parametrize("mark", [",", ", ", ";", "\t", " ", "   "])
    @pytest.mark.parametrize("head", ["", "# written today\n", "\ufeff", "\n\n"])
    @pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
    def test_marks(self, tmp_path: Path, mark: str, head: str, end: str) -> None:
        text = head + numbers(np.column_stack([XYZ, SCALE]), mark)
        (tmp_path / "a.txt").write_bytes(text.replace("\n", end).encode())
        cloud = read_cloud(tmp_path / "a.txt")
        np.testing.assert_array_equal(cloud.xyz, XYZ)
        np.testing.assert_array_equal(cloud.intensity, SCALE)

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
            ("1,5;2,5;3,5\n", "line 1"),  # decimal commas are not more columns
            ("1,5 2,5 3,5\n", "line 1"),
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


class TestArrays:
    def test_structured(self, tmp_path: Path) -> None:
        points = np.zeros(3, [("intensity", "u1"), ("z", ">f8"), ("y", "f4"), ("x", "i2")])
        points["x"], points["y"], points["z"] = [1, 2, 3], [4, 5, 6], [7, 8, 9]
        points["intensity"] = SCALE
        np.save(tmp_path / "a.npy", points)
        cloud = read_cloud(tmp_path / "a.npy")
        np.testing.assert_array_equal(cloud.xyz, [[1, 4, 7], [2, 5, 8], [3, 6, 9]])
        np.testing.assert_array_equal(cloud.intensity, SCALE)

    @pytest.mark.parametrize("order", ["C", "F"])
    def test_memory_order_does_not_matter(self, tmp_path: Path, order: str) -> None:
        np.save(tmp_path / "a.npy", np.array(XYZ, order=order))
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
    def test_no_table_of_points(self, tmp_path: Path, array: np.ndarray) -> None:
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
            {"x": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2], "i": SCALE},
            {"points": np.column_stack([XYZ, SCALE])},
            {"cloud": np.column_stack([XYZ, SCALE])},
            {"points": np.column_stack([XYZ, 0 * SCALE]), "intensity": SCALE, "pose": np.eye(4)},
        ],
    )
    def test_npz_keys(self, tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
        np.savez(tmp_path / "a.npz", **arrays)
        cloud = read_cloud(tmp_path / "a.npz")
        np.testing.assert_array_equal(cloud.xyz, XYZ)
        np.testing.assert_array_equal(cloud.intensity, SCALE)

    def test_npz_lengths_must_agree(self, tmp_path: Path) -> None:
        np.savez(tmp_path / "a.npz", xyz=XYZ, intensity=SCALE[:2])
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


@pytest.mark.parametrize("suffix", MAKERS)
@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_damage_gives_an_error_or_a_cloud(tmp_path: Path, suffix: str, data: st.DataObject) -> None:
    path = tmp_path / f"cloud{suffix}"
    MAKERS[suffix](path)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(0, 4))):
        # Small steps of a byte change digits and letters of a header; large ones break it.
        place = data.draw(st.integers(0, len(content) - 1))
        content[place] = (content[place] + data.draw(st.integers(0, 255))) % 256
    content = content[: data.draw(st.integers(0, len(content)) | st.just(len(content)))]
    path.write_bytes(bytes(content))
    try:
        assert_valid(read_cloud(path))
    except ReadError as error:
        message = str(error)
    else:
        message = str(path)
    assert str(path) in message
