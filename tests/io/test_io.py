"""What any reader must do: say what is wrong, drop what is not a return, join frames in order."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from retropole.base.datatypes import PointCloud
from retropole.base.errors import ReadError
from retropole.io import READERS, read_cloud, read_recording, sha256_of, write_pcd
from tests.io.files import INTENSITY, WRITERS, XYZ, make_pcd, make_ply


def assert_valid(cloud: PointCloud) -> None:
    assert len(cloud) > 0
    assert cloud.xyz.dtype == np.float64
    assert cloud.xyz.flags.c_contiguous
    assert np.all(np.isfinite(cloud.xyz))
    assert np.all(np.any(cloud.xyz != cloud.origin, axis=1))
    for column in (cloud.intensity, cloud.time):
        assert column is None or (column.dtype == np.float64 and np.all(np.isfinite(column)))
    assert cloud.ring is None or cloud.ring.dtype == np.int64


def test_every_suffix_can_be_written() -> None:
    assert set(WRITERS) == set(READERS)


@pytest.mark.parametrize("suffix", WRITERS)
def test_all_formats_give_the_same_cloud(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud{suffix.upper()}"
    # NumPy adds its suffix where it is not spelled in lower case.
    WRITERS[suffix](path.with_suffix(suffix))
    path.with_suffix(suffix).replace(path)
    cloud = read_cloud(str(path))
    assert_valid(cloud)
    np.testing.assert_allclose(cloud.xyz, XYZ, atol=1e-12)
    np.testing.assert_array_equal(cloud.intensity, INTENSITY)
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
        write_pcd(tmp_path / "0.pcd", PointCloud(XYZ, intensity=INTENSITY))
        write_pcd(tmp_path / "1.pcd", PointCloud(XYZ))
        with pytest.raises(ReadError, match=r"1\.pcd.*no intensity"):
            read_cloud(tmp_path)
        write_pcd(tmp_path / "1.pcd", PointCloud(XYZ, intensity=INTENSITY, origin=np.ones(3)))
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


@pytest.mark.parametrize("suffix", WRITERS)
@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_damage_gives_an_error_or_a_cloud(tmp_path: Path, suffix: str, data: st.DataObject) -> None:
    path = tmp_path / f"cloud{suffix}"
    WRITERS[suffix](path)
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


def test_a_recording_says_what_was_read(tmp_path: Path) -> None:
    for k in range(7):
        write_pcd(tmp_path / f"{k}.pcd", PointCloud(np.full((k + 1, 3), float(k + 1))))
    whole = read_recording(tmp_path)
    assert whole.is_whole
    assert [header.number for header in whole.headers] == list(whole.numbers) == list(range(7))
    part = read_recording(tmp_path, frames=slice(1, 6, 2))
    assert not part.is_whole
    assert (part.numbers, part.recording.count) == (range(1, 6, 2), 7)
    assert [header.number for header in part.headers] == [1, 3, 5]
    assert {(header.stamp, header.frame_id) for header in part.headers} == {(None, "")}
    cloud = read_cloud(tmp_path, frames=slice(1, 6, 2))
    np.testing.assert_array_equal(part.cloud.xyz, cloud.xyz)
    np.testing.assert_array_equal(part.cloud.frame, np.repeat([1, 3, 5], [2, 4, 6]))
