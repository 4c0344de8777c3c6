"""``--max-points``: what is left out is said, changes the pose little, and nothing below it."""

import json
from pathlib import Path

import numpy as np
import pytest

import retropole as rp
from retropole.base import se3
from retropole.base.datatypes import PointCloud
from retropole.base.errors import UsageError
from retropole.io import write_pcd
from tests.api.test_calibration import answer_of
from tests.cli.commands import retropole_here
from tests.tiers import first_of

Clouds = tuple[PointCloud, PointCloud]


@pytest.mark.full
def test_below_the_limit_nothing_changes(clouds: Clouds) -> None:
    expected = rp.calibrate(*clouds)
    same = rp.calibrate(*clouds, options=rp.RunConfig(max_points=max(map(len, clouds))))
    assert answer_of(same.document) == answer_of(expected.document)
    assert [item.thinned for item in same.document.inputs] == [0, 0]


@pytest.mark.parametrize("part", first_of([0.5, 0.25]))
@pytest.mark.full
def test_a_thinned_cloud_gives_the_same_pose(clouds: Clouds, part: float) -> None:
    expected = rp.calibrate(*clouds)
    most = int(part * min(map(len, clouds)))
    thinned = rp.calibrate(*clouds, options=rp.RunConfig(max_points=most))
    assert [item.points for item in thinned.document.inputs] == [most, most]
    assert thinned.T_target_source is not None
    assert expected.T_target_source is not None
    apart = se3.difference(thinned.T_target_source, expected.T_target_source)
    assert np.degrees(apart.rotation) < 0.05
    assert apart.translation < 0.01
    # The returns on poles are left out last.
    for lidar in ("target", "source"):
        before, after = (
            [pole.points for pole in getattr(each.document.poles, lidar)]
            for each in (expected, thinned)
        )
        assert len(after) == len(before)
        assert min(0.9, 2 * part) * sum(before) <= sum(after) <= sum(before)


@pytest.mark.full
def test_what_is_thinned_is_reported_and_recorded(
    scene: Path, clouds: Clouds, tmp_path: Path
) -> None:
    words = ["calibrate", scene / "lidar0.pcd", scene / "lidar1.pcd", "--out", tmp_path]
    done = retropole_here(*words, "--max-points", 20_000, "-v")
    assert done.returncode == 0, done.stderr
    told = " ".join(done.stdout.split())
    for k, cloud in enumerate(clouds):
        assert f"lidar{k}.pcd: downsampled from {len(cloud):,} to 20,000 points" in done.stderr
        assert f"{len(cloud) - 20_000:,} points left out as too many" in told
    result = json.loads((tmp_path / "result.json").read_text())
    assert [item["thinned"] for item in result["inputs"]] == [len(c) - 20_000 for c in clouds]
    assert result["config"]["max_points"] == 20_000
    assert "points left out as too many" in (tmp_path / "report.html").read_text()
    assert "downsampled" not in retropole_here(*words, "--max-points", 20_000, "-q").stderr
    assert retropole_here(*words, "--max-points", 999).returncode == 2
    with pytest.raises(
        UsageError, match="max_points is 999, expected a number from 1000 to 9007199254740992"
    ):
        rp.calibrate(*clouds, options=rp.RunConfig(max_points=999))


@pytest.mark.full
def test_frames_that_are_left_out_are_reported(clouds: Clouds, tmp_path: Path) -> None:
    few = clouds[0].select(np.arange(0, len(clouds[0]), 50))
    for k in range(30):
        write_pcd(tmp_path / "many" / f"{k}.pcd", few)
    words = ["detect", tmp_path / "many", "--json", "--out", tmp_path, "--frames", ":"]
    done = retropole_here(*words, "--max-points", 20 * len(few))
    assert "read 15 of 30 frames, one in 2, " in done.stderr
    assert json.loads(done.stdout)["input"]["frames_left_out"] == 15
    assert "frames" not in retropole_here(*words).stderr


@pytest.mark.full
def test_a_stored_run_with_no_limit_named_has_the_default(scene: Path, tmp_path: Path) -> None:
    words = ["calibrate", scene / "lidar0.pcd", scene / "lidar1.pcd", "--out", tmp_path, "-q"]
    assert retropole_here(*words, "--no-refine").returncode == 0
    result = json.loads((tmp_path / "result.json").read_text())
    del result["config"]["max_points"]
    for item in result["inputs"]:
        del item["thinned"], item["frames_left_out"]
    (tmp_path / "result.json").write_text(json.dumps(result))
    assert retropole_here("report", tmp_path, "-q").returncode == 0
    result["config"]["max_points"] = 0
    (tmp_path / "result.json").write_text(json.dumps(result))
    done = retropole_here("report", tmp_path)
    assert done.returncode == 2
    assert "max_points" in done.stderr
