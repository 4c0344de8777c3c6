"""What is printed of a recording is true of what was written to it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from retropole.api.contents import describe
from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.sensors import SENSORS, auto_threshold
from retropole.io import read_cloud, write_pcd
from retropole.io.beams import guess_sensors
from retropole.report.text import describe_info
from retropole.simulation import simulate_pair
from tests.io.files import required
from tests.paths import SHARED
from tests.tiers import first_of


def scan_of(name: str) -> PointCloud:
    rng = np.random.default_rng(1)
    # Half of the rings of a hemispherical LiDAR see nothing but the sky of a street.
    place = "corridor" if name == "JT128" else "street"
    return simulate_pair(place, rng, sensor_target=name, sensor_source=name).target


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return scan_of("HDL-32E")


def test_a_file_of_one_frame(tmp_path: Path, cloud: PointCloud) -> None:
    write_pcd(tmp_path / "a.pcd", cloud)
    document = describe(tmp_path / "a.pcd")
    read = read_cloud(tmp_path / "a.pcd")
    assert document.topics == []
    (said,) = document.clouds
    assert (said.frames, said.frames_read, said.topic, said.rate_hz) == (1, 1, None, None)
    assert (said.points, said.dropped) == (len(read), read.dropped)
    assert said.fields["x"] == "float32"
    assert said.fields["ring"] == "uint16"
    assert said.rings == 32
    assert said.sensors == ["HDL-32E"]
    ranges = np.linalg.norm(read.xyz - read.origin, axis=1)
    np.testing.assert_allclose(said.range_m, [ranges.min(), np.median(ranges), ranges.max()])
    intensity = said.intensity
    assert intensity is not None
    values, threshold = required(read.intensity), required(intensity.threshold)
    assert threshold == auto_threshold(values).value
    assert intensity.retro_points == np.count_nonzero(values >= threshold)
    assert sum(intensity.counts) == len(read)
    assert len(intensity.bin_edges) == len(intensity.counts) + 1


def test_which_field_the_intensity_is_of(tmp_path: Path, cloud: PointCloud) -> None:
    columns: dict[str, Any] = dict(zip("xyz", cloud.xyz.T, strict=True))
    columns["signal"] = required(cloud.intensity)
    np.savez(tmp_path / "a.npz", **columns, reflectivity=np.full(len(cloud), 7.0))
    found = describe(tmp_path / "a.npz")
    intensity = required(found.clouds[0].intensity)
    assert (intensity.field, intensity.others) == ("signal", ["reflectivity"])
    assert "of the field signal; --intensity reflectivity selects another" in describe_info(found)
    named = required(describe(tmp_path / "a.npz", intensity="reflectivity").clouds[0].intensity)
    assert (named.field, named.others, named.max) == ("reflectivity", ["signal"], 7)
    np.savez(tmp_path / "b.npz", **columns)
    assert "of the field" not in describe_info(describe(tmp_path / "b.npz"))


def test_all_topics_of_a_bag(tmp_path: Path, cloud: PointCloud) -> None:
    pytest.importorskip("apsw", reason="needs rosbags 0.11 to write bags")
    from tests.bags import points_of, write_bag

    points = points_of(cloud)
    path = write_bag(tmp_path, "bag", {"/front": [points] * 5, "/rear": [points[:99]] * 2})
    document = describe(path)
    assert {topic.name: topic.messages for topic in document.topics} == {
        **{"/front": 5, "/rear": 2, "/said": 5}
    }
    front, rear = document.clouds
    assert (front.topic, front.frames, front.frame_id) == ("/front", 5, "lidar")
    assert front.points == 5 * len(cloud)
    assert front.rate_hz == pytest.approx(10)
    assert front.duration_s == pytest.approx(0.4)
    assert (rear.topic, rear.points) == ("/rear", 198)
    (only,) = describe(path, topic="/rear", frames=slice(1)).clouds
    assert (only.topic, only.frames, only.frames_read, only.rate_hz) == ("/rear", 2, 1, None)
    text = describe_info(document)
    for words in ("/front", "10.00 Hz", "float32", "█", "← threshold", "HDL-32E"):
        assert words in text


def test_which_clock_the_times_are_of(tmp_path: Path, cloud: PointCloud) -> None:
    pytest.importorskip("apsw", reason="needs rosbags 0.11 to write bags")
    from tests.bags import points_of, write_bag

    points = [points_of(cloud.select(np.arange(50)))] * 2
    ahead = {"/front": 36.95, "/rear": -0.05}
    document = describe(write_bag(tmp_path, "mcap", dict.fromkeys(ahead, points), ahead=ahead))
    assert [each.clock_offset_s for each in document.clouds] == pytest.approx([36.95, -0.05])
    text = " ".join(describe_info(document).split())
    assert "clock is 37.0 s ahead of the recorder's, as TAI (PTP) is ahead of UTC (NTP)" in text
    assert "clock agrees with the recorder's within 0.5 s" in text
    write_pcd(tmp_path / "a.pcd", cloud)
    assert describe(tmp_path / "a.pcd").clouds[0].clock_offset_s is None
    assert "\nclock" not in describe_info(describe(tmp_path / "a.pcd"))


def test_no_intensity_and_one_for_all(tmp_path: Path, cloud: PointCloud) -> None:
    write_pcd(tmp_path / "none.pcd", replace(cloud, intensity=None))
    assert describe(tmp_path / "none.pcd").clouds[0].intensity is None
    write_pcd(tmp_path / "same.pcd", replace(cloud, intensity=np.full(len(cloud), 7.0)))
    said = describe(tmp_path / "same.pcd").clouds[0].intensity
    assert said is not None
    assert (said.threshold, said.retro_points, sum(said.counts)) == (None, 0, len(cloud))
    for name in ("none.pcd", "same.pcd"):
        assert "tape cannot be distinguished" in describe_info(describe(tmp_path / name))


@pytest.mark.parametrize("name", first_of([n for n, own in SENSORS.items() if own.rings], 5))
@pytest.mark.parametrize("direction", first_of([1, -1]))
def test_a_sensor_is_among_those_its_rings_fit(name: str, direction: int) -> None:
    scan = scan_of(name)
    assert scan.ring is not None
    # Manufacturers count rings from below or from above.
    ring = scan.ring if direction == 1 else len(SENSORS[name].elevations) - 1 - scan.ring
    fitting = guess_sensors(replace(scan, ring=ring))
    assert name in fitting
    for other in fitting:
        np.testing.assert_allclose(
            SENSORS[other].elevations, SENSORS[name].elevations, atol=np.radians(0.6)
        )


def test_without_rings_only_beams_far_apart_tell(cloud: PointCloud) -> None:
    assert guess_sensors(replace(cloud, ring=None)) == ["HDL-32E"]
    assert guess_sensors(replace(scan_of("OS1"), ring=None)) == []


def test_unknown_rather_than_a_wild_guess(cloud: PointCloud) -> None:
    turn = se3.from_rt(se3.exp_so3(np.array([0.2, 0.1, 0.0])), np.zeros(3))
    rotated = replace(cloud, xyz=se3.apply(turn, cloud.xyz))
    assert guess_sensors(rotated) == ["HDL-32E"], "the rings tell where the beams started"
    assert guess_sensors(replace(rotated, ring=None)) == []
    assert guess_sensors(scan_of("Mid-360")) == []
    rng = np.random.default_rng(0)
    assert guess_sensors(PointCloud(rng.uniform(-9, 9, (5000, 3)))) == []


@pytest.mark.parametrize(
    ("name", "sensors"),
    [
        ("formats/velodyne/sample_velodyne_hdl32.pcap", ["HDL-32E"]),
        ("formats/velodyne/sample_velodyne_vlp16_gps.pcap", ["VLP-16", "RS-LiDAR-16", "C16"]),
        ("pandar_0001/top.pcd", ["Pandar64"]),
        ("formats/mcap/test.mcap", []),
        ("pandaset/pandaset002_00_pandargt.pcd", []),
    ],
)
@pytest.mark.full
def test_sensors_of_real_recordings(name: str, sensors: list[str]) -> None:
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    assert guess_sensors(read_cloud(path)) == sensors
