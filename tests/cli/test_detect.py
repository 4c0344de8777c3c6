"""``retropole detect`` and ``retropole info`` as a user runs them."""

import json
from pathlib import Path
from xml.etree import ElementTree

import pytest

from retropole.io import read_cloud, write_pcd
from tests.cli.commands import retropole_here

pytestmark = pytest.mark.full


def test_detect_prints_a_table_and_draws(scene: Path, tmp_path: Path) -> None:
    done = retropole_here("detect", scene / "lidar0.pcd", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "2 poles" in done.stdout
    assert ElementTree.parse(tmp_path / "detect.svg").getroot().tag.endswith("}svg")
    as_json = retropole_here("detect", scene / "lidar0.pcd", "--out", tmp_path, "--json")
    assert len(json.loads(as_json.stdout)["poles"]) == 2


def test_detect_and_info_take_a_topic(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("retropole.report.detection.draw_detection", lambda *args, **named: None)
    done = retropole_here("detect", bag, "--topic", "/front", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "2 poles" in done.stdout
    done = retropole_here("info", bag)
    assert done.returncode == 0, done.stderr
    assert "/front" in done.stdout
    assert "/rear" in done.stdout
    document = json.loads(retropole_here("info", bag, "--topic", "/rear", "--json").stdout)
    assert document["schema"] == "retropole/info/1"
    assert [cloud["topic"] for cloud in document["clouds"]] == ["/rear"]


def test_what_is_left_out_of_a_long_recording_is_reported(dense: Path, tmp_path: Path) -> None:
    cloud = read_cloud(dense / "lidar0.pcd")
    for k in range(24):
        write_pcd(tmp_path / "many" / f"{k}.pcd", cloud)
    done = retropole_here("detect", "many", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    read = -(-24 // -(-24 * len(cloud) // 1_000_000))
    assert read < 24, "the clouds are large enough for frames to be left out"
    assert f"read {read} of 24 frames" in done.stderr
    assert json.loads(done.stdout)["input"]["points"] == read * len(cloud)
    done = retropole_here("detect", "many", "--json", "--frames", "3:5", cwd=tmp_path)
    assert json.loads(done.stdout)["input"]["points"] == 2 * len(cloud)
    assert "frames" not in done.stderr
