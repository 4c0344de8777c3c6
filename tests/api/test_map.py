"""A LiDAR in a map: found in the map's own coordinates, wherever its origin is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import retropole as rp
from retropole.api.checking import check_recordings, read_stored
from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import UsageError
from retropole.base.sensors import find_sensor
from retropole.io import write_pcd
from retropole.simulation import scan
from retropole.simulation.scenes import SURROUNDINGS


def assert_near(T: np.ndarray, other: np.ndarray, degrees: float, metres: float) -> None:
    off = se3.difference(T, other)
    assert off.rotation < np.radians(degrees)
    assert off.translation < metres


ORIGIN = np.array([412_000.0, 5_654_000.0, 90.0])


def place(origin: np.ndarray) -> tuple[PointCloud, PointCloud, np.ndarray]:
    """A map of three LiDARs, a fourth one's cloud, and its pose in the map."""
    rng = np.random.default_rng(5)
    surfaces = SURROUNDINGS["harbor"](rng).surfaces
    poses = [
        se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, turn])), np.array([x, y, 2.5]))
        for turn, x, y in ((0.3, -6.0, 1.0), (2.0, 5.0, -2.0), (4.0, 0.0, 4.0), (1.0, 1.0, -1.0))
    ]
    sensor = find_sensor("XT32")
    clouds = [scan(surfaces, sensor, pose, rng).cloud for pose in poses]
    seen = [se3.apply(pose, each.xyz) for pose, each in zip(poses[:3], clouds, strict=False)]
    return (
        PointCloud(np.concatenate(seen) + origin),
        clouds[3],
        se3.from_rt(np.eye(3), origin) @ poses[3],
    )


def options(rough: np.ndarray) -> rp.RunConfig:
    x, y, z = map(float, rough)
    return rp.RunConfig(map=True, prior_xyz=(x, y, z))


@pytest.mark.full
def test_a_lidar_is_found_in_a_map_in_its_coordinates(tmp_path: Path) -> None:
    """As it is in the same map about its origin, and with its errors stated."""
    found, pages = [], []
    for origin in (ORIGIN, np.zeros(3)):
        given, lidar, T = place(origin)
        rough = T[:3, 3] + np.array([1.5, -2.0, 0.5])
        result = rp.calibrate(given, lidar, sensor=("auto", "XT32"), options=options(rough))
        assert result.status != "refused"
        assert result.T_target_source is not None
        assert_near(result.T_target_source, T, degrees=0.05, metres=0.02)
        found.append(se3.from_rt(np.eye(3), -origin) @ result.T_target_source)
        result.save(tmp_path / "out")
        pages.append((tmp_path / "out" / "report.html").stat().st_size)
    # As many points are drawn about either origin.
    assert pages[0] == pytest.approx(pages[1], rel=0.05)
    assert_near(found[0], found[1], degrees=1e-3, metres=1e-3)
    assert result.uncertainty is not None
    named = {(entry.name, entry.sensor) for entry in result.uncertainty.budget}
    assert ("distortion of the map", None) in named
    assert "target" not in {sensor for _, sensor in named}
    stored = read_stored(tmp_path / "out")
    write_pcd(tmp_path / "map.pcd", given)
    push = se3.from_rt(np.eye(3), np.array([0.4, 0.0, 0.0]))
    for T_new, status in ((np.eye(4), "same"), (push, "moved")):
        write_pcd(tmp_path / "new.pcd", replace(lidar, xyz=se3.apply(T_new, lidar.xyz)))
        answer = check_recordings(stored, tmp_path / "map.pcd", tmp_path / "new.pcd")
        assert answer.status == status, answer.reasons


@pytest.mark.full
def test_a_map_of_another_place_is_refused() -> None:
    given, _, T = place(ORIGIN)
    rng = np.random.default_rng(8)
    other = scan(
        SURROUNDINGS["harbor"](rng).surfaces, find_sensor("XT32"), place(np.zeros(3))[2], rng
    ).cloud
    result = rp.calibrate(given, other, sensor=("auto", "XT32"), options=options(T[:3, 3]))
    assert result.status == "refused"


def test_a_place_is_of_use_in_a_map_alone_and_a_map_needs_its_surfaces() -> None:
    with pytest.raises(UsageError, match="--map"):
        rp.calibrate("a.las", "b.pcd", options=rp.RunConfig(prior_xyz=(1.0, 2.0, 3.0)))
    with pytest.raises(UsageError, match="--map-sigma-m"):
        rp.calibrate("a.las", "b.pcd", options=rp.RunConfig(map_sigma_m=0.02))
    with pytest.raises(UsageError, match="--no-refine"):
        rp.calibrate("a.las", "b.pcd", options=rp.RunConfig(map=True, refine=False))
