"""What any reader must do: say what is wrong, drop what is not a return, join frames in order."""

from collections.abc import Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from retropole.base.datatypes import PointCloud
from retropole.base.errors import ReadError
from retropole.io import READERS, read_cloud, read_recording, sha256_of, write_pcd
from retropole.io.beams import guess_sensors, rings_fault, with_trusted_rings
from tests.io.files import INTENSITY, WRITERS, XYZ, make_pcd, make_ply
from tests.tiers import first_of


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


SICK_BITS = {"<f4": (0x7F800001, 0xFF800001, 0x7F7FFFFF), "<f8": (0x7FF0000000000001, 2**64 - 1)}
"""Signalling NaN, with either sign, and the largest number; casting them warns."""

SICK = (float("nan"), -float("inf"), -1e38, 2.0**63, 1e-40)
FIELDS = (*"xyz", "intensity", "ring", "time")


def sick_columns(kind: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Give records of 80 points, a value of which is one that no sensor measures."""
    bits = np.array(SICK_BITS[kind], kind.replace("f", "u")).view(kind)
    values = np.concatenate([bits, np.array(SICK).astype(kind)])
    for k, name in enumerate(FIELDS):
        for value in values:
            table = np.random.default_rng(0).uniform(1, 9, (80, len(FIELDS))).round(1)
            table[:, :3] -= 5.05
            table[:, 4] = np.arange(80) % 16
            points = table.astype(kind)
            points[3, k] = value
            yield name, points


def write_sick(folder: Path, points: NDArray[Any]) -> Iterator[Path]:
    """Write points in every format that holds floats as they are, and as text."""
    kind = points.dtype.str
    names = " ".join(FIELDS)
    np.save(folder / "a.npy", points.view([(name, kind) for name in FIELDS])[:, 0])
    np.savez(folder / "a.npz", **dict(zip(FIELDS, points.T, strict=True)))
    head = f"VERSION 0.7\nFIELDS {names}\nSIZE {' '.join([kind[2]] * 6)}\nTYPE F F F F F F\n"
    head += f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA "
    (folder / "a.pcd").write_bytes(f"{head}binary\n".encode() + points.tobytes())
    head = head.replace("SIZE 4 4 4 4 4 4", "SIZE 4 4 4 4 2 4").replace(
        "F F F F F F", "F F F I U F"
    )
    rows = "".join(" ".join(map(repr, row)) + "\n" for row in points.tolist())
    (folder / "b.pcd").write_text(f"{head}ascii\n{rows}")
    (folder / "a.csv").write_text(f"{names}\n{rows}")
    own = {"4": "float", "8": "double"}[kind[2]]
    head = f"ply\nformat {{}} 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property {own} {name}\n" for name in FIELDS) + "end_header\n"
    (folder / "a.ply").write_bytes(head.format("binary_little_endian").encode() + points.tobytes())
    (folder / "b.ply").write_text(head.format("ascii") + rows)
    (folder / "a.bin").write_bytes(points[:, :4].tobytes())
    (folder / "b.bin").write_bytes(points[:, :5].tobytes())
    yield from (folder / f"{name}" for name in ("a.npy", "a.npz", "a.pcd", "b.pcd", "a.csv"))
    yield from (folder / f"{name}" for name in ("a.ply", "b.ply", "a.bin", "b.bin"))


@pytest.mark.full
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", SICK_BITS)
def test_no_number_of_a_file_is_cast_unchecked(tmp_path: Path, kind: str) -> None:
    """A cast of what does not fit warns, and gives any number."""
    for name, points in sick_columns(kind):
        for path in write_sick(tmp_path, points):
            # Of a .bin, the values decide what it is.
            with suppress(ReadError) if path.suffix == ".bin" else nullcontext():
                cloud = read_cloud(path)
                assert_valid(cloud)
                assert len(cloud) + cloud.dropped == 80, (name, points[3])
                rings_fault(cloud)
                guess_sensors(with_trusted_rings(cloud))


@pytest.mark.parametrize("suffix", first_of(WRITERS, 4))
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
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
