"""PCD against pypcd4 and against files of other programs."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from retropole.base.datatypes import PointCloud
from retropole.base.errors import ReadError, UsageError
from retropole.io import read_cloud, write_pcd
from tests.paths import SHARED

GOOD = {
    **{f"formats/pcd/{name}.pcd": 213 for name in ("ascii", "binary", "binary_compressed")},
    "formats/pcd/ascii_with_underscore.pcd": 213,
    **{
        f"formats/pcd/{name}.pcd": 7
        for name in ("ascii_multi_count", "ascii_organized", "binary_compressed_organized")
    },
    "pandar_scene1/p64.pcd": 106_365,
    "pandar_scene1/qt_201.pcd": 21_448,
    "pandar_scene1/qt_202.pcd": 11_663,
    "pandar_scene1/qt_203.pcd": 13_320,
    "pandar_scene1/qt_204.pcd": 25_046,
    "pandar_0001/top.pcd": 92_677,
    "pandar_0001/left.pcd": 8_572,
    "pandar_0001/right.pcd": 9_248,
    "pandaset/pandaset002_00_pandar64.pcd": 106_169,
    "pandaset/pandaset002_00_pandargt.pcd": 60_599,
    "planes_top_front/ref_filter.pcd": 7_013,
    "planes_top_front/data_filter.pcd": 8_101,
}
BAD = {
    "ascii_empty": "is empty",
    "ascii_invalid_header": "line 3.*FIEL",
    "ascii_with_empty_points": "POINTS is 0",
}
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no recordings in {SHARED}")

XYZ = np.array([[1.5, 2.0, 3.25], [-4.0, 5.5, 6.0], [7.0, -8.0, 9.0]])


@needs_shared
@pytest.mark.parametrize(("name", "points"), GOOD.items())
def test_recordings_read_as_pypcd4_reads_them(name: str, points: int) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    cloud = read_cloud(SHARED / name)
    assert len(cloud) == points
    data = pypcd4.PointCloud.from_path(SHARED / name).pc_data
    xyz = np.stack([data[axis].astype(float) for axis in "xyz"], axis=1)
    kept = np.all(np.isfinite(xyz), axis=1) & np.any(xyz != 0, axis=1)
    np.testing.assert_array_equal(cloud.xyz, xyz[kept])
    assert cloud.dropped == np.count_nonzero(~kept)
    for field, column in (("intensity", cloud.intensity), ("ring", cloud.ring)):
        # pypcd4 gives each value of a field of several values a name of its own.
        own = next((n for n in (field, f"{field}__0000") if n in data.dtype.names), None)
        assert (column is None) == (own is None)
        if column is not None:
            np.testing.assert_array_equal(column, data[own][kept])


@needs_shared
@pytest.mark.parametrize(("name", "message"), BAD.items())
def test_broken_files_say_why(name: str, message: str) -> None:
    with pytest.raises(ReadError, match=message):
        read_cloud(SHARED / "formats" / "pcd" / f"{name}.pcd")


@needs_shared
@pytest.mark.parametrize("name", ["simple.las", "simple.laz"])
def test_las_reads_as_laspy_reads_it(name: str) -> None:
    laspy = pytest.importorskip("laspy")
    path = SHARED / "formats" / "las" / name
    las, cloud = laspy.read(path), read_cloud(path)
    assert len(cloud) == 1065
    np.testing.assert_array_equal(cloud.xyz, las.xyz)
    np.testing.assert_array_equal(cloud.intensity, las.intensity)
    np.testing.assert_array_equal(cloud.time, las.gps_time)


KINDS = {
    ("F", 4): "<f4",
    ("F", 8): "<f8",
    **{("I", size): f"<i{size}" for size in (1, 2, 4, 8)},
    **{("U", size): f"<u{size}" for size in (1, 2, 4, 8)},
}


def pcd(
    fields: list[tuple[str, str, int, int]],
    columns: list[NDArray[Any]],
    encoding: str,
    *,
    viewpoint: str = "0 0 0 1 0 0 0",
    padding: bool = True,
    shape: tuple[int, int] | None = None,
) -> bytes:
    """Write a PCD of (name, type, size, count) fields without help of the code under test."""
    import lzf

    width, height = shape or (len(columns[0]), 1)
    head = "# .PCD v.7\nVERSION .7\n"
    for key, k in (("FIELDS", 0), ("SIZE", 2), ("TYPE", 1), ("COUNT", 3)):
        head += f"{key} {' '.join(str(field[k]) for field in fields)}\n"
    head += f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT {viewpoint}\n"
    head += f"POINTS {width * height}\nDATA {encoding}\n"
    typed = [
        np.ascontiguousarray(c.reshape(len(c), f[3]).astype(KINDS[f[1], f[2]]))
        for f, c in zip(fields, columns, strict=True)
    ]
    if encoding == "ascii":
        lines = [
            " ".join(str(v) for column in typed for v in column[k]) for k in range(len(typed[0]))
        ]
        body = ("\n".join(lines) + "\n").encode()
    elif encoding == "binary":
        body = b"".join(column[k].tobytes() for k in range(len(typed[0])) for column in typed)
    else:
        kept = [c for f, c in zip(fields, typed, strict=True) if padding or f[0] != "_"]
        plain = b"".join(column.tobytes() for column in kept)
        packed = lzf.compress(plain, 2 * len(plain) + 100)
        body = struct.pack("<II", len(packed), len(plain)) + packed
    return head.encode() + body


def simple(encoding: str, points: int = 60) -> bytes:
    xyz = np.tile(XYZ, (points // 3, 1))
    return pcd([(axis, "F", 4, 1) for axis in "xyz"], list(xyz.T), encoding)


ENCODINGS = ["ascii", "binary", "binary_compressed"]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("kind", "size"), KINDS)
def test_any_type_in_any_place(tmp_path: Path, encoding: str, kind: str, size: int) -> None:
    points = np.arange(1, 61, dtype=float)
    fields = [("_", "U", 1, 3), ("z", kind, size, 1), ("Intensity", kind, size, 2)]
    fields += [("_", "F", 4, 1), ("y", "F", 8, 1), ("rgb", "U", 4, 1), ("x", kind, size, 1)]
    columns = [np.zeros((60, 3)), points, np.column_stack([points + 1, 0 * points])]
    columns += [np.zeros(60), points / 8, 0 * points, points + 2]
    (tmp_path / "a.pcd").write_bytes(pcd(fields, columns, encoding, shape=(12, 5)))
    cloud = read_cloud(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.xyz, np.column_stack([points + 2, points / 8, points]))
    np.testing.assert_array_equal(cloud.intensity, points + 1)  # the first of two


@pytest.mark.parametrize("padding", [True, False])
def test_compressed_with_and_without_its_padding(tmp_path: Path, padding: bool) -> None:
    fields = [("x", "F", 4, 1), ("_", "U", 1, 4), ("y", "F", 4, 1), ("z", "F", 4, 1)]
    xyz = np.tile(XYZ, (20, 1))
    columns = [xyz[:, 0], np.zeros((60, 4)), xyz[:, 1], xyz[:, 2]]
    data = pcd(fields, columns, "binary_compressed", padding=padding)
    (tmp_path / "a.pcd").write_bytes(data)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd").xyz, xyz)


def test_viewpoint_is_the_origin_and_no_return(tmp_path: Path) -> None:
    fields = [(axis, "F", 4, 1) for axis in "xyz"]
    data = pcd(fields, list(XYZ.T), "binary", viewpoint="-4 5.5 6 1 0 0 0")
    (tmp_path / "a.pcd").write_bytes(data)
    cloud = read_cloud(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.origin, [-4, 5.5, 6])
    np.testing.assert_array_equal(cloud.xyz, XYZ[[0, 2]])
    assert cloud.dropped == 1


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("shape", [(0, 0), (0, 1), (60, 0)])
def test_points_are_read_where_width_and_height_are_not_reported(
    tmp_path: Path, encoding: str, shape: tuple[int, int]
) -> None:
    width, height = (f"{n}".encode() for n in shape)
    data = simple(encoding).replace(b"WIDTH 60", b"WIDTH " + width)
    (tmp_path / "a.pcd").write_bytes(data.replace(b"HEIGHT 1", b"HEIGHT " + height))
    cloud = read_cloud(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.xyz, np.tile(XYZ, (20, 1)))
    said = "WIDTH {} and HEIGHT {} are ignored: POINTS is 60".format(*shape)
    assert cloud.notes == (said,)
    huge = data.replace(b"HEIGHT 1", b"HEIGHT 0").replace(b"POINTS 60", b"POINTS 1000000000000")
    (tmp_path / "a.pcd").write_bytes(huge)
    with pytest.raises(ReadError, match="promises"):
        read_cloud(tmp_path / "a.pcd")


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("name", "notes"), [("_", 0), ("rgb", 1)])
def test_a_field_of_no_values_is_passed_over(
    tmp_path: Path, encoding: str, name: str, notes: int
) -> None:
    fields = [("x", "F", 4, 1), (name, "U", 1, 0), ("y", "F", 4, 1), ("z", "F", 4, 1)]
    xyz = np.tile(XYZ, (20, 1))
    data = pcd(fields, [xyz[:, 0], np.zeros((60, 0)), xyz[:, 1], xyz[:, 2]], encoding)
    (tmp_path / "a.pcd").write_bytes(data)
    cloud = read_cloud(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.xyz, xyz)
    assert cloud.notes == ("of COUNT 0, so without values: rgb",) * notes
    (tmp_path / "a.pcd").write_bytes(data.replace(b"COUNT 1 0 1 1", b"COUNT 0 0 0 0"))
    with pytest.raises(ReadError, match="COUNT is 0 for every field"):
        read_cloud(tmp_path / "a.pcd")


def test_text_that_its_type_cannot_hold_does_not_wrap(tmp_path: Path) -> None:
    data = pcd(
        [(a, "F", 4, 1) for a in "xyz"] + [("i", "U", 2, 1)], [*XYZ.T, np.full(3, 300)], "ascii"
    )
    (tmp_path / "a.pcd").write_bytes(data.replace(b"SIZE 4 4 4 2", b"SIZE 4 4 4 1"))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd").intensity, [300] * 3)


@pytest.mark.parametrize(
    ("encoding", "old", "new", "message"),
    [
        ("binary", b"POINTS 60", b"POINTS 1000000000000", "WIDTH 60.*POINTS 1000000000000"),
        ("ascii", b"SIZE 4 4 4", b"SIZE 4 4", "3, 2, 3 and 3"),
        ("ascii", b"SIZE 4 4 4", b"SIZE 4 4 3", r"line 5.*field z has type F of 3"),
        ("ascii", b"TYPE F F F", b"TYPE F F Q", r"line 5.*type Q"),
        ("ascii", b"FIELDS x y z", b"FIELDS x y w", r"field z is missing.*x, y, w"),
        ("ascii", b"FIELDS x y z\n", b"", "no FIELDS"),
        ("ascii", b"WIDTH 60", b"WIDTH 59", "WIDTH 59 times HEIGHT 1 is not POINTS 60"),
        ("ascii", b"WIDTH 60", b"WIDTH sixty", r"line 7.*sixty"),
        ("ascii", b"WIDTH 60", b"WIDTH -60", r"line 7.*-60"),
        ("ascii", b"HEIGHT 1", b"HEIGHT 1\nHEIGHT 1", r"line 9.*again, after line 8"),
        ("ascii", b"DATA ascii", b"DATA text", r"line 11.*text"),
        ("ascii", b"DATA ascii\n", b"", "starts with '1.5'"),
        ("ascii", b"VIEWPOINT 0", b"VIEWPOINT", r"line 9.*seven numbers"),
        ("ascii", b"1.5 2.0 3.25\n-4", b"1.5 2.0 3.25\nfour", r"line 13.*four.0 5.5 6.0"),
        ("ascii", b"1.5 2.0 3.25\n-4.0", b"1.5 2.0 3.25\n", r"line 13.*5.5 6.0"),
        ("binary", b"DATA binary\n", b"DATA binary_compressed\n", "decompress to"),
    ],
)
def test_errors_name_the_place(
    tmp_path: Path, encoding: str, old: bytes, new: bytes, message: str
) -> None:
    data = simple(encoding)
    assert old in data
    (tmp_path / "bad.pcd").write_bytes(data.replace(old, new, 1))
    with pytest.raises(ReadError, match=message) as caught:
        read_cloud(tmp_path / "bad.pcd")
    assert "bad.pcd" in str(caught.value)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_promise_of_a_header_takes_no_memory(tmp_path: Path, encoding: str) -> None:
    data = simple(encoding).replace(b"H 60", b"H " + b"1" + b"0" * 12)
    (tmp_path / "a.pcd").write_bytes(data.replace(b"POINTS 60", b"POINTS 1" + b"0" * 12))
    with pytest.raises(ReadError, match=r"promises"):
        read_cloud(tmp_path / "a.pcd")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_file_cut_short_is_an_error(tmp_path: Path, encoding: str) -> None:
    data = simple(encoding)
    start = data.index(b"DATA") + 20
    for end in range(start, len(data) - 2, 7):
        (tmp_path / "a.pcd").write_bytes(data[:end])
        with pytest.raises(ReadError):
            read_cloud(tmp_path / "a.pcd")


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (0, 2**31, "promises 2147483648 bytes of compressed data"),
        (0, 1, "1 bytes cannot decompress"),
        (4, 719, "decompress to 719 bytes, the header promises 720"),
        (8, 2**32 - 1, "damaged"),
    ],
)
def test_compressed_sizes_are_checked(tmp_path: Path, place: int, value: int, message: str) -> None:
    data = bytearray(simple("binary_compressed"))
    struct.pack_into("<I", data, data.index(b"compressed\n") + 11 + place, value)
    (tmp_path / "a.pcd").write_bytes(bytes(data))
    with pytest.raises(ReadError, match=message):
        read_cloud(tmp_path / "a.pcd")


class TestWrite:
    def test_round_trip(self, tmp_path: Path) -> None:
        rng = np.random.default_rng(1)
        cloud = PointCloud(
            rng.normal(size=(50, 3)).astype(np.float32).astype(float),
            intensity=rng.integers(0, 256, 50).astype(float),
            ring=rng.integers(0, 2**16, 50),
            time=1.7e9 + rng.random(50),
            origin=rng.normal(size=3),
        )
        write_pcd(tmp_path / "new" / "a.pcd", cloud)
        back = read_cloud(tmp_path / "new" / "a.pcd")
        for name in ("xyz", "intensity", "ring", "time", "origin"):
            np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))

    def test_pypcd4_reads_it(self, tmp_path: Path) -> None:
        pypcd4 = pytest.importorskip("pypcd4")
        cloud = PointCloud(XYZ, intensity=np.arange(3.0), ring=np.arange(3), origin=np.ones(3))
        write_pcd(tmp_path / "a.pcd", cloud)
        data = pypcd4.PointCloud.from_path(tmp_path / "a.pcd")
        assert data.fields == ("x", "y", "z", "intensity", "ring")
        np.testing.assert_array_equal(data.numpy(("x", "y", "z")), XYZ)
        np.testing.assert_array_equal(data.pc_data["ring"], [0, 1, 2])
        assert tuple(data.metadata.viewpoint)[:4] == (1, 1, 1, 1)

    def test_only_what_there_is(self, tmp_path: Path) -> None:
        write_pcd(tmp_path / "a.pcd", PointCloud(XYZ))
        back = read_cloud(tmp_path / "a.pcd")
        assert (back.intensity, back.ring, back.time) == (None, None, None)

    def test_what_does_not_fit_is_refused(self, tmp_path: Path) -> None:
        for cloud in (
            PointCloud(XYZ, ring=np.array([-1, 0, 1])),
            PointCloud(XYZ, ring=np.array([0, 1, 65536])),
            PointCloud(XYZ * 1e40),
            PointCloud(XYZ, intensity=np.full(3, 1e39)),
        ):
            with pytest.raises(UsageError, match=r"a\.pcd.*runs from"):
                write_pcd(tmp_path / "a.pcd", cloud)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_points_that_the_header_does_not_promise_are_reported(
    tmp_path: Path, encoding: str
) -> None:
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\n"
    header += f"POINTS 2\nDATA {encoding}\n"
    row = b"1 2 3\n" if encoding == "ascii" else np.array([1, 2, 3], "<f4").tobytes()
    path = tmp_path / "a.pcd"
    path.write_bytes(header.encode() + row * 5)
    cloud = read_cloud(path)
    assert len(cloud) == 2
    assert cloud.notes == ("the header promises 2 points, the 3 that follow them are left out",)
    # Some writers fill up the last page of a binary file.
    path.write_bytes(header.encode() + row * 2 + (b"\n" if encoding == "ascii" else bytes(4096)))
    assert read_cloud(path).notes == ()
