"""From a site file to a site."""

from pathlib import Path

import numpy as np
import pytest

from retropole.api.inputs import Listener, read_input
from retropole.api.site_file import decode_site_file
from retropole.api.site_inputs import offset_of, read_site, repeated, site_of, with_survey
from retropole.base.errors import ReadError
from retropole.io.fields import Wanted
from retropole.result import Reading
from tests.api.site_files import NAMES, recorded, write_site
from tests.io.files import required
from tests.io.packets.sending import angles_of, datagram, pcap, turning

SURVEY = """
[[surveyed_pole]]
name = "A"
placement = "2"
foot_m = [500_012.1234, 5_700_034.5678, 12.25]
top_m = [500_012.1234, 5_700_034.9678, 14.25]
sigma_m = 0.005
[[control_point]]
name = "P"
at_m = [500_020.0, 5_700_040.0, 11.0]
sigma_m = 0.004
[[control_point.seen]]
lidar = "gate"
at_m = [5, 0, 1]
sigma_m = 0.01
"""


def test_recordings_are_read_from_beside_the_file(tmp_path: Path) -> None:
    path = write_site(tmp_path)
    seen: list[str] = []
    read = read_site(path, Listener(on_read=lambda given: seen.append(given.name)))
    site = read.site
    assert [lidar.name for lidar in site.lidars] == list(NAMES)
    assert len(seen) == len(read.inputs) == 5
    assert site.lidars[2].clouds[1] is None
    cloud = site.lidars[1].clouds[0]
    assert cloud is not None
    np.testing.assert_allclose(cloud.xyz, recorded(10).xyz, atol=1e-5)
    assert site.frame.name == "LiDAR mast-a"
    assert not site.frame.surveyed
    documents = read.documents()
    assert (documents[2].lidar, documents[2].placement) == (1, 0)
    assert documents[2].path.endswith("mast-b/1.pcd")
    assert len(read.config.site_sha256) == 64


def test_what_a_lidar_table_says_goes_with_its_clouds(tmp_path: Path) -> None:
    more = 'sensor = "VLP-16"\nthreshold = 120\nserial = "7"\nunit = "cm"\n'
    more += "up = [0, 0, 2]\nup_sigma_deg = 1\n"
    gate = read_site(write_site(tmp_path, more)).site.lidars[2]
    assert gate.sensor is not None
    assert gate.sensor.name == "VLP-16"
    assert (gate.threshold, gate.serial) == (120, "7")
    assert gate.up is not None
    np.testing.assert_array_equal(gate.up.direction, [0, 0, 1])
    assert gate.up.sigma == pytest.approx(np.radians(1))
    assert gate.clouds[0] is not None
    np.testing.assert_allclose(gate.clouds[0].xyz, recorded(20).xyz / 100, atol=1e-6)


def test_packets_and_fields_are_read_as_calibrate_reads_them(tmp_path: Path) -> None:
    path = write_site(tmp_path, 'intensity = "echo"\n')
    text = path.read_text().replace("mast-b/1.pcd", "b.pcap").replace("gate/1.pcd", "gate.npz")
    text = text.replace('name = "mast-b"', 'name = "mast-b"\nangles = "unit.csv"')
    path.write_text(text.replace('"mast-b/2.pcd"', '""'))
    (tmp_path / "b.pcap").write_bytes(pcap([datagram(each) for each in turning("XT16")]))
    unit = angles_of(tmp_path / "unit.csv", 16)
    gate = recorded(20)
    echo = required(gate.intensity)
    np.savez(tmp_path / "gate.npz", xyz=gate.xyz, intensity=np.zeros(200), echo=echo)
    read = read_site(path)
    for at, name, wanted in (
        ((1, 0), "b.pcap", Wanted(angles=str(unit))),
        ((2, 0), "gate.npz", Wanted("echo")),
    ):
        cloud = read.inputs[at].cloud
        own = read_input(tmp_path / name, Reading(wanted=wanted)).cloud
        np.testing.assert_array_equal(cloud.xyz, own.xyz)
        np.testing.assert_array_equal(cloud.intensity, own.intensity)
    assert read.inputs[1, 0].cloud.notes == ("angles of Hesai XT16: unit.csv",)
    np.testing.assert_array_equal(read.inputs[2, 0].cloud.intensity, echo)
    documents = {(each.lidar, each.placement): each for each in read.documents()}
    assert documents[1, 0].reading(1000).wanted == Wanted(angles=str(unit))
    assert documents[2, 0].reading(1000).wanted == Wanted("echo")
    path.write_text(path.read_text().replace('"echo"', '"range"'))
    with pytest.raises(ReadError, match=r"lidar gate, .*range: no such field; .*intensity, echo"):
        read_site(path)
    path.write_text(path.read_text() + 'angles = "unit.csv"\n')
    with pytest.raises(ReadError, match=r"lidar gate, placement 1: .*has no packets"):
        read_site(path)


def test_large_coordinates_lose_nothing(tmp_path: Path) -> None:
    site = read_site(write_site(tmp_path, SURVEY)).site
    assert site.frame.surveyed
    assert np.abs(site.frame.offset % 100).max() == 0
    foot = site.poles[0].foot
    assert foot is not None
    assert np.abs(foot).max() <= 100
    assert site.poles[0].placement == 1
    # To a nanometre, half of the last digit of a float64 there.
    np.testing.assert_allclose(
        foot + site.frame.offset, [500_012.1234, 5_700_034.5678, 12.25], rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(site.points[0].at - foot, [7.8766, 5.4322, -1.25], atol=2e-9)
    assert site.points[0].seen[0].lidar == 2


def test_a_survey_about_its_own_origin_has_no_offset(tmp_path: Path) -> None:
    text = write_site(tmp_path, SURVEY.replace("500_0", "").replace("5_700_0", "")).read_bytes()
    np.testing.assert_array_equal(offset_of(decode_site_file(text)), [0, 0, 0])


def test_frames_are_named(tmp_path: Path) -> None:
    text = write_site(tmp_path, SURVEY).read_text()
    enu = '[reference]\nframe = "enu"\nlatitude_deg = 52\nlongitude_deg = 4.5\nheight_m = 7\n'
    for head, name in (
        ("", "local frame of the survey"),
        ('[reference]\nframe = "enu"\n', "ENU"),
        (enu, "ENU at 52, 4.5"),
        ("[reference]\nepsg = 25832\n", "EPSG:25832"),
    ):
        frame = site_of(decode_site_file((text + head).encode()), {}).frame
        assert frame.name == name
        assert frame.epsg == (25832 if "epsg" in head else None)
    frame = site_of(decode_site_file((text + enu).encode()), {}).frame
    assert frame.geodetic is not None
    np.testing.assert_allclose(frame.geodetic.array, [*np.radians([52, 4.5]), 7])


def test_a_survey_in_a_projected_system_is_taken_to_metres_on_the_ground(tmp_path: Path) -> None:
    pytest.importorskip("pyproj", reason="needs the extra world")
    path = write_site(tmp_path, SURVEY + "[reference]\nepsg = 25832\n")
    site = read_site(path).site
    assert site.frame.geodetic is not None
    first, second = site.poles[0].foot, site.points[0].at
    assert first is not None
    grid = np.linalg.norm([7.8766, 5.4322, -1.25])
    assert np.linalg.norm(second - first) / grid == pytest.approx(1 / 0.9996, abs=2e-5)


def test_a_projected_system_that_is_none_is_told_before_any_recording_is_read(
    tmp_path: Path,
) -> None:
    path = write_site(tmp_path, SURVEY + "[reference]\nepsg = 32767\n")
    pytest.importorskip("pyproj", reason="needs the extra world")
    read: list[str] = []
    with pytest.raises(ReadError, match=r"site\.toml: reference, epsg: EPSG:32767 is in no"):
        read_site(path, Listener(on_read=lambda given: read.append(given.name)))
    assert not read


def test_a_point_that_is_too_far_off_is_named(tmp_path: Path) -> None:
    path = write_site(tmp_path, SURVEY.replace("500_020.0", "50_020.0"))
    with pytest.raises(
        ReadError, match=r"site\.toml: control_point P, at_m: lies .* a digit wrong"
    ):
        read_site(path)


def test_a_recording_that_is_missing_is_named_before_any_is_read(tmp_path: Path) -> None:
    path = write_site(tmp_path)
    (tmp_path / "gate" / "1.pcd").unlink()
    read: list[str] = []
    with pytest.raises(ReadError, match=r"lidar gate, placement 1: .*1\.pcd: no such file"):
        read_site(path, Listener(on_read=lambda given: read.append(given.name)))
    assert not read


def test_a_recording_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    path = write_site(tmp_path)
    (tmp_path / "mast-b" / "2.pcd").write_text("nothing")
    with pytest.raises(ReadError, match="lidar mast-b, placement 2: "):
        read_site(path)


def test_one_recording_for_two_is_told(tmp_path: Path) -> None:
    path = write_site(tmp_path)
    read = read_site(path)
    assert repeated(read, read.documents()) is None
    (tmp_path / "mast-b" / "2.pcd").write_bytes((tmp_path / "mast-a" / "1.pcd").read_bytes())
    read = read_site(path)
    reason = repeated(read, read.documents())
    assert reason is not None
    assert reason.code == "same_recording"
    assert "mast-a in placement 1 and mast-b in placement 2" in reason.message


TABLES = """
[[surveyed_pole]]
name = "A"
placement = "1"
foot = "A foot"
top = "A top"
on = "surface"
[[control_point]]
name = "P"
at = "P"
sigma_m = 0.002
[[control_point.seen]]
lidar = "a"
at_m = [5, 0, 0]
sigma_m = 0.01
"""
SURVEYED = """id,north,east,height,sigma_e,sigma_n,sigma_h
A foot,2,1,0.5,0.004,0.005,0.01
A top,2.1,1.1,2.5,0.004,0.006,0.012
P,7,3,1,0.004,0.004,0.004
"""


def test_a_survey_of_a_file_is_that_of_the_site_file(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(SURVEYED)
    head = 'name = "Q"\nplacements = ["1"]\nsurvey = "points.csv"\n'
    lidars = "".join(f'[[lidar]]\nname = "{k}"\nrecordings = ["{k}.pcd"]\n' for k in "ab")
    path = tmp_path / "site.toml"
    file = decode_site_file((head + lidars + TABLES).encode())
    site = site_of(with_survey(file, path), {})
    (pole,), (point,) = site.poles, site.points
    np.testing.assert_array_equal(pole.foot, [1, 2, 0.5])
    np.testing.assert_array_equal(pole.top_sigma, [0.004, 0.006, 0.012])
    assert (pole.sigma, pole.on) == (0.012, "surface")
    # What the site file says of a point goes before what the survey says.
    np.testing.assert_array_equal(point.at, [3, 7, 1])
    assert (point.sigma, point.sigmas) == (0.002, None)
    (tmp_path / "points.csv").write_text(SURVEYED.replace("0.012", "0"))
    with pytest.raises(ReadError, match=r"points.csv: point A top: its 1 σ are .*give sigma_m"):
        with_survey(file, path)
    (tmp_path / "points.csv").write_text(SURVEYED.replace("sigma_h", "note"))
    with pytest.raises(ReadError, match="point A foot: has no 1 σ"):
        with_survey(file, path)
    for old, new, words in (
        ('survey = "points.csv"\n', "", "surveyed_pole A, foot: expected survey"),
        ('survey = "points.csv"\n', 'columns = "id, e, n, h"\n', "columns: expected survey"),
        ('foot = "A foot"', "foot_m = [1, 2, 0.5]", "surveyed_pole A: missing key sigma_m"),
        ('at = "P"', 'at = "P"\nat_m = [1, 2, 3]', "point P: expected at or at_m, not both"),
        ('at = "P"\n', "", "control_point P: expected at_m, or at"),
    ):
        with pytest.raises(ReadError, match=words):
            decode_site_file((head + lidars + TABLES).replace(old, new).encode())
