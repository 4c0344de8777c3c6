"""What a site file may hold, and what its errors name."""

from pathlib import Path

import pytest

from retropole.api.site_file import LARGEST_SITE_FILE, decode_site_file, read_site_file
from retropole.base.errors import ReadError
from retropole.io.fields import Wanted

LIDARS = """
[[lidar]]
name = "mast-a"
recordings = ["a/1.pcd", "a/2.pcd"]
[[lidar]]
name = "mast-b"
recordings = ["b/1.pcd", ""]
"""
HEAD = 'name = "Quay"\nplacements = ["1", "2"]\n'
SURVEY = """
[[surveyed_pole]]
name = "A"
placement = "1"
foot_m = [1.0, 2.0, 0.0]
sigma_m = 0.005
"""
POINT = """
[[control_point]]
name = "P"
at_m = [1, 2, 3]
sigma_m = 0.005
[[control_point.seen]]
lidar = "mast-b"
at_m = [5, 0, 0]
sigma_m = 0.01
"""


def test_a_short_file_takes_what_is_usual() -> None:
    site = decode_site_file((HEAD + LIDARS).encode())
    assert site.poles.radius_m == 0.02
    assert site.reference.lidar is None
    assert site.need is None
    assert [lidar.sensor for lidar in site.lidar] == ["auto", "auto"]
    assert not site.surveyed


def test_a_long_file_is_taken_as_it_stands() -> None:
    poles = "[poles]\nradius_m = 0.03\nradius_sigma_m = 0.001\n[need]\nwithin_cm = 2\n"
    reference = '[reference]\nframe = "enu"\nlatitude_deg = 52\nlongitude_deg = 4\nheight_m = 1\n'
    lidar = (
        '[[lidar]]\nname = "c"\nrecordings = ["c.bag", ""]\nsensor = "VLP-16"\nserial = "7"\n'
        'threshold = 150\nunit = "mm"\ntopic = "/points"\nframes = "0:20"\n'
        'intensity = "echo"\nangles = "units/7.csv"\n'
        "up = [0, 0.1, 1]\nup_sigma_deg = 0.5\n"
    )
    text = HEAD + "max_points = 100000\n" + poles + reference + LIDARS + lidar + SURVEY + POINT
    site = decode_site_file(text.encode(), Path("/quay"))
    assert site.surveyed
    assert site.lidar[2].reading(1000).wanted == Wanted("echo", "/quay/units/7.csv")
    assert site.lidar[2].frames == "0:20"
    assert site.control_point[0].seen[0].lidar == "mast-b"
    assert site.need is not None
    assert site.need.at_m == 30.0


WALK = HEAD.replace('"1", "2"', '"walk"') + "carried = true\n"
WALKED = LIDARS.replace('["a/1.pcd", "a/2.pcd"]', '["a"]').replace('["b/1.pcd", ""]', '["b"]')


def test_a_pole_that_is_carried_goes_with_nothing_of_standing_ones() -> None:
    assert decode_site_file((WALK + WALKED).encode()).carried
    two = HEAD + "carried = true\n" + LIDARS
    of_walk = SURVEY.replace('"1"', '"walk"')
    for text, fault in (
        (two, "expected one placement; there are 2"),
        (WALK + WALKED + of_walk, "surveyed_pole: cannot be used with a pole that is carried"),
        (WALK + WALKED + POINT, "control_point: cannot be used"),
        (WALK + WALKED + "up = [0, 0, 1]\nup_sigma_deg = 1\n", "lidar, up: cannot be used"),
        (WALK + WALKED + "mast_sway_deg = 0.1\n", "lidar, mast_sway_deg: cannot be used"),
        (WALK + "[poles]\nradius_sigma_m = 0.001\n" + WALKED, "radius_sigma_m: cannot be used"),
    ):
        with pytest.raises(ReadError, match=fault):
            decode_site_file(text.encode())


@pytest.mark.parametrize("unit", ["m", "cm", "mm", "ft", "in"])
def test_coordinates_may_be_in_any_unit(unit: str) -> None:
    site = decode_site_file((HEAD + LIDARS + f'unit = "{unit}"').encode())
    assert site.lidar[1].reading(site.max_points).unit == unit


def test_a_sensor_may_be_described_by_a_file_beside_it(tmp_path: Path) -> None:
    (tmp_path / "rear.toml").write_text('like = "XT32"')
    path = tmp_path / "site.toml"
    path.write_text(HEAD + LIDARS + 'sensor = "rear.toml"')
    assert read_site_file(path).lidar[1].sensor == str(tmp_path / "rear.toml")
    (tmp_path / "rear.toml").unlink()
    with pytest.raises(ReadError, match=r"lidar mast-b, sensor: .*rear.toml"):
        read_site_file(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name = ", "is not TOML"),
        ("x = " + "[" * 5000, "is not TOML"),
        ("x = 1" + "0" * 5000, "is not TOML"),
        (HEAD, "missing key lidar"),
        (HEAD + LIDARS.split('[[lidar]]\nname = "mast-b')[0], "lidar: expected a list of length"),
        (HEAD + "pole = 1" + LIDARS, "unknown key pole, expected poles"),
        (HEAD + LIDARS + 'recording = "x"', r"lidar 2 \(mast-b\): unknown key recording, expected"),
        (
            HEAD + "[poles]\nradius_m = 20" + LIDARS,
            r"poles, radius_m: 20 m is not the radius of a pole; 20 mm\?",
        ),
        (HEAD + "[poles]\nradius_m = 0.3" + LIDARS, "poles, radius_m: expected a number <= 0.25"),
        (HEAD + LIDARS + "threshold = nan", r"lidar 2 \(mast-b\), threshold: expected a number"),
        (HEAD + LIDARS + "up = [0, 1]", r"lidar 2 \(mast-b\), up: expected a list of length >= 3"),
        (HEAD + LIDARS + 'unit = "inch"', r"lidar 2 \(mast-b\), unit: invalid enum value 'inch'"),
        (
            HEAD + LIDARS + "up = [0, 0, 1]",
            "lidar mast-b: up and up_sigma_deg must be given together",
        ),
        (HEAD + LIDARS + "up = [0, 0, 0]\nup_sigma_deg = 1", "this vector has zero length"),
        (HEAD + LIDARS + 'sensor = "VLP-17"', "lidar mast-b, sensor: .*VLP-17"),
        (HEAD + LIDARS + 'frames = "a:b"', "lidar mast-b, frames: 'a:b', expected A:B"),
        (HEAD.replace(', "2"', "") + LIDARS, "lidar mast-a, recordings: expected 1, one for each"),
        (HEAD + LIDARS.replace("b/1.pcd", ""), "lidar mast-b, recordings: expected at least one"),
        (HEAD + LIDARS.replace("mast-b", "mast-a"), "lidar, name: 'mast-a' appears twice"),
        (HEAD.replace('"2"', '"1"') + LIDARS, "placements: '1' appears twice"),
        (HEAD.replace("Quay", "Quay\\u0007") + LIDARS, "name: .* is no name"),
        (
            HEAD + '[reference]\nlidar = "mast"' + LIDARS,
            "'mast' is unknown, expected one of mast-a",
        ),
        (HEAD + "[reference]\nepsg = 25832" + LIDARS, r"expected a \[\[surveyed_pole\]\]"),
        (HEAD + '[reference]\nlidar = "mast-a"' + LIDARS + SURVEY, "leave lidar out"),
        (HEAD + '[reference]\nepsg = 25832\nframe = "enu"' + LIDARS + SURVEY, "not both"),
        (HEAD + "[reference]\nlatitude_deg = 3" + LIDARS + SURVEY, "need frame"),
        (
            HEAD + '[reference]\nframe = "enu"\nlatitude_deg = 3' + LIDARS + SURVEY,
            "must be given together",
        ),
        (
            HEAD + LIDARS + SURVEY.replace('"1"', '"3"'),
            "surveyed_pole A, placement: '3' is unknown",
        ),
        (HEAD + LIDARS + SURVEY.replace("foot_m", "#"), "expected foot_m, top_m or both"),
        (HEAD + LIDARS + SURVEY + "top_m = [1, 2, 0]", "foot_m and top_m are the same point"),
        (HEAD + LIDARS + SURVEY.replace("0.005", "0"), r"surveyed_pole 1 \(A\), sigma_m: expected"),
        (
            HEAD + LIDARS + SURVEY.replace("2.0", "inf"),
            r"surveyed_pole 1 \(A\), foot_m 2: expected",
        ),
        (
            HEAD + LIDARS + POINT.replace("mast-b", "x"),
            "control_point P, seen, lidar: 'x' is unknown",
        ),
        (HEAD + LIDARS + POINT.replace("[5,", "[5000,"), r"control_point 1 \(P\), seen 1, at_m 1"),
        (HEAD + "[need]\nwithin_cm = 0" + LIDARS, "need, within_cm: expected a number > 0"),
        (HEAD + LIDARS + "a" + ".a" * 400 + " = 1", "more than 300 dots"),
        ("#" * LARGEST_SITE_FILE + "#", "too long for a site file"),
    ],
)
def test_an_error_names_the_key_and_what_was_expected(text: str, said: str) -> None:
    with pytest.raises(ReadError, match=said):
        decode_site_file(text.encode())


def test_what_is_no_text_is_no_site_file() -> None:
    with pytest.raises(ReadError, match="is not TOML"):
        decode_site_file(b'name = "\xff\xfe"')


def test_errors_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    with pytest.raises(ReadError, match=r"site\.toml: cannot be read"):
        read_site_file(path)
    path.write_text(HEAD)
    with pytest.raises(ReadError, match=r"site\.toml: missing key lidar"):
        read_site_file(path)
