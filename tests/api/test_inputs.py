"""What may be given for a cloud, and what is said of the rest."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import retropole as rp
from retropole.api.inputs import input_documents, read_input
from retropole.export.recording import Track, write_recording
from retropole.io import Frame, sha256_of, write_pcd
from retropole.io.recordings import FrameHeader
from retropole.result import Reading
from tests.api.clouds import cloud_of

TABLE = np.array([[1.5, 2.0, 3.25, 10], [-4.0, 5.5, 6.0, 20], [7.0, -8.0, 9.0, 255]])


class HasArray:
    """What other libraries' arrays look like to NumPy."""

    def __array__(self, dtype: Any = None, copy: Any = None) -> NDArray[np.float64]:
        return TABLE


@pytest.mark.parametrize(
    "given",
    [TABLE, TABLE.astype("f4"), np.asfortranarray(TABLE), HasArray(), cloud_of(TABLE)],
    ids=["float64", "float32", "columns", "other", "cloud"],
)
def test_arrays_and_clouds_of_all_kinds(given: NDArray[np.float64]) -> None:
    cloud = read_input(given).cloud
    assert cloud.xyz.dtype == np.float64
    np.testing.assert_array_equal(cloud.xyz, TABLE[:, :3])
    np.testing.assert_array_equal(cloud.intensity, TABLE[:, 3])
    assert cloud.dropped == 0


def test_whole_numbers_and_named_fields() -> None:
    np.testing.assert_array_equal(read_input(np.ones((2, 3), int)).cloud.xyz, np.ones((2, 3)))
    points = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("reflectivity", "u1")])
    points["x"], points["reflectivity"] = 1, [1, 2, 3]
    cloud = read_input(points).cloud
    np.testing.assert_array_equal(cloud.intensity, [1, 2, 3])


@pytest.mark.parametrize(
    "array",
    [
        np.ones((5, 2)),
        np.ones((5, 5)),
        np.ones(12),
        np.ones((2, 5, 4)),
        np.array(1.0),
        np.zeros((0, 4)),
        np.array([["a", "b", "c"]]),
        np.ones((5, 3), complex),
        np.full((5, 3), None),
    ],
    ids=lambda array: f"{array.dtype}{array.shape}",
)
def test_arrays_of_another_shape_say_what_is_expected(array: NDArray[Any]) -> None:
    with pytest.raises(rp.UsageError) as caught:
        rp.detect(array)
    message = str(caught.value)
    assert str(array.shape) in message
    assert "(N, 3)" in message
    assert "(N, 4)" in message


@pytest.mark.parametrize("given", [None, 3.0, {"x": 1}, [1, 2, 3], [[1.0, 2.0, 3.0, 4.0]]])
def test_what_is_no_cloud_is_named(given: object) -> None:
    with pytest.raises(rp.UsageError, match=r"expected a path, a PointCloud, or an array"):
        rp.calibrate(given, given)  # type: ignore[arg-type]


@pytest.mark.parametrize("row", [[np.nan] * 4, [0.0, 0, 0, 9]])
def test_nothing_but_what_is_no_return(row: list[float]) -> None:
    table = np.array([row] * 4)
    for given in (table, cloud_of(table)):
        with pytest.raises(rp.UsageError, match="none of its 4 points is finite"):
            read_input(given)


def test_clouds_are_made_sound() -> None:
    table = np.vstack([TABLE, [1, np.nan, 1, 5], [0, 0, 0, 5], [2, 2, 2, np.nan]])
    ring = np.arange(6)
    given = replace(cloud_of(table), ring=ring, dropped=1)
    cloud = read_input(given).cloud
    np.testing.assert_array_equal(cloud.ring, [0, 1, 2, 5])
    np.testing.assert_array_equal(cloud.intensity, [10, 20, 255, 0])
    assert cloud.dropped == 3
    sound = cloud_of(TABLE)
    assert read_input(sound).cloud is sound


def test_documents_say_where_clouds_come_from(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    write_pcd(path, cloud_of(TABLE))
    named = replace(cloud_of(TABLE), source="robot/front")
    given = [read_input(each) for each in (path, TABLE, cloud_of(TABLE), named)]
    of_file, of_array, of_cloud, of_named = input_documents(given)
    assert (of_file.path, of_file.sha256) == (str(path), sha256_of(path))
    assert of_array.path == of_cloud.path == "<array>"
    assert of_array.sha256 == hashlib.sha256(TABLE.tobytes()).hexdigest()
    assert of_named.path == "robot/front"
    changed = input_documents([read_input(TABLE + 1e-9), read_input(cloud_of(TABLE + 1e-9))])
    assert changed[0].sha256 != of_array.sha256
    assert changed[1].sha256 != of_cloud.sha256
    assert {each.points for each in (of_file, of_array, of_cloud, of_named)} == {3}


def test_a_file_is_hashed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hashed: list[str] = []

    def note(path: str) -> str:
        hashed.append(path)
        return ""

    monkeypatch.setattr("retropole.api.inputs.sha256_of", note)
    write_pcd(tmp_path / "a.pcd", cloud_of(TABLE))
    input_documents([read_input(tmp_path / "a.pcd")] * 4)
    assert hashed == [str(tmp_path / "a.pcd")]


@pytest.mark.parametrize(
    ("frames", "name"),
    [(("front", "front"), "front"), (("front", "other"), ""), (("a\nb", "a\nb"), ""), (("",), "")],
)
def test_a_document_has_the_frame_that_a_recording_names(
    frames: tuple[str, ...], name: str, tmp_path: Path
) -> None:
    pytest.importorskip("mcap")
    path = tmp_path / "a.mcap"
    cloud = cloud_of(TABLE)
    path.write_bytes(
        write_recording(
            {f"/points{k}": Track(each, [Frame(0, cloud)]) for k, each in enumerate(frames)}
        )
    )
    given = read_input(path, Reading(topic="/points0"))
    assert given.read is not None
    headers = tuple(FrameHeader(k, None, each) for k, each in enumerate(frames))
    (document,) = input_documents([replace(given, read=replace(given.read, headers=headers))])
    assert document.frame_id == name
    write_pcd(tmp_path / "a.pcd", cloud)
    assert input_documents([read_input(tmp_path / "a.pcd")])[0].frame_id == ""
