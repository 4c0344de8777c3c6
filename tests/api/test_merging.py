"""Clouds of a pair and of sites merged, at the coordinates that they have."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

import retropole as rp
from retropole.api.leveling import level_result
from retropole.api.merging import merge, placed
from retropole.base import se3
from retropole.base.datatypes import Array, PointCloud
from retropole.base.errors import ReadError, Refusal, UsageError
from retropole.io import read_cloud, sha256_of, write_pcd
from retropole.result import LEVEL_FILE, InputDoc, ReasonDoc, encode
from retropole.result.site import SiteDoc
from retropole.simulation import simulate_pair, simulate_site
from retropole.simulation.writing import write_site as write_simulated
from tests.api.clouds import calibrated
from tests.api.site_files import recorded
from tests.export import sites
from tests.results import result_of

T = se3.from_rt(se3.rotation_from_rpy(np.array([0.1, -0.2, 2.0])), np.array([1.0, 2.0, 0.5]))


def write_pair(folder: Path, *, status: str = "warn", sweeps: int = 0) -> Path:
    """Write two recordings, with times and rings, and a result that names them."""
    inputs = []
    for k, name in enumerate(("front", "rear")):
        cloud = recorded(k)
        path = folder / f"{name}.pcd"
        if sweeps:
            path = folder / name
            path.mkdir()
            for n in range(sweeps):
                write_pcd(path / f"{n}.pcd", recorded(10 * n + k))
        else:
            write_pcd(path, cloud)
        inputs.append(InputDoc(path.name, sha256_of(path), 200, 0, "auto", None))
    reasons = [] if status == "ok" else [ReasonDoc("not_confirmed", "not confirmed at all", {})]
    pose = None if status == "refused" else T
    document = result_of(status, reasons, pose, np.eye(6) * 1e-6)  # type: ignore[arg-type]
    file = folder / "result.json"
    file.write_bytes(encode(structs.replace(document, inputs=inputs)))
    return file


def in_target(folder: Path, sweeps: int = 0) -> Array:
    """All points in the frame of the target, the target's first."""
    names = [f"{name}/{n}.pcd" for n in range(sweeps) for name in ("front", "rear")]
    clouds = [read_cloud(folder / name) for name in names or ("front.pcd", "rear.pcd")]
    return np.concatenate(
        [cloud.xyz if k % 2 == 0 else se3.apply(T, cloud.xyz) for k, cloud in enumerate(clouds)]
    )


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".laz"])
def test_a_pair_is_merged_in_the_frame_of_the_target(suffix: str, tmp_path: Path) -> None:
    file, out = write_pair(tmp_path), tmp_path / f"out/a{suffix}"
    if suffix == ".laz":
        pytest.importorskip("laspy")
    merged = merge(tmp_path, out=out)
    np.testing.assert_allclose(read_cloud(out).xyz, in_target(tmp_path), atol=1e-3)
    assert merged.frame == "target"
    assert merged.points == [200, 200]
    assert merged.written == 400
    assert merged.notes == []
    assert [each.code for each in merged.reasons] == ["not_confirmed"]
    assert b"warning (not_confirmed): not confirmed at all" in out.read_bytes()[:4000]
    other = merge(file, out=out, frame="source")
    assert other.frame == "source"
    np.testing.assert_allclose(se3.apply(T, read_cloud(out).xyz), in_target(tmp_path), atol=1e-3)


def test_a_refused_result_merges_nothing(tmp_path: Path) -> None:
    write_pair(tmp_path, status="refused")
    with pytest.raises(Refusal, match="no poses: not confirmed at all"):
        merge(tmp_path, out=tmp_path / "a.ply")
    assert not (tmp_path / "a.ply").exists()


def test_all_sweeps_are_merged_and_some_where_requested(tmp_path: Path) -> None:
    write_pair(tmp_path, sweeps=4)
    out = tmp_path / "a.ply"
    merged = merge(tmp_path, out=out)
    assert merged.sweeps == [4, 4]
    np.testing.assert_allclose(read_cloud(out).xyz, in_target(tmp_path, 4), atol=1e-3)
    assert merge(tmp_path, out=out, frames=(1, 3, None)).sweeps == [2, 2]


def test_new_recordings_of_the_lidars_are_reported_to_be_new(tmp_path: Path) -> None:
    write_pair(tmp_path)
    paths = [tmp_path / "a.pcd", tmp_path / "b.pcd"]
    for k, path in enumerate(paths):
        write_pcd(path, recorded(20 + k))
    out = tmp_path / "a.ply"
    merged = merge(tmp_path, paths, out=out)
    (note,) = merged.notes
    assert note.startswith("target, source: not the recordings of the calibration")
    assert b"not the recordings of the calibration" in out.read_bytes()[:2000]
    clouds = [read_cloud(path).xyz for path in paths]
    expected = np.concatenate([clouds[0], se3.apply(T, clouds[1])])
    np.testing.assert_allclose(read_cloud(out).xyz, expected, atol=1e-3)
    alone = merge(tmp_path, {"source": paths[1]}, out=out)
    assert alone.points == [0, 200]
    assert "target: no recording is given, left out" in alone.notes
    with pytest.raises(UsageError, match="no LiDAR is called 'rear'; there are target, source"):
        merge(tmp_path, {"rear": paths[1]}, out=out)
    # Those of the run, wherever they are, are no others.
    moved = tmp_path / "moved.pcd"
    (tmp_path / "rear.pcd").rename(moved)
    assert merge(tmp_path, [tmp_path / "front.pcd", moved], out=out).notes == []


def test_a_box_is_in_the_frame_that_is_written(tmp_path: Path) -> None:
    write_pair(tmp_path)
    box, out = np.array([[0.0, -np.inf, -5.0], [np.inf, np.inf, 5.0]]), tmp_path / "a.ply"
    merged = merge(tmp_path, out=out, crop=box)
    every = in_target(tmp_path)
    inside = (every[:, 0] >= 0) & (np.abs(every[:, 2]) <= 5)
    assert merged.written == inside.sum()
    np.testing.assert_allclose(read_cloud(out).xyz, every[inside], atol=1e-3)
    with pytest.raises(UsageError, match="no point is left"):
        merge(tmp_path, out=tmp_path / "b.ply", crop=box + 1e6)
    assert not (tmp_path / "b.ply").exists()


def test_voxels_are_of_all_lidars_together(tmp_path: Path) -> None:
    write_pair(tmp_path, sweeps=3)
    out = tmp_path / "a.ply"
    merged = merge(tmp_path, out=out, voxel=4.0)
    cells = np.unique(np.floor(in_target(tmp_path, 3) / 4.0), axis=0)
    assert merged.written == len(cells)
    assert sum(merged.points) == 1200


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"out": "a.laz", "surfels": 0.3}, "surfels are written as .ply"),
        ({"surfels": 0.3, "voxel": 0.1}, "surfels use all points"),
        ({"out": "a.mcap", "voxel": 0.1}, "MCAP stores the sweeps one by one"),
        ({"out": "a.ply", "frame": "site"}, "no frame is named 'site'; there are target, source"),
        ({"out": "a.ply", "frame": "map"}, "the result has no frame map"),
        ({"out": "a.ply", "frame": "source", "epsg": 25832}, "--crs belongs to the frame map"),
        ({"out": "a.ply", "epsg": 25832}, "has no known position on the earth"),
        ({"out": "a.xyz"}, "unknown suffix"),
        ({}, "give a file to write"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    asked: dict[str, object], words: str, tmp_path: Path
) -> None:
    write_pair(tmp_path)
    sites.with_pyproj()
    if "out" in asked:
        asked = asked | {"out": tmp_path / str(asked["out"])}
    with pytest.raises((UsageError, ReadError), match=words):
        merge(tmp_path, **asked)  # type: ignore[arg-type]
    assert {p.name for p in tmp_path.iterdir()} == {"result.json", "front.pcd", "rear.pcd"}


def write_made_up(folder: Path, document: SiteDoc) -> dict[str, Path]:
    (folder / "site-result.json").write_bytes(encode(document))
    paths = {each.name: folder / f"{k}.pcd" for k, each in enumerate(document.lidars)}
    for k, path in enumerate(paths.values()):
        write_pcd(path, recorded(k))
    return paths


def by_pyproj(document: SiteDoc, xyz: Array, epsg: int) -> Array:
    """Places of the site in a projected system, through earth-centred coordinates by PROJ."""
    from pyproj import Transformer

    at = document.frame.geodetic
    assert at is not None
    lat, lon = np.degrees([at.latitude_rad, at.longitude_rad])
    steps = (
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=GRS80 +lat_0={lat} +lon_0={lon} "
        f"+h_0={at.height_m} +step +inv +proj=cart +ellps=GRS80 "
        f"+step +proj=utm +zone={epsg % 100} +ellps=GRS80"
    )
    return np.column_stack(Transformer.from_pipeline(steps).transform(*xyz.T))


@pytest.mark.parametrize("epsg", [None, 25833])
def test_a_site_in_utm_is_where_proj_says(epsg: int | None, tmp_path: Path) -> None:
    sites.with_pyproj()
    laspy = pytest.importorskip("laspy")
    from pyproj import CRS

    document = sites.in_utm()
    paths = write_made_up(tmp_path, document)
    merged = merge(tmp_path, paths, out=tmp_path / "a.laz", epsg=epsg)
    code = epsg or sites.UTM
    assert (merged.frame, merged.epsg) == ("map", code)
    las = laspy.read(tmp_path / "a.laz")
    in_site = np.concatenate(
        [
            se3.apply(np.array(lidar.T_site_lidar), read_cloud(paths[lidar.name]).xyz)
            for lidar in document.lidars
        ]
    )
    expected = by_pyproj(document, in_site, code)
    np.testing.assert_allclose(np.array(las.xyz), expected, atol=1e-3)
    assert CRS(las.header.parse_crs()).to_epsg() == code
    # The same as an array of a cloud's float64, in the frame of the site unless it is named.
    merge(tmp_path, paths, out=tmp_path / "a.ply", frame="map" if epsg is None else "", epsg=epsg)
    np.testing.assert_allclose(read_cloud(tmp_path / "a.ply").xyz, expected, atol=1e-6)
    assert merge(tmp_path, paths, out=tmp_path / "a.ply").frame == "site"
    np.testing.assert_allclose(read_cloud(tmp_path / "a.ply").xyz, in_site, atol=1e-4)


def test_a_system_of_another_continent_is_refused(tmp_path: Path) -> None:
    sites.with_pyproj()
    document = sites.in_utm()
    with pytest.raises(UsageError, match=r"far outside|no way"):
        placed(document, Path(), epsg=26710)
    assert placed(sites.on_plan(), Path(), "map").epsg is None


def test_what_moved_is_left_out(tmp_path: Path) -> None:
    write_pair(tmp_path, status="ok")
    rng = np.random.default_rng(1)
    for name in ("front", "rear"):
        folder = tmp_path / f"{name}s"
        folder.mkdir()
        for k in range(6):
            azimuth, z = rng.uniform(-np.pi, np.pi, 20_000), rng.uniform(-2, 6, 20_000)
            wall = np.c_[20 * np.cos(azimuth), 20 * np.sin(azimuth), z]
            body = rng.uniform(-0.4, 0.4, (300, 3)) + np.array([6, -6 + 2 * k, 0.5])
            write_pcd(folder / f"{k}.pcd", PointCloud(np.concatenate([wall, body])))
    given = [tmp_path / "fronts", tmp_path / "rears"]
    merged = merge(tmp_path, given, out=tmp_path / "a.ply", static=True)
    assert merged.moving == pytest.approx(2 * 6 * 300, rel=0.05)
    assert merged.written == sum(merged.points) - merged.moving
    one = merge(tmp_path, out=tmp_path / "a.ply", static=True)
    assert any("1 sweep do not show what moves" in note for note in one.notes)


def test_surfels_of_a_pair_say_how_far_surfaces_lie_apart(tmp_path: Path) -> None:
    pair = simulate_pair("corridor", np.random.default_rng(100))
    write_pair(tmp_path, status="ok")
    paths = [tmp_path / "a.pcd", tmp_path / "b.pcd"]
    write_pcd(paths[0], pair.target)
    # 1 cm along the vertical of the target, beside the true pose that the result has not.
    moved = se3.from_rt(np.eye(3), np.array([0, 0, 0.01])) @ pair.T_target_source
    write_pcd(paths[1], pair.source.transformed(se3.inverse(T) @ moved))
    merged = merge(tmp_path, paths, out=tmp_path / "s.ply", surfels=0.3)
    assert {each.kind for each in merged.distances} >= {"ground", "walls"}
    for each in merged.distances:
        if each.kind == "ground":
            assert each.median_signed_m == pytest.approx(0.01, abs=0.003)
    assert merged.surfels is not None
    assert merged.written == len(merged.surfels.centres) == len(read_cloud(tmp_path / "s.ply"))
    assert "ground" in merged.surfaces[0]
    assert merge(tmp_path, paths, surfels=0.3).distances == merged.distances


@pytest.mark.full
def test_a_calibrated_pair_lies_where_the_truth_is(tmp_path: Path) -> None:
    result = calibrated()
    result.save(tmp_path)
    document = result.document
    pose = document.T_target_source
    assert pose is not None
    with pytest.raises(ReadError, match="was an array"):
        merge(tmp_path, out=tmp_path / "a.ply")
    cloud = recorded(1)
    write_pcd(tmp_path / "a.pcd", cloud)
    write_pcd(tmp_path / "b.pcd", cloud)
    out = tmp_path / "m.ply"
    merge(tmp_path, [tmp_path / "a.pcd", tmp_path / "b.pcd"], out=out)
    own = read_cloud(tmp_path / "a.pcd").xyz
    expected = np.concatenate([own, se3.apply(np.array(pose), own)])
    np.testing.assert_allclose(read_cloud(out).xyz, expected, atol=1e-4)


@pytest.mark.full
def test_a_simulated_site_of_four_is_merged_where_it_was_calibrated(tmp_path: Path) -> None:
    import retropole as rp

    laspy = pytest.importorskip("laspy")
    site = simulate_site("posts", np.random.default_rng(1), lidars=4, placements=1)
    write_simulated(site, tmp_path / "s")
    result = rp.calibrate_site(tmp_path / "s")
    result.save(tmp_path / "out")
    merged = merge(tmp_path / "out", out=tmp_path / "a.laz", surfels=None)
    poses = [np.array(each.T_site_lidar) for each in result.document.lidars]
    clouds = [own[0] for own in site.clouds if own[0] is not None]
    expected = [se3.apply(pose, cloud.xyz) for pose, cloud in zip(poses, clouds, strict=True)]
    las = laspy.read(tmp_path / "a.laz")
    for k, own in enumerate(expected, 1):
        np.testing.assert_allclose(np.array(las.xyz)[las.point_source_id == k], own, atol=1e-3)
    assert merged.frame == "site"
    # The LiDARs see one ground, in an adjustment that is good to some millimetres.
    found = merge(tmp_path / "out", surfels=0.3).distances
    assert len({each.lidars for each in found}) >= 3
    grounds = [each.median_m for each in found if each.kind == "ground" and each.surfels > 50]
    assert max(grounds) < 0.03
    assert json.loads((tmp_path / "out/site-result.json").read_text())["status"] != "refused"


def test_units_of_the_run_are_those_of_the_merge(tmp_path: Path) -> None:
    file = write_pair(tmp_path, status="ok")
    for name in ("front", "rear"):
        cloud = read_cloud(tmp_path / f"{name}.pcd")
        write_pcd(tmp_path / f"{name}.pcd", replace(cloud, xyz=1000 * cloud.xyz))
    text = json.loads(file.read_text())
    text["config"]["unit"] = "mm"
    file.write_text(json.dumps(text))
    merged = merge(tmp_path, out=tmp_path / "a.ply")
    assert np.abs(read_cloud(tmp_path / "a.ply").xyz).max() < 50
    assert any("not the file that the run read" in note for note in merged.notes)


@pytest.mark.full
def test_the_ground_is_that_of_its_own_result(tmp_path: Path) -> None:
    street = simulate_pair("street", np.random.default_rng(2), sensor_target="VLP-16")
    rp.calibrate(street.target, street.source, options=rp.RunConfig(refine=False)).save(tmp_path)
    paths = [tmp_path / "a.pcd", tmp_path / "b.pcd"]
    write_pcd(paths[0], street.target)
    write_pcd(paths[1], street.source)
    out = tmp_path / "g.ply"
    with pytest.raises(UsageError, match="retropole level"):
        merge(tmp_path, paths, out=out, frame="ground")
    document, _ = level_result(tmp_path, paths)
    (tmp_path / LEVEL_FILE).write_bytes(encode(document))
    merge(tmp_path, paths, out=out, frame="ground")
    T = document.T_ground_frame
    first = read_cloud(out).xyz[: len(street.target)]
    np.testing.assert_allclose(first, se3.apply(T, street.target.xyz), atol=1e-3)
    # The lowest tenth lies on the ground.
    assert abs(np.quantile(first[:, 2], 0.1)) < 0.1
    moved = structs.replace(document, T_ground_frame=np.eye(4))
    (tmp_path / LEVEL_FILE).write_bytes(encode(moved))
    with pytest.raises(UsageError, match="another result"):
        merge(tmp_path, paths, out=out, frame="ground")
