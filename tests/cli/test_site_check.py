"""``retropole site check`` as a user runs it: three LiDARs, one of which is moved."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from retropole.base import se3
from retropole.io import read_cloud, write_pcd
from tests.cli.commands import retropole_here

pytestmark = pytest.mark.full

NAMES = ("posts-1", "posts-2", "posts-3")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibrated site, its first placement again, and the same with a LiDAR turned by 1°."""
    folder = tmp_path_factory.mktemp("site")
    words = "simulate", "site", "posts", "--lidars", 3, "--seed", 1, "--out", folder / "first"
    assert retropole_here(*words, "--sensor", "VLP-16").returncode == 0
    done = retropole_here("site", "calibrate", folder / "first", "--out", folder / "out", "-q")
    assert done.returncode == 0, done.stderr
    turned = se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, np.radians(1.0)])), np.zeros(3))
    for name in ("same", "moved", "swapped"):
        (folder / name).mkdir()
        for lidar in NAMES:
            cloud = read_cloud(folder / "first" / f"{lidar}_1.pcd")
            # Another recording: not byte for byte the one of the calibration.
            cloud = cloud.select(np.arange(1, len(cloud)))
            if name == "moved" and lidar == "posts-3":
                cloud = replace(cloud, xyz=se3.apply(turned, cloud.xyz))
            write_pcd(folder / name / f"{lidar}.pcd", cloud)
        assert retropole_here("site", "init", folder / name).returncode == 0
    for lidar, other in (("posts-1", "posts-2"), ("posts-2", "posts-1")):
        shutil.copy(folder / "first" / f"{other}_1.pcd", folder / "swapped" / f"{lidar}.pcd")
    return folder


def test_the_same_recordings_stand(site: Path) -> None:
    done = retropole_here("site", "check", site / "out", site / "same")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("verdict: same\n")
    assert "posts-1, posts-3" in done.stdout
    assert "recordings_of_result" not in done.stdout


def test_the_recordings_of_the_calibration_prove_nothing(site: Path) -> None:
    done = retropole_here("site", "check", site / "out", site / "first")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "recordings_of_result: posts-1, posts-2; posts-1, posts-3" in done.stdout
    assert done.stdout.count("this is no check") == 1


def test_the_lidar_that_moved_is_named(site: Path) -> None:
    words = "site", "check", site / "out" / "site-result.json", site / "moved" / "site.toml"
    done = retropole_here(*words)
    assert done.returncode == 4, done.stdout + done.stderr
    assert "moved: posts-3; the others have not moved" in done.stdout
    done = retropole_here(*words, "--json")
    answer = json.loads(done.stdout)
    assert done.stdout.count("\n") == 1
    assert (answer["status"], answer["moved"], answer["untold"]) == ("moved", ["posts-3"], [])
    for pair in answer["pairs"]:
        is_off = "posts-3" in (pair["target"], pair["source"])
        assert pair["status"] == ("moved" if is_off else "same")
        if is_off:
            assert pair["moved_deg"] == pytest.approx(1.0, abs=0.1)


def test_the_check_of_a_pair_names_that_of_the_site(site: Path) -> None:
    files = site / "moved" / "posts-1.pcd", site / "moved" / "posts-3.pcd"
    done = retropole_here("check", site / "out", *files)
    assert done.returncode == 2
    assert "'retropole site check' checks them all" in done.stderr


def test_exchanged_files_and_other_names_are_told(site: Path, tmp_path: Path) -> None:
    done = retropole_here("site", "check", site / "out", site / "swapped")
    assert done.returncode == 3
    assert "is the file that the result has for" in " ".join(done.stdout.split())
    for k, name in enumerate(("left", "right")):
        shutil.copy(site / "same" / f"posts-{k + 1}.pcd", tmp_path / f"{name}.pcd")
    assert retropole_here("site", "init", tmp_path).returncode == 0
    done = retropole_here("site", "check", site / "out", tmp_path)
    assert done.returncode == 2
    assert "the result has posts-1, posts-2, posts-3: use these names" in done.stderr


def test_a_lidar_without_a_recording_is_not_told(site: Path, tmp_path: Path) -> None:
    for lidar in NAMES[:2]:
        shutil.copy(site / "same" / f"{lidar}.pcd", tmp_path)
    assert retropole_here("site", "init", tmp_path).returncode == 0
    done = retropole_here("site", "check", site / "out", tmp_path)
    assert done.returncode == 3
    assert "undecided whether moved: posts-3" in done.stdout


def test_help_has_worked_examples() -> None:
    done = retropole_here("site", "check", "--help")
    assert done.returncode == 0
    assert "retropole site check " in done.stdout.split("Examples:")[1]
