"""Fused clouds and surfels as files, read back by our readers and by laspy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from retropole.base import files
from retropole.base.datatypes import PointCloud
from retropole.base.errors import UsageError
from retropole.base.palette import COLORS
from retropole.export.clouds import (
    SUFFIXES,
    About,
    by_lidar,
    by_value,
    cloud_writer,
    surfel_file,
    topics_of_lidars,
)
from retropole.fusion.merging import NO_RING, Points, fused
from retropole.fusion.surfels import Surfels
from retropole.io import read_cloud

ABOUT = About(
    names=["front", "rear-left ü"],
    frame="target",
    comments=["verdict of the calibration: warn, not_confirmed"],
    has_intensity=True,
    has_ring=True,
    has_time=True,
    is_large=False,
    middle=np.zeros(3),
    is_unix=True,
)
EXTRAS = {".las": "laspy", ".laz": "laspy", ".mcap": "mcap"}


def points_of(seed: int, count: int = 500, lidar: int = 0) -> Points:
    rng = np.random.default_rng(seed)
    return fused(
        PointCloud(
            rng.normal(0, 20, (count, 3)),
            rng.uniform(0, 255, count),
            rng.integers(0, 32, count),
            1.7e9 + rng.uniform(0, 0.1, count),
        ),
        np.eye(4),
        lidar,
    )


def write(path: Path, about: About, *parts: Points) -> Path:
    if path.suffix in EXTRAS:
        pytest.importorskip(EXTRAS[path.suffix])
    with cloud_writer(path, about) as add:
        for k, part in enumerate(parts):
            add(part, 1.7e9 + 0.1 * k)
    return path


@pytest.mark.parametrize("suffix", [each for each in SUFFIXES if each != ".mcap"])
@pytest.mark.parametrize("is_coloured", [False, True])
def test_a_file_holds_all_points_as_they_are(
    suffix: str, is_coloured: bool, tmp_path: Path
) -> None:
    parts = [points_of(k, lidar=k % 2) for k in range(3)]
    every = np.concatenate(parts)
    about = replace(ABOUT, colour=by_lidar if is_coloured else None)
    path = write(tmp_path / f"a{suffix}", about, *parts)
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.xyz, every["xyz"], atol=6e-5)
    assert cloud.ring is not None
    np.testing.assert_array_equal(cloud.ring, every["ring"])
    assert cloud.intensity is not None
    assert cloud.time is not None
    if suffix in (".las", ".laz"):
        # GPS time is ahead of UTC by 18 s, and LAS counts from 1e9 s after its start.
        np.testing.assert_allclose(cloud.time, every["time"] - 315_964_800 + 18 - 1e9, atol=1e-6)
        np.testing.assert_array_equal(cloud.intensity, every["intensity"].round())
    else:
        np.testing.assert_array_equal(cloud.time, every["time"])
        np.testing.assert_array_equal(cloud.intensity, every["intensity"])
    head = path.read_bytes()[:4000]
    assert b"warn, not_confirmed" in head
    assert b"lidar 1: rear-left" in head


def test_las_says_what_other_programs_need(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    parts = [points_of(k, lidar=k) for k in range(2)]
    parts[1]["ring"], parts[1]["intensity"] = NO_RING, np.nan
    about = replace(ABOUT, colour=by_lidar, middle=np.array([691_607.3, 5_334_765.5, 512.4]))
    for part in parts:
        part["xyz"] += about.middle
    las = laspy.read(write(tmp_path / "a.laz", about, *parts))
    assert las.header.version == "1.4"
    assert las.header.point_format.id == 7
    assert las.header.global_encoding.wkt
    assert las.header.offsets.tolist() == [691_607, 5_334_766, 512]
    np.testing.assert_allclose(las.xyz, np.concatenate(parts)["xyz"], atol=6e-5)
    assert las.header.mins == pytest.approx(las.xyz.min(axis=0))
    assert [*np.unique(las.point_source_id)] == [1, 2]
    assert {*las["ring"][500:]} == {NO_RING}
    assert np.isnan(las["raw_intensity"][500:]).all()
    np.testing.assert_array_equal(las["raw_intensity"][:500], parts[0]["intensity"])
    assert {*las.return_number, *las.number_of_returns} == {1}
    assert hex(las.red[0] >> 8)[2:] == f"{int(COLORS[0][1:3], 16):x}"


def test_las_stretches_intensities_from_0_to_1(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    points = points_of(1)
    points["intensity"] /= 255
    las = laspy.read(write(tmp_path / "a.las", replace(ABOUT, intensity_scale=65_535.0), points))
    np.testing.assert_allclose(las.intensity / 65_535, points["intensity"], atol=1e-5)


def test_what_is_too_far_for_las_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    points = points_of(1)
    points["xyz"][3] = 3e5
    with pytest.raises(UsageError, match="remove it with --crop"):
        write(tmp_path / "a.las", ABOUT, points)
    assert [*tmp_path.iterdir()] == []


def test_mcap_has_a_message_for_each_sweep_in_one_frame(tmp_path: Path) -> None:
    parts = [points_of(k, lidar=k % 2) for k in range(4)]
    path = write(tmp_path / "a.mcap", ABOUT, *parts)
    topics = topics_of_lidars(ABOUT.names)
    assert topics == ["/front/points", "/rear_left__/points"]
    for k, topic in enumerate(topics):
        cloud = read_cloud(path, topic=topic)
        own = np.concatenate(parts[k::2])
        np.testing.assert_allclose(cloud.xyz, own["xyz"], atol=1e-5)
        assert cloud.time is not None
        np.testing.assert_array_equal(cloud.time, own["time"])
        assert cloud.recorded == pytest.approx((1.7e9 + 0.1 * k, 1.7e9 + 0.1 * (k + 2)))
    from mcap.reader import make_reader

    with path.open("rb") as file:
        (note, *_) = make_reader(file).iter_metadata()
    assert "verdict of the calibration: warn, not_confirmed" in note.metadata.values()


def test_topics_are_distinguished() -> None:
    assert topics_of_lidars(["a-b", "a b", "7"]) == [
        "/a_b/points",
        "/a_b_1/points",
        "/lidar_7/points",
    ]


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("before", [None, b"older"])
def test_what_is_interrupted_leaves_nothing_half_written(
    suffix: str, before: bytes | None, tmp_path: Path
) -> None:
    path = tmp_path / f"a{suffix}"
    if suffix in EXTRAS:
        pytest.importorskip(EXTRAS[suffix])
    if before is not None:
        path.write_bytes(before)

    def interrupted() -> None:
        with cloud_writer(path, ABOUT) as add:
            add(points_of(1), 0.0)
            # Whoever ends the process at once finds it here.
            assert [Path(name).exists() for name in files.unfinished] == [True]
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [each.read_bytes() for each in tmp_path.iterdir()] == [before] * (before is not None)
    assert not files.unfinished


def test_other_suffixes_are_refused(tmp_path: Path) -> None:
    with (
        pytest.raises(UsageError, match=r"expected one of \.ply"),
        cloud_writer(tmp_path / "a.xyz", ABOUT),
    ):
        pass


def test_large_coordinates_are_float64(tmp_path: Path) -> None:
    points = points_of(1)
    points["xyz"] += [691_607.3, 5_334_765.5, 512.4]
    for suffix in (".ply", ".pcd"):
        path = write(tmp_path / f"a{suffix}", replace(ABOUT, is_large=True), points)
        np.testing.assert_array_equal(read_cloud(path).xyz, points["xyz"])


def test_values_are_coloured_from_low_to_high() -> None:
    colours = by_value(np.array([0.0, 1.0, -5.0, 9.0, np.nan]), 0.0, 1.0)
    assert colours[0].tolist() == colours[2].tolist() == [68, 1, 84]
    assert colours[1].tolist() == colours[3].tolist() == [253, 231, 37]
    assert colours[4].tolist() == [0, 0, 0]


@pytest.mark.parametrize("lidars", [3, 2**31])
def test_surfels_are_ply_with_normals(lidars: int, tmp_path: Path) -> None:
    one = np.ones(4)
    xyz = np.arange(12.0).reshape(4, 3)
    normals = np.tile([0.0, 0.6, 0.8], (4, 1))
    count, bits = np.arange(4), np.full(4, lidars)
    made = Surfels(xyz, normals, 0.5 * one, 0.01 * one, 7 * one, count, bits)
    difference = np.array([np.nan, 0.0, 0.02, -0.02])
    path = tmp_path / "a.ply"
    path.write_bytes(surfel_file(made, difference, ["verdict: ok"]))
    rows = records(path)
    np.testing.assert_array_equal(np.column_stack([rows[n] for n in "xyz"]), xyz)
    np.testing.assert_allclose(np.column_stack([rows[n] for n in ("nx", "ny", "nz")]), normals)
    assert rows["lidars"].tolist() == [lidars] * 4
    np.testing.assert_allclose(rows["distance"], difference.astype(np.float32))
    # Dark, grey, orange in front, blue behind.
    assert rows["red"].tolist() == [90, 230, 213, 0]
    np.testing.assert_allclose(rows["radius"], 0.5)
    np.testing.assert_array_equal(read_cloud(path).xyz, xyz[1:] if not xyz[0].any() else xyz)


def records(path: Path) -> Any:
    """Read the vertices of a binary PLY by its own header."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    kinds = {"float": "f4", "double": "f8", "uchar": "u1", "ushort": "u2", "uint": "u4"}
    lines = [line.split() for line in head.decode().splitlines()]
    fields = [(w[2], "<" + kinds[w[1]]) for w in lines if w[0] == "property"]
    (count,) = [int(w[2]) for w in lines if w[:2] == ["element", "vertex"]]
    found = np.frombuffer(body, fields)
    assert len(found) == count
    return found
