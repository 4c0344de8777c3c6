"""``retropole certify`` as a user runs it."""

import json
from pathlib import Path

import numpy as np
import pytest

from retropole.simulation import simulate_pair, write_pair
from tests.cli.commands import retropole_here


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("four")
    pair = simulate_pair(
        "corridor",
        np.random.default_rng(5),
        sensor_target="XT32",
        sensor_source="XT32",
        poles=4,
    )
    write_pair(pair, folder)
    return folder


@pytest.mark.full
def test_four_poles_are_tested(four: Path) -> None:
    files = four / "lidar0.pcd", four / "lidar1.pcd"
    named = "--sensor", "XT32"
    done = retropole_here("certify", *files, *named)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("verdict: pass\n")
    assert "all 6 differences within their limits" in done.stdout
    assert "is not given" not in done.stdout
    unnamed = retropole_here("certify", *files, "--json")
    assert unnamed.returncode == 0
    document = json.loads(unnamed.stdout)
    assert document["status"] == "pass"
    assert len(document["pairs"][0]["distances"]) == 6
    assert [each["sensor"] for each in document["inputs"]] == ["auto", "auto"]


def test_two_poles_are_refused_with_the_reason(scene: Path) -> None:
    files = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here("certify", *files)
    assert done.returncode == 3
    assert done.stdout.startswith("verdict: refused\n  too_few_distances: 1 distance")
    assert "what to do: " in done.stdout
    quiet = retropole_here("certify", *files, "-q")
    assert (quiet.returncode, quiet.stdout) == (3, "")
    assert "too_few_distances" in quiet.stderr


def test_recordings_are_given_one_way(scene: Path) -> None:
    file = scene / "lidar0.pcd"
    assert retropole_here("certify").returncode == 2
    assert retropole_here("certify", file).returncode == 2
    assert retropole_here("certify", file, file, "--placement", file, file).returncode == 2


@pytest.mark.full
def test_every_pair_of_a_site_file_is_tested(four: Path) -> None:
    (four / "site.toml").write_text(
        'name = "quay"\nplacements = ["one"]\n'
        '[[lidar]]\nname = "a"\nsensor = "XT32"\nserial = "SN<1"\nrecordings = ["lidar0.pcd"]\n'
        '[[lidar]]\nname = "b"\nsensor = "XT32"\nrecordings = ["lidar1.pcd"]\n'
    )
    done = retropole_here("certify", four / "site.toml", "--out", four / "out")
    assert done.returncode == 0, done.stderr
    assert json.loads((four / "out" / "field-test.json").read_text())["status"] == "pass"
    page = (four / "out" / "field-test.html").read_text()
    for said in ("Pass: the LiDARs measure", "Field test: quay", "SN&lt;1"):
        assert said in page
    assert "all 6 differences within their limits" in done.stdout
    of_folder = retropole_here("certify", four, "--json")
    assert json.loads(of_folder.stdout)["status"] == "pass"
    other = retropole_here("certify", four / "site.toml", "--radius", "0.03")
    assert other.returncode == 2
    assert "--radius: the site file already gives it" in other.stderr
