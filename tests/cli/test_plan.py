"""``retropole plan`` as a user runs it, and what reads its plan."""

import json
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from retropole.api import planning
from retropole.api.plan_checking import load_plan
from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.cli import run
from retropole.planning.place import Station
from retropole.planning.planner import Planned
from retropole.result import encode
from tests.cli.commands import retropole_here
from tests.planning.places import planned
from tests.report.plans import made_picture, made_plan

DRAWN: tuple[object, ...] = ("--lidar", "a", "VLP-16", 0, 0, 1.5, 0, 5, 0)
DRAWN += ("--lidar", "b", "VLP-16", 1, 2, 1.5, 0, 5, 20)
SMALL = ("--allow", 4.6, -1.5, 5.0, -1.1, "--allow", 4.6, 0.6, 5.0, 1.0)


@pytest.mark.full
def test_a_plan_is_a_document_and_a_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """LiDARs that are drawn as they were asked for, and a plan that was made for others."""
    asked: dict[str, Any] = {}

    def made(stations: tuple[Station, ...], **options: Any) -> Planned:
        asked.update(options, stations=stations)
        return planned()

    words = ("plan", *DRAWN, *SMALL, "--need-cm", 5, "--poles", 3, "--out", tmp_path)
    with patch.object(planning, "plan_poles", made):
        assert run([str(word) for word in words]) == 0
    first, second = asked["stations"]
    np.testing.assert_allclose(second.at - first.at, [1.0, 2.0, 0.0], atol=0.05)
    assert (asked["poles"], asked["placements"], asked["need"].within) == (3, 1, 0.05)
    assert [area.low.tolist() for area in asked["allowed"]] == [[4.6, -1.5], [4.6, 0.6]]
    shown = capsys.readouterr().out
    for said in ("Pole A: ", "Tape measure: below ", "The need, within 5 cm at 30 m"):
        assert said in shown
    document = load_plan(tmp_path)
    assert [pole.name for pole in document.placements[0].poles] == ["A", "B"]
    page = (tmp_path / "plan.html").read_text()
    assert page.lower().startswith("<!doctype html>")
    assert "http://" not in page.replace("http://www.w3.org", "")


@pytest.mark.full
def test_drawn_lidars_are_planned(tmp_path: Path) -> None:
    done = retropole_here("plan", *DRAWN, *SMALL, "--need-cm", 5, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    document = load_plan(tmp_path)
    for pole in document.placements[0].poles:
        assert 4.6 <= pole.foot_m[0] <= 5.2
        assert {seen.lidar for seen in pole.seen} == {"a", "b"}
    # On bare ground nothing confirms what two poles say.
    assert document.rehearsal is not None
    assert document.rehearsal.status != "ok"
    assert any("gave the verdict" in each for each in document.words)
    # Each was rehearsed: it is worth it where its verdict is better.
    assert all(each.status is not None for each in document.more)


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
        (("a.pcd", "b.pcd", "--box", 1, 1, 1, 1, 1), "--box describes"),
        (("--lidar", "a", "XT32", 0, 0, 2, 0, 0, 0), "at least two LiDARs"),
        (("--lidar", "a", "XT33", *[0] * 6, "--lidar", "b", "XT32", *[1] * 6), "XT33"),
        (("a.pcd", "b.pcd"), "a.pcd"),
    ],
)
def test_slips_are_reported(
    words: tuple[object, ...],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["plan", *map(str, words)]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "retropole-plan").exists()


@pytest.mark.parametrize("command", ["calibrate", "detect", "watch"])
@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("predicted", [], "predicted: 0 LiDARs"),
        ("lidars", [], "lidars"),
        ("schema", "x", "no plan of poles"),
        ("", "", "no LiDAR"),
    ],
)
def test_a_plan_that_does_not_fit_ends_before_the_work(
    command: str,
    field: str,
    value: Any,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The recordings are none: nothing was read when the plan was refused."""
    document = json.loads(encode(made_plan(made_picture(lidars=3 if not field else 2))))
    if field:
        document[field] = value
    elif command == "calibrate":
        said = "a plan of 3 LiDARs"
    (tmp_path / "plan.json").write_text(json.dumps(document))
    clouds = [tmp_path / name for name in ("a.pcd", "b.pcd")]
    for cloud in clouds:
        cloud.write_text("no cloud")
    given = clouds[:1] if command == "detect" else clouds
    words = [command, *given, "--plan", tmp_path / "plan.json", "--out", tmp_path / "out"]
    words += ["--lidar", "nobody"] if command == "detect" and not field else []
    words += ["--no-page"] if command == "watch" else []
    assert run([str(word) for word in words]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_no_ground_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("plan", *DRAWN, "--allow", 90, 90, 95, 95, "--out", tmp_path / "plan")
    assert run([str(word) for word in words]) == 3
    assert "refused (no_ground)" in capsys.readouterr().err
    assert not (tmp_path / "plan").exists()
