"""``retropole plan`` as a user runs it, and what reads its plan."""

import json
from pathlib import Path

import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Array
from tests.cli.commands import retropole_here

DRAWN: tuple[object, ...] = ("--lidar", "a", "VLP-16", 0, 0, 1.5, 0, 5, 0)
DRAWN += ("--lidar", "b", "VLP-16", 1, 2, 1.5, 0, 5, 20)
SMALL = ("--allow", 4.6, -1.5, 5.0, -1.1, "--allow", 4.6, 0.6, 5.0, 1.0)


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plan")
    done = retropole_here("plan", *DRAWN, *SMALL, "--need-cm", 5, "--out", folder)
    assert done.returncode == 0, done.stderr
    assert "Pole A: " in done.stdout
    assert "Tape measure: below " in done.stdout
    assert "The need, within 5 cm at 30 m" in done.stdout
    return folder


def test_a_plan_is_a_document_and_a_page(plan: Path) -> None:
    document = json.loads((plan / "plan.json").read_text())
    assert document["schema"] == "retropole/plan/1"
    poles = document["placements"][0]["poles"]
    assert [pole["name"] for pole in poles] == ["A", "B"]
    for pole in poles:
        assert 4.6 <= pole["foot_m"][0] <= 5.2
        assert {seen["lidar"] for seen in pole["seen"]} == {"a", "b"}
    # On bare ground nothing confirms what two poles say.
    assert document["rehearsal"]["status"] != "ok"
    assert any("gave the verdict" in each for each in document["words"])
    page = (plan / "plan.html").read_text()
    assert page.lower().startswith("<!doctype html>")
    assert "http://" not in page.replace("http://www.w3.org", "")


@pytest.mark.full
def test_recordings_are_planned_with_a_rough_pose(
    dense: Path, truth: Array, tmp_path: Path
) -> None:
    """The street as it was recorded: that poles stand there already does not matter."""
    xyz, rpy = truth[:3, 3], np.degrees(se3.rpy_from_rotation(truth[:3, :3]))
    clouds = dense / "lidar0.pcd", dense / "lidar1.pcd"
    rough = ("--xyz", *np.round(xyz, 1), "--rpy-deg", *np.round(rpy))
    done = retropole_here("plan", *clouds, *rough, *SMALL, "--out", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert [lidar["name"] for lidar in document["lidars"]] == ["lidar0", "lidar1"]
    first, second = (np.array(each["T_place_lidar"]) for each in document["lidars"])
    apart = se3.difference(se3.inverse(first) @ second, truth)
    assert apart.rotation < np.radians(0.5)
    assert apart.translation < 0.05
    # What stands there is not what was planned.
    done = retropole_here("detect", clouds[0], "--plan", tmp_path, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "plan: as seen by lidar0" in done.stderr
    done = retropole_here("calibrate", *clouds, "--plan", tmp_path, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "plan: error at 30 m: " in done.stderr
    wrong = ("--xyz", *np.round(xyz, 1), "--rpy-deg", *np.round(rpy + np.array([0, 0, 40])))
    done = retropole_here("plan", *clouds, *wrong, "--out", tmp_path)
    assert done.returncode == 3
    assert "refused (pose_contradicted)" in done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "give TARGET and SOURCE"),
        (("a.pcd",), "SOURCE is needed"),
        (("a.pcd", "b.pcd", "--xyz", 0, 0, 0), "--xyz and --rpy-deg together"),
        (("a.pcd", "b.pcd", "--at-m", 30), "give both"),
        (("a.pcd", "b.pcd", "--box", 1, 1, 1, 1, 1), "--box draws"),
        (("--lidar", "a", "XT32", 0, 0, 2, 0, 0, 0), "two LiDARs at least"),
        (("--lidar", "a", "XT33", *[0] * 6, "--lidar", "b", "XT32", *[1] * 6), "XT33"),
        (("a.pcd", "b.pcd"), "a.pcd"),
    ],
)
def test_slips_are_told(words: tuple[object, ...], said: str, tmp_path: Path) -> None:
    done = retropole_here("plan", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert not (tmp_path / "retropole-plan").exists()


def test_a_file_that_is_no_plan_is_told(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "plan.json").write_text("{}")
    done = retropole_here("detect", scene / "lidar0.pcd", "--plan", tmp_path, cwd=tmp_path)
    assert done.returncode == 2
    assert "no plan" in done.stderr


def test_no_ground_is_refused(tmp_path: Path) -> None:
    done = retropole_here("plan", *DRAWN, "--allow", 90, 90, 95, 95, cwd=tmp_path)
    assert done.returncode == 3
    assert "refused (no_ground)" in done.stderr
