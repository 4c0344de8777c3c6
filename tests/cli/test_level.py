"""``retropole level`` as a user runs it."""

import json
from pathlib import Path

import numpy as np
import pytest

from retropole.base import se3
from retropole.simulation import simulate_pair, write_pair
from tests.cli.commands import retropole_here


@pytest.mark.full
def test_a_result_is_levelled(tmp_path: Path) -> None:
    pair = simulate_pair("street", np.random.default_rng(2), sensor_target="OS1")
    write_pair(pair, tmp_path)
    files = tmp_path / "lidar0.pcd", tmp_path / "lidar1.pcd"
    out = tmp_path / "out"
    assert retropole_here("calibrate", *files, "--out", out, "-q", "--level").returncode == 0
    at_once = json.loads((out / "level.json").read_text())["lidars"]
    done = retropole_here("level", out, "--base-link", "1.2,0.3,10")
    assert done.returncode == 0, done.stderr
    assert "Relative to the vertical" in done.stdout
    document = json.loads((out / "level.json").read_text())
    assert document["schema"] == "retropole/level/1"
    assert [each["height_m"] for each in document["lidars"]] == [e["height_m"] for e in at_once]
    for lidar, truth in zip(
        document["lidars"], (pair.T_world_target, pair.T_world_source), strict=True
    ):
        rpy = se3.rpy_from_rotation(truth[:3, :3])
        off = np.array([lidar["roll_rad"], lidar["pitch_rad"], lidar["height_m"]])
        off -= [*rpy[:2], truth[2, 3]]
        off[0] = (off[0] + np.pi) % (2 * np.pi) - np.pi
        # The region of three that holds all but one in ten thousand.
        assert off @ np.linalg.solve(lidar["roll_pitch_height"], off) < 21.1
    base = np.array(document["lidars"][0]["T_base_footprint_lidar"])
    assert np.allclose(base[:2, 3], [1.2, 0.3])
    assert np.degrees(se3.rpy_from_rotation(base[:3, :3])[2]) == pytest.approx(10.0)
    assert base[2, 3] == pytest.approx(document["lidars"][0]["height_m"])


def test_what_cannot_be_is_reported(tmp_path: Path) -> None:
    assert retropole_here("level", tmp_path / "none.json").returncode == 2
    done = retropole_here("level", tmp_path, "--base-link", "1,2")
    assert done.returncode == 2
    assert "X,Y,YAW_DEG" in done.stderr
    assert retropole_here("level", tmp_path, "--lidar", "a").returncode == 2
