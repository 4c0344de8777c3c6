"""``retropole evaluate`` as a user runs it."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.cli.commands import retropole_here

pytestmark = pytest.mark.full


def test_evaluate_prefers_the_truth(scene: Path, tmp_path: Path) -> None:
    truth = scene / "truth.json"
    wrong = np.array(json.loads(truth.read_text())["T_target_source"])
    wrong[0, 3] += 0.2
    clouds = scene / "lidar0.pcd", scene / "lidar1.pcd"
    np.savetxt(tmp_path / "wrong.txt", wrong)
    scores = []
    for file in (truth, tmp_path / "wrong.txt"):
        done = retropole_here("evaluate", *clouds, "--transform", file, "--truth", truth, "--json")
        assert done.returncode == 0, done.stderr
        scores.append(json.loads(done.stdout))
    right, off = scores
    assert right["e_rt_m"] == pytest.approx(0.0, abs=1e-9)
    assert off["e_rt_m"] == pytest.approx(0.2)
    assert off["translation_error_m"] == pytest.approx(0.2)
    assert right["rqe_sum"] > off["rqe_sum"]
    assert right["plane_residual_m"] < off["plane_residual_m"]
    found = right["confirmation"]
    assert found["agreeing"] > 100
    assert found["contradicted"] == found["contradicting"] / (
        found["agreeing"] + found["contradicting"]
    )
    done = retropole_here("evaluate", *clouds, "--transform", truth)
    assert (
        f"{found['agreeing']:,} patches agree, {found['contradicting']} contradict" in done.stdout
    )


def test_files_of_the_result_the_other_way_round_are_told(scene: Path, tmp_path: Path) -> None:
    clouds = scene / "lidar0.pcd", scene / "lidar1.pcd"
    assert retropole_here("calibrate", *clouds, "--out", tmp_path, "-q").returncode == 0
    for result in (tmp_path, tmp_path / "result.json"):
        done = retropole_here("evaluate", *clouds[::-1], "--transform", result)
        assert done.returncode == 2
        assert "TARGET and SOURCE are swapped" in done.stderr
        assert "give them the other way round" in done.stderr
    assert retropole_here("evaluate", *clouds, "--transform", tmp_path).returncode == 0


def test_evaluate_refuses_a_transform_that_is_none(scene: Path, tmp_path: Path) -> None:
    np.savetxt(tmp_path / "scaled.txt", np.diag([2.0, 2.0, 2.0, 1.0]))
    clouds = scene / "lidar0.pcd", scene / "lidar1.pcd"
    done = retropole_here("evaluate", *clouds, "--transform", tmp_path / "scaled.txt")
    assert done.returncode == 2
    assert "scaled.txt" in done.stderr
