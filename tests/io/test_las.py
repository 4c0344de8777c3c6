"""LAS and LAZ: what the header promises is checked first."""

import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from retropole.base.errors import MissingExtraError, ReadError
from retropole.io import read_cloud
from tests.io.files import XYZ, make_las


def test_missing_laspy_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.las").write_bytes(b"LASF")
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(MissingExtraError, match=r"retropole\[las\]"):
        read_cloud(tmp_path / "a.las")


@pytest.mark.parametrize("point_format", [3, 6, 7, 8])
@pytest.mark.parametrize("count", [1, 50_001])
def test_every_compression_of_laz_is_read(tmp_path: Path, point_format: int, count: int) -> None:
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


def test_laz_layers_are_checked_before_memory_is_allocated(tmp_path: Path) -> None:
    """The decoder would allocate memory for such a layer, and end the process without it."""
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


def test_las_counts_are_checked_before_memory_is_allocated(tmp_path: Path) -> None:
    path = tmp_path / "a.las"
    make_las(path)
    content = path.read_bytes()
    path.write_bytes(content[:100] + struct.pack("<I", 10**9) + content[104:])
    with pytest.raises(ReadError, match="1000000000 variable length records"):
        read_cloud(path)
    path.write_bytes(content[:-1])
    with pytest.raises(ReadError, match="promises 3 points"):
        read_cloud(path)


def test_laz_chunks_are_checked_before_memory_is_allocated(tmp_path: Path) -> None:
    """The decoder would end the process where it cannot allocate the memory."""
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


@pytest.mark.parametrize(("offset", "value"), [(-2, 0), (-2, 1), (0, 9), (2, 21)])
def test_items_that_make_up_no_point_are_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], offset: int, value: int
) -> None:
    """The decoder would panic, and print a trace of its own."""
    make_las(tmp_path / "a.laz")
    data = bytearray((tmp_path / "a.laz").read_bytes())
    # The items of a point of format 3: itself, its time, its colour; before them, their number.
    first = data.index(struct.pack("<HHHHHH", 6, 20, 2, 7, 8, 2))
    struct.pack_into("<H", data, first + offset, value)
    (tmp_path / "a.laz").write_bytes(data)
    with pytest.raises(ReadError, match=r"a\.laz: its \d compressed items have .* a point has 34"):
        read_cloud(tmp_path / "a.laz")
    assert capfd.readouterr().err == ""
